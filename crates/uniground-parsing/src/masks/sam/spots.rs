//! Chooses the points at which a segmenter is prompted.

use super::super::IdImage;
use super::{GRID, MaskCandidate};
use uniground_geometry::scene::Frame;

/// A prompt point, and the condition that makes the prompt unnecessary.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct PromptPoint {
    /// Column and row in the picture.
    pub(super) at: (f32, f32),
    unless: SkipCondition,
}

/// Which existing mask at a point makes its prompt unnecessary.
#[derive(Debug, Clone, Copy, PartialEq)]
enum SkipCondition {
    /// No mask: always prompt.
    Never,
    /// Any mask.
    Any,
    /// A mask of about this share of the picture.
    OfSize(f32),
}

/// A mask up to this many times larger or smaller than a segment shows the same thing.
const SAME_SIZE: f32 = 2.0;

impl PromptPoint {
    /// Returns whether the existing masks make this prompt unnecessary. Its window must be the
    /// whole picture, or the condition [`SkipCondition::Never`].
    pub(super) fn is_answered(&self, picture: (u32, u32), found: &[MaskCandidate]) -> bool {
        let fits = |mask: &MaskCandidate| match self.unless {
            SkipCondition::Never => false,
            SkipCondition::Any => true,
            SkipCondition::OfSize(share) => {
                let ratio = mask.area as f32 / (GRID * GRID) as f32 / share;
                (1.0 / SAME_SIZE..=SAME_SIZE).contains(&ratio)
            }
        };
        found.iter().any(|mask| fits(mask) && mask.contains_pixel(self.at, picture))
    }
}

/// Returns a grid of prompt points over a picture, row by row: always prompted, or only where no
/// mask exists.
pub(super) fn grid_points(
    (width, height): (u32, u32),
    per_side: u32,
    always: bool,
) -> Vec<PromptPoint> {
    let at = |i: u32, length: u32| (i as f32 + 0.5) * length as f32 / per_side as f32 - 0.5;
    let unless = if always { SkipCondition::Never } else { SkipCondition::Any };
    (0..per_side * per_side)
        .map(|i| PromptPoint { at: (at(i % per_side, width), at(i / per_side, height)), unless })
        .collect()
}

/// Returns the centers of segments that are not specks, the largest segment first. The center is
/// the pixel farthest from the segment's border.
pub(super) fn segment_centers(
    segments: &IdImage,
    frame: &Frame,
    min_share: f32,
) -> Vec<PromptPoint> {
    struct SegmentInfo {
        pixels: u32,
        middle: (u32, usize),
    }
    let inward = distance_to_border(segments);
    let mut found: Vec<Option<SegmentInfo>> = Vec::new();
    for (i, (&id, &distance)) in
        segments.ids.iter().zip(&inward).enumerate().filter(|(_, (id, _))| **id != 0)
    {
        let id = usize::from(id);
        if found.len() <= id {
            found.resize_with(id + 1, || None);
        }
        let segment = found[id].get_or_insert(SegmentInfo { pixels: 0, middle: (0, i) });
        segment.pixels += 1;
        if distance > segment.middle.0 {
            segment.middle = (distance, i);
        }
    }
    let total = segments.ids.len() as f32;
    let mut segments_found: Vec<SegmentInfo> =
        found.into_iter().flatten().filter(|s| s.pixels as f32 >= min_share * total).collect();
    segments_found.sort_by_key(|s| (std::cmp::Reverse(s.pixels), s.middle.1));
    let width = segments.width as usize;
    segments_found
        .into_iter()
        .map(|s| {
            let at = frame.color_position((s.middle.1 % width) as f32, (s.middle.1 / width) as f32);
            PromptPoint { at, unless: SkipCondition::OfSize(s.pixels as f32 / total) }
        })
        .filter(|spot| {
            let inside = |at: f32, length: u32| at > -0.5 && at < length as f32 - 0.5;
            inside(spot.at.0, frame.color.width()) && inside(spot.at.1, frame.color.height())
        })
        .collect()
}

/// Returns the distance of each pixel to the nearest pixel of another id or to the picture's
/// border, in thirds of a pixel (chamfer 3-4).
fn distance_to_border(segments: &IdImage) -> Vec<u32> {
    let (width, height) = (segments.width as i32, segments.height as i32);
    let mut distance = vec![u32::MAX; segments.ids.len()];
    let before = [(-1, 0, 3), (0, -1, 3), (-1, -1, 4), (1, -1, 4)];
    let mut relax = |x: i32, y: i32, direction: i32| {
        let here = (y * width + x) as usize;
        for (dx, dy, step) in before {
            let (x, y) = (x + direction * dx, y + direction * dy);
            let inside = (0..width).contains(&x) && (0..height).contains(&y);
            let there = if inside { (y * width + x) as usize } else { here };
            let reached = match inside && segments.ids[there] == segments.ids[here] {
                true => distance[there].saturating_add(step),
                false => step,
            };
            distance[here] = distance[here].min(reached);
        }
    };
    for y in 0..height {
        (0..width).for_each(|x| relax(x, y, 1));
    }
    for y in (0..height).rev() {
        (0..width).rev().for_each(|x| relax(x, y, -1));
    }
    distance
}

#[cfg(test)]
mod tests {
    use super::super::tests::frame;
    use super::super::{CropWindow, MaskPatch};
    use super::*;

    /// Returns a picture with one segment that contains a smaller one, and a speck.
    fn segments() -> IdImage {
        let id = |x: u32, y: u32| match (x, y) {
            (10..30, 10..30) => 5,
            (90, 60) => 7,
            _ => 2,
        };
        IdImage { width: 96, height: 64, ids: (0..96 * 64).map(|i| id(i % 96, i / 96)).collect() }
    }

    #[test]
    fn segment_centers_are_far_from_borders_and_specks_have_none() {
        let found = segment_centers(&segments(), &frame(), 0.001);
        assert_eq!(found.len(), 2);
        let ((x, y), (inner_x, inner_y)) = (found[0].at, found[1].at);
        assert!((46.0..75.0).contains(&x) && (28.0..36.0).contains(&y), "{x} {y}");
        assert!(
            (18.0..22.0).contains(&inner_x) && (18.0..22.0).contains(&inner_y),
            "{inner_x} {inner_y}"
        );
    }

    #[test]
    fn prompt_is_skipped_only_for_a_mask_of_similar_size() {
        let spots = segment_centers(&segments(), &frame(), 0.001);
        let mask = |reach: usize| {
            let bits: Vec<bool> =
                (0..GRID * GRID).map(|i| i % GRID < reach && i / GRID < reach * 2).collect();
            let cells = bits
                .chunks(64)
                .map(|bits| {
                    bits.iter().enumerate().fold(0, |word, (bit, on)| word | u64::from(*on) << bit)
                })
                .collect();
            let window = CropWindow { left: 0, top: 0, width: 96, height: 64, scale: (1.0, 1.0) };
            let area = bits.iter().filter(|on| **on).count() as u32;
            MaskCandidate { quality: 0.9, cells, area, patch: MaskPatch::default(), window }
        };
        // The inner segment is 20 x 20 of 96 x 64 pixels, 53 x 80 of 256 x 256 cells.
        let (wide, close) = (mask(250), mask(60));
        let answered = |found: &[MaskCandidate]| {
            spots.iter().map(|s| s.is_answered((96, 64), found)).collect::<Vec<_>>()
        };
        assert_eq!(answered(&[]), [false, false]);
        assert_eq!(answered(std::slice::from_ref(&wide)), [true, false]);
        assert_eq!(answered(&[wide, close]), [true, true]);
    }

    #[test]
    fn grid_points_under_masks_are_skipped_unless_always_prompted() {
        let window = CropWindow { left: 0, top: 0, width: 96, height: 64, scale: (1.0, 1.0) };
        let left_half = [u64::MAX, u64::MAX, 0, 0].repeat(GRID);
        let mask = MaskCandidate {
            quality: 0.9,
            cells: left_half,
            area: (GRID * GRID / 2) as u32,
            patch: MaskPatch::default(),
            window,
        };
        let open = |always| {
            grid_points((96, 64), 4, always)
                .iter()
                .filter(|s| !s.is_answered((96, 64), std::slice::from_ref(&mask)))
                .count()
        };
        assert_eq!((open(true), open(false)), (16, 8));
    }
}
