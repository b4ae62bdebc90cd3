//! Occupied space of a room: the cloud in columns of voxels above a 5 cm grid of the floor.
//! Computed once per parse; every request for approach poses reads it.

use rayon::prelude::*;
use std::collections::BTreeSet;
use uniground_geometry::scene::{Instance, InstanceId, Structure};
use uniground_geometry::statistics::quantile;
use uniground_geometry::voxels::typical_spacing_m;
use uniground_geometry::{Point2, Point3};

/// Side of a cell, meters. Multiples of it are used where points lie further apart, or the scan is
/// too large.
const CELL_M: f32 = 0.05;
/// Width of a cell in multiples of the point spacing. Smaller cells would leave holes in floors.
const POINTS_PER_CELL_SIDE: f32 = 1.5;
/// Height of a voxel, meters: half of its side, because the camera looks over table tops at grazing
/// angles.
pub(super) const LAYER_M: f32 = 0.025;
/// Layers of a column.
pub(super) const LAYERS: i32 = 128;
/// Columns begin this far below the floor, meters.
pub(super) const BELOW_FLOOR_M: f32 = 0.1;
/// Maximum number of cells of a grid: 100 x 100 m at 5 cm.
const MAX_CELLS: usize = 4_000_000;
/// Where a scan needs more than [`MAX_CELLS`], this share of its points is left out on every side
/// as strays.
const STRAY_SHARE: f32 = 0.001;
/// Number of points that quantiles are computed from.
const SAMPLE: usize = 200_000;
/// Where no floor was recognized, the fullest layer within this height above the lowest points
/// counts as floor, meters.
const FLOOR_SEARCH_M: f32 = 0.5;

/// Cells of the floor, in rows that start at the least y. The outermost cells hold no points.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Grid {
    /// Corner of the first cell, meters, world frame.
    pub origin: Point2<f32>,
    pub cell_m: f32,
    pub width: usize,
    pub height: usize,
}

impl Grid {
    /// Builds the grid around points, with larger cells where there would be too many.
    fn around(positions: &[Point3<f32>], cell_m: f32) -> Self {
        let all = positions
            .par_iter()
            .filter(|p| p.iter().all(|c| c.is_finite()))
            .map(|p| (p.xy(), p.xy()))
            .reduce_with(|(lo, hi), (l, h)| (lo.inf(&l), hi.sup(&h)));
        let (mut low, mut high) = all.unwrap_or_default();
        let cells = |low: Point2<f32>, high: Point2<f32>, cell_m: f32| {
            let [width, height] =
                [0, 1].map(|axis| ((high[axis] - low[axis]) / cell_m) as usize + 3);
            (width, height)
        };
        let fits = |(width, height): (usize, usize)| width.saturating_mul(height) <= MAX_CELLS;
        if !fits(cells(low, high, cell_m)) {
            let step = positions.len().div_ceil(SAMPLE).max(1);
            for axis in [0, 1] {
                let mut values: Vec<f32> =
                    positions.iter().step_by(step).map(|p| p[axis]).collect();
                low[axis] = quantile(&mut values, STRAY_SHARE).unwrap_or(low[axis]).max(low[axis]);
                high[axis] =
                    quantile(&mut values, 1.0 - STRAY_SHARE).unwrap_or(high[axis]).min(high[axis]);
            }
        }
        let mut cell_m = cell_m;
        while !fits(cells(low, high, cell_m)) {
            cell_m *= 2.0;
        }
        // Aligned to whole cells, so that the grid stays in place when the scan grows.
        let origin = low.map(|c| ((c / cell_m).floor() - 1.0) * cell_m);
        let (width, height) = cells(origin, high, cell_m);
        Self { origin, cell_m, width, height }
    }

    /// Returns column and row of a position; `None` outside.
    pub fn at(&self, x: f32, y: f32) -> Option<(usize, usize)> {
        let [column, row] =
            [x - self.origin.x, y - self.origin.y].map(|c| (c / self.cell_m).floor());
        let inside =
            column >= 0.0 && row >= 0.0 && column < self.width as f32 && row < self.height as f32;
        inside.then_some((column as usize, row as usize))
    }

    /// Returns the cell of a position; `None` outside.
    pub fn cell(&self, x: f32, y: f32) -> Option<usize> {
        self.at(x, y).map(|(column, row)| row * self.width + column)
    }

    /// Returns column and row of a cell.
    pub fn place(&self, cell: usize) -> (usize, usize) {
        (cell % self.width, cell / self.width)
    }

    /// Returns the middle of a cell, meters, world frame.
    pub fn center(&self, cell: usize) -> Point2<f32> {
        let (column, row) = self.place(cell);
        Point2::new(
            self.origin.x + (column as f32 + 0.5) * self.cell_m,
            self.origin.y + (row as f32 + 0.5) * self.cell_m,
        )
    }

    pub fn len(&self) -> usize {
        self.width * self.height
    }
}

/// A voxel: its cell and its layer in one number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Voxel(u32);

impl Voxel {
    pub fn new(cell: usize, layer: i32) -> Self {
        Self((cell as u32) << 7 | layer as u32)
    }

    pub fn cell(self) -> usize {
        (self.0 >> 7) as usize
    }

    pub fn layer(self) -> i32 {
        (self.0 & 127) as i32
    }
}

/// The columns of a scene, and the instance that each voxel belongs to.
pub struct Occupancy {
    pub(super) grid: Grid,
    /// Height of the floor, meters, world frame.
    pub(super) floor_z_m: f32,
    /// One bit for each layer, the lowest first.
    pub(super) columns: Vec<u128>,
    /// Ascending by instance, then voxel.
    voxels: Vec<(InstanceId, Voxel)>,
}

impl Occupancy {
    /// Bins a parsed cloud. `instance_of_point` has the instance of every point, 0 for none.
    /// `instances` give the height of the floor.
    #[must_use]
    pub fn of(
        positions: &[Point3<f32>],
        instance_of_point: &[InstanceId],
        instances: &[Instance],
    ) -> Self {
        let steps = (POINTS_PER_CELL_SIDE * typical_spacing_m(positions) / CELL_M).ceil().max(1.0);
        let grid = Grid::around(positions, CELL_M * steps);
        let floor_z_m = floor_height(positions, instance_of_point, instances);
        let mut voxels: Vec<(InstanceId, Voxel)> = positions
            .par_iter()
            .enumerate()
            .filter_map(|(point, p)| {
                // Points above the top of the columns go to the last layer: it is above every
                // robot, and its points can still be targets.
                let layer = layer_of(p.z - floor_z_m).min(LAYERS - 1);
                let cell = grid.cell(p.x, p.y).filter(|_| layer >= 0)?;
                Some((
                    instance_of_point.get(point).copied().unwrap_or_default(),
                    Voxel::new(cell, layer),
                ))
            })
            .collect();
        voxels.dedup();
        voxels.par_sort_unstable();
        voxels.dedup();
        let mut columns = vec![0; grid.len()];
        for (_, voxel) in &voxels {
            columns[voxel.cell()] |= 1 << voxel.layer();
        }
        Self { grid, floor_z_m, columns, voxels }
    }

    /// Returns the height of the floor, meters, world frame.
    #[must_use]
    pub fn floor_z_m(&self) -> f32 {
        self.floor_z_m
    }

    /// Returns the size in memory, bytes.
    #[must_use]
    pub fn bytes(&self) -> usize {
        self.columns.len() * size_of::<u128>()
            + self.voxels.len() * size_of::<(InstanceId, Voxel)>()
    }

    /// Returns the voxels that hold points of an instance, ascending.
    pub(super) fn of_instance(&self, id: InstanceId) -> impl Iterator<Item = Voxel> {
        let from = self.voxels.partition_point(|(other, _)| *other < id);
        self.voxels[from..]
            .iter()
            .take_while(move |(other, _)| *other == id)
            .map(|(_, voxel)| *voxel)
    }

    /// Returns the middle of a voxel, meters, world frame.
    pub(super) fn center(&self, voxel: Voxel) -> Point3<f32> {
        let at = self.grid.center(voxel.cell());
        Point3::new(
            at.x,
            at.y,
            self.floor_z_m - BELOW_FLOOR_M + (voxel.layer() as f32 + 0.5) * LAYER_M,
        )
    }
}

/// Returns the layer at a height above the floor. Layers outside of `0..LAYERS` do not exist.
pub(super) fn layer_of(above_floor_m: f32) -> i32 {
    ((above_floor_m + BELOW_FLOOR_M) / LAYER_M).floor() as i32
}

/// Returns the median height of the floor's points. Where no floor was recognized, uses the fullest
/// layer near the lowest points.
fn floor_height(
    positions: &[Point3<f32>],
    instance_of_point: &[InstanceId],
    instances: &[Instance],
) -> f32 {
    let is_floor = |i: &&Instance| i.structure == Some(Structure::Floor);
    let floors: BTreeSet<InstanceId> = instances.iter().filter(is_floor).map(|i| i.id).collect();
    let step = positions.len().div_ceil(SAMPLE).max(1);
    let of_floor = positions
        .iter()
        .zip(instance_of_point)
        .filter(|(_, id)| floors.contains(id))
        .map(|(p, _)| p.z);
    let mut heights: Vec<f32> = of_floor.step_by(step).collect();
    if let Some(middle) = quantile(&mut heights, 0.5) {
        return middle;
    }
    let mut heights: Vec<f32> = positions.iter().step_by(step).map(|p| p.z).collect();
    let Some(lowest) = quantile(&mut heights, 0.01) else { return 0.0 };
    let mut layers = [0_usize; (FLOOR_SEARCH_M / LAYER_M) as usize];
    for height in &heights {
        if let Some(layer) = layers.get_mut(((height - lowest) / LAYER_M).round().max(0.0) as usize)
        {
            *layer += 1;
        }
    }
    let fullest = (0..layers.len())
        .max_by_key(|layer| (layers[*layer], std::cmp::Reverse(*layer)))
        .unwrap_or_default();
    let (near, mut of_layer) = (lowest + fullest as f32 * LAYER_M, heights);
    of_layer.retain(|height| (height - near).abs() <= LAYER_M);
    quantile(&mut of_layer, 0.5).unwrap_or(lowest)
}
