//! A cloud from posed depth: voxel grid with running means, for scans that bring no cloud of their own.

use super::IngestError;
use crate::geometry::voxels::{VoxelKey, VoxelMap};
use crate::geometry::{Point3, Vector3};
use crate::progress::Progress;
use crate::scene::{Frame, FrameRef, PointCloud, stream_frames};
use uniground_types::settings::FusionSettings;

/// Weighted sums of the measurements that fell into one voxel, positions relative to the voxel's centre.
#[derive(Default, Clone, Copy)]
struct Cell {
    offset: [f32; 3],
    colour: [f32; 3],
    weight: f32,
    count: u32,
}

/// Fuses all frames. Frames are folded in one by one in order, so the result does not depend on threads.
///
/// # Errors
/// [`IngestError`] for unreadable frames, cancellation, or frames that hold no depth at all.
pub fn fuse(frames: &[FrameRef], settings: &FusionSettings, progress: &Progress) -> Result<PointCloud, IngestError> {
    let mut cells: VoxelMap<Cell> = VoxelMap::default();
    stream_frames(
        frames,
        |frame| Ok::<_, IngestError>(frame_cells(&frame.decode()?, settings)),
        |i, partial| {
            progress.report("fuse_cloud", i as f32 / frames.len() as f32)?;
            for (key, cell) in partial {
                let sum = cells.entry(key).or_default();
                for axis in 0..3 {
                    sum.offset[axis] += cell.offset[axis];
                    sum.colour[axis] += cell.colour[axis];
                }
                sum.weight += cell.weight;
                sum.count += cell.count;
            }
            Ok(())
        },
    )?;
    if cells.is_empty() {
        return Err(IngestError::NoUsableFrames { reason: "no depth picture holds a measurement".into() });
    }
    let measurements: u64 = cells.values().map(|cell| u64::from(cell.count)).sum();
    let least = measurements as f32 / cells.len() as f32 * settings.min_share_of_mean;
    let mut sorted: Vec<_> = cells.into_iter().filter(|(_, cell)| cell.count as f32 >= least).collect();
    sorted.sort_unstable_by_key(|(key, _)| *key);
    let mut cloud = PointCloud::default();
    for (key, cell) in sorted {
        cloud.positions.push(key.center(settings.voxel_m) + Vector3::from(cell.offset) / cell.weight);
        cloud.colours.push(cell.colour.map(|sum| (sum / cell.weight).round() as u8));
    }
    Ok(cloud)
}

/// One frame's measurements per voxel, in key order.
fn frame_cells(frame: &Frame, settings: &FusionSettings) -> Vec<(VoxelKey, Cell)> {
    let camera_to_world = frame.depth_camera.world_to_camera().inverse();
    let (rotation, shift) = (camera_to_world.rotation.to_rotation_matrix(), camera_to_world.translation.vector);
    let intrinsics = frame.depth_camera.intrinsics;
    let colours = frame.colour_on_depth_grid();
    let (width, height) = (frame.depth.width, frame.depth.height);
    let mut cells: VoxelMap<Cell> = VoxelMap::default();
    for v in 0..height {
        for u in 0..width {
            let z_m = frame.depth.at((u, v));
            if z_m <= 0.0 || z_m > settings.max_depth_m || on_silhouette(frame, u, v, z_m, settings.silhouette_tolerance) {
                continue;
            }
            let p = Point3::from(rotation * intrinsics.unproject(u as f32, v as f32, z_m).coords + shift);
            let key = VoxelKey::of(&p, settings.voxel_m);
            let offset = p - key.center(settings.voxel_m);
            let colour = colours[(v * width + u) as usize];
            let cell = cells.entry(key).or_default();
            // A depth sensor's noise grows with the square of the distance: near looks count more.
            let weight = 1.0 / (z_m * z_m).max(0.01);
            for axis in 0..3 {
                cell.offset[axis] += offset[axis] * weight;
                cell.colour[axis] += f32::from(colour[axis]) * weight;
            }
            cell.weight += weight;
            cell.count += 1;
        }
    }
    let mut sorted: Vec<_> = cells.into_iter().collect();
    sorted.sort_unstable_by_key(|(key, _)| *key);
    sorted
}

fn on_silhouette(frame: &Frame, u: u32, v: u32, z_m: f32, tolerance: f32) -> bool {
    let differs = |u: u32, v: u32| {
        let other = frame.depth.at((u, v));
        other > 0.0 && (other - z_m).abs() > tolerance * z_m
    };
    (u > 0 && differs(u - 1, v))
        || (u + 1 < frame.depth.width && differs(u + 1, v))
        || (v > 0 && differs(u, v - 1))
        || (v + 1 < frame.depth.height && differs(u, v + 1))
}
