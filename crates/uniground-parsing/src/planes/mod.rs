//! The planes of a building: floors, ceilings and walls, found before merging.
//!
//! Masks are unreliable where a room is plain: two white walls share one mask, or the mask of a
//! desk includes the wall behind it. But a wall is a plane, and no thing lies on both sides of the
//! edge where two planes meet. So superpoints are first separated by the plane they lie on.
//! [`merging`](super::merging) never joins superpoints of different planes, or those on a plane
//! with those before it.
//!
//! Free space decides whether a plane belongs to the building. A floor has cameras above it and
//! nothing below; a ceiling has nothing above it. Over the top of a wall nothing is visible; over
//! the top of a wardrobe, the wall behind it is. Where only a low part of a wall was seen, nothing
//! at all is behind it.

pub mod flat_things;
mod rugs;
mod seen;
mod sheet;
mod surface_color;

use super::superpoints::{Patch, Superpoints};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use sheet::{PlanePart, SuperpointPlane, connected_components, fit};
use std::collections::{BTreeMap, BTreeSet};
use uniground_geometry::boxes::Aabb;
use uniground_geometry::progress::{Cancelled, Progress};
use uniground_geometry::scene::{PointCloud, Structure};
use uniground_geometry::statistics::{median, quantile};
use uniground_geometry::union_find::UnionFind;
use uniground_geometry::{Point3, Vector3};

/// A plane of the building.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Plane {
    /// Floor, wall or ceiling.
    pub structure: Structure,
    /// Unit length; sign arbitrary.
    pub normal: Vector3<f32>,
    /// A point on the plane, meters.
    pub middle: Point3<f32>,
    /// Area that was seen, square meters.
    pub area_m2: f32,
}

/// The planes of a scan, and the superpoints that lie on them.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Planes {
    /// Largest first.
    pub planes: Vec<Plane>,
    /// By superpoint: the index of its plane in `planes`.
    pub of_superpoint: Vec<Option<u32>>,
    /// By superpoint: the flat thing on a plane that it belongs to, numbered from 0.
    pub flat_thing_of: Vec<Option<u32>>,
}

impl Planes {
    /// Returns the height of the lowest floor, meters, if one was found.
    #[must_use]
    pub fn floor_z(&self) -> Option<f32> {
        self.planes
            .iter()
            .filter(|p| p.structure == Structure::Floor)
            .map(|p| p.middle.z)
            .min_by(f32::total_cmp)
    }

    /// Returns planes, and the superpoints on them, without flat things.
    #[must_use]
    pub fn new(planes: Vec<Plane>, of_superpoint: Vec<Option<u32>>) -> Self {
        let flat_thing_of = vec![None; of_superpoint.len()];
        Self { planes, of_superpoint, flat_thing_of }
    }

    /// Returns, by superpoint, what merging keeps apart: the number of a plane, or of a flat thing
    /// after those of all planes.
    #[must_use]
    pub fn kept_apart(&self) -> Vec<Option<u32>> {
        let after_planes = |thing: u32| self.planes.len() as u32 + thing;
        self.of_superpoint
            .iter()
            .zip(&self.flat_thing_of)
            .map(|(plane, thing)| plane.or_else(|| thing.map(after_planes)))
            .collect()
    }

    /// Joins small patches on a plane with the plane. A patch that lies on a wall, has its color
    /// and is no larger than a picture is a piece of the wall that masks have cut off. `region_of`
    /// must separate planes. Returns the region of each superpoint, `0..n`.
    #[must_use]
    pub fn with_patches(&self, superpoints: &Superpoints, region_of: &[u32]) -> Vec<u32> {
        let count = region_of.iter().max().map_or(0, |&r| r as usize + 1);
        let regions = Patch::merge_by_label(&superpoints.patches, region_of, count);
        let mut plane_of = vec![None; count];
        region_of.iter().zip(&self.of_superpoint).for_each(|(&region, &plane)| {
            plane_of[region as usize] = plane_of[region as usize].or(plane);
        });
        let mut sets = UnionFind::new(count);
        for (k, plane) in self.planes.iter().enumerate() {
            let on: Vec<usize> = (0..count).filter(|&r| plane_of[r] == Some(k as u32)).collect();
            let points: u32 = on.iter().map(|&r| regions[r].points).sum();
            let area_m2 = |r: usize| regions[r].points as f32 / points as f32 * plane.area_m2;
            let large: Vec<usize> =
                on.iter().copied().filter(|&r| area_m2(r) >= MIN_AREA_M2).collect();
            for &patch in on.iter().filter(|&&r| area_m2(r) < MAX_PATCH_M2) {
                let differs = |r: usize| (regions[r].lab - regions[patch].lab).norm();
                let alike = large
                    .iter()
                    .copied()
                    .min_by(|&a, &b| differs(a).total_cmp(&differs(b)).then(a.cmp(&b)));
                if let Some(whole) = alike.filter(|&r| differs(r) < SAME_COLOR) {
                    sets.union(whole as u32, patch as u32);
                }
            }
        }
        let (labels, _) = sets.into_labels();
        region_of.iter().map(|&r| labels[r as usize]).collect()
    }
}

/// Maximum area of a patch, square meters. Larger pieces of a plane are separate things or parts of
/// the building.
const MAX_PATCH_M2: f32 = 0.15;
/// CIELAB distance within which a patch has the color of its plane.
const SAME_COLOR: f32 = 10.0;

/// Points count as on a plane within three times the noise of the scan, but at least within this
/// distance, meters.
const MIN_SLACK_M: f32 = 0.02;
/// Upper bound of that distance, meters: anything that stands out more is a thing.
const MAX_SLACK_M: f32 = 0.06;
/// Factor on that distance for assigning points to a known plane, because poses drift and walls
/// bend.
const ASSIGNED_SLACKS: f32 = 1.5;
/// Minimum share of a superpoint's points on a plane for the superpoint to lie on it.
const ON_PLANE: f32 = 0.7;
/// Cosine of 20 degrees: maximum angle between the normals of a superpoint and its plane.
const SAME_NORMAL: f32 = 0.94;
/// Cosine of 10 degrees: the same for the superpoints that a plane is fitted to.
const GIVES_NORMAL: f32 = 0.985;
/// Edge of the cells in which planes are measured, meters.
const CELL_M: f32 = 0.1;
/// Maximum gap between parts of one plane, meters: furniture can hide that much of a wall. Parts
/// farther apart are different planes.
const GAP_M: f32 = 1.0;
/// Minimum area of a plane, square meters; smaller ones are things.
const MIN_AREA_M2: f32 = 1.0;
/// Minimum area of a superpoint that starts a plane, square meters: the normals of smaller ones are
/// noise.
const MIN_SEED_M2: f32 = 0.04;
/// Minimum width of a wall, and its minimum height above the floor, meters.
const MIN_WALL_WIDTH_M: f32 = 0.5;
const MIN_WALL_TOP_M: f32 = 1.6;
/// The same for the lower part of a wall, where nothing is visible behind it.
const MIN_LOW_WALL_WIDTH_M: f32 = 1.0;
const MIN_LOW_WALL_TOP_M: f32 = 0.9;
/// A point farther behind a plane than this counts as behind it, meters.
const BEHIND_M: f32 = 0.15;
/// Maximum share of cells with something behind or below them. From there on, a plane bounds no
/// room.
const MAX_SEEN_BEHIND: f32 = 0.25;
/// The same for the lower part of a wall. Over kitchen cabinets, the wall behind is visible along
/// nearly all of their width.
const MAX_SEEN_BEHIND_LOW: f32 = 0.1;
/// Minimum height of a ceiling above the floor, meters.
const MIN_CEILING_M: f32 = 1.9;
const THICKEST_RUG_M: f32 = 0.06;

/// Finds the planes. `cameras` are camera centers, meters. Without any, floors and ceilings are
/// recognized by what lies above and below.
///
/// # Errors
/// [`Cancelled`].
pub fn find(
    cloud: &PointCloud,
    superpoints: &Superpoints,
    cameras: &[Point3<f32>],
    progress: &Progress,
) -> Result<Planes, Cancelled> {
    progress.report("planes", 0.0)?;
    let scan = CloudBySuperpoint::of(cloud, superpoints);
    let mut left: BTreeSet<u32> = (0..scan.patches.len() as u32)
        .filter(|&s| scan.patches[s as usize].area_m2 >= MIN_SEED_M2)
        .collect();
    let mut seeds: Vec<u32> = left.iter().copied().collect();
    seeds.sort_by(|&a, &b| {
        scan.patches[b as usize]
            .area_m2
            .total_cmp(&scan.patches[a as usize].area_m2)
            .then(a.cmp(&b))
    });
    let mut candidates = Vec::new();
    for seed in seeds {
        progress.check()?;
        if left.contains(&seed) {
            let members = scan.find_coplanar(seed, &left);
            members.iter().for_each(|s| {
                left.remove(s);
            });
            candidates.extend(scan.split_into_sheets(&members));
        }
    }
    let floors = candidates
        .iter()
        .filter(|sheet| sheet.is_level() && scan.is_floor(sheet, cameras, f32::INFINITY));
    let floor_z =
        floors.map(|sheet| sheet.middle.z).min_by(f32::total_cmp).unwrap_or(scan.lowest_z);
    let mut planes: Vec<(PlanePart, Structure)> = candidates
        .into_iter()
        .filter_map(|sheet| scan.classify_sheet(&sheet, cameras, floor_z).map(|s| (sheet, s)))
        .collect();
    let walls: Vec<(Point3<f32>, Vector3<f32>, f32)> = planes
        .iter()
        .filter(|p| p.1 == Structure::Wall)
        .map(|(s, _)| (s.middle, s.normal, s.area_m2()))
        .collect();
    planes.retain(|(sheet, structure)| {
        *structure != Structure::Wall || !scan.is_in_front_of_wall(sheet, &walls, cameras)
    });
    // A plane a few centimeters above a larger floor is a rug.
    let floors: Vec<(f32, f32)> = planes
        .iter()
        .filter(|p| p.1 == Structure::Floor)
        .map(|(s, _)| (s.middle.z, s.area_m2()))
        .collect();
    let on_floor = |sheet: &PlanePart| {
        floors.iter().any(|(z, area_m2)| {
            *area_m2 > sheet.area_m2() && (0.005..THICKEST_RUG_M).contains(&(sheet.middle.z - z))
        })
    };
    planes.retain(|(sheet, structure)| *structure != Structure::Floor || !on_floor(sheet));
    planes.sort_by(|a, b| b.0.area_m2().total_cmp(&a.0.area_m2()));
    progress.report("planes", 0.8)?;
    let mut of_superpoint = scan.assign_superpoints(&planes);
    let planes: Vec<Plane> = planes
        .into_iter()
        .map(|(sheet, structure)| Plane {
            structure,
            normal: sheet.normal,
            middle: sheet.middle,
            area_m2: sheet.area_m2(),
        })
        .collect();
    rugs::separate_rugs(&scan, superpoints, &planes, cameras, &mut of_superpoint);
    Ok(Planes::new(planes, of_superpoint))
}

/// The cloud grouped by superpoint.
struct CloudBySuperpoint<'a> {
    cloud: &'a PointCloud,
    /// Points of each superpoint.
    members: Vec<Vec<u32>>,
    patches: Vec<SuperpointPlane>,
    /// Bounds of each superpoint, meters.
    bounds: Vec<Option<Aabb>>,
    slack_m: f32,
    lowest_z: f32,
    highest_z: f32,
    /// Occupied cells: ground column to the heights in it.
    columns: BTreeMap<(i32, i32), Vec<i32>>,
}

impl<'a> CloudBySuperpoint<'a> {
    fn of(cloud: &'a PointCloud, superpoints: &Superpoints) -> Self {
        let mut members: Vec<Vec<u32>> = vec![Vec::new(); superpoints.patches.len()];
        for (i, &superpoint) in superpoints.of_point.iter().enumerate() {
            members[superpoint as usize].push(i as u32);
        }
        let patches = members.par_iter().map(|points| SuperpointPlane::of(cloud, points)).collect();
        let bounds = members
            .par_iter()
            .map(|points| Aabb::around(points.iter().map(|&i| &cloud.positions[i as usize])))
            .collect();
        let mut roughness: Vec<f32> =
            superpoints.of_point.iter().map(|&s| superpoints.roughness_m[s as usize]).collect();
        let slack_m = (3.0 * median(&mut roughness).unwrap_or(0.0)).clamp(MIN_SLACK_M, MAX_SLACK_M);
        let mut heights: Vec<f32> = cloud.positions.iter().map(|p| p.z).collect();
        let (lowest_z, highest_z) = (
            quantile(&mut heights, 0.01).unwrap_or(0.0),
            quantile(&mut heights, 0.99).unwrap_or(0.0),
        );
        let mut columns: BTreeMap<(i32, i32), BTreeSet<i32>> = BTreeMap::new();
        for p in &cloud.positions {
            let at = |v: f32| (v / CELL_M).floor() as i32;
            columns.entry((at(p.x), at(p.y))).or_default().insert(at(p.z));
        }
        let columns =
            columns.into_iter().map(|(at, heights)| (at, heights.into_iter().collect())).collect();
        Self { cloud, members, patches, bounds, slack_m, lowest_z, highest_z, columns }
    }

    fn points(&self, superpoint: u32) -> impl Iterator<Item = &Point3<f32>> {
        self.members[superpoint as usize].iter().map(|&i| &self.cloud.positions[i as usize])
    }

    /// Returns the superpoints that a box may contain points of.
    fn superpoints_near(&self, place: &Aabb) -> impl Iterator<Item = u32> {
        let near = |bounds: &Option<Aabb>| bounds.is_some_and(|own| own.gap(place) <= 0.0);
        (0..).zip(&self.bounds).filter(move |(_, bounds)| near(bounds)).map(|(s, _)| s)
    }

    fn share_on_plane(&self, superpoint: u32, normal: &Vector3<f32>, middle: &Point3<f32>) -> f32 {
        let on = self
            .points(superpoint)
            .filter(|p| (*p - middle).dot(normal).abs() <= ASSIGNED_SLACKS * self.slack_m)
            .count();
        on as f32 / self.members[superpoint as usize].len().max(1) as f32
    }

    /// Returns the superpoints of `left` that lie on one plane with `seed`. The plane is fitted
    /// twice.
    fn find_coplanar(&self, seed: u32, left: &BTreeSet<u32>) -> BTreeSet<u32> {
        let SuperpointPlane { mut normal, mut middle, .. } = self.patches[seed as usize];
        let mut found = BTreeSet::from([seed]);
        for _ in 0..2 {
            found = left
                .iter()
                .copied()
                .filter(|&s| {
                    let patch = &self.patches[s as usize];
                    patch.normal.dot(&normal).abs() > GIVES_NORMAL
                        && (patch.middle - middle).dot(&normal).abs() <= self.slack_m
                })
                .collect();
            found.insert(seed);
            (normal, middle) = fit(found.iter().map(|&s| &self.patches[s as usize]));
        }
        found
    }

    /// Splits a plane into connected parts and returns those that are large enough.
    fn split_into_sheets(&self, members: &BTreeSet<u32>) -> Vec<PlanePart> {
        let (normal, middle) = fit(members.iter().map(|&s| &self.patches[s as usize]));
        let level = normal.z.abs() > SAME_NORMAL;
        let along =
            if level { Vector3::x() } else { Vector3::new(-normal.y, normal.x, 0.0).normalize() };
        let (along, up) =
            if level { (along, Vector3::y()) } else { (along, along.cross(&normal).normalize()) };
        let up = if up.z < 0.0 { -up } else { up };
        let mut whole = PlanePart { normal, middle, along, up, cells: BTreeSet::new() };
        whole.cells = members.iter().flat_map(|&s| self.points(s)).map(|p| whole.cell(p)).collect();
        connected_components(&whole.cells, (GAP_M / CELL_M) as i32)
            .into_iter()
            .filter(|cells| cells.len() as f32 * CELL_M * CELL_M >= MIN_AREA_M2)
            .map(|cells| PlanePart { normal, middle, along, up, cells })
            .collect()
    }

    fn classify_sheet(
        &self,
        sheet: &PlanePart,
        cameras: &[Point3<f32>],
        floor_z: f32,
    ) -> Option<Structure> {
        if sheet.is_level() && self.is_floor(sheet, cameras, floor_z) {
            return Some(Structure::Floor);
        }
        if sheet.is_upright() {
            return self.is_wall(sheet, cameras, floor_z).then_some(Structure::Wall);
        }
        self.is_ceiling(sheet, cameras, floor_z).then_some(Structure::Ceiling)
    }

    /// Returns whether cameras were above the sheet, and nothing is under it. A second floor above
    /// the lowest must be larger than a bed and have been walked on.
    fn is_floor(&self, sheet: &PlanePart, cameras: &[Point3<f32>], lowest_z: f32) -> bool {
        let over = cameras.iter().filter(|c| sheet.covers(c) && c.z > sheet.middle.z + 0.2).count();
        let walked = match sheet.middle.z > lowest_z + 0.25 {
            true => sheet.area_m2() > 4.0 && over as f32 > 0.05 * cameras.len() as f32,
            false => over > 0 || (sheet.area_m2() > 4.0 && sheet.middle.z < self.lowest_z + 0.3),
        };
        walked && self.share_of_columns(sheet, |z, own| z < own - 0.2) < MAX_SEEN_BEHIND
    }

    /// Returns whether cameras were below the sheet, and nothing is over it.
    fn is_ceiling(&self, sheet: &PlanePart, cameras: &[Point3<f32>], floor_z: f32) -> bool {
        let under = cameras
            .iter()
            .all(|c| !sheet.covers(c) || sheet.distance(c) * sheet.normal.z.signum() < 0.0);
        let above = self.share_of_columns(sheet, |z, own| z > own + 0.2);
        under && sheet.middle.z > floor_z + MIN_CEILING_M && above < MAX_SEEN_BEHIND
    }

    /// Returns the share of the sheet's cells with a height in their column for which `far(height,
    /// sheet's own height)` is true.
    fn share_of_columns(&self, sheet: &PlanePart, far: impl Fn(f32, f32) -> bool) -> f32 {
        let mut seen = BTreeSet::new();
        let mut hit = 0_u32;
        for &(a, b) in &sheet.cells {
            let p = sheet.middle
                + sheet.along * ((a as f32 + 0.5) * CELL_M)
                + sheet.up * ((b as f32 + 0.5) * CELL_M);
            let column = ((p.x / CELL_M).floor() as i32, (p.y / CELL_M).floor() as i32);
            if seen.insert(column) {
                let heights = self.columns.get(&column);
                hit += u32::from(heights.is_some_and(|heights| {
                    heights.iter().any(|&z| far((z as f32 + 0.5) * CELL_M, p.z))
                }));
            }
        }
        hit as f32 / seen.len().max(1) as f32
    }

    /// Returns whether the sheet is wide and high, and nothing is visible behind it over its top. A
    /// lower one is a wall if nothing is visible behind it at any height.
    fn is_wall(&self, sheet: &PlanePart, cameras: &[Point3<f32>], floor_z: f32) -> bool {
        let mut tops: BTreeMap<i32, i32> = BTreeMap::new();
        for &(a, b) in &sheet.cells {
            let top = tops.entry(a).or_insert(b);
            *top = (*top).max(b);
        }
        let mut highest: Vec<f32> = tops
            .values()
            .map(|&b| sheet.middle.z + (b as f32 + 1.0) * CELL_M * sheet.up.z)
            .collect();
        let top_z = quantile(&mut highest, 0.9).unwrap_or(0.0);
        let is_high = top_z >= (floor_z + MIN_WALL_TOP_M).min(self.highest_z - 0.3);
        let (min_width_m, from_z, max_behind) = match is_high {
            true => (MIN_WALL_WIDTH_M, top_z + BEHIND_M, MAX_SEEN_BEHIND),
            false => (MIN_LOW_WALL_WIDTH_M, f32::NEG_INFINITY, MAX_SEEN_BEHIND_LOW),
        };
        let width_m = tops.len() as f32 * CELL_M;
        if width_m < min_width_m || top_z < floor_z + MIN_LOW_WALL_TOP_M {
            return false;
        }
        // Searches behind the sheet as seen from the cameras, within its width and the depth of a
        // room: over the top of a high one, at any height of a low one.
        const DEPTH_M: f32 = 1.5;
        let before =
            cameras.iter().filter(|c| sheet.distance(c) > 0.0).count() * 2 >= cameras.len();
        let mut behind = BTreeSet::new();
        for p in self.cloud.positions.iter().filter(|p| p.z > from_z) {
            let distance = sheet.distance(p) * if before { -1.0 } else { 1.0 };
            if (BEHIND_M..DEPTH_M).contains(&distance) {
                behind.insert(sheet.cell(p).0);
            }
        }
        let hit = tops.keys().filter(|a| behind.contains(a)).count();
        (hit as f32) < max_behind * tops.len() as f32
    }

    /// Returns whether a larger wall continues behind it, as behind a curtain or a wardrobe as high
    /// as the room.
    fn is_in_front_of_wall(
        &self,
        sheet: &PlanePart,
        walls: &[(Point3<f32>, Vector3<f32>, f32)],
        cameras: &[Point3<f32>],
    ) -> bool {
        const DEEPEST_M: f32 = 0.7;
        let before =
            cameras.iter().filter(|c| sheet.distance(c) > 0.0).count() * 2 >= cameras.len();
        walls.iter().any(|(middle, normal, area_m2)| {
            // Position of the other wall, seen from the center of this one.
            let behind = (sheet.middle - middle).dot(normal)
                * normal.dot(&sheet.normal).signum()
                * if before { 1.0 } else { -1.0 };
            normal.dot(&sheet.normal).abs() > SAME_NORMAL
                && *area_m2 > sheet.area_m2()
                && (2.0 * self.slack_m..DEEPEST_M).contains(&behind)
        })
    }

    /// Returns the plane of each superpoint: the largest one that it lies on.
    fn assign_superpoints(&self, planes: &[(PlanePart, Structure)]) -> Vec<Option<u32>> {
        (0..self.patches.len() as u32)
            .into_par_iter()
            .map(|s| {
                let patch = &self.patches[s as usize];
                let best = planes.iter().enumerate().filter(|(_, (sheet, _))| {
                    let near = sheet.distance(&patch.middle).abs()
                        <= ASSIGNED_SLACKS * self.slack_m
                        && sheet.covers(&patch.middle);
                    let parallel = patch.area_m2 < MIN_SEED_M2 / 2.0
                        || patch.normal.dot(&sheet.normal).abs() > SAME_NORMAL;
                    near && parallel
                        && self.share_on_plane(s, &sheet.normal, &sheet.middle) >= ON_PLANE
                });
                best.map(|(i, _)| i as u32).next()
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::superpoints;
    use uniground_types::settings::SuperpointSettings;

    /// Adds a gray block between two corners: a point every two centimeters, with noise of a few
    /// millimeters.
    fn block(cloud: &mut PointCloud, low: [f32; 3], high: [f32; 3], grey: u8) {
        const STEP_M: f32 = 0.02;
        let steps = |axis: usize| 0..=((high[axis] - low[axis]) / STEP_M).round() as u32;
        for x in steps(0) {
            for y in steps(1) {
                for z in steps(2) {
                    let shake =
                        |k: u32| ((x * 31 + y * 57 + z * 91 + k * 17) % 13) as f32 * 5e-4 - 3e-3;
                    let at =
                        |axis: usize, k: u32| low[axis] + k as f32 * STEP_M + shake(axis as u32);
                    cloud.positions.push(Point3::new(at(0, x), at(1, y), at(2, z)));
                    cloud.colors.push([grey; 3]);
                }
            }
        }
    }

    /// Returns a room of 4 by 3 by 2.6 m without a ceiling: a bed, a wardrobe before one wall, a
    /// panel on another.
    fn room() -> (PointCloud, Planes, Superpoints) {
        let mut cloud = PointCloud::default();
        block(&mut cloud, [0.0, 0.0, 0.0], [4.0, 3.0, 0.0], 120);
        for (low, high) in [
            ([0.0, 0.0, 0.0], [4.0, 0.0, 2.6]),
            ([0.0, 3.0, 0.0], [4.0, 3.0, 2.6]),
            ([0.0, 0.0, 0.0], [0.0, 3.0, 2.6]),
            ([4.0, 0.0, 0.0], [4.0, 3.0, 2.6]),
        ] {
            block(&mut cloud, low, high, 200);
        }
        block(&mut cloud, [2.5, 0.6, 0.5], [4.0, 2.4, 0.5], 60);
        block(&mut cloud, [0.5, 2.4, 0.0], [2.0, 2.4, 2.0], 90);
        let superpoints =
            superpoints::compute(&cloud, &SuperpointSettings::default(), &Progress::silent())
                .unwrap();
        let cameras =
            [Point3::new(1.0, 1.0, 1.5), Point3::new(1.5, 1.5, 1.5), Point3::new(3.0, 1.2, 1.6)];
        let planes = find(&cloud, &superpoints, &cameras, &Progress::silent()).unwrap();
        (cloud, planes, superpoints)
    }

    #[test]
    fn floor_and_walls_are_found_and_beds_and_wardrobes_are_not_planes() {
        let (cloud, planes, superpoints) = room();
        let count = |structure| planes.planes.iter().filter(|p| p.structure == structure).count();
        assert_eq!(
            (count(Structure::Floor), count(Structure::Wall), count(Structure::Ceiling)),
            (1, 4, 0),
            "{:#?}",
            planes.planes
        );
        assert!(planes.floor_z().unwrap().abs() < 0.01);
        let kind_at = |p: Point3<f32>| {
            let nearest = (0..cloud.len()).min_by(|&a, &b| {
                (cloud.positions[a] - p).norm().total_cmp(&(cloud.positions[b] - p).norm())
            });
            planes.of_superpoint[superpoints.of_point[nearest.unwrap()] as usize]
                .map(|plane| planes.planes[plane as usize].structure)
        };
        assert_eq!(kind_at(Point3::new(1.0, 1.0, 0.0)), Some(Structure::Floor));
        assert_eq!(kind_at(Point3::new(0.0, 1.5, 1.3)), Some(Structure::Wall));
        assert_eq!(
            kind_at(Point3::new(3.0, 1.5, 0.5)),
            None,
            "the top of a bed is not a floor, although a camera was above it"
        );
        assert_eq!(
            kind_at(Point3::new(1.2, 2.4, 1.0)),
            None,
            "a wardrobe is not a wall: the wall behind is visible above it"
        );
    }

    /// A kitchen of which the cameras saw nothing above 1.4 m: a counter before one wall, the lower
    /// part of another.
    #[test]
    fn the_lower_part_of_a_wall_is_a_wall_if_nothing_is_behind_it() {
        let mut cloud = PointCloud::default();
        block(&mut cloud, [0.0, 0.0, 0.0], [4.0, 3.0, 0.0], 120);
        block(&mut cloud, [0.0, 0.0, 0.9], [4.0, 0.0, 2.6], 200); // a wall down to the counter
        block(&mut cloud, [0.0, 0.0, 0.9], [4.0, 0.6, 0.9], 60); // its top
        block(&mut cloud, [0.0, 0.6, 0.0], [4.0, 0.6, 0.9], 90); // its front
        block(&mut cloud, [4.0, 0.7, 0.0], [4.0, 3.0, 1.4], 200); // the lower part of a wall
        block(&mut cloud, [2.5, 2.4, 0.0], [3.0, 3.0, 0.7], 80); // a small cupboard
        let superpoints =
            superpoints::compute(&cloud, &SuperpointSettings::default(), &Progress::silent())
                .unwrap();
        let cameras = [Point3::new(1.0, 1.8, 1.5), Point3::new(1.5, 2.0, 1.5)];
        let planes = find(&cloud, &superpoints, &cameras, &Progress::silent()).unwrap();
        let mut walls: Vec<[i32; 3]> = planes
            .planes
            .iter()
            .filter(|plane| plane.structure == Structure::Wall)
            .map(|plane| {
                let Point3 { coords } = plane.middle;
                [coords.x, coords.y, coords.z].map(|v| (v * 10.0).round() as i32)
            })
            .collect();
        walls.sort_unstable();
        assert_eq!(walls.len(), 2, "{:#?}", planes.planes);
        assert_eq!((walls[0][1], walls[1][0]), (0, 40), "{walls:?}");
    }

    #[test]
    fn small_patches_of_the_same_color_rejoin_the_wall() {
        let superpoints = Superpoints {
            of_point: vec![],
            patches: [(10_000, 80.0), (50, 78.0), (50, 20.0), (50, 80.0)]
                .map(|(points, l)| Patch {
                    points,
                    center: Point3::origin(),
                    normal: Vector3::z(),
                    lab: uniground_geometry::color::Lab::new(l, 0.0, 0.0),
                })
                .to_vec(),
            adjacent: vec![],
            roughness_m: vec![0.0; 4],
        };
        let wall = Plane {
            structure: Structure::Wall,
            normal: Vector3::x(),
            middle: Point3::origin(),
            area_m2: 8.0,
        };
        let planes = Planes::new(vec![wall], vec![Some(0), Some(0), Some(0), None]);
        let regions = planes.with_patches(&superpoints, &[0, 1, 2, 3]);
        assert_eq!(
            regions,
            [0, 0, 1, 2],
            "the dark patch is a picture, and the last one is not on the wall"
        );
    }
}
