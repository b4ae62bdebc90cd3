//! Encodes pictures as JPEG.

use image::RgbImage;
use jpeg_encoder::{ColorType, Encoder};

const QUALITY: u8 = 85;

/// Encodes a picture. Returns an empty file for more than 65,535 pixels per side, which JPEG does
/// not support.
#[must_use]
pub fn encode_jpeg(image: &RgbImage) -> Vec<u8> {
    let mut bytes = Vec::new();
    let (Ok(width), Ok(height)) = (u16::try_from(image.width()), u16::try_from(image.height()))
    else {
        tracing::warn!(
            width = image.width(),
            height = image.height(),
            "image is too large for JPEG"
        );
        return bytes;
    };
    if let Err(error) =
        Encoder::new(&mut bytes, QUALITY).encode(image.as_raw(), width, height, ColorType::Rgb)
    {
        tracing::warn!(%error, width, height, "image could not be encoded");
        bytes.clear();
    }
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn encoded_picture_decodes_to_nearly_the_same_pixels() {
        let picture = RgbImage::from_fn(64, 48, |x, y| image::Rgb([x as u8 * 3, y as u8 * 4, 90]));
        let decoded = image::load_from_memory(&encode_jpeg(&picture)).unwrap().into_rgb8();
        let worst = picture.iter().zip(decoded.iter()).map(|(a, b)| a.abs_diff(*b)).max();
        assert!(worst.is_some_and(|d| d < 24), "{worst:?}");
    }

    #[test]
    fn picture_too_large_for_jpeg_gives_an_empty_file() {
        assert!(encode_jpeg(&RgbImage::new(70_000, 1)).is_empty());
    }
}
