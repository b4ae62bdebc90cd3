//! What one frame measured of the surfaces in front of it.

use std::collections::HashSet;
use std::hash::BuildHasherDefault;
use uniground_geometry::scene::{Camera, Frame};
use uniground_geometry::voxels::{KeyHasher, VoxelKey};
use uniground_geometry::{Point3, Vector3};
use uniground_types::settings::FusionSettings;

/// One frame, prepared for integration: depth without smeared edges, and a weight for each pixel.
pub(super) struct FusionFrame {
    pub camera: Camera,
    width: u32,
    height: u32,
    /// Row-major, one per pixel of the depth picture.
    pixels: Vec<PixelSample>,
    /// Largest depth of each tile of [`TILE`] by [`TILE`] pixels, row-major. Unknown depth counts
    /// as 0.
    farthest_m: Vec<f32>,
    tiles_wide: u32,
    /// Blocks near a measured surface, ascending.
    pub blocks: Vec<VoxelKey>,
}

/// The measurement of one pixel.
#[derive(Clone, Copy)]
pub(super) struct PixelSample {
    /// Depth along the optical axis, meters. 0: no measurement.
    pub depth_m: f32,
    /// Weight of the measurement. Near and frontal views have the largest weight.
    pub weight: f32,
    /// Weight of the color. Sharp pictures have the largest weight.
    pub color_weight: f32,
    pub color: [u8; 3],
}

const TILE: u32 = 16;

impl FusionFrame {
    pub fn new(frame: &Frame, settings: &FusionSettings) -> Self {
        let (width, height) = (frame.depth.width, frame.depth.height);
        let colors = frame.color_on_depth_grid();
        let sharpness = sharpness(&colors, width);
        let mut pixels = Vec::with_capacity(colors.len());
        for v in 0..height {
            for u in 0..width {
                let z_m = frame.depth.at((u, v));
                let usable = z_m > 0.0
                    && z_m <= settings.max_depth_m
                    && !on_silhouette(frame, u, v, z_m, settings.silhouette_tolerance);
                let weight = if usable {
                    view_cosine(frame, u, v, z_m) / (z_m * z_m).max(0.01)
                } else {
                    0.0
                };
                let color = colors[(v * width + u) as usize];
                pixels.push(PixelSample {
                    depth_m: if usable { z_m } else { 0.0 },
                    weight,
                    color_weight: weight * weight * sharpness,
                    color,
                });
            }
        }
        let tiles_wide = width.div_ceil(TILE);
        let mut farthest_m = vec![0.0_f32; (tiles_wide * height.div_ceil(TILE)) as usize];
        for (i, seen) in pixels.iter().enumerate() {
            let (u, v) = (i as u32 % width, i as u32 / width);
            let farthest = &mut farthest_m[(v / TILE * tiles_wide + u / TILE) as usize];
            *farthest = farthest.max(seen.depth_m);
        }
        let mut look = Self {
            camera: frame.depth_camera,
            width,
            height,
            pixels,
            farthest_m,
            tiles_wide,
            blocks: Vec::new(),
        };
        look.blocks = look.touched_voxels(settings);
        look
    }

    /// Returns the measurement of the pixel at this position, or `None` outside the picture.
    pub fn at(&self, u: f32, v: f32) -> Option<&PixelSample> {
        let (column, row) = ((u + 0.5) as i64, (v + 0.5) as i64);
        let inside =
            u > -0.5 && v > -0.5 && column < i64::from(self.width) && row < i64::from(self.height);
        inside.then(|| &self.pixels[(row * i64::from(self.width) + column) as usize])
    }

    /// Returns whether a sphere, in camera axes, can be visible or in front of a visible surface.
    /// False if it is outside of the picture or fully hidden.
    pub fn may_reach(&self, center: &Point3<f32>, radius_m: f32) -> bool {
        let near_m = center.z - radius_m;
        if near_m <= 0.05 {
            return center.z + radius_m > 0.05;
        }
        let camera = &self.camera.intrinsics;
        let (u, v) = (
            camera.fx * center.x / center.z + camera.cx,
            camera.fy * center.y / center.z + camera.cy,
        );
        let (ru, rv) = (camera.fx * radius_m / near_m, camera.fy * radius_m / near_m);
        let tiles = |low: f32, high: f32, len: u32| {
            let tile = |at: f32| (at.clamp(0.0, len as f32 - 1.0) as u32) / TILE;
            (high >= 0.0 && low <= len as f32 - 1.0).then(|| tile(low)..=tile(high))
        };
        let (Some(columns), Some(rows)) =
            (tiles(u - ru, u + ru, self.width), tiles(v - rv, v + rv, self.height))
        else {
            return false;
        };
        rows.flat_map(|row| columns.clone().map(move |column| (row, column))).any(
            |(row, column)| self.farthest_m[(row * self.tiles_wide + column) as usize] >= near_m,
        )
    }

    fn touched_voxels(&self, settings: &FusionSettings) -> Vec<VoxelKey> {
        let block_m = super::volume::SIDE as f32 * settings.voxel_m;
        let truncation_m = settings.truncation_m();
        let to_world = self.camera.world_to_camera().inverse();
        let camera = self.camera.intrinsics;
        let mut keys: HashSet<VoxelKey, BuildHasherDefault<KeyHasher>> = HashSet::default();
        let steps = (2.0 * truncation_m / (block_m / 2.0)).ceil().max(1.0);
        let mut last = None;
        for (i, seen) in self.pixels.iter().enumerate().filter(|(_, seen)| seen.depth_m > 0.0) {
            let (u, v) = ((i as u32 % self.width) as f32, (i as u32 / self.width) as f32);
            // Neighboring pixels mostly fall into the same block: compare with it before hashing.
            let here = VoxelKey::containing(
                &(to_world * camera.unproject(u, v, seen.depth_m)),
                block_m / 4.0,
            );
            if last.replace(here) == Some(here) {
                continue;
            }
            for step in 0..=steps as u32 {
                let z_m = seen.depth_m - truncation_m + 2.0 * truncation_m * step as f32 / steps;
                if z_m > 0.0 {
                    keys.insert(VoxelKey::containing(
                        &(to_world * camera.unproject(u, v, z_m)),
                        block_m,
                    ));
                }
            }
        }
        let mut keys: Vec<_> = keys.into_iter().collect();
        keys.sort_unstable();
        keys
    }
}

/// Returns the cosine between the view and the surface normal, from the depths around a pixel; at
/// least 0.1.
fn view_cosine(frame: &Frame, u: u32, v: u32, z_m: f32) -> f32 {
    /// Distance of the neighboring pixels on either side. With adjacent pixels, noise dominates.
    const REACH: u32 = 3;
    let camera = frame.depth_camera.intrinsics;
    let (width, height) = (frame.depth.width, frame.depth.height);
    let point = |u: u32, v: u32| {
        let depth = frame.depth.at((u, v));
        camera.unproject(u as f32, v as f32, if depth > 0.0 { depth } else { z_m })
    };
    let along = point((u + REACH).min(width - 1), v) - point(u.saturating_sub(REACH), v);
    let down = point(u, (v + REACH).min(height - 1)) - point(u, v.saturating_sub(REACH));
    let ray = camera.unproject(u as f32, v as f32, 1.0).coords;
    let normal: Vector3<f32> = along.cross(&down);
    (normal.dot(&ray).abs() / (normal.norm() * ray.norm()).max(f32::MIN_POSITIVE)).clamp(0.1, 1.0)
}

/// Returns the mean difference of brightness between neighboring pixels of a row. Pictures with
/// motion blur have small differences.
fn sharpness(colors: &[[u8; 3]], width: u32) -> f32 {
    let brightness = |c: &[u8; 3]| c.iter().map(|&v| i32::from(v)).sum::<i32>();
    let differences = |row: &[[u8; 3]]| {
        row.windows(2)
            .map(|pair| i64::from((brightness(&pair[0]) - brightness(&pair[1])).abs()))
            .sum::<i64>()
    };
    let sum: i64 = colors.chunks(width.max(1) as usize).map(differences).sum();
    1.0 + sum as f32 / colors.len().max(1) as f32
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
