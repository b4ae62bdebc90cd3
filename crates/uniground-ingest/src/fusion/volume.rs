//! A truncated signed distance volume in sparse blocks.

use super::frame::{FusionFrame, PixelSample};
use rayon::prelude::*;
use uniground_geometry::scene::PointCloud;
use uniground_geometry::voxels::{VoxelKey, VoxelMap};
use uniground_geometry::{Point3, Vector3};
use uniground_types::settings::FusionSettings;

/// Voxels along the edge of a block.
pub(super) const SIDE: usize = 8;
const CELLS: usize = SIDE * SIDE * SIDE;
/// Two gigabytes of blocks: an apartment of 400 square meters with its furniture at the default
/// voxel size.
pub(super) const MAX_BLOCKS: usize = (2 << 30) / (CELLS * size_of::<Voxel>());

/// Weighted means of the measurements at one voxel.
#[derive(Clone, Copy, Default)]
struct Voxel {
    /// Signed distance to the surface along the view, divided by the truncation distance. Positive
    /// in front of the surface, `-1..=1`.
    distance: f32,
    weight: f32,
    color_weight: f32,
    /// Color in 256ths.
    color: [u16; 3],
    /// Number of frames that saw a surface within the truncation distance.
    views: u16,
}

struct Block {
    key: VoxelKey,
    voxels: Box<[Voxel; CELLS]>,
}

/// The maximum number of blocks is reached.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct VolumeFull;

pub(super) struct Volume {
    settings: FusionSettings,
    most_blocks: usize,
    number_of: VoxelMap<u32>,
    blocks: Vec<Block>,
}

impl Volume {
    pub fn new(settings: &FusionSettings, most_blocks: usize) -> Self {
        Self {
            settings: *settings,
            most_blocks,
            number_of: VoxelMap::default(),
            blocks: Vec::new(),
        }
    }

    /// Allocates blocks where the frame measured a surface, and integrates the frame into all
    /// blocks that it sees or sees through.
    pub fn integrate(&mut self, look: &FusionFrame) -> Result<(), VolumeFull> {
        for &key in &look.blocks {
            if !self.number_of.contains_key(&key) {
                if self.blocks.len() == self.most_blocks {
                    return Err(VolumeFull);
                }
                self.number_of.insert(key, self.blocks.len() as u32);
                self.blocks.push(Block { key, voxels: Box::new([Voxel::default(); CELLS]) });
            }
        }
        let settings = &self.settings;
        let block_m = SIDE as f32 * settings.voxel_m;
        let to_camera = look.camera.world_to_camera();
        self.blocks.par_iter_mut().with_min_len(64).for_each(|block| {
            // Half of the diagonal of a block.
            let radius_m = 0.867 * block_m;
            let center = to_camera * block.key.center(block_m);
            if look.may_reach(&center, radius_m) {
                block.integrate(look, settings);
            }
        });
        Ok(())
    }

    /// Returns the zero crossings between neighboring voxels, in order of block and voxel.
    pub fn extract_surface(&self) -> PointCloud {
        let least = self.min_views();
        let mut order: Vec<&Block> = self.blocks.iter().collect();
        order.sort_unstable_by_key(|block| block.key);
        let parts: Vec<PointCloud> =
            order.into_par_iter().map(|block| self.crossings(block, least)).collect();
        let mut cloud = PointCloud::default();
        for part in parts {
            cloud.positions.extend(part.positions);
            cloud.colors.extend(part.colors);
        }
        cloud
    }

    /// Returns the minimum number of frames that must have seen a voxel: a share of what is usual
    /// in this scan.
    fn min_views(&self) -> u16 {
        let (mut views, mut voxels) = (0_u64, 0_u64);
        for voxel in self.blocks.iter().flat_map(|block| block.voxels.iter()) {
            if voxel.distance.abs() < 0.5 && voxel.views > 0 {
                views += u64::from(voxel.views);
                voxels += 1;
            }
        }
        let mean = views as f32 / voxels.max(1) as f32;
        ((mean * self.settings.min_share_of_mean).round() as u16).max(1)
    }

    fn crossings(&self, block: &Block, least: u16) -> PointCloud {
        let voxel_m = self.settings.voxel_m;
        // On a surface seen from one side, the distance falls by a voxel per voxel. Between the
        // front of one surface and the back of another, distances jump.
        let steepest = 3.0 * voxel_m / self.settings.truncation_m();
        let next: [Option<&Block>; 3] = std::array::from_fn(|axis| {
            let step = std::array::from_fn(|i| i64::from(i == axis));
            self.number_of.get(&block.key.offset(step)).map(|&n| &self.blocks[n as usize])
        });
        let corner = block.corner(voxel_m);
        let mut cloud = PointCloud::default();
        for (i, here) in block.voxels.iter().enumerate().filter(|(_, voxel)| voxel.views >= least) {
            let at = voxel_position(i);
            for axis in 0..3 {
                let stride = SIDE.pow(2 - axis as u32);
                let there = match at[axis] + 1 < SIDE {
                    true => Some(&block.voxels[i + stride]),
                    false => next[axis].map(|block| &block.voxels[i - (SIDE - 1) * stride]),
                };
                let Some(there) = there.filter(|voxel| voxel.views >= least) else { continue };
                let fall = here.distance - there.distance;
                if (here.distance > 0.0) == (there.distance > 0.0) || fall.abs() > steepest {
                    continue;
                }
                let share = here.distance / fall;
                let mut position = corner + Vector3::from(at.map(|k| k as f32 + 0.5)) * voxel_m;
                position[axis] += share * voxel_m;
                cloud.positions.push(position);
                cloud.colors.push(std::array::from_fn(|c| {
                    let mixed = f32::from(here.color[c]) * (1.0 - share)
                        + f32::from(there.color[c]) * share;
                    (mixed / 256.0).round().min(255.0) as u8
                }));
            }
        }
        cloud
    }
}

/// Returns the position of a voxel within its block along X, Y, Z.
const fn voxel_position(i: usize) -> [usize; 3] {
    [i / (SIDE * SIDE), i / SIDE % SIDE, i % SIDE]
}

impl Block {
    fn corner(&self, voxel_m: f32) -> Point3<f32> {
        let block_m = SIDE as f32 * voxel_m;
        self.key.center(block_m) - Vector3::repeat(block_m / 2.0)
    }

    fn integrate(&mut self, look: &FusionFrame, settings: &FusionSettings) {
        let (voxel_m, truncation_m) = (settings.voxel_m, settings.truncation_m());
        let to_camera = look.camera.world_to_camera();
        let rotation = to_camera.rotation.to_rotation_matrix();
        let steps: [Vector3<f32>; 3] =
            std::array::from_fn(|axis| rotation.matrix().column(axis) * voxel_m);
        let first = to_camera * (self.corner(voxel_m) + Vector3::repeat(voxel_m / 2.0));
        let camera = look.camera.intrinsics;
        for (i, voxel) in self.voxels.iter_mut().enumerate() {
            let [x, y, z] = voxel_position(i);
            let p = first + steps[0] * x as f32 + steps[1] * y as f32 + steps[2] * z as f32;
            if p.z <= 0.0 {
                continue;
            }
            let Some(seen) =
                look.at(camera.fx * p.x / p.z + camera.cx, camera.fy * p.y / p.z + camera.cy)
            else {
                continue;
            };
            let distance = (seen.depth_m - p.z) / truncation_m;
            if seen.depth_m > 0.0 && distance > -1.0 {
                voxel.add_measurement(seen, distance, voxel_m / truncation_m);
            }
        }
    }
}

impl Voxel {
    /// Adds a measurement. `distance` is in truncation distances, at least `-1`. `step` is one
    /// voxel in that unit.
    fn add_measurement(&mut self, seen: &PixelSample, distance: f32, step: f32) {
        // Nothing was measured behind a surface, so the weight decreases to zero there. Otherwise
        // the back of a thin object would push its front away.
        let weight =
            seen.weight * if distance < -step { (1.0 + distance) / (1.0 - step) } else { 1.0 };
        self.weight += weight;
        self.distance +=
            (distance.min(1.0) - self.distance) * weight / self.weight.max(f32::MIN_POSITIVE);
        if distance >= 1.0 {
            return;
        }
        self.views = self.views.saturating_add(1);
        self.color_weight += seen.color_weight;
        let share = seen.color_weight / self.color_weight.max(f32::MIN_POSITIVE);
        for (mean, &now) in self.color.iter_mut().zip(&seen.color) {
            *mean = (f32::from(*mean) + (f32::from(now) * 256.0 - f32::from(*mean)) * share).round()
                as u16;
        }
    }
}
