//! Classifies the cells of the floor as free, occupied or unknown, and draws the map of them.

use super::occupancy::{BELOW_FLOOR_M, Grid, LAYER_M, LAYERS, Occupancy, layer_of};
use image::{GrayImage, Luma};
use uniground_types::approach::FloorMap;

/// A robot rolls over anything lower than this: rugs, sills, the noise of a depth camera. Meters.
const STEP_M: f32 = 0.05;
/// An obstacle that begins exactly at the robot's height does not touch it: tolerance, meters.
const SLACK_M: f32 = 1e-4;
/// A cell without points counts as floor where at least this many of the eight around it are floor.
/// It is then a hole between points, not an area that was never seen.
const CLOSING_NEIGHBORS: usize = 6;
/// Gray values of `map_server`: 254 is below its threshold for free, 0 is above that for occupied,
/// 205 is in between.
const FREE: Luma<u8> = Luma([254]);
const OCCUPIED: Luma<u8> = Luma([0]);
const UNKNOWN: Luma<u8> = Luma([205]);
/// Thresholds of `map_server`. With this one, 205 is unknown; with 0.25, the default of newer
/// versions, it would be free.
const FREE_THRESHOLD: f32 = 0.196;
const OCCUPIED_THRESHOLD: f32 = 0.65;

/// Classification of a cell.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Cell {
    /// Floor was seen, and nothing above it that is lower than the robot.
    Floor,
    /// An object on the floor, or one that hangs too low.
    Obstacle,
    /// Neither: never seen, or no floor.
    Unknown,
}

/// The floor, classified for a robot of some height.
pub struct Floor {
    pub(super) grid: Grid,
    pub(super) cells: Vec<Cell>,
    height_m: f32,
    /// Height of the floor, meters, world frame.
    z_m: f32,
}

impl Floor {
    /// Classifies the columns up to a height above the floor, meters.
    #[must_use]
    pub fn of(occupancy: &Occupancy, height_m: f32) -> Self {
        let grid = occupancy.grid;
        let step = ((STEP_M + BELOW_FLOOR_M) / LAYER_M).round() as i32;
        let (floor, obstacles) = (layers(0, step - 1), layers(step, layer_of(height_m - SLACK_M)));
        let seen = |column: u128| match (column & obstacles != 0, column & floor != 0) {
            (true, _) => Cell::Obstacle,
            (false, true) => Cell::Floor,
            (false, false) => Cell::Unknown,
        };
        let mut cells: Vec<Cell> = occupancy.columns.iter().map(|&column| seen(column)).collect();
        let holes: Vec<usize> =
            (0..cells.len()).filter(|&cell| is_hole(&grid, &cells, cell)).collect();
        holes.into_iter().for_each(|cell| cells[cell] = Cell::Floor);
        Self { grid, cells, height_m, z_m: occupancy.floor_z_m }
    }

    /// Returns the map and its picture. The picture's first row is the greatest y.
    #[must_use]
    pub fn map(&self) -> (FloorMap, GrayImage) {
        let (width, height) = (self.grid.width as u32, self.grid.height as u32);
        let picture = GrayImage::from_fn(width, height, |x, y| {
            let row = self.grid.height - 1 - y as usize;
            match self.cells[row * self.grid.width + x as usize] {
                Cell::Floor => FREE,
                Cell::Obstacle => OCCUPIED,
                Cell::Unknown => UNKNOWN,
            }
        });
        let map = FloorMap {
            image: "floor.png".into(),
            mode: "trinary".into(),
            resolution: self.grid.cell_m,
            origin: [self.grid.origin.x, self.grid.origin.y, 0.0],
            negate: 0,
            occupied_thresh: OCCUPIED_THRESHOLD,
            free_thresh: FREE_THRESHOLD,
            width,
            height,
            height_m: self.height_m,
            floor_z_m: self.z_m,
        };
        (map, picture)
    }
}

/// Returns the bits of a range of layers, both ends included.
pub(super) fn layers(from: i32, to: i32) -> u128 {
    let (from, to) = (from.max(0), to.min(LAYERS - 1));
    if from > to { 0 } else { (u128::MAX >> (LAYERS - 1 - to + from)) << from }
}

fn is_hole(grid: &Grid, cells: &[Cell], cell: usize) -> bool {
    let (column, row) = grid.place(cell);
    let at_rim = column == 0 || row == 0 || column + 1 == grid.width || row + 1 == grid.height;
    if cells[cell] != Cell::Unknown || at_rim {
        return false;
    }
    let around = [cell - grid.width, cell, cell + grid.width]
        .into_iter()
        .flat_map(|middle| [middle - 1, middle, middle + 1]);
    around.filter(|&other| cells[other] == Cell::Floor).count() >= CLOSING_NEIGHBORS
}
