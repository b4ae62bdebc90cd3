//! What a frame shows of the cloud, and its masks.

use super::PixelArea;
use crate::masks::IdImage;
use crate::visibility::{FramePoint, PointVisibility};
use std::collections::HashSet;
use uniground_geometry::scene::{Frame, Intrinsics};
use uniground_geometry::statistics::median;
use uniground_models::neural::{Encoded, LowMask};

/// The middle of an area is without this share of its width and height on each side.
const MIDDLE: f32 = 0.25;
/// Radius in pixels in which the nearest mask is searched if the place itself has none.
const AROUND_PX: i32 = 6;

/// A frame, the points of the cloud it shows, and the input of its masks.
pub(super) struct FrameLookup {
    pub frame: Frame,
    pub seen: Vec<FramePoint>,
    pub cut: FrameSegmentation,
}

/// The input of a frame's masks.
pub(super) enum FrameSegmentation {
    /// Input of a segmenter's decoder.
    Encoded(Encoded),
    /// Built-in masks, from coarse to fine.
    Images(Vec<IdImage>),
}

impl FrameLookup {
    /// Returns the points of the cloud under a mask, and their positions in the color picture.
    pub fn points_under(&self, mask: &Mask) -> (Vec<u32>, Vec<(f32, f32)>) {
        let under: Vec<&FramePoint> =
            self.seen.iter().filter(|point| mask.covers(self, point)).collect();
        let pixels = under.iter().filter_map(|point| color_pixel(&self.frame, point)).collect();
        (under.into_iter().map(|point| point.point).collect(), pixels)
    }

    /// Returns the IoU of an area and that in which the frame shows these points.
    pub fn fill(&self, points: &[u32], area: &PixelArea) -> f32 {
        let points: HashSet<u32> = points.iter().copied().collect();
        let shown = self.visible().filter(|point| points.contains(&point.point));
        let pixels: Vec<(f32, f32)> =
            shown.filter_map(|point| color_pixel(&self.frame, point)).collect();
        PixelArea::of_most(&pixels).map_or(0.0, |shown| shown.iou(area))
    }

    /// Returns the points that the frame shows in an area, if they are about as far away as its
    /// middle.
    pub fn points_in_area(&self, area: &PixelArea) -> Vec<u32> {
        let to_camera = self.frame.color_camera.world_to_camera();
        let depth_m = |point: &FramePoint| (to_camera * point.position).z;
        let within = |area: PixelArea| {
            self.visible().filter(move |point| {
                color_pixel(&self.frame, point).is_some_and(|pixel| area.contains(pixel))
            })
        };
        let mut depths: Vec<f32> = within(area.grown(-MIDDLE)).map(depth_m).collect();
        let Some(middle_m) = median(&mut depths) else { return Vec::new() };
        let Intrinsics { fx, fy, .. } = self.frame.color_camera.intrinsics;
        let across_m =
            ((area.right - area.left) / fx).max((area.bottom - area.top) / fy) * middle_m;
        let is_near = |point: &&FramePoint| (depth_m(point) - middle_m).abs() <= across_m;
        within(*area).filter(is_near).map(|point| point.point).collect()
    }

    pub fn visible(&self) -> impl Iterator<Item = &FramePoint> {
        self.seen.iter().filter(|point| point.sight == PointVisibility::Visible)
    }
}

/// A mask of a frame.
pub(super) enum Mask {
    /// Built-in masks, ascending, on the frame's depth image.
    Cut { level: usize, ids: Vec<u16> },
    /// A segmenter's mask, over the color picture.
    Decoded { mask: LowMask, scale: (f32, f32), threshold: f32 },
}

impl Mask {
    /// Returns whether it covers a point that its frame shows.
    pub fn covers(&self, looked: &FrameLookup, point: &FramePoint) -> bool {
        match (self, &looked.cut) {
            (Self::Cut { level, ids }, FrameSegmentation::Images(images)) => {
                ids.binary_search(&images[*level].at(point.cell)).is_ok()
            }
            (Self::Cut { .. }, FrameSegmentation::Encoded(_)) => false,
            (Self::Decoded { mask, scale, threshold }, _) => {
                color_pixel(&looked.frame, point).is_some_and(|at| mask.at(at, *scale) > *threshold)
            }
        }
    }
}

/// Returns the position of a point of the cloud in a frame's color picture; `None` outside.
pub(super) fn color_pixel(frame: &Frame, point: &FramePoint) -> Option<(f32, f32)> {
    frame.color_camera.project(&point.position).map(|pixel| (pixel.u, pixel.v))
}

/// Returns the mask at a position of the color picture, or the nearest one to it.
pub(super) fn nearest_mask(ids: &IdImage, frame: &Frame, (x, y): (f32, f32)) -> Option<u16> {
    let (depth, color) = (&frame.depth_camera.intrinsics, &frame.color_camera.intrinsics);
    let column = ((x - color.cx) / color.fx * depth.fx + depth.cx).round() as i32;
    let row = ((y - color.cy) / color.fy * depth.fy + depth.cy).round() as i32;
    let around =
        |reach: i32| (-reach..=reach).flat_map(move |dy| (-reach..=reach).map(move |dx| (dx, dy)));
    let mut near: Vec<(i32, i32)> = around(AROUND_PX).collect();
    near.sort_by_key(|(dx, dy)| dx * dx + dy * dy);
    let id = |(dx, dy): (i32, i32)| {
        let (u, v) = (u32::try_from(column + dx).ok()?, u32::try_from(row + dy).ok()?);
        (u < ids.width && v < ids.height).then(|| ids.at((u, v))).filter(|id| *id != 0)
    };
    near.into_iter().find_map(id)
}
