//! Selects the frames that a parse uses.

use uniground_geometry::scene::FrameRef;
use uniground_types::settings::FrameSamplingSettings;

/// Returns the frames to use, in order: first the stride (paper: `max(1, floor(N_f / 1000))`), then
/// the budget.
#[must_use]
pub fn sample_frames(frames: &[FrameRef], settings: &FrameSamplingSettings) -> Vec<FrameRef> {
    let stride = (frames.len() / settings.stride_frames.max(1) as usize).max(1);
    let strided: Vec<FrameRef> = frames.iter().step_by(stride).cloned().collect();
    match settings.max_frames.map(|n| n.max(1) as usize) {
        Some(budget) if strided.len() > budget => {
            let chosen = spread_along_path(&strided, budget);
            chosen.into_iter().map(|frame| strided[frame].clone()).collect()
        }
        _ => strided,
    }
}

/// Picks `budget` frames at equal steps of the distance traveled, so that a camera that stands
/// still does not use up the budget. Returns their positions in `frames`, in order.
pub(crate) fn spread_along_path(frames: &[FrameRef], budget: usize) -> Vec<usize> {
    let mut travelled = vec![0.0_f32];
    for pair in frames.windows(2) {
        let step = pair[0].camera_to_world.inverse() * pair[1].camera_to_world;
        // A rotation shows new things as much as a step does: one radian counts as one meter.
        let last = travelled[travelled.len() - 1];
        travelled.push(last + step.translation.vector.norm() + step.rotation.angle());
    }
    let total = travelled[travelled.len() - 1];
    if total <= 0.0 {
        return (0..frames.len()).step_by(frames.len().div_ceil(budget)).collect();
    }
    let mut chosen = Vec::with_capacity(budget);
    let mut next = 0;
    for k in 0..budget {
        let target = total * k as f32 / (budget - 1).max(1) as f32;
        let at = travelled[next..].partition_point(|&t| t < target) + next;
        let at = at.clamp(next, frames.len() - 1);
        chosen.push(at);
        next = at + 1;
        if next >= frames.len() {
            break;
        }
    }
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;
    use uniground_geometry::Isometry3;
    use uniground_geometry::scene::{FrameIndex, Intrinsics};

    fn path(xs: impl Iterator<Item = f32>) -> Vec<FrameRef> {
        let intrinsics = Intrinsics { width: 1, height: 1, fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 };
        xs.enumerate()
            .map(|(i, x)| FrameRef {
                index: FrameIndex(i as u32),
                time_s: None,
                color: "c".into(),
                depth: "d".into(),
                color_intrinsics: intrinsics,
                depth_intrinsics: intrinsics,
                depth_scale_m: 0.001,
                camera_to_world: Isometry3::translation(x, 0.0, 0.0),
                optics: uniground_geometry::scene::Optics::default(),
            })
            .collect()
    }

    #[test]
    fn stride_follows_the_paper() {
        let settings = FrameSamplingSettings { max_frames: None, ..Default::default() };
        for (frames, used) in [(1, 1), (999, 999), (1999, 1999), (2000, 1000), (3500, 1167)] {
            assert_eq!(
                sample_frames(&path((0..frames).map(|i| i as f32)), &settings).len(),
                used,
                "{frames} frames"
            );
        }
    }

    #[test]
    fn stationary_camera_does_not_use_up_the_budget() {
        // 90 frames at the start, then ten steps of one meter.
        let frames = path((0..90).map(|_| 0.0).chain((1..=10).map(|i| i as f32)));
        let chosen = sample_frames(
            &frames,
            &FrameSamplingSettings { max_frames: Some(11), ..Default::default() },
        );
        let moving = chosen.iter().filter(|f| f.camera_to_world.translation.x > 0.0).count();
        assert!(chosen.len() <= 11 && moving == 10, "{moving} of {}", chosen.len());
        assert!(chosen.windows(2).all(|w| w[0].index < w[1].index));
    }
}
