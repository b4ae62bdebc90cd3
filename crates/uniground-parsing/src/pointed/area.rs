//! Areas of a color picture, and the masks in them.

use crate::masks::IdImage;
use uniground_geometry::scene::Frame;

/// Share of the positions that lie outside of the area of most of them, on each side.
const OUTSIDE: f32 = 0.02;
/// Width of the rim of a picture, as a share of its width and height.
const RIM: f32 = 0.01;

/// A rectangle in a color picture, pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PixelArea {
    /// Column of the left rim.
    pub left: f32,
    /// Row of the upper rim.
    pub top: f32,
    /// Column of the right rim.
    pub right: f32,
    /// Row of the lower rim.
    pub bottom: f32,
}

impl From<[u32; 4]> for PixelArea {
    /// Converts left, top, right and bottom.
    fn from(rims: [u32; 4]) -> Self {
        let [left, top, right, bottom] = rims.map(|px| px as f32);
        Self { left, top, right, bottom }
    }
}

impl PixelArea {
    /// Returns the area of these positions, without the outermost 2 % on each side. `None` if there
    /// are none.
    pub(super) fn of_most(pixels: &[(f32, f32)]) -> Option<Self> {
        let span = |of: fn(&(f32, f32)) -> f32| {
            let mut along: Vec<f32> = pixels.iter().map(of).collect();
            along.sort_by(f32::total_cmp);
            let out = (along.len() as f32 * OUTSIDE) as usize;
            Some((*along.get(out)?, along[along.len() - 1 - out]))
        };
        let ((left, right), (top, bottom)) = (span(|p| p.0)?, span(|p| p.1)?);
        Some(Self { left, top, right, bottom })
    }

    /// Returns the area with a margin on each side: a share of its width and height.
    pub(super) fn grown(&self, share: f32) -> Self {
        let (x, y) = ((self.right - self.left) * share, (self.bottom - self.top) * share);
        Self {
            left: self.left - x,
            top: self.top - y,
            right: self.right + x,
            bottom: self.bottom + y,
        }
    }

    /// Returns whether it reaches the rim of a picture of this size, so that the object may go on
    /// outside of it.
    pub(super) fn reaches_rim(&self, (width, height): (u32, u32)) -> bool {
        let (x, y) = (RIM * width as f32, RIM * height as f32);
        self.left <= x
            || self.top <= y
            || self.right >= width as f32 - x
            || self.bottom >= height as f32 - y
    }

    /// Returns the part of the area that is in a picture of this size.
    pub(super) fn within(&self, (width, height): (u32, u32)) -> Self {
        let (width, height) = (width as f32, height as f32);
        Self {
            left: self.left.clamp(0.0, width),
            top: self.top.clamp(0.0, height),
            right: self.right.clamp(0.0, width),
            bottom: self.bottom.clamp(0.0, height),
        }
    }

    pub(super) fn contains(&self, (x, y): (f32, f32)) -> bool {
        (self.left..=self.right).contains(&x) && (self.top..=self.bottom).contains(&y)
    }

    /// Returns the IoU of two areas.
    pub(super) fn iou(&self, other: &Self) -> f32 {
        let size = |width: f32, height: f32| width.max(0.0) * height.max(0.0);
        let both = size(
            self.right.min(other.right) - self.left.max(other.left),
            self.bottom.min(other.bottom) - self.top.max(other.top),
        );
        let own = |area: &Self| size(area.right - area.left, area.bottom - area.top);
        both / (own(self) + own(other) - both).max(f32::EPSILON)
    }
}

/// Returns the masks, ascending, that have at least these shares of their pixels in an area of the
/// frame's color picture: a list for each share, without repeated and empty lists.
pub(super) fn masks_inside(
    ids: &IdImage,
    frame: &Frame,
    area: &PixelArea,
    least_shares: &[f32],
) -> Vec<Vec<u16>> {
    // Numbers of pixels of each mask: all, and those in the area.
    let mut counts = vec![(0_u32, 0_u32); usize::from(u16::MAX) + 1];
    for row in 0..ids.height {
        for column in 0..ids.width {
            let (all, inside) = &mut counts[usize::from(ids.at((column, row)))];
            *all += 1;
            *inside += u32::from(area.contains(frame.color_position(column as f32, row as f32)));
        }
    }
    let masks = |least_share: &f32| {
        let is_inside = |id: &u16| {
            let (all, inside) = counts[usize::from(*id)];
            inside > 0 && inside as f32 >= least_share * all as f32
        };
        (1..=u16::MAX).filter(is_inside).collect::<Vec<u16>>()
    };
    let mut lists: Vec<Vec<u16>> =
        least_shares.iter().map(masks).filter(|list| !list.is_empty()).collect();
    lists.dedup();
    lists
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn area(left: f32, top: f32, right: f32, bottom: f32) -> PixelArea {
        PixelArea { left, top, right, bottom }
    }

    #[test]
    fn overlap_of_areas() {
        let whole = area(0.0, 0.0, 10.0, 10.0);
        assert_eq!(whole.iou(&whole), 1.0);
        assert_eq!(whole.iou(&area(0.0, 0.0, 5.0, 10.0)), 0.5);
        assert_eq!(whole.iou(&area(20.0, 0.0, 25.0, 10.0)), 0.0);
        assert_eq!(area(1.0, 1.0, 1.0, 1.0).iou(&area(1.0, 1.0, 1.0, 1.0)), 0.0, "empty areas");
        assert_eq!(area(10.0, 20.0, 20.0, 40.0).grown(0.1), area(9.0, 18.0, 21.0, 42.0));
        assert_eq!(area(-9.0, 18.0, 21.0, 42.0).within((20, 30)), area(0.0, 18.0, 20.0, 30.0));
        // A hundredth of 200 x 100 pixels is 2 and 1.
        let reaches = |of: PixelArea| of.reaches_rim((200, 100));
        assert!(!reaches(area(3.0, 2.0, 197.0, 98.0)));
        assert!(reaches(area(2.0, 2.0, 197.0, 98.0)) && reaches(area(3.0, 1.0, 197.0, 98.0)));
        assert!(reaches(area(3.0, 2.0, 198.0, 98.0)) && reaches(area(3.0, 2.0, 197.0, 99.0)));
    }

    #[test]
    fn few_outer_positions_do_not_extend_an_area() {
        let mut pixels: Vec<(f32, f32)> = (0..100).map(|i| (i as f32, 50.0 - i as f32)).collect();
        pixels.push((900.0, 900.0));
        let most = PixelArea::of_most(&pixels).unwrap();
        assert_eq!((most.left, most.right), (2.0, 98.0));
        assert_eq!(PixelArea::of_most(&[]), None);
    }

    proptest! {
        #[test]
        fn overlap_is_symmetric_and_a_share(a in prop::array::uniform4(0.0_f32..100.0), b in prop::array::uniform4(0.0_f32..100.0)) {
            let of = |[x, y, width, height]: [f32; 4]| area(x, y, x + width, y + height);
            let (a, b) = (of(a), of(b));
            prop_assert!((0.0..=1.0001).contains(&a.iou(&b)));
            prop_assert_eq!(a.iou(&b), b.iou(&a));
        }
    }
}
