//! Several pictures on one, each under a tag, for models that accept few pictures.

use super::collage::{Area, SHEET, draw_tag, paste};
use image::RgbImage;

/// Height of a tag, pixels: letters stay readable however small the pictures become.
const TAG_PX: u32 = 28;
const GAP_PX: u32 = 6;

/// Pictures on one picture.
#[derive(Debug, Clone, PartialEq)]
pub struct CombinedPicture {
    /// All pictures with their tags.
    pub picture: RgbImage,
    /// Where each picture is, in their order: left, top, width, height, pixels.
    pub areas: Vec<Area>,
}

/// Puts pictures on one picture, row by row, each under its tag. They are reduced by a common factor
/// where the longer side would otherwise exceed `max_side_px`.
#[must_use]
pub fn combine_pictures(pictures: &[(String, RgbImage)], max_side_px: u32) -> CombinedPicture {
    let sizes: Vec<(u32, u32)> = pictures.iter().map(|(_, picture)| picture.dimensions()).collect();
    // The number of columns that gives the least longer side.
    let columns = (1..=sizes.len().max(1))
        .min_by_key(|&columns| {
            let (width, height) = arrange(&sizes, columns).0;
            width.max(height)
        })
        .unwrap_or(1);
    let rows = sizes.len().div_ceil(columns) as u32;
    let ((width, height), _) = arrange(&sizes, columns);
    // Tags and gaps are not reduced.
    let share = |length: u32, fixed: u32| {
        max_side_px.saturating_sub(fixed) as f32 / length.saturating_sub(fixed).max(1) as f32
    };
    let scale = share(width, columns as u32 * GAP_PX).min(share(height, rows * (TAG_PX + GAP_PX)));
    let reduced = |length: u32| ((length as f32 * scale.min(1.0)) as u32).max(1);
    let sizes: Vec<(u32, u32)> = sizes.iter().map(|&(w, h)| (reduced(w), reduced(h))).collect();
    let ((width, height), areas) = arrange(&sizes, columns);
    let mut sheet = RgbImage::from_pixel(width.max(1), height.max(1), SHEET);
    for ((tag, picture), &area) in pictures.iter().zip(&areas) {
        draw_tag(&mut sheet, (area.0, area.1 - TAG_PX), TAG_PX, tag);
        paste(&mut sheet, picture, area);
    }
    CombinedPicture { picture: sheet, areas }
}

/// Returns the size of the whole and the area of each picture, in rows of `columns`.
fn arrange(sizes: &[(u32, u32)], columns: usize) -> ((u32, u32), Vec<Area>) {
    let (mut areas, mut whole, mut top) = (Vec::new(), (0, 0), 0);
    for row in sizes.chunks(columns) {
        let mut left = 0;
        for &(width, height) in row {
            areas.push((left, top + TAG_PX, width, height));
            left += width + GAP_PX;
        }
        top += TAG_PX + row.iter().map(|(_, height)| *height).max().unwrap_or(0) + GAP_PX;
        whole = (whole.0.max(left), top);
    }
    (whole, areas)
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Rgb;

    fn pictures(sizes: &[(u32, u32)]) -> Vec<(String, RgbImage)> {
        let color = |i: usize| Rgb([40 + 20 * i as u8, 200, 60]);
        let picture = |(i, &(w, h)): (usize, &(u32, u32))| {
            (format!("Image {}", i + 1), RgbImage::from_pixel(w, h, color(i)))
        };
        sizes.iter().enumerate().map(picture).collect()
    }

    #[test]
    fn every_picture_is_whole_under_a_tag() {
        let sizes = [(1120, 1120), (1023, 512), (768, 512), (512, 512), (768, 576)];
        for max_side_px in [700, 1600, 4096] {
            let CombinedPicture { picture, areas } =
                combine_pictures(&pictures(&sizes), max_side_px);
            let (width, height) = picture.dimensions();
            assert!(width.max(height) <= max_side_px, "{width} x {height}");
            assert!(width.max(height) < 2 * width.min(height), "{width} x {height}");
            for (i, ((left, top, w, h), (of_w, of_h))) in areas.into_iter().zip(sizes).enumerate() {
                let middle = picture.get_pixel(left + w / 2, top + h / 2);
                assert_eq!(*middle, Rgb([40 + 20 * i as u8, 200, 60]));
                assert!(left + w <= width && top + h <= height && top >= TAG_PX);
                let (now, before) = (w as f32 / h as f32, of_w as f32 / of_h as f32);
                assert!((now / before - 1.0).abs() < 0.03, "{now} {before}");
                let letters =
                    (left..left + w.min(60)).flat_map(|x| (top - TAG_PX..top).map(move |y| (x, y)));
                assert!(letters.filter(|&(x, y)| picture.get_pixel(x, y).0[0] > 200).count() > 20);
            }
        }
    }

    #[test]
    fn no_pictures_give_an_empty_sheet() {
        assert_eq!(combine_pictures(&[], 512).picture.dimensions(), (1, 1));
    }
}
