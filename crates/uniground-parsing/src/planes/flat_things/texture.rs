//! A surface as a picture of small cells, and the parts of it that differ from the rest.

use super::{CloudBySuperpoint, ON_TOP_M, Surface, SurfacePoints};
use crate::planes::sheet::{any_perpendicular, connected_components};
use crate::planes::surface_color::{hue_distance, most_common_color};
use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet, HashSet, VecDeque};
use uniground_geometry::boxes::OrientedBox;
use uniground_geometry::color::{Lab, srgb_to_lab};
use uniground_geometry::statistics::median;
use uniground_geometry::{Point2, Vector2};

/// Edge of a cell in multiples of the typical point spacing, and its bounds, meters.
const CELL_SPACINGS: f32 = 1.3;
const CELL_M: std::ops::RangeInclusive<f32> = 0.012..=0.05;
/// About the maximum number of cells of a surface, and of those around it. On larger surfaces,
/// cells are larger.
const MOST_CELLS: f32 = 4e6;
/// Number of empty cells around a surface: more than are ever closed.
const MARGIN: usize = 4;
/// Minimum CIELAB distance of another color.
const OTHER_COLOR: f32 = 6.0;
/// Minimum distance between hues, at the surface's lightness, in multiples of the median over the
/// surface: wood has many colors. A cell below it is the surface under another light.
const OTHER_HUE_MEDIANS: f32 = 3.0;
const OTHER_HUE: f32 = 3.0;
/// Minimum height of a cell above a top in multiples of the distance within which points count as
/// on a plane, which is at least 2 cm.
const RISES_SLACKS: f32 = 0.7;
/// Gaps between parts of one thing up to this width are closed, meters.
const CLOSED_M: f32 = 0.06;
/// Minimum area and width of a flat thing, square meters and meters.
const MIN_AREA_M2: f32 = 0.015;
const MIN_WIDTH_M: f32 = 0.07;
/// Maximum share of the surface that a flat thing covers; a larger area is another surface.
const MAX_OF_SURFACE: f32 = 0.4;
/// Minimum share of its rectangle that a flat thing fills.
const MIN_FILLED: f32 = 0.5;
/// A thing that fills less than the first of its rectangle is split where it is narrow, if its
/// parts then fill more of theirs by the second.
const SPLIT_BELOW: f32 = 0.8;
const SPLIT_GAIN: f32 = 0.1;
/// Maximum width of the place where two things touch, meters.
const MOST_NECK_M: f32 = 0.4;
/// Minimum share of its rim with the surface beside it. At the edge of a surface, another color is
/// mostly that of what comes next.
const MIN_BESIDE: f32 = 0.65;
/// Maximum share of its rim with something tall on it: it is the foot of that.
const MAX_BESIDE_TALL: f32 = 0.15;

/// What the points in a cell show.
#[derive(Debug, Clone, Copy)]
pub(super) struct TextureCell {
    lab: Lab,
    /// Mean height above the surface, meters.
    height_m: f32,
    /// Whether something stands there that is not flat.
    is_tall: bool,
}

/// A surface as a picture.
pub(super) struct Texture {
    width: usize,
    cell_m: f32,
    /// By cell, row by row: what it shows, if it has points.
    pub(super) cells: Vec<Option<TextureCell>>,
    /// Indices of the points, and the cell of each.
    pub(super) points: Vec<u32>,
    pub(super) cell_of_point: Vec<usize>,
}

impl Texture {
    /// Unrolls a surface. `None` if it has no points.
    pub(super) fn of(
        surface: &Surface,
        points: SurfacePoints,
        scan: &CloudBySuperpoint,
        spacing_m: f32,
    ) -> Option<Self> {
        let across = any_perpendicular(&surface.normal);
        let axes = [across, surface.normal.cross(&across)];
        let at = |point: u32| &scan.cloud.positions[point as usize];
        let along = |point: u32| axes.map(|axis| (at(point) - surface.middle).dot(&axis));
        let own: Vec<[f32; 2]> = points.own.iter().map(|&point| along(point)).collect();
        let bound = |i: usize, pick: fn(f32, f32) -> f32| own.iter().map(|at| at[i]).reduce(pick);
        let low = [bound(0, f32::min)?, bound(1, f32::min)?];
        let size = [bound(0, f32::max)? - low[0], bound(1, f32::max)? - low[1]];
        let fine_m = (CELL_SPACINGS * spacing_m).clamp(*CELL_M.start(), *CELL_M.end());
        let longest_m = size[0].max(size[1]);
        let cell_m = fine_m
            .max((size[0] * size[1] / MOST_CELLS).sqrt())
            .max(longest_m * (2 * MARGIN) as f32 / MOST_CELLS);
        let [width, height] = size.map(|size| (size / cell_m) as usize + 1 + 2 * MARGIN);
        let cell = |along: &[f32; 2]| {
            let [a, b] = [0, 1].map(|i| ((along[i] - low[i]).max(0.0) / cell_m) as usize + MARGIN);
            b.min(height - 1) * width + a.min(width - 1)
        };
        let mut texture = Self {
            width,
            cell_m,
            cells: vec![None; width * height],
            points: points.own,
            cell_of_point: own.iter().map(cell).collect(),
        };
        if !points.above.is_empty() {
            let outline = texture.outline();
            for point in points.above {
                let cell = cell(&along(point));
                if outline[cell] {
                    texture.points.push(point);
                    texture.cell_of_point.push(cell);
                }
            }
        }
        texture.fill_cells(surface, scan);
        Some(texture)
    }

    /// Returns the cells with points, and those that they enclose.
    fn outline(&self) -> Vec<bool> {
        let mut occupied = vec![false; self.cells.len()];
        self.cell_of_point.iter().for_each(|&cell| occupied[cell] = true);
        let mut outline = vec![false; self.cells.len()];
        for mut cells in self.components(&self.closed(&occupied)) {
            self.fill(&mut cells);
            cells.into_iter().for_each(|cell| outline[cell] = true);
        }
        outline
    }

    fn fill_cells(&mut self, surface: &Surface, scan: &CloudBySuperpoint) {
        let mut sums = vec![(Lab::zeros(), 0.0, 0_u32, false); self.cells.len()];
        for (&point, &cell) in self.points.iter().zip(&self.cell_of_point) {
            let height_m = surface.height(&scan.cloud.positions[point as usize]);
            let sum = &mut sums[cell];
            if surface.is_top && height_m >= ON_TOP_M.end {
                sum.3 = true;
            } else {
                sum.0 += srgb_to_lab(scan.cloud.colors[point as usize]);
                sum.1 += height_m;
                sum.2 += 1;
            }
        }
        let known: Vec<Option<TextureCell>> = sums
            .into_iter()
            .map(|(lab, height_m, n, is_tall)| {
                let count = n.max(1) as f32;
                (n > 0 || is_tall).then(|| TextureCell {
                    lab: lab / count,
                    height_m: height_m / count,
                    is_tall,
                })
            })
            .collect();
        self.cells = known;
        self.smooth();
    }

    /// Averages the color of each cell with those around it. Fills cells that most cells around
    /// them enclose.
    fn smooth(&mut self) {
        const ENCLOSED: usize = 5;
        let smoothed = (0..self.cells.len()).map(|cell| {
            let own = self.cells[cell];
            if own.is_some_and(|own| own.is_tall) {
                return own;
            }
            let around = self.around(cell).filter_map(|at| self.cells[at]);
            let around: Vec<TextureCell> = around.filter(|cell| !cell.is_tall).collect();
            if own.is_none() && around.len() < ENCLOSED {
                return None;
            }
            let all = || around.iter().chain(&own);
            let n = all().count() as f32;
            let height_m = all().map(|cell| cell.height_m).sum::<f32>() / n;
            Some(TextureCell {
                lab: all().fold(Lab::zeros(), |sum, cell| sum + cell.lab) / n,
                height_m: own.map_or(height_m, |own| own.height_m),
                is_tall: false,
            })
        });
        self.cells = smoothed.collect();
    }

    /// Returns the up to eight cells around a cell.
    fn around(&self, cell: usize) -> impl Iterator<Item = usize> + '_ {
        let (width, height) = (self.width as isize, (self.cells.len() / self.width) as isize);
        let (a, b) = (cell as isize % width, cell as isize / width);
        (-1..=1_isize)
            .flat_map(|j| (-1..=1_isize).map(move |i| (i, j)))
            .filter(|at| *at != (0, 0))
            .map(move |(i, j)| (a + i, b + j))
            .filter(move |(a, b)| (0..width).contains(a) && (0..height).contains(b))
            .map(move |(a, b)| (b * width + a) as usize)
    }

    /// Returns the flat cells that differ from the surface. `None` if it has no main color.
    fn other_cells(&self, slack_m: f32) -> Option<Vec<bool>> {
        let known: Vec<&TextureCell> =
            self.cells.iter().flatten().filter(|cell| !cell.is_tall).collect();
        let labs: Vec<(Lab, u32)> = known.iter().map(|cell| (cell.lab, 1)).collect();
        let color = most_common_color(&labs)?;
        let mut hues: Vec<f32> = labs.iter().map(|(lab, _)| hue_distance(lab, &color)).collect();
        let least = OTHER_HUE.max(OTHER_HUE_MEDIANS * median(&mut hues)?);
        let mut heights: Vec<f32> = known.iter().map(|cell| cell.height_m).collect();
        let base_m = median(&mut heights)?;
        let rises_m = RISES_SLACKS * slack_m;
        let is_other = |cell: &TextureCell| {
            let differs = (cell.lab - color).norm() >= OTHER_COLOR
                && hue_distance(&cell.lab, &color) >= least;
            !cell.is_tall && (differs || cell.height_m - base_m >= rises_m)
        };
        Some(self.cells.iter().map(|cell| cell.as_ref().is_some_and(is_other)).collect())
    }

    /// Returns the cells of each flat thing. `slack_m`: how far points of a plane are from it,
    /// meters.
    pub(super) fn things(&self, slack_m: f32) -> Vec<Vec<usize>> {
        let Some(other) = self.other_cells(slack_m) else { return Vec::new() };
        let known = self.cells.iter().flatten().count() as f32;
        let cell_m2 = self.cell_m * self.cell_m;
        let mut things = Vec::new();
        let mut left = self.components(&self.closed(&other));
        while let Some(mut cells) = left.pop() {
            if (cells.len() as f32) * cell_m2 < 0.5 * MIN_AREA_M2 {
                continue;
            }
            self.fill(&mut cells);
            if let Some(parts) = self.split_at_necks(&cells) {
                left.extend(parts);
                continue;
            }
            let area_m2 = cells.len() as f32 * cell_m2;
            let size = self.rectangle(&cells);
            let (beside, tall) = self.share_beside(&cells, &other);
            if area_m2 >= MIN_AREA_M2
                && cells.len() as f32 <= MAX_OF_SURFACE * known
                && size.min() >= MIN_WIDTH_M
                && area_m2 >= MIN_FILLED * size.x * size.y
                && beside >= MIN_BESIDE
                && tall <= MAX_BESIDE_TALL
            {
                things.push(cells);
            }
        }
        things
    }

    /// Closes gaps between the cells of a set.
    fn closed(&self, set: &[bool]) -> BTreeSet<usize> {
        let reach = (0.5 * CLOSED_M / self.cell_m).ceil() as usize;
        let grown = (0..reach).fold(set.to_vec(), |set, _| self.grown(&set, true));
        let closed = (0..reach).fold(grown, |set, _| self.grown(&set, false));
        (0..closed.len()).filter(|cell| closed[*cell]).collect()
    }

    /// Returns the size of the smallest rectangle around cells, meters.
    fn rectangle(&self, cells: &[usize]) -> Vector2<f32> {
        let center = |cell: &usize| {
            Point2::new((cell % self.width) as f32, (cell / self.width) as f32) * self.cell_m
        };
        let centers: Vec<Point2<f32>> = cells.iter().map(center).collect();
        let rectangle = OrientedBox::min_area(&centers, (0.0, 0.0));
        rectangle.map_or_else(Vector2::zeros, |r| r.size.xy().add_scalar(self.cell_m))
    }

    /// Returns the parts of a thing that only touch: each fills its own rectangle, and all together
    /// do not.
    fn split_at_necks(&self, cells: &[usize]) -> Option<Vec<Vec<usize>>> {
        let cell_m2 = self.cell_m * self.cell_m;
        let fill = |parts: &[Vec<usize>]| {
            let (mut own, mut around) = (0.0, 0.0);
            for part in parts {
                let size = self.rectangle(part);
                own += part.len() as f32 * cell_m2;
                around += size.x * size.y;
            }
            own / around
        };
        let whole = fill(&[cells.to_vec()]);
        if whole > SPLIT_BELOW {
            return None;
        }
        let own: BTreeSet<usize> = cells.iter().copied().collect();
        let mut core = own.clone();
        for _ in 0..(0.5 * MOST_NECK_M / self.cell_m) as usize {
            core = core
                .iter()
                .copied()
                .filter(|&cell| self.around(cell).all(|at| core.contains(&at)))
                .collect();
            let mut parts = self.components(&core);
            parts.retain(|part| part.len() >= 4);
            if parts.len() < 2 {
                continue;
            }
            // Every cell goes to the part that reaches it first.
            let mut part_of: BTreeMap<usize, usize> = BTreeMap::new();
            let mut open: VecDeque<usize> = VecDeque::new();
            for (i, part) in parts.iter().enumerate() {
                part.iter().for_each(|&cell| {
                    part_of.insert(cell, i);
                    open.push_back(cell);
                });
            }
            while let Some(cell) = open.pop_front() {
                let part = part_of[&cell];
                for next in self.around(cell).filter(|next| own.contains(next)) {
                    if let Entry::Vacant(free) = part_of.entry(next) {
                        free.insert(part);
                        open.push_back(next);
                    }
                }
            }
            let mut whole_parts = vec![Vec::new(); parts.len()];
            part_of.into_iter().for_each(|(cell, part)| whole_parts[part].push(cell));
            whole_parts.retain(|part| part.len() as f32 * cell_m2 >= MIN_AREA_M2);
            if whole_parts.len() >= 2 && fill(&whole_parts) >= whole + SPLIT_GAIN {
                return Some(whole_parts);
            }
        }
        None
    }

    /// Grows a set of cells by one cell all around, or shrinks it.
    fn grown(&self, set: &[bool], grow: bool) -> Vec<bool> {
        (0..set.len())
            .map(|cell| match grow {
                true => set[cell] || self.around(cell).any(|at| set[at]),
                false => set[cell] && self.around(cell).all(|at| set[at]),
            })
            .collect()
    }

    /// Returns the connected parts of a set of cells, each ascending.
    fn components(&self, cells: &BTreeSet<usize>) -> Vec<Vec<usize>> {
        let place = |&cell: &usize| ((cell / self.width) as i32, (cell % self.width) as i32);
        let cell = |(row, column): (i32, i32)| row as usize * self.width + column as usize;
        connected_components(&cells.iter().map(place).collect(), 1)
            .into_iter()
            .map(|part| part.into_iter().map(cell).collect())
            .collect()
    }

    /// Adds the cells that a connected set encloses.
    fn fill(&self, cells: &mut Vec<usize>) {
        let column = |cell: &usize| cell % self.width;
        let (Some(left), Some(right)) =
            (cells.iter().map(column).min(), cells.iter().map(column).max())
        else {
            return;
        };
        let (low, high) = (cells[0] / self.width, cells[cells.len() - 1] / self.width);
        let (w, h) = (right - left + 3, high - low + 3);
        let place = |cell: usize| (cell / self.width - low + 1) * w + column(&cell) - left + 1;
        let mut inside = vec![true; w * h];
        let mut wall = vec![false; w * h];
        cells.iter().for_each(|&cell| wall[place(cell)] = true);
        let mut open = vec![0];
        inside[0] = false;
        while let Some(at) = open.pop() {
            let (a, b) = (at % w, at / w);
            let next = [
                (a > 0).then(|| at - 1),
                (a + 1 < w).then_some(at + 1),
                (b > 0).then(|| at.wrapping_sub(w)),
                (b + 1 < h).then_some(at + w),
            ];
            for next in next.into_iter().flatten() {
                if !wall[next] && std::mem::take(&mut inside[next]) {
                    open.push(next);
                }
            }
        }
        *cells = (0..w * h)
            .filter(|&at| inside[at])
            .map(|at| (at / w + low - 1) * self.width + at % w + left - 1)
            .collect();
    }

    /// Returns the shares of the rim of a thing with the surface and with something tall beside it.
    fn share_beside(&self, cells: &[usize], other: &[bool]) -> (f32, f32) {
        let own: HashSet<usize> = cells.iter().copied().collect();
        let rim: Vec<usize> = cells
            .iter()
            .copied()
            .filter(|&cell| self.around(cell).any(|at| !own.contains(&at)))
            .collect();
        let share = |is_beside: &dyn Fn(usize) -> bool| {
            let near = |cell: usize| {
                self.around(cell).any(|at| is_beside(at) || self.around(at).any(is_beside))
            };
            rim.iter().filter(|cell| near(**cell)).count() as f32 / rim.len().max(1) as f32
        };
        let is_tall = |at: usize| self.cells[at].is_some_and(|cell| cell.is_tall);
        let is_surface = |at: usize| {
            !own.contains(&at) && self.cells[at].is_some() && !other[at] && !is_tall(at)
        };
        (share(&is_surface), share(&is_tall))
    }
}
