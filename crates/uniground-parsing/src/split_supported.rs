//! Splits things off the surface that supports them, where masks did not separate the two.
//!
//! A lamp on a desk of its own color is hardly visible in any mask, so the last and loosest stages
//! of merging absorb it. But a table top is level, and a thing on it is above it, connected without
//! it, and much smaller. The points alone show that.

use super::planes::Planes;
use super::superpoints::{Patch, Superpoints};
use rayon::prelude::*;
use std::collections::BTreeSet;
use uniground_geometry::Point3;
use uniground_geometry::progress::{Cancelled, Progress};
use uniground_geometry::scene::PointCloud;
use uniground_geometry::statistics::quantile;

/// Edge of the cells footprints are measured in, meters.
const CELL_M: f32 = 0.04;
/// Cosine of 11 degrees: maximum tilt of a superpoint of a top.
const LEVEL: f32 = 0.98;
/// Maximum height step between consecutive level superpoints of one top, meters.
const TOP_STEP_M: f32 = 0.02;
/// Minimum area of a top, square meters.
const MIN_TOP_M2: f32 = 0.1;
/// Minimum height of a thing's middle above its top, meters: less is noise.
const OVER_M: f32 = 0.03;
/// Minimum rise of a thing above its top, meters.
const MIN_RISE_M: f32 = 0.05;
/// Maximum gap between a top and the lowest point of a thing, meters: its lowest points are often
/// assigned to the top.
const CONTACT_M: f32 = 0.08;
/// Maximum share of the top's rectangle that a thing covers; a wider one is a back, a side or a
/// shelf.
const MAX_COVERED: f32 = 0.4;
/// Minimum share of a thing's own footprint over that rectangle.
const OVER_TOP: f32 = 0.7;
/// Maximum share of the region's points in one thing. If most of the region stands on the surface,
/// the surface is its foot, as with a screen.
const MAX_OF_REGION: f32 = 0.5;

/// Gives each thing on a level part of a region its own region, if it has `min_points`. Returns the
/// region `0..n` of each superpoint. Superpoints on planes of the building do not change.
///
/// # Errors
/// [`Cancelled`].
pub fn split_supported(
    cloud: &PointCloud,
    superpoints: &Superpoints,
    planes: &Planes,
    mut region_of: Vec<u32>,
    min_points: u32,
    progress: &Progress,
) -> Result<Vec<u32>, Cancelled> {
    let mut points: Vec<Vec<Point3<f32>>> = vec![Vec::new(); superpoints.patches.len()];
    for (p, &superpoint) in cloud.positions.iter().zip(&superpoints.of_point) {
        points[superpoint as usize].push(*p);
    }
    let pieces: Vec<SuperpointFacts> = points
        .par_iter()
        .zip(&superpoints.patches)
        .map(|(points, patch)| SuperpointFacts::measure(points, patch))
        .collect();
    let mut neighbors = vec![Vec::new(); pieces.len()];
    for &(a, b) in &superpoints.adjacent {
        neighbors[a as usize].push(b);
        neighbors[b as usize].push(a);
    }
    let mut members: Vec<Vec<u32>> =
        vec![Vec::new(); region_of.iter().max().map_or(0, |&region| region as usize + 1)];
    (0..)
        .zip(&region_of)
        .for_each(|(superpoint, &region)| members[region as usize].push(superpoint));
    let mut regions = members.len() as u32;
    for members in members
        .iter()
        .filter(|members| members.iter().all(|&s| planes.of_superpoint[s as usize].is_none()))
    {
        progress.check()?;
        let mut left: BTreeSet<u32> = members.iter().copied().collect();
        let most = (MAX_OF_REGION * count_points(members, &pieces) as f32) as u32;
        for top in find_surfaces(&pieces, members) {
            let above = |s: &u32| {
                let piece = &pieces[*s as usize];
                piece.middle_z > top.z + OVER_M
                    && piece.low_z > top.z - CONTACT_M
                    && !top.members.contains(s)
            };
            for thing in group_connected(left.iter().copied().filter(above).collect(), &neighbors) {
                if (min_points..=most).contains(&count_points(&thing, &pieces))
                    && top.is_supporting(&thing, &pieces)
                {
                    thing.iter().for_each(|s| {
                        left.remove(s);
                        region_of[*s as usize] = regions;
                    });
                    regions += 1;
                }
            }
        }
    }
    Ok(region_of)
}

/// Facts about a superpoint.
struct SuperpointFacts {
    points: u32,
    /// Heights of the 5th, 50th and 95th percentile of its points, meters.
    low_z: f32,
    middle_z: f32,
    high_z: f32,
    is_level: bool,
    footprint: BTreeSet<(i32, i32)>,
}

impl SuperpointFacts {
    fn measure(points: &[Point3<f32>], patch: &Patch) -> Self {
        let mut heights: Vec<f32> = points.iter().map(|p| p.z).collect();
        let mut height = |share| quantile(&mut heights, share).unwrap_or(0.0);
        Self {
            points: points.len() as u32,
            low_z: height(0.05),
            middle_z: height(0.5),
            high_z: height(0.95),
            is_level: patch.normal.z.abs() > LEVEL,
            footprint: points
                .iter()
                .map(|p| ((p.x / CELL_M).floor() as i32, (p.y / CELL_M).floor() as i32))
                .collect(),
        }
    }
}

/// A range of cells: lowest column and row, highest column and row.
#[derive(Clone, Copy)]
struct CellRect([i32; 4]);

impl CellRect {
    fn bounding(cells: &BTreeSet<(i32, i32)>) -> Self {
        let grown = |[left, near, right, far]: [i32; 4], &(x, y): &(i32, i32)| {
            [left.min(x), near.min(y), right.max(x), far.max(y)]
        };
        Self(cells.iter().fold([i32::MAX, i32::MAX, i32::MIN, i32::MIN], grown))
    }

    fn area_cells(self) -> f32 {
        let Self([left, near, right, far]) = self;
        (right - left + 1) as f32 * (far - near + 1) as f32
    }

    /// Returns whether it contains a cell, or one next to it.
    fn contains_cell(self, (x, y): (i32, i32)) -> bool {
        let Self([left, near, right, far]) = self;
        (left - 1..=right + 1).contains(&x) && (near - 1..=far + 1).contains(&y)
    }
}

/// A level part of a region that can support things.
struct SupportSurface {
    z: f32,
    members: BTreeSet<u32>,
    area_m2: f32,
    around: CellRect,
}

impl SupportSurface {
    /// Returns whether these superpoints stand on it as one thing.
    fn is_supporting(&self, thing: &[u32], pieces: &[SuperpointFacts]) -> bool {
        let piece = |&s: &u32| &pieces[s as usize];
        let low_z = thing.iter().map(|s| piece(s).low_z).fold(f32::INFINITY, f32::min);
        let high_z = thing.iter().map(|s| piece(s).high_z).fold(f32::NEG_INFINITY, f32::max);
        let cells = footprint(thing, pieces);
        let over = cells.iter().filter(|cell| self.around.contains_cell(**cell)).count();
        low_z < self.z + CONTACT_M
            && high_z >= self.z + MIN_RISE_M
            && over as f32 >= OVER_TOP * cells.len() as f32
            && CellRect::bounding(&cells).area_cells() <= MAX_COVERED * self.around.area_cells()
    }
}

fn count_points(members: &[u32], pieces: &[SuperpointFacts]) -> u32 {
    members.iter().map(|&s| pieces[s as usize].points).sum()
}

fn footprint(members: &[u32], pieces: &[SuperpointFacts]) -> BTreeSet<(i32, i32)> {
    members.iter().flat_map(|&s| pieces[s as usize].footprint.iter().copied()).collect()
}

/// Returns the level surfaces of a region, largest first.
fn find_surfaces(pieces: &[SuperpointFacts], members: &[u32]) -> Vec<SupportSurface> {
    let height = |&s: &u32| pieces[s as usize].middle_z;
    let mut level: Vec<u32> =
        members.iter().copied().filter(|&s| pieces[s as usize].is_level).collect();
    level.sort_by(|a, b| height(a).total_cmp(&height(b)).then(a.cmp(b)));
    let top = |members: &[u32]| {
        let cells = footprint(members, pieces);
        let area_m2 = cells.len() as f32 * CELL_M * CELL_M;
        let mut heights: Vec<f32> = members.iter().map(height).collect();
        let z = quantile(&mut heights, 0.5).unwrap_or(0.0);
        SupportSurface {
            z,
            members: members.iter().copied().collect(),
            area_m2,
            around: CellRect::bounding(&cells),
        }
    };
    let mut tops: Vec<SupportSurface> =
        level.chunk_by(|a, b| height(b) - height(a) <= TOP_STEP_M).map(top).collect();
    tops.retain(|top| top.area_m2 >= MIN_TOP_M2);
    tops.sort_by(|a, b| b.area_m2.total_cmp(&a.area_m2));
    tops
}

/// Groups these superpoints into connected sets.
fn group_connected(mut left: BTreeSet<u32>, neighbors: &[Vec<u32>]) -> Vec<Vec<u32>> {
    let mut sets = Vec::new();
    while let Some(first) = left.pop_first() {
        let (mut set, mut at) = (vec![first], 0);
        while let Some(&member) = set.get(at) {
            set.extend(neighbors[member as usize].iter().filter(|other| left.remove(other)));
            at += 1;
        }
        sets.push(set);
    }
    sets
}

#[cfg(test)]
mod tests {
    use super::*;
    use uniground_geometry::Vector3;
    use uniground_geometry::color::Lab;

    /// A block from corner to corner, meters, sampled every two centimeters, and its normal.
    type Block = ([f32; 3], [f32; 3], Vector3<f32>);

    /// Splits one region of these blocks, given the pairs that touch. Returns the region of each
    /// block.
    fn split_blocks(blocks: &[Block], adjacent: &[(u32, u32)], plane: Option<u32>) -> Vec<u32> {
        let (mut cloud, mut of_point, mut patches) =
            (PointCloud::default(), Vec::new(), Vec::new());
        for (i, (low, high, normal)) in (0..).zip(blocks) {
            let steps = |axis: usize| 0..=((high[axis] - low[axis]) / 0.02).round() as u32;
            let before = of_point.len();
            for (x, y, z) in
                steps(0).flat_map(|x| steps(1).flat_map(move |y| steps(2).map(move |z| (x, y, z))))
            {
                let at = |axis: usize, k: u32| low[axis] + k as f32 * 0.02;
                cloud.positions.push(Point3::new(at(0, x), at(1, y), at(2, z)));
                of_point.push(i);
            }
            patches.push(Patch {
                points: (of_point.len() - before) as u32,
                center: Point3::origin(),
                normal: *normal,
                lab: Lab::zeros(),
            });
        }
        let count = blocks.len();
        let superpoints = Superpoints {
            of_point,
            patches,
            adjacent: adjacent.to_vec(),
            roughness_m: vec![0.0; count],
        };
        let planes = Planes::new(Vec::new(), vec![plane; count]);
        split_supported(&cloud, &superpoints, &planes, vec![0; count], 50, &Progress::silent())
            .unwrap()
    }

    fn top() -> Block {
        ([0.0, 0.0, 0.74], [1.4, 0.8, 0.74], Vector3::z())
    }

    #[test]
    fn objects_on_a_table_are_split_off_in_one_piece_each() {
        let foot = ([0.2, 0.2, 0.76], [0.3, 0.3, 0.86], Vector3::x());
        let shade = ([0.15, 0.15, 0.86], [0.35, 0.35, 1.1], Vector3::x());
        let box_ = ([1.0, 0.4, 0.76], [1.2, 0.6, 0.9], Vector3::x());
        let leg = ([0.0, 0.0, 0.0], [0.06, 0.06, 0.7], Vector3::x());
        let adjacent = [(0, 1), (1, 2), (0, 3), (0, 4)];
        assert_eq!(
            split_blocks(&[top(), foot, shade, box_, leg], &adjacent, None),
            [0, 1, 1, 2, 0]
        );
        assert_eq!(
            split_blocks(&[top(), foot, shade, box_, leg], &adjacent, Some(0)),
            [0; 5],
            "a plane of the building"
        );
    }

    #[test]
    fn backs_overhangs_and_small_pieces_are_not_split_off() {
        let back = ([0.0, 0.0, 0.76], [1.4, 0.5, 1.2], Vector3::y());
        let beside = ([1.38, 0.2, 0.76], [1.7, 0.6, 1.0], Vector3::x());
        let floating = ([0.5, 0.5, 0.9], [0.7, 0.7, 1.1], Vector3::x());
        let crumb = ([0.5, 0.6, 0.76], [0.52, 0.62, 0.82], Vector3::x());
        for other in [back, beside, floating, crumb] {
            assert_eq!(split_blocks(&[top(), other], &[(0, 1)], None), [0, 0], "{other:?}");
        }
    }

    #[test]
    fn screen_is_not_split_off_its_foot() {
        let foot = ([0.0, 0.0, 0.74], [0.6, 0.4, 0.74], Vector3::z());
        let low = ([0.1, 0.1, 0.76], [0.4, 0.2, 0.86], Vector3::y());
        assert_eq!(
            split_blocks(&[foot, low], &[(0, 1)], None),
            [0, 1],
            "less than half of the region, like a thing on a tray"
        );
        let high = ([0.1, 0.1, 0.76], [0.4, 0.2, 1.2], Vector3::y());
        assert_eq!(split_blocks(&[foot, high], &[(0, 1)], None), [0, 0]);
    }

    #[test]
    fn small_or_sloping_surfaces_do_not_support_things() {
        let mug = ([0.1, 0.1, 0.76], [0.2, 0.2, 0.9], Vector3::x());
        let small = ([0.0, 0.0, 0.74], [0.24, 0.24, 0.74], Vector3::z());
        assert_eq!(split_blocks(&[small, mug], &[(0, 1)], None), [0, 0]);
        let sloping = ([0.0, 0.0, 0.74], [1.4, 0.8, 0.74], Vector3::new(0.0, 0.3, 0.95));
        assert_eq!(split_blocks(&[sloping, mug], &[(0, 1)], None), [0, 0]);
    }
}
