//! Sparse voxel grids: points binned into cubes, and cubes looked up by integer coordinates.

use super::Point3;
use rayon::prelude::*;
use std::collections::HashMap;
use std::hash::{BuildHasherDefault, Hasher};

/// Integer voxel coordinates packed into one sortable key, 21 bits per axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct VoxelKey(pub u64);

const BIAS: i64 = 1 << 20;
const MASK: u64 = (1 << 21) - 1;

impl VoxelKey {
    /// Returns the voxel of edge `voxel_m` that contains `p`. Coordinates beyond ±2^20 voxels are
    /// clamped to the border.
    #[must_use]
    pub fn containing(p: &Point3<f32>, voxel_m: f32) -> Self {
        Self::pack([p.x, p.y, p.z].map(|c| floor_to_int(c / voxel_m)))
    }

    fn pack(cell: [i64; 3]) -> Self {
        let [x, y, z] = cell.map(|c| c.saturating_add(BIAS).clamp(0, MASK as i64) as u64);
        Self(x << 42 | y << 21 | z)
    }

    /// Returns the key at an offset of `d` voxels.
    #[must_use]
    pub fn offset(self, d: [i64; 3]) -> Self {
        let cell = [self.0 >> 42, self.0 >> 21 & MASK, self.0 & MASK];
        Self::pack(std::array::from_fn(|i| cell[i] as i64 - BIAS + d[i]))
    }

    /// Converts an offset in voxels to a single number for
    /// [`offset_by_step`](Self::offset_by_step).
    #[must_use]
    pub const fn step([x, y, z]: [i64; 3]) -> i64 {
        (x << 42) + (y << 21) + z
    }

    /// Returns the key at the offset of a [`step`](Self::step). Faster than
    /// [`offset`](Self::offset), but beyond the border it returns an arbitrary other key.
    #[must_use]
    pub const fn offset_by_step(self, step: i64) -> Self {
        Self((self.0 as i64).wrapping_add(step) as u64)
    }

    /// Returns the center of the voxel, meters.
    #[must_use]
    pub fn center(self, voxel_m: f32) -> Point3<f32> {
        let at =
            |shift: u32| ((self.0 >> shift & MASK) as i64 - BIAS) as f32 * voxel_m + voxel_m / 2.0;
        Point3::new(at(42), at(21), at(0))
    }
}

/// Returns `value.floor() as i64` without the call into the C library that the oldest x86-64
/// processors need.
fn floor_to_int(value: f32) -> i64 {
    let towards_zero = value as i64;
    towards_zero.saturating_sub(i64::from((towards_zero as f32) > value))
}

/// A multiplicative hasher for packed keys. They are already well spread, and hostile input costs
/// only time.
#[derive(Default)]
pub struct KeyHasher(u64);

impl Hasher for KeyHasher {
    fn finish(&self) -> u64 {
        self.0
    }
    fn write(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            self.write_u64(u64::from(byte));
        }
    }
    fn write_u64(&mut self, value: u64) {
        let mixed = (self.0 ^ value).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        self.0 = mixed ^ mixed >> 32;
    }
}

/// Values by voxel; hashing a key takes one multiplication.
pub type VoxelMap<V> = HashMap<VoxelKey, V, BuildHasherDefault<KeyHasher>>;

/// Points grouped by voxel. Voxels are numbered in key order, so the numbering depends only on the
/// points.
pub struct VoxelGrid {
    /// Occupied voxels, ascending; the index in this list is the voxel's number.
    pub keys: Vec<VoxelKey>,
    /// Voxel number of each input point.
    pub of_point: Vec<u32>,
    index: VoxelMap<u32>,
}

impl VoxelGrid {
    /// Bins points into cubes with an edge of `voxel_m` meters.
    #[must_use]
    pub fn new(points: &[Point3<f32>], voxel_m: f32) -> Self {
        let point_keys: Vec<VoxelKey> =
            points.par_iter().map(|p| VoxelKey::containing(p, voxel_m)).collect();
        let keys = distinct(point_keys.clone());
        let index: VoxelMap<u32> = keys.iter().enumerate().map(|(i, &k)| (k, i as u32)).collect();
        let of_point = point_keys.par_iter().map(|k| index[k]).collect();
        Self { keys, of_point, index }
    }

    /// Returns the number of occupied voxels.
    #[must_use]
    pub fn len(&self) -> usize {
        self.keys.len()
    }

    /// Returns whether there were no points.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.keys.is_empty()
    }

    /// Returns the number of a voxel, or `None` when it contains no point.
    #[must_use]
    pub fn get(&self, key: VoxelKey) -> Option<u32> {
        self.index.get(&key).copied()
    }

    /// Returns the occupied voxels among the 26 neighbors of every voxel, ascending.
    #[must_use]
    pub fn neighbors(&self) -> VoxelNeighbors {
        const CHUNK: usize = 4096;
        let chunks: Vec<(Vec<u32>, Vec<u32>)> = (0..self.len())
            .step_by(CHUNK)
            .collect::<Vec<_>>()
            .into_par_iter()
            .map(|from| self.collect_neighbors(from..(from + CHUNK).min(self.len())))
            .collect();
        let mut starts = Vec::with_capacity(self.len() + 1);
        let mut total = 0;
        starts.push(0);
        for (counts, _) in &chunks {
            for count in counts {
                total += count;
                starts.push(total);
            }
        }
        VoxelNeighbors { starts, list: chunks.into_iter().flat_map(|(_, list)| list).collect() }
    }

    /// Returns the count per voxel, and the neighbors in one list.
    ///
    /// Along Z, neighbors have consecutive keys. As voxels ascend, so do the keys of the nine
    /// columns around them. So nine cursors sweep the sorted keys once, without look-ups.
    fn collect_neighbors(&self, voxels: std::ops::Range<usize>) -> (Vec<u32>, Vec<u32>) {
        let columns: [i64; 9] =
            std::array::from_fn(|i| VoxelKey::step([i as i64 / 3 - 1, i as i64 % 3 - 1, -1]));
        let lowest = |voxel: usize, column: i64| self.keys[voxel].offset_by_step(column);
        let mut cursors =
            columns.map(|column| self.keys.partition_point(|&k| k < lowest(voxels.start, column)));
        let (mut counts, mut list) =
            (Vec::with_capacity(voxels.len()), Vec::with_capacity(voxels.len() * 10));
        for voxel in voxels {
            let before = list.len();
            for (&column, cursor) in columns.iter().zip(&mut cursors) {
                let low = lowest(voxel, column);
                while self.keys.get(*cursor).is_some_and(|&k| k < low) {
                    *cursor += 1;
                }
                let within = self.keys[*cursor..].iter().take(3).take_while(|k| k.0 <= low.0 + 2);
                list.extend(
                    (*cursor..*cursor + within.count()).filter(|&n| n != voxel).map(|n| n as u32),
                );
            }
            counts.push((list.len() - before) as u32);
        }
        (counts, list)
    }
}

/// Neighbors of every voxel, one list after the other.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct VoxelNeighbors {
    starts: Vec<u32>,
    list: Vec<u32>,
}

impl VoxelNeighbors {
    /// Returns the numbers of the occupied voxels around this one, ascending, at most 26.
    #[must_use]
    pub fn neighbors_of(&self, voxel: u32) -> &[u32] {
        let v = voxel as usize;
        &self.list[self.starts[v] as usize..self.starts[v + 1] as usize]
    }
}

/// Returns the distinct keys, ascending.
fn distinct(mut keys: Vec<VoxelKey>) -> Vec<VoxelKey> {
    // Consecutive points are mostly close together, so much is removed before the sort.
    keys.dedup();
    keys.par_sort_unstable();
    keys.dedup();
    keys
}

/// Initial cell size for measuring the surface area of a cloud, meters.
const AREA_CELL_M: f32 = 0.1;
/// Minimum number of points per cell on average. With fewer, cells do not cover the surface, and
/// larger ones are tried.
const POINTS_PER_CELL: usize = 3;

/// Returns the typical distance between neighboring points on their surface, meters: the side of
/// the square that each point represents.
#[must_use]
pub fn typical_spacing_m(points: &[Point3<f32>]) -> f32 {
    const LARGEST_CELL_M: f32 = 1000.0;
    let mut cell_m = AREA_CELL_M;
    loop {
        let cells =
            distinct(points.par_iter().map(|p| VoxelKey::containing(p, cell_m)).collect()).len();
        if cells * POINTS_PER_CELL <= points.len() || cells <= 1 || cell_m > LARGEST_CELL_M {
            return (cells as f32 * cell_m * cell_m / points.len().max(1) as f32).sqrt();
        }
        cell_m *= 2.0;
    }
}

/// Offsets of the 26 voxels around a voxel.
pub const NEIGHBORS_26: [[i64; 3]; 26] = {
    let mut all = [[0; 3]; 26];
    let (mut n, mut i) = (0, 0);
    while i < 27 {
        let d = [i / 9 - 1, i / 3 % 3 - 1, i % 3 - 1];
        if i != 13 {
            all[n] = d;
            n += 1;
        }
        i += 1;
    }
    all
};

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn key_offsets_work_across_zero() {
        let key = VoxelKey::containing(&Point3::new(-0.01, 0.01, 0.0), 0.05);
        assert_eq!(
            key.offset([1, 0, 0]),
            VoxelKey::containing(&Point3::new(0.01, 0.01, 0.0), 0.05)
        );
        assert!((key.center(0.05) - Point3::new(-0.025, 0.025, 0.025)).norm() < 1e-6);
    }

    #[test]
    fn every_point_is_in_its_voxel() {
        let points: Vec<_> = (0..5000)
            .map(|i| i as f32)
            .map(|i| Point3::new((i * 0.7).sin(), (i * 0.13).cos() * 0.6, (i * 0.031).sin() * 0.4))
            .collect();
        let grid = VoxelGrid::new(&points, 0.05);
        for (p, &v) in points.iter().zip(&grid.of_point) {
            assert_eq!(grid.keys[v as usize], VoxelKey::containing(p, 0.05));
        }
        assert!(grid.len() < points.len());
        let neighbors = grid.neighbors();
        for (v, key) in grid.keys.iter().enumerate() {
            let looked_up: Vec<u32> =
                NEIGHBORS_26.iter().filter_map(|&d| grid.get(key.offset(d))).collect();
            assert_eq!(neighbors.neighbors_of(v as u32), looked_up);
        }
    }

    #[test]
    fn typical_spacing_is_measured_on_the_surface() {
        let plane: Vec<_> = (0..200)
            .flat_map(|i| {
                (0..200).map(move |j| Point3::new(i as f32 * 0.02, j as f32 * 0.02, 0.51))
            })
            .collect();
        assert!((typical_spacing_m(&plane) - 0.02).abs() < 0.002, "{}", typical_spacing_m(&plane));
        let sparse: Vec<_> = plane.iter().map(|p| p * 100.0).collect();
        assert!((typical_spacing_m(&sparse) - 2.0).abs() < 0.4, "{}", typical_spacing_m(&sparse));
    }

    #[test]
    fn huge_and_non_finite_coordinates_do_not_panic() {
        let grid = VoxelGrid::new(
            &[Point3::new(1e30, -1e30, f32::NAN), Point3::new(f32::INFINITY, 0.0, 0.0)],
            0.01,
        );
        assert_eq!(grid.of_point.len(), 2);
    }
}
