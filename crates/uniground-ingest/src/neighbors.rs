//! Measures how well neighboring frames agree: the error of their depth and the drift of their
//! poses.

use rayon::prelude::*;
use uniground_geometry::scene::{DepthImage, FrameIndex, FrameRef};
use uniground_geometry::statistics::median;

/// Number of compared pairs, spread over the scan, and number of points per pair.
const PAIRS: usize = 20;
const POINTS: usize = 2000;
/// Points whose depth differs by more than this share are occluded in one of the two pictures, or
/// moved.
const SAME_SURFACE: f32 = 0.1;
/// A pair is ignored if fewer points than this are seen in both frames.
const FEWEST: usize = 50;

/// Statistics from comparing the depth of each frame with that of the next.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct NeighborAgreement {
    /// Median difference between measured depths of the same place, meters. Includes both noise and
    /// drift.
    pub depth_error_m: f32,
    /// Median over the frames of the offset in depth to the next frame, meters. Includes drift
    /// only.
    pub drift_m: f32,
    /// The largest drift, meters.
    pub worst_drift_m: f32,
    /// The frame with the largest drift, measured between it and the next.
    pub worst_after: FrameIndex,
}

/// Compares a sample of neighboring frames. Returns `None` where they do not overlap or cannot be
/// read.
#[must_use]
pub fn compare_neighbors(frames: &[FrameRef]) -> Option<NeighborAgreement> {
    let pairs: Vec<&[FrameRef]> = frames.windows(2).collect();
    let sample: Vec<&[FrameRef]> =
        pairs.iter().step_by(pairs.len().div_ceil(PAIRS).max(1)).copied().collect();
    let told: Vec<(f32, f32, FrameIndex)> = sample
        .into_par_iter()
        .filter_map(|pair| {
            let (error_m, drift_m) = depth_difference(
                &pair[0],
                &pair[0].decode_depth().ok()?,
                &pair[1],
                &pair[1].decode_depth().ok()?,
            )?;
            Some((error_m, drift_m, pair[0].index))
        })
        .collect();
    let worst = told.iter().max_by(|a, b| a.1.total_cmp(&b.1).then(b.2.cmp(&a.2)))?;
    Some(NeighborAgreement {
        depth_error_m: median(&mut told.iter().map(|told| told.0).collect::<Vec<_>>())?,
        drift_m: median(&mut told.iter().map(|told| told.1).collect::<Vec<_>>())?,
        worst_drift_m: worst.1,
        worst_after: worst.2,
    })
}

/// Returns the median absolute difference of depth, and the absolute value of the median
/// difference.
fn depth_difference(
    from: &FrameRef,
    depth: &DepthImage,
    to: &FrameRef,
    other: &DepthImage,
) -> Option<(f32, f32)> {
    let (intrinsics, camera) = (from.depth_intrinsics, to.depth_camera());
    let step = (depth.depth_m.len() / POINTS).max(1);
    let differences: Vec<f32> = (0..depth.depth_m.len())
        .step_by(step)
        .filter(|&at| depth.depth_m[at] > 0.0)
        .filter_map(|at| {
            let (column, row) = (at as u32 % depth.width, at as u32 / depth.width);
            let point = from.camera_to_world
                * intrinsics.unproject(column as f32, row as f32, depth.depth_m[at]);
            let pixel = camera.project(&point)?;
            let measured_m = other.at(pixel.cell());
            let difference_m = pixel.z_m - measured_m;
            (measured_m > 0.0 && difference_m.abs() <= SAME_SURFACE * measured_m)
                .then_some(difference_m)
        })
        .collect();
    if differences.len() < FEWEST {
        return None;
    }
    let error_m = median(&mut differences.iter().map(|m| m.abs()).collect::<Vec<_>>())?;
    Some((error_m, median(&mut differences.clone())?.abs()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use camino::Utf8Path;
    use image::{ImageBuffer, Luma};
    use uniground_geometry::Isometry3;
    use uniground_geometry::scene::{Intrinsics, Optics};

    /// Creates a frame that looks along +Z at a wall, from `at_m` on that axis.
    fn frame(folder: &Utf8Path, index: u32, at_m: f32, depth_mm: u16) -> FrameRef {
        let depth = folder.join(format!("{index}.png"));
        ImageBuffer::<Luma<u16>, _>::from_pixel(64, 64, Luma([depth_mm])).save(&depth).unwrap();
        let intrinsics =
            Intrinsics { width: 64, height: 64, fx: 64.0, fy: 64.0, cx: 31.5, cy: 31.5 };
        FrameRef {
            index: FrameIndex(index),
            time_s: None,
            color: depth.clone(),
            depth,
            color_intrinsics: intrinsics,
            depth_intrinsics: intrinsics,
            depth_scale_m: 0.001,
            camera_to_world: Isometry3::translation(0.0, 0.0, at_m),
            optics: Optics::default(),
        }
    }

    #[test]
    fn the_frame_with_the_largest_pose_drift_is_reported() {
        let folder = tempfile::tempdir().unwrap();
        let folder = Utf8Path::from_path(folder.path()).unwrap();
        // Each frame is ten centimeters nearer. The pose of the last one is four centimeters off.
        let frames = [
            frame(folder, 0, 0.0, 2000),
            frame(folder, 1, 0.1, 1900),
            frame(folder, 2, 0.2, 1800),
            frame(folder, 5, 0.3, 1740),
        ];
        let told = compare_neighbors(&frames).unwrap();
        assert!(told.depth_error_m < 0.001 && told.drift_m < 0.001, "{told:?}");
        assert!(
            (told.worst_drift_m - 0.04).abs() < 1e-3 && told.worst_after == FrameIndex(2),
            "{told:?}"
        );
        assert_eq!(compare_neighbors(&frames[..1]), None);
        let away = frame(folder, 7, 50.0, 2000);
        assert_eq!(
            compare_neighbors(&[frames[0].clone(), away]),
            None,
            "the frames do not overlap"
        );
    }
}
