//! Shortest paths over free cells: eight neighbors, never diagonally past a corner.
//!
//! One search from the start (Dijkstra, with a bucket queue for its integer costs) gives the paths
//! to all poses at once and shows which cells cannot be reached. A search per pose would visit the
//! same cells again. Costs are integers, so that nothing depends on rounding.

use super::occupancy::Grid;

/// Costs of a step along an axis and of a diagonal one. 99 / 70 is the square root of 2 to 5
/// digits.
const STRAIGHT: u32 = 70;
const DIAGONAL: u32 = 99;
const BUCKETS: usize = 128;

/// Free cells. Cells at the rim of the grid are never free.
pub(super) struct FreeCells<'a> {
    pub grid: &'a Grid,
    pub free: Vec<bool>,
}

/// Cost of the path from one start cell to every cell.
pub(super) struct Ways {
    costs: Vec<u32>,
    /// The previous cell on the path.
    before: Vec<u32>,
}

impl FreeCells<'_> {
    /// Returns the cells one step away, and the cost of the step.
    fn steps(&self, cell: usize) -> impl Iterator<Item = (usize, u32)> {
        let width = self.grid.width;
        let [east, west, north, south] = [cell + 1, cell - 1, cell + width, cell - width];
        let straight = [east, west, north, south].map(|to| (to, [to, to], STRAIGHT));
        let diagonal = [
            (north + 1, [north, east]),
            (north - 1, [north, west]),
            (south + 1, [south, east]),
            (south - 1, [south, west]),
        ];
        let all = straight.into_iter().chain(diagonal.map(|(to, past)| (to, past, DIAGONAL)));
        all.filter(|&(to, [a, b], _)| self.free[to] && self.free[a] && self.free[b])
            .map(|(to, _, cost)| (to, cost))
    }

    /// Computes all paths from a free cell.
    pub fn ways_from(&self, start: usize) -> Ways {
        let mut ways = Ways {
            costs: vec![u32::MAX; self.free.len()],
            before: vec![u32::MAX; self.free.len()],
        };
        let mut buckets: Vec<Vec<usize>> = vec![Vec::new(); BUCKETS];
        ways.costs[start] = 0;
        buckets[0].push(start);
        let (mut waiting, mut cost) = (1_usize, 0_u32);
        while waiting > 0 {
            let bucket = std::mem::take(&mut buckets[cost as usize % BUCKETS]);
            waiting -= bucket.len();
            for cell in
                bucket.into_iter().filter(|&cell| ways.costs[cell] == cost).collect::<Vec<_>>()
            {
                for (to, step) in self.steps(cell) {
                    let reached = cost + step;
                    if reached < ways.costs[to] {
                        (ways.costs[to], ways.before[to]) = (reached, cell as u32);
                        buckets[reached as usize % BUCKETS].push(to);
                        waiting += 1;
                    }
                }
            }
            cost += 1;
        }
        ways
    }

    /// Returns the largest connected area of free cells that holds one of `wanted`, as flags by
    /// cell; the first of equals. All flags are false where that area is smaller than `least` cells
    /// and the room has a larger one elsewhere: it is then a pocket that no robot can enter.
    pub fn largest_area(&self, wanted: &[usize], least: usize) -> Vec<bool> {
        let mut area_of = vec![u32::MAX; self.free.len()];
        let mut sizes: Vec<usize> = Vec::new();
        for seed in 0..self.free.len() {
            if !self.free[seed] || area_of[seed] != u32::MAX {
                continue;
            }
            let number = sizes.len() as u32;
            let (mut open, mut size) = (vec![seed], 0);
            area_of[seed] = number;
            while let Some(cell) = open.pop() {
                size += 1;
                // A diagonal step passes two free cells, so these four directions find the same
                // areas.
                for to in [cell + 1, cell - 1, cell + self.grid.width, cell - self.grid.width] {
                    if self.free[to] && area_of[to] == u32::MAX {
                        area_of[to] = number;
                        open.push(to);
                    }
                }
            }
            sizes.push(size);
        }
        let near = wanted.iter().filter(|&&cell| self.free[cell]).map(|&cell| area_of[cell]);
        let best = near.max_by_key(|&area| (sizes[area as usize], std::cmp::Reverse(area)));
        let largest = sizes.iter().max().copied().unwrap_or(0);
        let best = best.filter(|&area| sizes[area as usize] >= least.min(largest));
        area_of.into_iter().map(|area| area != u32::MAX && Some(area) == best).collect()
    }

    /// Returns whether the straight line between the middles of two cells touches free cells only.
    fn is_straight(&self, from: usize, to: usize) -> bool {
        let place = |cell| {
            let (column, row) = self.grid.place(cell);
            (column as i64, row as i64)
        };
        let ((mut x, mut y), (to_x, to_y)) = (place(from), place(to));
        let (dx, dy) = ((to_x - x).abs(), (to_y - y).abs());
        let (step_x, step_y) = ((to_x - x).signum(), (to_y - y).signum());
        let free = |x: i64, y: i64| self.free[y as usize * self.grid.width + x as usize];
        let mut error = dx - dy;
        loop {
            if !free(x, y) {
                return false;
            }
            if (x, y) == (to_x, to_y) {
                return true;
            }
            match error.signum() {
                1 => (x, error) = (x + step_x, error - 2 * dy),
                -1 => (y, error) = (y + step_y, error + 2 * dx),
                // Through a corner: the line touches both cells beside it.
                _ if !free(x + step_x, y) || !free(x, y + step_y) => return false,
                _ => (x, y, error) = (x + step_x, y + step_y, error + 2 * (dx - dy)),
            }
        }
    }

    /// Reduces a path to its corners: cells on a straight line between two others are left out.
    pub fn corners(&self, way: &[usize]) -> Vec<usize> {
        let mut corners: Vec<usize> = way.first().copied().into_iter().collect();
        let mut at = 0;
        while at + 1 < way.len() {
            let straight = (at + 1..way.len()).take_while(|&to| self.is_straight(way[at], way[to]));
            at = straight.last().unwrap_or(at + 1);
            corners.push(way[at]);
        }
        corners
    }
}

impl Ways {
    /// Returns whether there is a path to the cell.
    pub fn reaches(&self, cell: usize) -> bool {
        self.costs[cell] != u32::MAX
    }

    /// Returns the length of the path over cells, meters.
    pub fn length_m(&self, cell: usize, grid: &Grid) -> f32 {
        self.costs[cell] as f32 / STRAIGHT as f32 * grid.cell_m
    }

    /// Returns the cells from the start to a reachable one.
    pub fn way_to(&self, cell: usize) -> Vec<usize> {
        let before = |cell: &usize| {
            self.before
                .get(*cell)
                .filter(|&&before| before != u32::MAX)
                .map(|&before| before as usize)
        };
        let mut way: Vec<usize> = std::iter::successors(Some(cell), before).collect();
        way.reverse();
        way
    }
}
