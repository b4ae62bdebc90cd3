//! Approach poses: which cells remain after each condition, and which of them are best.

use super::clearance::{clearance_m, distances};
use super::floor::{Cell, Floor};
use super::occupancy::Occupancy;
use super::path::{FreeCells, Ways};
use super::target::Target;
use super::visibility::{Look, look};
use rayon::prelude::*;
use std::collections::BTreeMap;
use uniground_geometry::{Point2, Point3};
use uniground_types::approach::{
    CellCounts, FailedCondition, FloorPoint, Robot, StandingPose, Start,
};

/// Number of points of the target that are checked from every candidate, and from those that are
/// returned.
const SAMPLE: usize = 64;
const FINE_SAMPLE: usize = 400;
/// A pose with a smaller visible share counts as not seeing the object.
const LEAST_VISIBLE: f32 = 0.1;
/// Maximum distance from a start that is not free to the nearest free cell, meters.
const START_SEARCH_M: f32 = 0.5;
/// A free area smaller than this, separated from a larger one, is a pocket behind furniture, square
/// meters.
const POCKET_M2: f32 = 0.5;
/// Side of a block of cells of which only the clearest is checked: views from 5 cm apart are the
/// same.
const BLOCK: usize = 3;
/// Poses are apart by this and by the robot's own width, meters. Closer ones are no real
/// alternatives.
const APART_M: f32 = 0.6;

/// Costs of a meter to the object, of the object being entirely hidden, and of a meter of missing
/// clearance, in meters to drive. A meter to the object costs more than a meter of driving;
/// otherwise a robot would stop at the first place with a view.
const NEARNESS: f32 = 2.5;
const HIDDEN: f32 = 3.0;
const TIGHTNESS: f32 = 2.0;
/// More clearance around the robot than this adds nothing, meters.
const ROOMY_M: f32 = 0.3;

/// A request for approach poses.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wish {
    /// The robot to place.
    pub robot: Robot,
    /// The robot's current position.
    pub from: Option<FloorPoint>,
    /// Least and greatest horizontal distance to the object, meters.
    pub distances_m: [f32; 2],
    /// Maximum number of poses to return.
    pub max_poses: usize,
}

/// The approach poses of a request.
#[derive(Debug, Clone, PartialEq)]
pub struct Places {
    /// The poses, best first; or the condition that no cell met.
    pub poses: Result<Vec<StandingPose>, FailedCondition>,
    /// The start of the robot.
    pub start: Option<Start>,
    /// Number of cells that each condition left.
    pub cells: CellCounts,
}

/// A candidate cell, with its measurements before the visibility check.
#[derive(Debug, Clone, Copy)]
struct Candidate {
    cell: usize,
    distance_m: f32,
    reach_m: f32,
    /// Infinite where there is no obstacle.
    clearance_m: f32,
}

/// The room, with the clearance for one robot.
struct Room<'a> {
    occupancy: &'a Occupancy,
    target: &'a Target,
    wish: &'a Wish,
    floor: Floor,
    clearance_m: Vec<f32>,
    free: FreeCells<'a>,
}

/// Finds approach poses.
pub(super) fn places(occupancy: &Occupancy, target: &Target, wish: &Wish) -> Places {
    let grid = &occupancy.grid;
    let floor = Floor::of(occupancy, wish.robot.height_m);
    let to_obstacle =
        distances(grid.width, grid.height, |cell| floor.cells[cell] == Cell::Obstacle);
    let clearance_m: Vec<f32> =
        to_obstacle.into_iter().map(|cells| clearance_m(cells, grid.cell_m)).collect();
    let is_free =
        |cell: usize| floor.cells[cell] == Cell::Floor && clearance_m[cell] >= wish.robot.radius_m;
    let free = FreeCells { grid, free: (0..grid.len()).map(is_free).collect() };
    Room { occupancy, target, wish, floor, clearance_m, free }.places()
}

impl Room<'_> {
    fn places(&self) -> Places {
        let mut cells = CellCounts::default();
        let mut left = self.near();
        cells.near = left.len() as u32;
        left.retain(|candidate| self.floor.cells[candidate.cell] == Cell::Floor);
        cells.floor = left.len() as u32;
        left.retain(|candidate| self.free.free[candidate.cell]);
        cells.clear = left.len() as u32;
        let start = self.wish.from.map(|from| self.start(from));
        let ways = match start {
            Some(None) => {
                return Places { poses: Err(FailedCondition::StartNotFree), start: None, cells };
            }
            Some(Some((cell, _))) => Some(self.free.ways_from(cell)),
            None => None,
        };
        let start = start.flatten().map(|(_, start)| start);
        let (mut left, beyond): (Vec<Candidate>, Vec<Candidate>) = if let Some(ways) = &ways {
            left.into_iter().partition(|candidate| ways.reaches(candidate.cell))
        } else {
            let least = (POCKET_M2 / self.occupancy.grid.cell_m.powi(2)) as usize;
            let area = self.free.largest_area(
                &left.iter().map(|candidate| candidate.cell).collect::<Vec<_>>(),
                least,
            );
            left.into_iter().partition(|candidate| area[candidate.cell])
        };
        cells.connected = left.len() as u32;
        self.measure_reach(&mut left);
        cells.in_reach = left.len() as u32;
        let from = self.clearest(left);
        cells.looked_from = from.len() as u32;
        let mut ranked = self.looked_from(from, ways.as_ref());
        cells.visible = ranked.len() as u32;
        ranked.sort_by(|a, b| {
            a.cost.total_cmp(&b.cost).then(a.candidate.cell.cmp(&b.candidate.cell))
        });
        let poses = match cells {
            CellCounts { floor: 0, .. } => Err(FailedCondition::NoFloor),
            CellCounts { clear: 0, .. } => Err(FailedCondition::NoRoom),
            CellCounts { connected: 0, .. } => Err(FailedCondition::NotReachable),
            CellCounts { in_reach: 0, .. } => Err(FailedCondition::OutOfReach),
            CellCounts { visible: 0, .. } if self.is_seen_from(beyond) => {
                Err(FailedCondition::NotReachable)
            }
            CellCounts { visible: 0, .. } => Err(FailedCondition::NotVisible),
            _ => match self.spread(&ranked, ways.as_ref()) {
                poses if poses.is_empty() => Err(FailedCondition::NotVisible),
                poses => Ok(poses),
            },
        };
        Places { poses, start, cells }
    }

    /// Returns all cells within the distance limits.
    fn near(&self) -> Vec<Candidate> {
        let (grid, [least, most]) = (&self.occupancy.grid, self.wish.distances_m);
        let window = self.target.distances(self.occupancy, most);
        let cells = (0..window.width * window.height)
            .map(|at| (window.column + at % window.width, window.row + at / window.width));
        let candidate = |(column, row): (usize, usize)| {
            let (cell, distance_m) =
                (row * grid.width + column, window.at(column, row)? * grid.cell_m);
            let clearance_m = self.clearance_m[cell];
            (least..=most).contains(&distance_m).then_some(Candidate {
                cell,
                distance_m,
                reach_m: 0.0,
                clearance_m,
            })
        };
        cells.filter_map(candidate).collect()
    }

    /// Returns the start of the robot: the cell it is in, or the nearest free one.
    fn start(&self, from: FloorPoint) -> Option<(usize, Start)> {
        let grid = &self.occupancy.grid;
        let from = Point2::new(from.x as f32, from.y as f32);
        let away = |cell: usize| (grid.center(cell) - from).norm();
        let own = grid.cell(from.x, from.y).filter(|&cell| self.free.free[cell]);
        let [(left, top), (right, bottom)] = [-START_SEARCH_M, START_SEARCH_M].map(|by| {
            let place = |at: f32, origin: f32, cells: usize| {
                (((at + by - origin) / grid.cell_m).max(0.0) as usize).min(cells - 1)
            };
            (place(from.x, grid.origin.x, grid.width), place(from.y, grid.origin.y, grid.height))
        });
        let around = (top..=bottom)
            .flat_map(|row| (left..=right).map(move |column| row * grid.width + column));
        let nearest = || {
            around.filter(|&cell| self.free.free[cell]).min_by(|a, b| away(*a).total_cmp(&away(*b)))
        };
        let cell = own.or_else(nearest).filter(|&cell| away(cell) <= START_SEARCH_M)?;
        let at = grid.center(cell);
        Some((cell, Start { x: at.x, y: at.y, moved_m: away(cell), was_free: own.is_some() }))
    }

    /// Measures the distance an arm has to reach, and removes cells that are out of reach.
    fn measure_reach(&self, candidates: &mut Vec<Candidate>) {
        let (robot, grid) = (&self.wish.robot, &self.occupancy.grid);
        // The reach is never less than this, whatever the height.
        candidates.retain(|candidate| {
            robot.reach_m.is_none_or(|reach| candidate.distance_m - robot.radius_m <= reach)
        });
        let up = |low_m: f32| (low_m - robot.height_m).max(0.0);
        let above: Vec<(Point2<f32>, f32)> = self
            .target
            .footprint
            .iter()
            .map(|&(cell, low_m)| (grid.center(cell), up(low_m)))
            .collect();
        let is_low = above.iter().all(|(_, up_m)| *up_m == 0.0);
        candidates.par_iter_mut().for_each(|candidate| {
            let at = grid.center(candidate.cell);
            let across = |metres: f32| (metres - robot.radius_m).max(0.0);
            let squares =
                above.iter().map(|(part, up_m)| across((part - at).norm()).powi(2) + up_m * up_m);
            // Where no part is higher than the robot, the nearest part is the one already measured.
            candidate.reach_m = if is_low {
                across(candidate.distance_m)
            } else {
                squares.fold(f32::INFINITY, f32::min).sqrt()
            };
        });
        candidates.retain(|candidate| robot.reach_m.is_none_or(|reach| candidate.reach_m <= reach));
    }

    /// Keeps the clearest cell of each block, in order of cell.
    fn clearest(&self, candidates: Vec<Candidate>) -> Vec<Candidate> {
        let mut blocks: BTreeMap<(usize, usize), Candidate> = BTreeMap::new();
        for candidate in candidates {
            let (column, row) = self.occupancy.grid.place(candidate.cell);
            let best = blocks.entry((row / BLOCK, column / BLOCK)).or_insert(candidate);
            if candidate.clearance_m > best.clearance_m {
                *best = candidate;
            }
        }
        blocks.into_values().collect()
    }

    /// Returns whether there are cells with the object in sight and in reach that cannot be reached
    /// by a path.
    fn is_seen_from(&self, mut beyond: Vec<Candidate>) -> bool {
        self.measure_reach(&mut beyond);
        !self.looked_from(self.clearest(beyond), None).is_empty()
    }

    /// Returns the candidates from which the object is in sight.
    fn looked_from(&self, candidates: Vec<Candidate>, ways: Option<&Ways>) -> Vec<Ranked> {
        let sample = self.target.sample(SAMPLE);
        let ranked = candidates.into_par_iter().map(|candidate| {
            let Look { visible_share, .. } =
                look(self.occupancy, self.target, &self.eye(candidate.cell), &sample);
            let path_m =
                ways.map_or(0.0, |ways| ways.length_m(candidate.cell, &self.occupancy.grid));
            Ranked { candidate, visible_share, cost: self.cost(&candidate, visible_share, path_m) }
        });
        ranked.filter(|one| one.visible_share >= LEAST_VISIBLE).collect()
    }

    /// Returns the cost of a pose, in meters to drive.
    fn cost(&self, candidate: &Candidate, visible_share: f32, path_m: f32) -> f32 {
        let room_m = candidate.clearance_m - self.wish.robot.radius_m;
        path_m
            + NEARNESS * candidate.distance_m
            + HIDDEN * (1.0 - visible_share)
            + TIGHTNESS * (ROOMY_M - room_m).max(0.0)
    }

    fn eye(&self, cell: usize) -> Point3<f32> {
        let at = self.occupancy.grid.center(cell);
        Point3::new(at.x, at.y, self.occupancy.floor_z_m + self.wish.robot.eye_height_m)
    }

    /// Returns the best poses, each apart from the others. They are checked once more with more
    /// rays, because few rays may overestimate the visible share.
    fn spread(&self, ranked: &[Ranked], ways: Option<&Ways>) -> Vec<StandingPose> {
        let (grid, apart_m) = (&self.occupancy.grid, APART_M.max(2.0 * self.wish.robot.radius_m));
        let fine = self.target.sample(FINE_SAMPLE);
        let (mut chosen, mut poses): (Vec<Point2<f32>>, Vec<StandingPose>) = Default::default();
        for Ranked { candidate, .. } in ranked {
            let at = grid.center(candidate.cell);
            if chosen.iter().any(|other| (at - other).norm() < apart_m) {
                continue;
            }
            let seen = look(self.occupancy, self.target, &self.eye(candidate.cell), &fine);
            if seen.visible_share >= LEAST_VISIBLE {
                chosen.push(at);
                poses.push(self.pose(candidate, seen, ways));
            }
            if poses.len() == self.wish.max_poses {
                break;
            }
        }
        poses
    }

    fn pose(
        &self,
        candidate: &Candidate,
        Look { visible_share, middle }: Look,
        ways: Option<&Ways>,
    ) -> StandingPose {
        let (grid, at) = (&self.occupancy.grid, self.occupancy.grid.center(candidate.cell));
        let corners =
            ways.map(|ways| self.free.corners(&ways.way_to(candidate.cell))).unwrap_or_default();
        let path: Vec<_> = corners.into_iter().map(|cell| grid.center(cell)).collect();
        // An empty sum of floats is -0.
        let path_m =
            ways.map(|_| path.windows(2).fold(0.0, |sum, leg| sum + (leg[1] - leg[0]).norm()));
        StandingPose {
            position: [at.x, at.y, self.occupancy.floor_z_m],
            yaw_rad: (middle.y - at.y).atan2(middle.x - at.x),
            look_at: middle.coords.into(),
            distance_m: candidate.distance_m,
            reach_m: candidate.reach_m,
            visible_share,
            clearance_m: candidate.clearance_m.is_finite().then_some(candidate.clearance_m),
            path_m,
            path: path.into_iter().map(|corner| corner.coords.into()).collect(),
            why: String::new(),
        }
    }
}

/// A candidate after the visibility check.
#[derive(Debug, Clone, Copy)]
struct Ranked {
    candidate: Candidate,
    visible_share: f32,
    cost: f32,
}
