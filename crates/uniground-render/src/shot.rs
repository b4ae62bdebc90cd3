//! A photograph as evidence: the whole of it, a crop of its subject, and the mask of the subject in
//! both.

use image::{RgbImage, imageops};
use uniground_geometry::scene::{CellMask, FrameIndex, View};

/// One photograph that shows a candidate.
#[derive(Debug, Clone, PartialEq)]
pub struct Shot {
    /// The candidate with a margin.
    pub crop: RgbImage,
    /// The photograph as taken, or with its box already drawn.
    pub frame: RgbImage,
    /// Position of the candidate in `frame`: left, top, right, bottom as shares of its width and
    /// height.
    pub place: [f32; 4],
    /// Mask of the candidate within `place`, and the position of that place in `crop`; `None` if it
    /// is not known, or already drawn.
    pub mask: Option<(CellMask, [f32; 4])>,
    /// The frame the photograph was taken with, and the part of it that `crop` shows (left, top,
    /// right, bottom, pixels); `None` for other pictures.
    pub taken: Option<(FrameIndex, [u32; 4])>,
}

/// Margin of a crop around the tight box on each side, as a share of the box's width and height, so
/// that the object is not cut off.
const CROP_MARGIN: f32 = 0.1;
/// Minimum size of a crop each way, pixels, if the photograph is that large: small objects are
/// recognized by their surroundings.
const LEAST_CROP_PX: u32 = 224;

impl Shot {
    /// Creates a shot from existing pictures: a crop, and the photograph with its box at `box_px`
    /// (left, top, right, bottom, pixels).
    #[must_use]
    pub fn new(crop: RgbImage, frame: RgbImage, box_px: [u32; 4]) -> Self {
        let place = to_area_shares(box_px, [0, 0, frame.width(), frame.height()]);
        Self { crop, frame, place, mask: None, taken: None }
    }

    /// Creates a shot of a view and its photograph.
    #[must_use]
    pub fn from_view(photograph: RgbImage, view: &View) -> Self {
        let area = crop_area(view.box_px, photograph.dimensions());
        let crop = cut_out_area(&photograph, area);
        let mask = view
            .mask
            .as_ref()
            .and_then(CellMask::from_view_mask)
            .map(|mask| (mask, to_area_shares(view.box_px, area)));
        Self { mask, taken: Some((view.frame, area)), ..Self::new(crop, photograph, view.box_px) }
    }

    /// Returns the number of pixels of the photograph that show the candidate; without a mask,
    /// those of its box.
    #[must_use]
    pub fn covered_px(&self) -> f32 {
        let [left, top, right, bottom] = self.place;
        let share = self.mask.as_ref().map_or(1.0, |(mask, _)| mask.share());
        (right - left)
            * self.frame.width() as f32
            * (bottom - top)
            * self.frame.height() as f32
            * share
    }
}

/// Returns the part of a photograph to crop for a box (left, top, right, bottom, pixels): with a
/// margin, and large enough to recognize the object.
#[must_use]
pub fn crop_area([left, top, right, bottom]: [u32; 4], (width, height): (u32, u32)) -> [u32; 4] {
    let along = |low: u32, high: u32, length: u32| {
        let margin = (high.saturating_sub(low) as f32 * CROP_MARGIN) as u32;
        let (low, high) =
            (low.min(length.saturating_sub(1)).saturating_sub(margin), (high + margin).min(length));
        let least = LEAST_CROP_PX.min(length);
        let missing = least.saturating_sub(high.saturating_sub(low));
        if missing == 0 {
            return (low, high);
        }
        // Space that is missing on one side is taken from the other.
        let high = (low.saturating_sub(missing / 2) + least).min(length);
        (high - least, high)
    };
    let ((x, x2), (y, y2)) = (along(left, right, width), along(top, bottom, height));
    [x, y, x2, y2]
}

/// Cuts out an area of a photograph (left, top, right, bottom, pixels).
#[must_use]
pub fn cut_out_area(photograph: &RgbImage, [left, top, right, bottom]: [u32; 4]) -> RgbImage {
    imageops::crop_imm(photograph, left, top, (right - left).max(1), (bottom - top).max(1))
        .to_image()
}

/// Converts a box to shares of an area, both in pixels of one picture.
#[must_use]
pub fn to_area_shares(box_px: [u32; 4], [left, top, right, bottom]: [u32; 4]) -> [f32; 4] {
    let [l, t, r, b] = box_px.map(|v| v as f32);
    let (x, y) = (left as f32, top as f32);
    let (width, height) = ((right - left).max(1) as f32, (bottom - top).max(1) as f32);
    [(l - x) / width, (t - y) / height, (r - x) / width, (b - y) / height]
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use uniground_geometry::scene::FrameIndex;

    proptest! {
        /// Whatever the box, its crop contains it, lies in the photograph, and has 224 pixels each
        /// way if the photograph is that large.
        #[test]
        fn crop_contains_its_box_and_has_the_minimum_size(
            (width, height) in (1..900_u32, 1..700_u32), low in (0.0..1.0_f32, 0.0..1.0_f32), size in (0.0..1.0_f32, 0.0..1.0_f32),
        ) {
            let span = |low: f32, size: f32, length: u32| {
                let low = ((low * length as f32) as u32).min(length - 1);
                (low, low + 1 + (size * (length - low - 1) as f32) as u32)
            };
            let ((left, right), (top, bottom)) = (span(low.0, size.0, width), span(low.1, size.1, height));
            let [x, y, x2, y2] = crop_area([left, top, right, bottom], (width, height));
            prop_assert!(x <= left && right <= x2 && x2 <= width && y <= top && bottom <= y2 && y2 <= height);
            prop_assert!(x2 - x >= LEAST_CROP_PX.min(width) && y2 - y >= LEAST_CROP_PX.min(height));
            prop_assert!(x2 - x <= (right - left) * 12 / 10 + LEAST_CROP_PX);
        }
    }

    #[test]
    fn large_boxes_get_a_ten_percent_margin_and_small_ones_224_pixels() {
        assert_eq!(crop_area([100, 100, 400, 340], (640, 480)), [70, 76, 430, 364]);
        assert_eq!(crop_area([300, 200, 320, 230], (640, 480)), [198, 103, 422, 327]);
        assert_eq!(
            crop_area([0, 460, 20, 480], (640, 480)),
            [0, 256, 224, 480],
            "at the border, the crop extends to the other side"
        );
    }

    #[test]
    fn shot_locates_its_object_in_crop_and_frame() {
        let mask = CellMask::from_fn(10, 10, |column, _| column < 5);
        let view = View {
            frame: FrameIndex(0),
            visible_points: 9,
            box_px: [300, 200, 320, 230],
            mask: Some(mask.to_view_mask()),
        };
        let shot = Shot::from_view(RgbImage::new(640, 480), &view);
        assert_eq!((shot.crop.dimensions(), shot.frame.dimensions()), ((224, 224), (640, 480)));
        let (unpacked, [left, top, right, bottom]) = shot.mask.clone().unwrap();
        assert_eq!((unpacked, left, right), (mask, 102.0 / 224.0, 122.0 / 224.0));
        assert!((top - 97.0 / 224.0).abs() < 1e-6 && (bottom - 127.0 / 224.0).abs() < 1e-6);
        assert!((shot.covered_px() - 300.0).abs() < 0.1);
    }
}
