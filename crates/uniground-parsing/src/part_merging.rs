//! Part merging: joins the parts of a piece of furniture.
//!
//! Masks cut a chair where its seat and back meet in a valley, a bookcase at its boards, and a
//! table off its legs. Five rules hold in any room and need no model:
//!
//! - Parts that touch above and below within the same outline are one stack, such as a bookcase or
//!   a refrigerator.
//! - A slender part that carries something is a leg or pole of it.
//! - A plate that stands on the rim of something as wide as itself is its back.
//! - A part that ends close under something larger and does not stick out is its foot.
//! - Leaves form a plant, together with the pot they grow out of.

mod foliage;

use super::planes::Planes;
use super::superpoints::Superpoints;
use nalgebra::SymmetricEigen;
use rayon::prelude::*;
use std::collections::BTreeMap;
use uniground_geometry::boxes::{Aabb, OrientedBox};
use uniground_geometry::moments::Moments;
use uniground_geometry::progress::{Cancelled, Progress};
use uniground_geometry::scene::PointCloud;
use uniground_geometry::statistics::quantile;
use uniground_geometry::union_find::UnionFind;
use uniground_geometry::{Point3, Vector3};
use uniground_types::settings::PartMergingSettings;

/// Facts about a region, which is a part or an already merged whole.
#[derive(Debug, Clone)]
struct RegionFacts {
    points: f32,
    aabb: Aabb,
    footprint: OrientedBox,
    /// Whether some of it lies on a plane of the building.
    is_structural: bool,
    /// Extents along the principal axes, descending, meters.
    extents: [f32; 3],
    /// Direction of the smallest extent.
    normal: Vector3<f32>,
}

/// Vertical gap or overlap up to which two parts count as touching, meters.
const CONTACT_M: f32 = 0.1;

/// Joins regions that are parts of one thing. Returns the region `0..n` of each superpoint.
///
/// # Errors
/// [`Cancelled`].
pub fn join_parts(
    cloud: &PointCloud,
    superpoints: &Superpoints,
    planes: &Planes,
    region_of: Vec<u32>,
    settings: &PartMergingSettings,
    progress: &Progress,
) -> Result<Vec<u32>, Cancelled> {
    if !settings.enabled {
        return Ok(region_of);
    }
    progress.report("join_parts", 0.0)?;
    let joining = PartMerger { cloud, superpoints, planes, settings, progress };
    let is_leg =
        |part: &RegionFacts, whole: &RegionFacts| is_leg(settings, part) && ends_under(part, whole);
    let is_back = |part: &RegionFacts, whole: &RegionFacts| is_back(settings, part, whole);
    let is_stacked = |part: &RegionFacts, whole: &RegionFacts| is_stacked(settings, part, whole);
    let rules: [&PartRule; 4] = [&is_stacked, &is_leg, &is_back, &is_foot];
    let count = region_of.iter().max().map_or(0, |&region| region as usize + 1);
    let (mut region_of, mut known) = (region_of, vec![None; count]);
    let parts = joining.measure_regions(&region_of, known)?;
    (region_of, known) = foliage::join_foliage(superpoints, region_of, &parts);
    for rule in rules {
        let parts = joining.measure_regions(&region_of, known)?;
        (region_of, known) = joining.join_by_rule(region_of, &parts, rule);
    }
    Ok(region_of)
}

/// Whether the first region is a part of the second.
type PartRule<'a> = dyn Fn(&RegionFacts, &RegionFacts) -> bool + 'a;

struct PartMerger<'a> {
    cloud: &'a PointCloud,
    superpoints: &'a Superpoints,
    planes: &'a Planes,
    settings: &'a PartMergingSettings,
    progress: &'a Progress,
}

impl PartMerger<'_> {
    /// Joins each region with the neighbor it is a part of: `rule(part, whole)` decides. Of several
    /// such neighbors, it joins the one with which it shares most border. Returns the new regions,
    /// and the facts of those that did not change.
    fn join_by_rule(
        &self,
        region_of: Vec<u32>,
        parts: &[RegionFacts],
        rule: &PartRule,
    ) -> (Vec<u32>, Vec<Option<RegionFacts>>) {
        let mut contacts: BTreeMap<(u32, u32), u32> = BTreeMap::new();
        for &(a, b) in &self.superpoints.adjacent {
            let (a, b) = (region_of[a as usize], region_of[b as usize]);
            if a != b {
                *contacts.entry((a, b)).or_default() += 1;
                *contacts.entry((b, a)).or_default() += 1;
            }
        }
        let furniture = |part: &RegionFacts| part.footprint.size.max() <= self.settings.longest_m;
        let mut best: BTreeMap<u32, (u32, std::cmp::Reverse<u32>)> = BTreeMap::new();
        for (&(a, b), &n) in &contacts {
            let (part, whole) = (&parts[a as usize], &parts[b as usize]);
            if furniture(part) && furniture(whole) && rule(part, whole) {
                let offer = (n, std::cmp::Reverse(b));
                let seat = best.entry(a).or_insert(offer);
                *seat = (*seat).max(offer);
            }
        }
        let mut sets = UnionFind::new(parts.len());
        for (part, (_, std::cmp::Reverse(whole))) in best {
            sets.union(part, whole);
        }
        join_sets(sets, region_of, parts)
    }

    /// Computes the facts of every region, given those already known.
    fn measure_regions(
        &self,
        region_of: &[u32],
        known: Vec<Option<RegionFacts>>,
    ) -> Result<Vec<RegionFacts>, Cancelled> {
        let mut members: Vec<Vec<Point3<f32>>> = vec![Vec::new(); known.len()];
        let mut structural = vec![false; known.len()];
        for (&region, plane) in region_of.iter().zip(&self.planes.of_superpoint) {
            structural[region as usize] |= plane.is_some();
        }
        for (p, &superpoint) in self.cloud.positions.iter().zip(&self.superpoints.of_point) {
            let region = region_of[superpoint as usize] as usize;
            if known[region].is_none() {
                members[region].push(*p);
            }
        }
        let part = |(known, (positions, &is_structural)): (
            Option<RegionFacts>,
            (&Vec<Point3<f32>>, &bool),
        )| {
            self.progress.check()?;
            Ok(known.unwrap_or_else(|| RegionFacts {
                is_structural,
                ..RegionFacts::measure(positions)
            }))
        };
        known.into_par_iter().zip(members.par_iter().zip(&structural)).map(part).collect()
    }
}

/// Joins sets of regions. Returns the new regions, and the facts of those that did not change.
fn join_sets(
    sets: UnionFind,
    region_of: Vec<u32>,
    parts: &[RegionFacts],
) -> (Vec<u32>, Vec<Option<RegionFacts>>) {
    let (labels, count) = sets.into_labels();
    let mut joined = vec![0; count];
    labels.iter().for_each(|&label| joined[label as usize] += 1);
    let mut known = vec![None; count];
    for (part, &label) in
        parts.iter().zip(&labels).filter(|(_, label)| joined[**label as usize] == 1)
    {
        known[label as usize] = Some(part.clone());
    }
    (region_of.into_iter().map(|r| labels[r as usize]).collect(), known)
}

/// Returns whether the part is directly above or below the other with the same outline, neither far
/// from it nor reaching far into it. The smaller joins the larger. A part that leaves a rim free
/// all around stands there as a separate thing.
fn is_stacked(settings: &PartMergingSettings, part: &RegionFacts, whole: &RegionFacts) -> bool {
    /// Minimum intersection over union of both outlines along each axis of the larger one.
    const SAME_OUTLINE: f32 = 0.75;
    /// Maximum gap or overlap in height, as a share of both together.
    const APART: f32 = 0.4;
    /// Minimum width of a rim, meters.
    const RIM_M: f32 = 0.03;
    if part.is_structural || whole.is_structural || part.points > whole.points {
        return false;
    }
    let (low, high) =
        (part.aabb.min().z.min(whole.aabb.min().z), part.aabb.max().z.max(whole.aabb.max().z));
    let off = (part.aabb.size.z + whole.aabb.size.z - (high - low)).abs();
    if high - low > settings.longest_m || off > APART * (high - low) {
        return false;
    }
    let (upper, lower) =
        if part.aabb.center.z > whole.aabb.center.z { (part, whole) } else { (whole, part) };
    let [upper, lower] = [upper, lower].map(|part| part.footprint_ranges(whole.footprint.yaw_rad));
    let along = || upper.iter().zip(&lower);
    let is_same = along()
        .all(|(a, b)| a.1.min(b.1) - a.0.max(b.0) >= SAME_OUTLINE * (a.1.max(b.1) - a.0.min(b.0)));
    let leaves_rim =
        along().all(|(upper, lower)| upper.0 - lower.0 >= RIM_M && lower.1 - upper.1 >= RIM_M);
    is_same && !leaves_rim
}

fn is_leg(settings: &PartMergingSettings, part: &RegionFacts) -> bool {
    const SLENDER: f32 = 3.0;
    let [long, wide, _] = part.extents;
    wide <= settings.leg_thickness_m && long >= SLENDER * wide
}

/// Returns whether it is upright, thin, no taller than furniture, as wide as the seat, and at its
/// rim.
fn is_back(settings: &PartMergingSettings, part: &RegionFacts, seat: &RegionFacts) -> bool {
    const TALLEST_M: f32 = 1.0;
    /// Maximum lean of a plate from upright: sine of 35 degrees.
    const UPRIGHT: f32 = 0.57;
    let stands_on = (part.aabb.min().z - seat.aabb.max().z).abs() <= 1.5 * CONTACT_M;
    if part.extents[2] > settings.plate_thickness_m
        || part.normal.z.abs() > UPRIGHT
        || part.aabb.size.z > TALLEST_M
        || !stands_on
    {
        return false;
    }
    let Some(across) = part.normal.xy().try_normalize(1e-6) else { return false };
    let along = nalgebra::Vector2::new(-across.y, across.x);
    let ratio = part.width(&along) / seat.width(&along).max(1e-3);
    let offset = (part.aabb.center - seat.aabb.center).xy().dot(&across).abs();
    (settings.back_width..=1.0 / settings.back_width).contains(&ratio)
        && offset >= 0.25 * seat.width(&across)
}

/// Returns whether the other begins where this part ends.
fn ends_under(part: &RegionFacts, other: &RegionFacts) -> bool {
    other.aabb.center.z > part.aabb.center.z
        && (other.aabb.min().z - part.aabb.max().z).abs() <= 1.5 * CONTACT_M
}

/// Returns whether the part is smaller, below the other, and does not stick out.
fn is_foot(part: &RegionFacts, other: &RegionFacts) -> bool {
    const UNDER: f32 = 0.8;
    part.points < 0.5 * other.points
        && part.aabb.size.z >= CONTACT_M
        && part.aabb.center.z < other.aabb.min().z
        && (other.aabb.min().z - part.aabb.max().z).abs() <= CONTACT_M
        && part.aabb.footprint_overlap(&other.aabb) >= UNDER
}

impl RegionFacts {
    fn measure(positions: &[Point3<f32>]) -> Self {
        /// Share of the points ignored at either end, so that outliers do not make a leg thick.
        const TRIM: f32 = 0.02;
        let axes = SymmetricEigen::new(Moments::from_points(positions).covariance).eigenvectors;
        let range = |of: &dyn Fn(&Point3<f32>) -> f32| {
            let mut values: Vec<f32> = positions.iter().map(of).collect();
            (
                quantile(&mut values, TRIM).unwrap_or(0.0),
                quantile(&mut values, 1.0 - TRIM).unwrap_or(0.0),
            )
        };
        let mut extents: [(f32, usize); 3] = std::array::from_fn(|i| {
            let (lo, hi) = range(&|p| p.coords.dot(&axes.column(i)));
            (hi - lo, i)
        });
        extents.sort_by(|a, b| b.0.total_cmp(&a.0));
        let bounds: [(f32, f32); 3] = std::array::from_fn(|axis| range(&|p| p[axis]));
        let aabb = Aabb::from_corners(
            Point3::from(bounds.map(|b| b.0)),
            Point3::from(bounds.map(|b| b.1)),
        );
        let ground: Vec<_> = positions.iter().map(Point3::xy).collect();
        let flat = OrientedBox { center: aabb.center, size: aabb.size, yaw_rad: 0.0 };
        let footprint = OrientedBox::min_area(&ground, bounds[2]).unwrap_or(flat);
        Self {
            points: positions.len() as f32,
            aabb,
            footprint,
            is_structural: false,
            extents: extents.map(|e| e.0),
            normal: axes.column(extents[2].1).into_owned(),
        }
    }

    /// Returns the range of the footprint along the two axes of a world rotated by `yaw_rad` about
    /// Z, meters.
    fn footprint_ranges(&self, yaw_rad: f32) -> [(f32, f32); 2] {
        let OrientedBox { center, size, yaw_rad: own_rad } = self.footprint;
        let (sin, cos) = yaw_rad.sin_cos();
        let (turned_sin, turned_cos) = (own_rad - yaw_rad).sin_cos();
        let (x, y) = (cos * center.x + sin * center.y, cos * center.y - sin * center.x);
        let half_x = f32::midpoint(size.x * turned_cos.abs(), size.y * turned_sin.abs());
        let half_y = f32::midpoint(size.x * turned_sin.abs(), size.y * turned_cos.abs());
        [(x - half_x, x + half_x), (y - half_y, y + half_y)]
    }

    /// Returns the extent of the footprint along a horizontal direction, meters.
    fn width(&self, direction: &nalgebra::Vector2<f32>) -> f32 {
        let (sin, cos) = self.footprint.yaw_rad.sin_cos();
        let (u, v) = (cos * direction.x + sin * direction.y, cos * direction.y - sin * direction.x);
        // Along an oblique direction, a rectangle is as wide as the chord through its center.
        let (x, y) = (self.footprint.size.x, self.footprint.size.y);
        (x / u.abs().max(1e-6)).min(y / v.abs().max(1e-6))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::superpoints::Patch;
    use uniground_geometry::color::Lab;

    /// A block from corner to corner, meters, sampled every two centimeters.
    type Block = ([f32; 3], [f32; 3]);

    /// Joins blocks, given the pairs that touch. Returns the whole that each belongs to.
    fn joined(blocks: &[Block], adjacent: &[(u32, u32)]) -> Vec<u32> {
        let (mut cloud, mut of_point) = (PointCloud::default(), Vec::new());
        for (i, (low, high)) in blocks.iter().enumerate() {
            let steps = |axis: usize| 0..=((high[axis] - low[axis]) / 0.02).round() as u32;
            for x in steps(0) {
                for y in steps(1) {
                    for z in steps(2) {
                        let at = |axis: usize, k: u32| low[axis] + k as f32 * 0.02;
                        cloud.positions.push(Point3::new(at(0, x), at(1, y), at(2, z)));
                        of_point.push(i as u32);
                    }
                }
            }
        }
        let patch =
            Patch { points: 1, center: Point3::origin(), normal: Vector3::z(), lab: Lab::zeros() };
        let superpoints = Superpoints {
            of_point,
            patches: vec![patch; blocks.len()],
            adjacent: adjacent.to_vec(),
            roughness_m: vec![0.0; blocks.len()],
        };
        let planes = Planes::new(Vec::new(), vec![None; blocks.len()]);
        join_parts(
            &cloud,
            &superpoints,
            &planes,
            (0..blocks.len() as u32).collect(),
            &PartMergingSettings::default(),
            &Progress::silent(),
        )
        .unwrap()
    }

    const SEAT: Block = ([0.0, 0.0, 0.42], [0.44, 0.44, 0.46]);

    #[test]
    fn seat_legs_and_back_join_into_a_chair() {
        let leg = |x: f32, y: f32| ([x, y, 0.0], [x + 0.04, y + 0.04, 0.42]);
        let back = ([0.0, 0.42, 0.46], [0.44, 0.46, 0.9]);
        let parts = [SEAT, leg(0.0, 0.0), leg(0.4, 0.0), leg(0.0, 0.4), leg(0.4, 0.4), back];
        assert_eq!(joined(&parts, &[(0, 1), (0, 2), (0, 3), (0, 4), (0, 5)]), [0; 6]);
        assert_eq!(joined(&parts, &[]), [0, 1, 2, 3, 4, 5], "only adjacent parts are joined");
    }

    #[test]
    fn poles_and_feet_join_the_part_above_them() {
        let lamp = [([-0.2, -0.2, 1.3], [0.2, 0.2, 1.6]), ([-0.01, -0.01, 0.1], [0.01, 0.01, 1.3])];
        assert_eq!(joined(&lamp, &[(0, 1)]), [0, 0]);
        let foot = ([0.16, 0.16, 0.0], [0.28, 0.28, 0.38]);
        let cushion = ([0.0, 0.0, 0.38], [0.44, 0.44, 0.52]);
        assert_eq!(joined(&[cushion, foot], &[(0, 1)]), [0, 0]);
    }

    #[test]
    fn stacked_parts_with_the_same_outline_are_joined() {
        let storey = |z: f32| ([0.0, 0.0, z], [0.9, 0.36, z + 0.4]);
        assert_eq!(
            joined(&[storey(0.0), storey(0.42), storey(0.84)], &[(0, 1), (1, 2)]),
            [0, 0, 0],
            "a bookcase"
        );
        let beside = ([0.92, 0.0, 0.0], [1.82, 0.36, 0.4]);
        assert_eq!(
            joined(&[storey(0.0), beside], &[(0, 1)]),
            [0, 1],
            "two identical shelves side by side"
        );
        let before = ([0.0, 0.38, 0.0], [0.9, 0.7, 0.4]);
        assert_eq!(joined(&[storey(0.0), before], &[(0, 1)]), [0, 1]);
        let narrower = ([0.1, 0.0, 0.42], [0.7, 0.36, 0.8]);
        assert_eq!(joined(&[storey(0.0), narrower], &[(0, 1)]), [0, 1], "a screen on its cabinet");
        let far_over = ([0.0, 0.0, 1.6], [0.9, 0.36, 2.0]);
        assert_eq!(joined(&[storey(0.0), far_over], &[(0, 1)]), [0, 1]);
        let too_high = ([0.0, 0.0, 0.42], [0.9, 0.36, 3.2]);
        assert_eq!(joined(&[([0.0, 0.0, -2.0], [0.9, 0.36, 0.4]), too_high], &[(0, 1)]), [0, 1]);
    }

    #[test]
    fn stacked_parts_are_compared_along_their_own_axes_and_never_with_walls() {
        let block = |low: f32, yaw: f32| {
            let at = |i: u32, j: u32, k: u32| {
                let (x, y) = (i as f32 * 0.02, j as f32 * 0.02);
                Point3::new(
                    x * yaw.cos() - y * yaw.sin(),
                    x * yaw.sin() + y * yaw.cos(),
                    low + k as f32 * 0.02,
                )
            };
            let points: Vec<_> = (0..50)
                .flat_map(|i| (0..16).flat_map(move |j| (0..20).map(move |k| (i, j, k))))
                .map(|(i, j, k)| at(i, j, k))
                .collect();
            RegionFacts::measure(&points)
        };
        let settings = PartMergingSettings::default();
        assert!(is_stacked(&settings, &block(0.0, 0.6), &block(0.4, 0.6)));
        assert!(!is_stacked(&settings, &block(0.0, 0.6), &block(0.4, 1.4)), "different rotations");
        assert!(!is_stacked(
            &settings,
            &block(0.0, 0.6),
            &RegionFacts { is_structural: true, ..block(0.4, 0.6) }
        ));
    }

    #[test]
    fn objects_on_a_table_stay_separate() {
        let top = ([0.0, 0.0, 0.7], [1.4, 0.8, 0.74]);
        let mug = ([0.6, 0.3, 0.74], [0.68, 0.38, 0.84]);
        let bottle = ([0.2, 0.4, 0.74], [0.26, 0.46, 1.04]);
        let monitor = ([0.4, 0.6, 0.74], [0.9, 0.64, 1.1]);
        assert_eq!(joined(&[top, mug, bottle, monitor], &[(0, 1), (0, 2), (0, 3)]), [0, 1, 2, 3]);
    }

    #[test]
    fn walls_are_not_backs_and_cabinets_are_not_feet() {
        let desk = ([0.0, 0.0, 0.7], [1.4, 0.7, 0.74]);
        let wall = ([0.0, 0.7, 0.74], [1.4, 0.74, 2.4]);
        assert_eq!(joined(&[desk, wall], &[(0, 1)]), [0, 1]);
        let (cabinet, printer) =
            (([0.0, 0.0, 0.0], [0.5, 0.5, 0.6]), ([0.05, 0.05, 0.6], [0.45, 0.45, 0.8]));
        assert_eq!(joined(&[cabinet, printer], &[(0, 1)]), [0, 1]);
    }
}
