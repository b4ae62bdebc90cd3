//! Small flat patches of a scan: their positions and normals. They show what is level and what is
//! upright.

use rayon::prelude::*;
use uniground_geometry::least_axis::least_axis;
use uniground_geometry::moments::Moments;
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::{FrameError, FrameRef, PointCloud, stream_frames};
use uniground_geometry::voxels::{VoxelKey, typical_spacing_m};
use uniground_geometry::{Point3, Vector3};

/// A flat piece of surface, in meters, in the world of the caller.
#[derive(Debug, Clone, Copy)]
pub(super) struct SurfacePatch {
    /// Unit length. Its sign has no meaning.
    pub normal: Vector3<f32>,
    pub at: Point3<f32>,
    /// Approximate area, square meters.
    pub weight: f32,
}

/// Maximum number of frames: enough to cover the room from everywhere.
const MAX_FRAMES: usize = 48;
/// Number of pixels of a depth picture that are examined, along either side.
const GRID: u32 = 48;
/// Maximum depth, meters. Beyond it, depth is too noisy for a normal.
const FARTHEST_M: f32 = 6.0;
/// Maximum number of points of a cloud.
const MAX_POINTS: usize = 2_000_000;
/// Maximum thickness of a flat cell, as a share of its width.
const FLAT: f32 = 0.12;
const MIN_POINTS: usize = 8;

/// Returns patches of a sample of depth pictures, in the frames' world. Unreadable pictures are
/// left out: other checks report them.
pub(super) fn sample_patches(frames: &[FrameRef], progress: &Progress) -> Vec<SurfacePatch> {
    let sample: Vec<FrameRef> =
        frames.iter().step_by(frames.len().div_ceil(MAX_FRAMES).max(1)).cloned().collect();
    let mut all = Vec::new();
    let looked = stream_frames(
        &sample,
        |frame| Ok::<_, FrameError>(patches_of_frame(frame).unwrap_or_default()),
        |_, mut surfaces| {
            all.append(&mut surfaces);
            Ok(())
        },
    );
    // Cancelled: the next progress report returns the error.
    if looked.is_err() || progress.report("levelling", 1.0).is_err() {
        return Vec::new();
    }
    all
}

fn patches_of_frame(frame: &FrameRef) -> Result<Vec<SurfacePatch>, FrameError> {
    let depth = frame.decode_depth()?;
    let camera = frame.depth_intrinsics;
    // Neighbors to both sides of a pixel: far enough apart that noise does not dominate, close
    // enough to stay on one surface.
    let reach = (depth.width.min(depth.height) / 60).max(2);
    let point = |u: u32, v: u32| {
        let z = depth.at((u, v));
        (z > 0.1 && z < FARTHEST_M).then(|| camera.unproject(u as f32, v as f32, z))
    };
    let mut surfaces = Vec::new();
    for row in 1..GRID {
        for column in 1..GRID {
            let (u, v) = (depth.width * column / GRID, depth.height * row / GRID);
            if u < reach || v < reach || u + reach >= depth.width || v + reach >= depth.height {
                continue;
            }
            let (Some(p), Some(left), Some(right)) =
                (point(u, v), point(u - reach, v), point(u + reach, v))
            else {
                continue;
            };
            let (Some(over), Some(under)) = (point(u, v - reach), point(u, v + reach)) else {
                continue;
            };
            // On a flat surface, a point is the midpoint of its neighbors.
            let slack = 0.004 + 0.004 * p.z * p.z;
            let bent = |a: &Point3<f32>, b: &Point3<f32>| {
                ((a.coords + b.coords) / 2.0 - p.coords).norm() > 4.0 * slack
            };
            let across = |a: &Point3<f32>, b: &Point3<f32>| (a - b).norm() > 0.25 * p.z;
            if bent(&left, &right)
                || bent(&over, &under)
                || across(&left, &right)
                || across(&over, &under)
            {
                continue;
            }
            let Some(normal) = (right - left).cross(&(under - over)).try_normalize(1e-12) else {
                continue;
            };
            let facing = normal.dot(&p.coords.normalize()).abs();
            // A pixel covers more of a surface the farther away and the more oblique it is. At
            // grazing angles the normal is noise.
            if facing > 0.15 {
                let area = p.z * p.z / facing.max(0.3) / (camera.fx * camera.fy);
                let pixels = (depth.width * depth.height) as f32 / (GRID * GRID) as f32;
                surfaces.push(SurfacePatch {
                    normal: frame.camera_to_world * normal,
                    at: frame.camera_to_world * p,
                    weight: area * pixels,
                });
            }
        }
    }
    Ok(surfaces)
}

/// Returns the flat cells of a cloud.
pub(super) fn patches_of_cloud(cloud: &PointCloud) -> Vec<SurfacePatch> {
    let points: Vec<Point3<f32>> =
        cloud.positions.iter().step_by(cloud.len().div_ceil(MAX_POINTS).max(1)).copied().collect();
    let cell_m = (4.0 * typical_spacing_m(&points)).clamp(0.05, 1.0);
    let mut by_cell: Vec<(VoxelKey, u32)> = points
        .par_iter()
        .enumerate()
        .map(|(i, p)| (VoxelKey::containing(p, cell_m), i as u32))
        .collect();
    by_cell.par_sort_unstable();
    let cells: Vec<&[(VoxelKey, u32)]> =
        by_cell.chunk_by(|a, b| a.0 == b.0).filter(|cell| cell.len() >= MIN_POINTS).collect();
    cells
        .par_iter()
        .filter_map(|cell| {
            let own: Vec<Point3<f32>> = cell.iter().map(|(_, i)| points[*i as usize]).collect();
            let Moments { mean, covariance } = Moments::from_points(&own);
            let (least, normal) = least_axis(&covariance);
            // The middle eigenvalue, from the trace and the square of the matrix. For lines, both
            // smaller eigenvalues are small.
            let rest = covariance.trace() - least;
            let product = (covariance.norm_squared() - least * least - rest * rest) / -2.0;
            let middle = (rest - (rest * rest - 4.0 * product).max(0.0).sqrt()) / 2.0;
            let flat = least.max(0.0).sqrt() < FLAT * rest.max(0.0).sqrt() && middle > 0.1 * rest;
            flat.then_some(SurfacePatch { normal, at: mean, weight: cell_m * cell_m })
        })
        .collect()
}
