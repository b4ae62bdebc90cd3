//! Estimates the tokens of a request before it is sent, for budgets and for figures without a
//! model.

use super::{ChatRequest, Part};

/// Estimated tokens of a request: English text at four characters per token, pictures by the tiles
/// that common providers document (512 x 512 pixels after fitting into 2048 x 2048 with the shorter
/// side at most 768: 85 + 170 per tile).
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Tokens {
    /// Tokens of all text, including the system message.
    pub text: u64,
    /// Tokens of all pictures.
    pub pictures: u64,
}

const CHARS_PER_TOKEN: u64 = 4;
const PICTURE: u64 = 85;
const TILE: u64 = 170;

impl Tokens {
    /// Estimates the tokens of a request. Its schema is not counted.
    #[must_use]
    pub fn estimate(request: &ChatRequest) -> Self {
        let mut tokens = Self { text: text_tokens(&request.system), pictures: 0 };
        for part in &request.user {
            match part {
                Part::Text(words) => tokens.text += text_tokens(words),
                Part::Picture(picture) => {
                    tokens.pictures += self::picture_tokens(picture.width, picture.height);
                }
            }
        }
        tokens
    }

    /// Estimates the tokens of a text.
    #[must_use]
    pub fn estimate_text(words: &str) -> u64 {
        text_tokens(words)
    }

    /// Returns the sum of text and picture tokens.
    #[must_use]
    pub fn total(self) -> u64 {
        self.text + self.pictures
    }
}

fn text_tokens(words: &str) -> u64 {
    (words.chars().count() as u64).div_ceil(CHARS_PER_TOKEN)
}

fn picture_tokens(width: u32, height: u32) -> u64 {
    let (width, height) = (f64::from(width.max(1)), f64::from(height.max(1)));
    let fit = (2048.0 / width.max(height)).min(1.0);
    let fit = fit * (768.0 / (width.min(height) * fit)).min(1.0);
    let tiles = |side: f64| (side * fit / 512.0).ceil() as u64;
    PICTURE + TILE * tiles(width) * tiles(height)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Figures from the provider's own documentation.
    #[test]
    fn pictures_are_counted_in_tiles() {
        assert_eq!(picture_tokens(1024, 1024), 765);
        assert_eq!(picture_tokens(2048, 4096), 1105);
        assert_eq!(picture_tokens(512, 512), 255);
        assert_eq!(picture_tokens(2048, 680), 85 + 170 * 8);
    }
}
