//! The space that a thing fills, seen from above: columns, and the heights at which each is filled.
//!
//! Boxes are not enough. Around a wall of a room that is rotated in its world, or around an
//! L-shaped counter, a box contains half of the room.

use nalgebra::Rotation2;
use std::collections::BTreeMap;
use uniground_geometry::boxes::OrientedBox;
use uniground_geometry::{Point2, Point3};

/// Edge of a column, meters.
const CELL_M: f32 = 0.05;
/// Height of a level, meters.
const LEVEL_M: f32 = 0.03;

type Cell = (i32, i32);

/// The columns of a thing along its own axes.
#[derive(Debug, Clone)]
pub struct Columns {
    /// Rotation from the world's axes to the thing's own.
    turn: Rotation2<f32>,
    filled: FilledColumns,
    lowest_z: f32,
}

/// Which columns are filled, and at which levels: one bit per level, from the lowest point upward.
/// Anything above the last level counts as in it.
#[derive(Debug, Clone)]
enum FilledColumns {
    Seen {
        columns: BTreeMap<Cell, u128>,
        /// First and last filled column of each row along the thing's X axis, and of each file
        /// along its Y axis.
        rows: BTreeMap<i32, (i32, i32)>,
        files: BTreeMap<i32, (i32, i32)>,
    },
    /// Every column from the first to the last has the same levels. Not expanded, since boxes can
    /// be as large as a scan's coordinates.
    Throughout { first: Cell, last: Cell, levels: u128 },
}

impl Columns {
    /// Builds columns from points (meters, world frame, Z up), along the axes of a box rotated by
    /// `yaw_rad`.
    pub fn from_points(points: impl Iterator<Item = Point3<f32>> + Clone, yaw_rad: f32) -> Self {
        let turn = Rotation2::new(-yaw_rad);
        let lowest_z = points.clone().map(|p| p.z).fold(f32::INFINITY, f32::min);
        let mut columns: BTreeMap<Cell, u128> = BTreeMap::new();
        points.for_each(|p| {
            *columns.entry(cell(&(turn * p.xy()))).or_default() |= 1 << level(p.z - lowest_z);
        });
        let (mut rows, mut files) = (BTreeMap::new(), BTreeMap::new());
        let reach = |spans: &mut BTreeMap<i32, (i32, i32)>, line: i32, at: i32| {
            let span = spans.entry(line).or_insert((at, at));
            *span = (span.0.min(at), span.1.max(at));
        };
        for &(x, y) in columns.keys() {
            reach(&mut rows, y, x);
            reach(&mut files, x, y);
        }
        Self { turn, filled: FilledColumns::Seen { columns, rows, files }, lowest_z }
    }

    /// Builds columns from a box that is completely filled.
    pub fn from_box(filled: &OrientedBox) -> Self {
        let turn = Rotation2::new(-filled.yaw_rad);
        let (center, half) = (turn * filled.center.xy(), filled.size / 2.0);
        let (first, last) = (cell(&(center - half.xy())), cell(&(center + half.xy())));
        let levels = u128::MAX >> (127 - level(filled.size.z));
        Self {
            turn,
            filled: FilledColumns::Throughout { first, last, levels },
            lowest_z: filled.center.z - half.z,
        }
    }

    /// Returns the share of these columns that lie within the outline of the others, which means
    /// between two of them along one of their axes. The outline is used because the surface under a
    /// thing was not seen.
    pub fn share_over(&self, other: &Self) -> f32 {
        let (mut all, mut over) = (0, 0);
        for p in self.filled.cells().map(|own| self.middle(own)) {
            all += 1;
            over += u32::from(other.filled.holds(other.cell(&p)));
        }
        over as f32 / all.max(1) as f32
    }

    /// Returns the share of the columns at this thing's rim next to which the others are filled at
    /// height `z`, meters, plus or minus `within_m`.
    pub fn share_touching(&self, other: &Self, z: f32, within_m: f32) -> f32 {
        let low = z - within_m - other.lowest_z;
        if low + 2.0 * within_m < 0.0 {
            return 0.0;
        }
        let levels = (u128::MAX >> (127 - level(low + 2.0 * within_m))) & (u128::MAX << level(low));
        let (mut rim, mut touching) = (0, 0);
        for own in self.filled.cells().filter(|own| self.filled.is_rim(*own)) {
            rim += 1;
            touching += u32::from(
                cells_around(other.cell(&self.middle(own)), 1)
                    .any(|c| other.filled.at(c) & levels != 0),
            );
        }
        touching as f32 / rim.max(1) as f32
    }

    /// Returns whether one of these columns is within `within_m` meters of the outline of the
    /// others.
    pub fn is_beside(&self, other: &Self, within_m: f32) -> bool {
        let cells = (within_m / CELL_M) as i32;
        self.filled.cells().any(|own| {
            cells_around(other.cell(&self.middle(own)), cells).any(|c| other.filled.holds(c))
        })
    }

    /// Returns the extents along its own axes, the larger first, meters.
    pub fn extents(&self) -> [f32; 2] {
        let [x, y] = self.filled.extents().map(|columns| columns as f32 * CELL_M);
        [x.max(y), x.min(y)]
    }

    /// Returns the column over a point on the ground plan, meters, world frame.
    fn cell(&self, p: &Point2<f32>) -> Cell {
        cell(&(self.turn * p))
    }

    /// Returns the center of a column, meters, world frame.
    fn middle(&self, (x, y): Cell) -> Point2<f32> {
        self.turn.inverse() * Point2::new((x as f32 + 0.5) * CELL_M, (y as f32 + 0.5) * CELL_M)
    }
}

impl FilledColumns {
    fn cells(&self) -> Box<dyn Iterator<Item = Cell> + '_> {
        match self {
            Self::Seen { columns, .. } => Box::new(columns.keys().copied()),
            &Self::Throughout { first, last, .. } => Box::new(
                (first.0..=last.0).flat_map(move |x| (first.1..=last.1).map(move |y| (x, y))),
            ),
        }
    }

    /// Returns the levels filled in a column.
    fn at(&self, cell: Cell) -> u128 {
        match self {
            Self::Seen { columns, .. } => columns.get(&cell).copied().unwrap_or(0),
            Self::Throughout { levels, .. } if self.holds(cell) => *levels,
            Self::Throughout { .. } => 0,
        }
    }

    /// Returns whether a column is within the outline.
    fn holds(&self, (x, y): Cell) -> bool {
        match self {
            Self::Seen { rows, files, .. } => {
                let within = |span: Option<&(i32, i32)>, at| {
                    span.is_some_and(|&(from, to)| (from..=to).contains(&at))
                };
                within(rows.get(&y), x) || within(files.get(&x), y)
            }
            Self::Throughout { first, last, .. } => {
                (first.0..=last.0).contains(&x) && (first.1..=last.1).contains(&y)
            }
        }
    }

    fn is_rim(&self, (x, y): Cell) -> bool {
        [(x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1)].iter().any(|c| self.at(*c) == 0)
    }

    /// Returns the number of columns it spans along X and Y.
    fn extents(&self) -> [i32; 2] {
        let (xs, ys) = match self {
            Self::Seen { rows, files, .. } => {
                let ends = |lines: &BTreeMap<i32, (i32, i32)>| {
                    lines.keys().next().copied().zip(lines.keys().next_back().copied())
                };
                (ends(files), ends(rows))
            }
            Self::Throughout { first, last, .. } => {
                (Some((first.0, last.0)), Some((first.1, last.1)))
            }
        };
        [xs, ys].map(|ends| {
            ends.map_or(0, |(first, last)| last.saturating_sub(first).saturating_add(1))
        })
    }
}

/// Returns the column over a point, meters, along its own axes.
fn cell(own: &Point2<f32>) -> Cell {
    ((own.x / CELL_M).floor() as i32, (own.y / CELL_M).floor() as i32)
}

/// Returns the level at this height above the lowest one, meters.
fn level(over_m: f32) -> u32 {
    (over_m / LEVEL_M).clamp(0.0, 127.0) as u32
}

/// Returns this column and those within `cells` of it.
fn cells_around((x, y): Cell, cells: i32) -> impl Iterator<Item = Cell> {
    (-cells..=cells).flat_map(move |dx| (-cells..=cells).map(move |dy| (x + dx, y + dy)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use uniground_geometry::Vector3;

    fn filled(size: [f32; 3], center: [f32; 3], yaw_rad: f32) -> Columns {
        Columns::from_box(&OrientedBox {
            center: Point3::from(center),
            size: Vector3::from(size),
            yaw_rad,
        })
    }

    #[test]
    fn points_of_a_box_fill_the_same_columns_as_the_box() {
        let points = (0..30).flat_map(|x| {
            (0..20).flat_map(move |y| {
                (0..10).map(move |z| Point3::new(x as f32, y as f32, z as f32) * 0.02)
            })
        });
        let (seen, known) = (
            Columns::from_points(points, 0.0),
            filled([0.58, 0.38, 0.18], [0.29, 0.19, 0.09], 0.0),
        );
        let columns = |of: &Columns| {
            of.filled.cells().map(|c| (c, of.filled.at(c), of.filled.is_rim(c))).collect::<Vec<_>>()
        };
        assert_eq!((columns(&seen), seen.extents()), (columns(&known), known.extents()));
        assert_eq!(seen.share_over(&known), 1.0);
        assert_eq!(seen.share_touching(&known, 0.1, 0.02), 1.0);
        assert_eq!(seen.share_touching(&known, 0.4, 0.02), 0.0, "above its top");
        assert_eq!(seen.share_touching(&known, -0.2, 0.02), 0.0, "below it");
    }

    #[test]
    fn huge_boxes_are_not_expanded_into_columns() {
        let (floor, box_on_it) = (
            filled([1e7, 1e7, 0.1], [0.0, 0.0, -0.05], 0.3),
            filled([0.4, 0.4, 0.4], [3.0, 2.0, 0.2], 0.0),
        );
        assert_eq!(
            (box_on_it.share_over(&floor), box_on_it.share_touching(&floor, 0.0, 0.06)),
            (1.0, 1.0)
        );
        assert!(box_on_it.is_beside(&floor, 0.1) && floor.extents()[1] > 9e6);
    }

    #[test]
    fn rotated_things_are_measured_along_their_own_axes() {
        let wall = filled([4.0, 0.1, 2.0], [0.0, 0.0, 1.0], 0.7);
        assert!(
            (wall.extents()[0] - 4.0).abs() <= 0.1 && wall.extents()[1] <= 0.15,
            "{:?}",
            wall.extents()
        );
        let beside = |off: f32| {
            let at = nalgebra::Rotation2::new(0.7) * Point2::new(1.0, off);
            filled([0.2, 0.2, 0.2], [at.x, at.y, 1.0], 0.7).is_beside(&wall, 0.1)
        };
        assert_eq!([0.2, 0.4, -0.2, -0.4].map(beside), [true, false, true, false]);
    }
}
