//! The voxels of the instance to approach.

use super::clearance::distances;
use super::occupancy::{LAYER_M, LAYERS, Occupancy, Voxel, layer_of};
use std::collections::BTreeSet;
use uniground_geometry::Point3;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::scene::{Instance, InstanceId, Level};

/// Value for cells without a voxel of the instance.
const NONE: u128 = 0;

/// An instance as voxels.
pub(super) struct Target {
    /// Ascending; never empty.
    pub voxels: Vec<Voxel>,
    /// Layers of the instance by cell, over the bounding rectangle of its cells.
    own: Window<u128>,
    /// Cells below the instance, each with the height of its lowest point above the floor, meters.
    pub footprint: Vec<(usize, f32)>,
}

/// A value for every cell of a rectangle of the grid.
pub(super) struct Window<V> {
    pub column: usize,
    pub row: usize,
    pub width: usize,
    pub height: usize,
    values: Vec<V>,
}

impl<V: Copy> Window<V> {
    /// Returns the value of a cell by column and row; `None` outside.
    pub fn at(&self, column: usize, row: usize) -> Option<V> {
        let (x, y) = (column.checked_sub(self.column)?, row.checked_sub(self.row)?);
        if x < self.width && y < self.height {
            self.values.get(y * self.width + x).copied()
        } else {
            None
        }
    }
}

impl Target {
    /// Returns the voxels of an instance after corrections; `None` where it has none because it
    /// lies below the floor.
    pub fn of(occupancy: &Occupancy, instances: &[Instance], id: InstanceId) -> Option<Self> {
        let instance = instances.get((id.0 as usize).checked_sub(1)?)?;
        Self::of_voxels(occupancy, voxels_of(occupancy, instances, instance))
    }

    /// Returns the voxels at points, meters, world frame; `None` where all of them are outside of
    /// the columns.
    pub fn of_points(occupancy: &Occupancy, points: &[Point3<f32>]) -> Option<Self> {
        let voxel = |p: &Point3<f32>| {
            let layer = layer_of(p.z - occupancy.floor_z_m);
            let cell = occupancy.grid.cell(p.x, p.y)?;
            (0..LAYERS).contains(&layer).then(|| Voxel::new(cell, layer))
        };
        let mut voxels: Vec<Voxel> = points.iter().filter_map(voxel).collect();
        voxels.sort_unstable();
        voxels.dedup();
        Self::of_voxels(occupancy, voxels)
    }

    /// `voxels` are ascending. Returns `None` where there are none.
    fn of_voxels(occupancy: &Occupancy, voxels: Vec<Voxel>) -> Option<Self> {
        let grid = &occupancy.grid;
        // Ascending, so that the first voxel of a cell is its lowest.
        let mut lowest = voxels.clone();
        lowest.dedup_by_key(|voxel| voxel.cell());
        let places: Vec<(usize, usize)> =
            lowest.iter().map(|voxel| grid.place(voxel.cell())).collect();
        let (columns, rows) =
            (|| places.iter().map(|place| place.0), || places.iter().map(|place| place.1));
        let (column, last_column, row, last_row) =
            (columns().min()?, columns().max()?, rows().min()?, rows().max()?);
        let (width, height) = (last_column - column + 1, last_row - row + 1);
        let mut own = Window { column, row, width, height, values: vec![NONE; width * height] };
        for voxel in &voxels {
            let (x, y) = grid.place(voxel.cell());
            own.values[(y - row) * width + x - column] |= 1 << voxel.layer();
        }
        let above_floor =
            |voxel: Voxel| occupancy.center(voxel).z - LAYER_M / 2.0 - occupancy.floor_z_m;
        let footprint =
            lowest.into_iter().map(|voxel| (voxel.cell(), above_floor(voxel))).collect();
        Some(Self { voxels, own, footprint })
    }

    /// Returns the layers of the target in a cell. They do not hide the target.
    pub fn own_layers(&self, column: usize, row: usize) -> u128 {
        self.own.at(column, row).unwrap_or(NONE)
    }

    /// Returns an even sample of its voxels, always the same.
    pub fn sample(&self, most: usize) -> Vec<Voxel> {
        let count = self.voxels.len().min(most);
        (0..count).map(|i| self.voxels[i * self.voxels.len() / count]).collect()
    }

    /// Returns the horizontal distance to the nearest of its cells, in cells, for all cells not
    /// much further than `most_m`.
    pub fn distances(&self, occupancy: &Occupancy, most_m: f32) -> Window<f32> {
        let grid = &occupancy.grid;
        let around = (most_m / grid.cell_m).ceil() as usize + 1;
        let (column, row) =
            (self.own.column.saturating_sub(around), self.own.row.saturating_sub(around));
        let width = (self.own.column + self.own.width + around).min(grid.width) - column;
        let height = (self.own.row + self.own.height + around).min(grid.height) - row;
        let is_site = |at: usize| self.own_layers(column + at % width, row + at / width) != NONE;
        Window { column, row, width, height, values: distances(width, height, is_site) }
    }
}

/// Things have their own points, wholes those of their things, merged things those of their
/// members. Parts and instances found later have only boxes.
fn voxels_of(occupancy: &Occupancy, instances: &[Instance], instance: &Instance) -> Vec<Voxel> {
    // Stray points lie on other objects.
    let within = |voxels: &[Voxel], grown_m: f32| -> Vec<Voxel> {
        let inside = |voxel: &Voxel| holds(&instance.aabb, grown_m, &occupancy.center(*voxel));
        voxels.iter().copied().filter(inside).collect()
    };
    let own = voxels_of_members(occupancy, instances, &[instance.id]);
    if !own.is_empty() {
        let without_strays = within(&own, occupancy.grid.cell_m);
        return if without_strays.is_empty() { own } else { without_strays };
    }
    let part = within(&voxels_of_members(occupancy, instances, &instance.things), 0.0);
    if part.is_empty() { occupied_in(occupancy, &instance.aabb) } else { part }
}

/// Returns the voxels of instances and of their members, ascending.
fn voxels_of_members(
    occupancy: &Occupancy,
    instances: &[Instance],
    ids: &[InstanceId],
) -> Vec<Voxel> {
    let (mut known, mut open) = (BTreeSet::new(), ids.to_vec());
    while let Some(id) = open.pop() {
        if known.insert(id)
            && let Some(instance) = instances.get((id.0 as usize).wrapping_sub(1))
        {
            open.extend(&instance.merged_from);
            open.extend(instance.things.iter().filter(|_| instance.level == Level::Whole));
        }
    }
    let mut voxels: Vec<Voxel> =
        known.into_iter().flat_map(|id| occupancy.of_instance(id)).collect();
    voxels.sort_unstable();
    voxels.dedup();
    voxels
}

fn occupied_in(occupancy: &Occupancy, aabb: &Aabb) -> Vec<Voxel> {
    let grid = &occupancy.grid;
    let [(left, top), (right, bottom)] = [aabb.min(), aabb.max()].map(|corner| {
        let place = |at: f32, origin: f32, cells: usize| {
            (((at - origin) / grid.cell_m).max(0.0) as usize).min(cells - 1)
        };
        (place(corner.x, grid.origin.x, grid.width), place(corner.y, grid.origin.y, grid.height))
    });
    let cells =
        (top..=bottom).flat_map(|row| (left..=right).map(move |column| row * grid.width + column));
    let voxels = cells.flat_map(|cell| {
        (0..LAYERS)
            .filter(move |layer| occupancy.columns[cell] >> layer & 1 == 1)
            .map(move |l| Voxel::new(cell, l))
    });
    voxels.filter(|&voxel| holds(aabb, 0.0, &occupancy.center(voxel))).collect()
}

fn holds(aabb: &Aabb, grown_m: f32, point: &Point3<f32>) -> bool {
    let away = (point - aabb.center).abs();
    (0..3).all(|axis| away[axis] <= aabb.size[axis] / 2.0 + grown_m)
}
