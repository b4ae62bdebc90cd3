//! The cloud binned into voxels with neighbors, color and surface normal.

use super::Patch;
use rayon::prelude::*;
use uniground_geometry::color::{Lab, srgb_to_lab};
use uniground_geometry::least_axis::least_axis;
use uniground_geometry::progress::{Cancelled, Progress};
use uniground_geometry::scene::PointCloud;
use uniground_geometry::voxels::{VoxelGrid, VoxelKey, VoxelNeighbors};
use uniground_geometry::{Matrix3, Point3, Vector3};

/// Occupied voxels as a graph. Vectors are indexed by voxel number.
pub(super) struct VoxelCloud {
    pub grid: VoxelGrid,
    /// The points of each voxel; normals by PCA over the voxel and its neighbors.
    pub patches: Vec<Patch>,
    /// Surface variation: smallest eigenvalue over their sum, 0 on a plane.
    pub curvatures: Vec<f32>,
    /// Root mean square distance of the surrounding points to their plane, meters.
    pub roughness_m: Vec<f32>,
    neighbors: VoxelNeighbors,
}

/// Number, mean and scatter (sum of outer products about the mean) of a set of points.
#[derive(Clone, Copy, Default)]
struct ScatterMoments {
    count: f32,
    mean: Vector3<f32>,
    scatter: Matrix3<f32>,
}

impl ScatterMoments {
    fn add(&mut self, p: &Point3<f32>) {
        self.count += 1.0;
        let before = p.coords - self.mean;
        self.mean += before / self.count;
        self.scatter += before * (p.coords - self.mean).transpose();
    }

    /// Returns the moments of both sets together (Chan's pairwise update): no cancellation far from
    /// the origin.
    fn merge(self, other: &Self) -> Self {
        let count = self.count + other.count;
        if count == 0.0 {
            return self;
        }
        let delta = other.mean - self.mean;
        Self {
            count,
            mean: self.mean + delta * (other.count / count),
            scatter: self.scatter
                + other.scatter
                + delta * delta.transpose() * (self.count * other.count / count),
        }
    }
}

impl VoxelCloud {
    pub fn new(cloud: &PointCloud, voxel_m: f32, progress: &Progress) -> Result<Self, Cancelled> {
        let grid = VoxelGrid::new(&cloud.positions, voxel_m);
        progress.check()?;
        let (moments, labs) = accumulate(cloud, &grid);
        progress.check()?;
        let neighbors = grid.neighbors();
        progress.check()?;
        let surfaces: Vec<VoxelSurface> = (0..grid.len())
            .into_par_iter()
            .map(|v| {
                let around = neighbors.neighbors_of(v as u32);
                estimate_surface(
                    &around.iter().fold(moments[v], |sum, &n| sum.merge(&moments[n as usize])),
                )
            })
            .collect();
        let curvatures = surfaces.iter().map(|s| s.curvature).collect();
        let roughness_m = surfaces.iter().map(|s| s.roughness_m).collect();
        let patches = surfaces
            .par_iter()
            .zip(&moments)
            .zip(&labs)
            .map(|((surface, m), &lab)| Patch {
                points: m.count as u32,
                center: Point3::from(m.mean),
                normal: surface.normal,
                lab,
            })
            .collect();
        Ok(Self { grid, patches, curvatures, roughness_m, neighbors })
    }

    pub fn len(&self) -> usize {
        self.patches.len()
    }

    pub fn neighbors(&self, voxel: u32) -> &[u32] {
        self.neighbors.neighbors_of(voxel)
    }

    /// Numbers the connected parts of equal labels `0..n` in voxel order, so that every label is
    /// one piece.
    pub fn connected_labels(&self, labels: &[u32]) -> Vec<u32> {
        const NONE: u32 = u32::MAX;
        let mut pieces = vec![NONE; self.len()];
        let mut count = 0;
        let mut found = Vec::new();
        for start in 0..self.len() as u32 {
            if pieces[start as usize] != NONE {
                continue;
            }
            pieces[start as usize] = count;
            found.push(start);
            while let Some(v) = found.pop() {
                for &n in self.neighbors(v) {
                    if pieces[n as usize] == NONE && labels[n as usize] == labels[v as usize] {
                        pieces[n as usize] = count;
                        found.push(n);
                    }
                }
            }
            count += 1;
        }
        pieces
    }

    /// Returns the pairs `(low, high)` of labels that are neighbors, sorted. Two labels are
    /// neighbors when a voxel of one is among the nearest to a voxel of the other. The nearest are
    /// the 26 around it and, in sparse places (thin legs, gaps in the scan), wider rings until
    /// [`NEAREST`] are found. This prevents a hole in a scan from cutting an object in two.
    pub fn adjacent_labels(&self, labels: &[u32]) -> Vec<(u32, u32)> {
        let rings: Vec<Vec<i64>> = (2..=WIDEST_RING).map(ring).collect();
        let chunk_pairs = |voxels: &[u32]| {
            // Neighboring voxels yield the same pairs repeatedly: a small table of recent pairs
            // keeps the list short.
            let mut seen = [(u32::MAX, u32::MAX); 256];
            let mut pairs = Vec::new();
            let mut note = |own: u32, other: u32| {
                let pair = (own.min(other), own.max(other));
                let slot = &mut seen[(own ^ other.wrapping_mul(31)) as usize % 256];
                if own != other && *slot != pair {
                    *slot = pair;
                    pairs.push(pair);
                }
            };
            for &v in voxels {
                let (own, around) = (labels[v as usize], self.neighbors(v));
                around.iter().for_each(|&n| note(own, labels[n as usize]));
                // Only where a patch ends without touching another is there a gap to search across.
                if around.iter().any(|&n| labels[n as usize] != own) {
                    continue;
                }
                self.rings_beyond(v, around.len(), &rings)
                    .into_iter()
                    .for_each(|n| note(own, labels[n as usize]));
            }
            pairs
        };
        let voxels: Vec<u32> = (0..self.len() as u32).collect();
        let mut pairs: Vec<_> = voxels.par_chunks(4096).flat_map_iter(chunk_pairs).collect();
        pairs.par_sort_unstable();
        pairs.dedup();
        pairs
    }

    /// Returns voxels of the rings from the second on, ring by ring, until there are [`NEAREST`] of
    /// them including the `found` nearer ones.
    fn rings_beyond(&self, v: u32, mut found: usize, rings: &[Vec<i64>]) -> Vec<u32> {
        let mut voxels = Vec::new();
        for ring in rings {
            if found >= NEAREST {
                break;
            }
            let before = voxels.len();
            voxels.extend(ring.iter().filter_map(|&step| {
                self.grid.get(self.grid.keys[v as usize].offset_by_step(step))
            }));
            found += voxels.len() - before;
        }
        voxels
    }
}

/// Minimum number of neighbors of a voxel, as far as [`WIDEST_RING`] reaches (docs/METHOD.md,
/// section 1.2).
const NEAREST: usize = 8;
/// Maximum distance of a neighbor, voxels.
pub(crate) const WIDEST_RING: i64 = 4;

/// Returns the offsets to the voxels whose largest coordinate offset is `ring`.
fn ring(ring: i64) -> Vec<i64> {
    let side = 2 * ring + 1;
    let offsets =
        (0..side.pow(3)).map(|i| [i / side / side - ring, i / side % side - ring, i % side - ring]);
    offsets.filter(|d| d.iter().any(|c| c.abs() == ring)).map(VoxelKey::step).collect()
}

/// Computes moments and mean color of each voxel's points, in the order of the points.
fn accumulate(cloud: &PointCloud, grid: &VoxelGrid) -> (Vec<ScatterMoments>, Vec<Lab>) {
    // Voxels that a worker fills at a time. Each worker scans all points, so there are few workers.
    let share = grid.len().div_ceil(2 * rayon::current_num_threads()).max(1);
    let mut moments = vec![ScatterMoments::default(); grid.len()];
    let mut labs = vec![Lab::zeros(); grid.len()];
    let parts = moments.par_chunks_mut(share).zip(labs.par_chunks_mut(share));
    parts.enumerate().for_each(|(part, (moments, labs))| {
        let first = part * share;
        for (i, &v) in grid.of_point.iter().enumerate() {
            let Some(m) = (v as usize).checked_sub(first).and_then(|v| moments.get_mut(v)) else {
                continue;
            };
            m.add(&cloud.positions[i]);
            labs[v as usize - first] += srgb_to_lab(cloud.colors[i]);
        }
        for (lab, m) in labs.iter_mut().zip(moments) {
            *lab /= m.count;
        }
    });
    (moments, labs)
}

/// The plane through the points of a voxel and its neighbors.
struct VoxelSurface {
    normal: Vector3<f32>,
    curvature: f32,
    roughness_m: f32,
}

fn estimate_surface(moments: &ScatterMoments) -> VoxelSurface {
    let covariance = moments.scatter / moments.count.max(1.0);
    let total = covariance.trace();
    if total <= f32::EPSILON * f32::EPSILON {
        return VoxelSurface { normal: Vector3::z(), curvature: 0.0, roughness_m: 0.0 };
    }
    let (least, normal) = least_axis(&covariance);
    VoxelSurface { normal, curvature: least / total, roughness_m: least.sqrt() }
}
