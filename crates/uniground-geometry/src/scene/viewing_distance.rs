//! How far away the things are that frames show.

use super::FrameRef;
use crate::statistics::median;

/// Number of frames that are measured, evenly chosen.
const FRAMES: usize = 9;
/// Every n-th pixel is measured.
const STEP: usize = 7;

/// Returns the median depth of the surfaces that the depth pictures show, meters. Pictures that
/// cannot be read are left out; `None` without any measurement.
#[must_use]
pub fn viewing_distance_m(frames: &[FrameRef]) -> Option<f32> {
    let step = frames.len().div_ceil(FRAMES).max(1);
    let mut distances: Vec<f32> = Vec::new();
    for depth in frames.iter().step_by(step).filter_map(|frame| frame.decode_depth().ok()) {
        let measured = depth.depth_m.iter().step_by(STEP).copied();
        distances.extend(measured.filter(|z_m| z_m.is_finite() && *z_m > 0.0));
    }
    median(&mut distances)
}
