//! Text in pictures, with an embedded font (Noto Sans Bold, Latin; OFL).

use ab_glyph::{Font, FontRef, Glyph, PxScale, ScaleFont, point};
use image::{Rgb, RgbImage};
use std::sync::LazyLock;

static FONT: LazyLock<Option<FontRef<'static>>> = LazyLock::new(|| {
    FontRef::try_from_slice(include_bytes!("../assets/fonts/NotoSans-Bold-latin.ttf")).ok()
});

/// Returns the width of a line of text at a size in pixels.
pub(super) fn width(text: &str, size_px: f32) -> f32 {
    lay_out_glyphs(text, size_px).1
}

/// Draws a line of text with its top left corner at `(x, y)`.
pub(super) fn draw(
    picture: &mut RgbImage,
    text: &str,
    x: f32,
    y: f32,
    size_px: f32,
    color: Rgb<u8>,
) {
    let Some(font) = FONT.as_ref() else { return };
    for mut glyph in lay_out_glyphs(text, size_px).0 {
        glyph.position += point(x, y);
        let Some(outline) = font.outline_glyph(glyph) else { continue };
        let bounds = outline.px_bounds();
        outline.draw(|column, row, coverage| {
            let (u, v) =
                (bounds.min.x as i64 + i64::from(column), bounds.min.y as i64 + i64::from(row));
            let inside = u >= 0
                && v >= 0
                && u < i64::from(picture.width())
                && v < i64::from(picture.height());
            if inside {
                let below = picture.get_pixel_mut(u as u32, v as u32);
                for (channel, ink) in below.0.iter_mut().zip(color.0) {
                    *channel = (f32::from(*channel)
                        + (f32::from(ink) - f32::from(*channel)) * coverage.min(1.0))
                    .round() as u8;
                }
            }
        });
    }
}

/// Returns glyphs from the origin, with the baseline set so that the line starts at its top; and
/// the advance.
fn lay_out_glyphs(text: &str, size_px: f32) -> (Vec<Glyph>, f32) {
    let Some(font) = FONT.as_ref() else { return (Vec::new(), 0.0) };
    let scaled = font.as_scaled(PxScale::from(size_px));
    let mut advance = 0.0;
    let glyphs = text
        .chars()
        .map(|c| {
            let id = font.glyph_id(c);
            let glyph =
                id.with_scale_and_position(PxScale::from(size_px), point(advance, scaled.ascent()));
            advance += scaled.h_advance(id);
            glyph
        })
        .collect();
    (glyphs, advance)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_is_drawn_and_clipped_to_the_picture() {
        let mut picture = RgbImage::new(120, 40);
        draw(&mut picture, "22 sofa", 5.0, 5.0, 20.0, Rgb([255, 255, 255]));
        let ink = picture.pixels().filter(|p| p.0[0] > 128).count();
        assert!((200..2000).contains(&ink), "{ink} bright pixels");
        assert!(width("22 sofa", 20.0) > 50.0 && width("22 sofa", 20.0) < 110.0);
        draw(&mut picture, "off the picture", -50.0, 35.0, 20.0, Rgb([255, 0, 0]));
    }
}
