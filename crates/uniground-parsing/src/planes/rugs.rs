//! Finds rugs that are too thin to be separated from the floor by height: their color differs.
//!
//! Brightness is no evidence: a shadow is the floor's color dimmed and is not a rug, even if it is
//! very dark. A rug must also be visible to cameras: in a synthetic cloud, the underside of a box
//! lies on the floor too.

use super::seen::is_seen;
use super::surface_color::{hue_distance, is_same_color, most_common_color};
use super::{CELL_M, CloudBySuperpoint, Plane};
use crate::superpoints::Superpoints;
use std::cell::LazyCell;
use std::collections::{BTreeMap, BTreeSet};
use uniground_geometry::boxes::OrientedBox;
use uniground_geometry::color::Lab;
use uniground_geometry::scene::Structure;
use uniground_geometry::union_find::UnionFind;
use uniground_geometry::{Point3, Vector3};

/// Minimum distance between hues, at the floor's lightness. A superpoint below it is the floor
/// under another light.
const OTHER_HUE: f32 = 5.0;
/// Minimum area and size of a rug, square meters and meters; smaller patches are stains and scraps.
const MIN_AREA_M2: f32 = 0.15;
const MIN_WIDTH_M: f32 = 0.3;
/// Maximum share of the floor that a rug covers; a larger area is another floor.
const MAX_OF_FLOOR: f32 = 0.4;
/// Minimum share of its rectangle that a rug fills, since furniture hides some of it.
const MIN_FILLED: f32 = 0.4;
/// Minimum share of a rug's rim with floor beside it. The floor of another room has this floor
/// beside it only in the doorway.
const MIN_BESIDE_FLOOR: f32 = 0.4;

/// Removes rugs from the planes of their floors, so that the two are not merged. `of_superpoint`
/// has the plane of each superpoint. `cameras` are camera centers, meters; without any, every point
/// counts as seen.
pub(super) fn separate_rugs(
    scan: &CloudBySuperpoint,
    superpoints: &Superpoints,
    planes: &[Plane],
    cameras: &[Point3<f32>],
    of_superpoint: &mut [Option<u32>],
) {
    let floors = (0..).zip(planes).filter(|(_, plane)| plane.structure == Structure::Floor);
    for (k, plane) in floors {
        let on: Vec<u32> = (0..)
            .zip(&*of_superpoint)
            .filter(|(_, plane)| **plane == Some(k))
            .map(|(s, _)| s)
            .collect();
        let colors: Vec<(Lab, u32)> = on
            .iter()
            .map(|&s| &superpoints.patches[s as usize])
            .map(|patch| (patch.lab, patch.points))
            .collect();
        let Some(color) = most_common_color(&colors) else { continue };
        let points = |group: &[u32]| {
            group.iter().map(|&s| superpoints.patches[s as usize].points).sum::<u32>() as f32
        };
        let m2_per_point = plane.area_m2 / points(&on);
        let (odd, own): (Vec<u32>, Vec<u32>) =
            on.iter().partition(|&&s| is_other_color(&superpoints.patches[s as usize].lab, &color));
        let floor = LazyCell::new(|| ground_cells(scan, own.into_iter()));
        let is_visible = |group: &[u32]| {
            let members = group.iter().flat_map(|&s| &scan.members[s as usize]);
            is_seen(scan, &members.copied().collect::<Vec<_>>(), &Vector3::z(), cameras)
        };
        let is_rug = |group: &Vec<u32>| {
            let area_m2 = points(group) * m2_per_point;
            if !(MIN_AREA_M2..=MAX_OF_FLOOR * plane.area_m2).contains(&area_m2) {
                return false;
            }
            let ground: Vec<_> =
                group.iter().flat_map(|&s| scan.points(s)).map(Point3::xy).collect();
            let size = OrientedBox::min_area(&ground, (0.0, 0.0))
                .map_or_else(Default::default, |rectangle| rectangle.size);
            let beside_floor = || share_beside(&ground_cells(scan, group.iter().copied()), &floor);
            size.x.min(size.y) >= MIN_WIDTH_M
                && area_m2 >= MIN_FILLED * size.x * size.y
                && beside_floor() >= MIN_BESIDE_FLOOR
                && is_visible(group)
        };
        for s in group_connected(&odd, superpoints).into_iter().filter(is_rug).flatten() {
            of_superpoint[s as usize] = None;
        }
    }
}

/// Returns the ground cells, [`CELL_M`] wide, that superpoints lie on.
fn ground_cells(
    scan: &CloudBySuperpoint,
    superpoints: impl Iterator<Item = u32>,
) -> BTreeSet<(i32, i32)> {
    let at = |v: f32| (v / CELL_M).floor() as i32;
    superpoints.flat_map(|s| scan.points(s)).map(|p| (at(p.x), at(p.y))).collect()
}

/// Returns the share of the rim of these cells with floor beside it.
fn share_beside(cells: &BTreeSet<(i32, i32)>, floor: &BTreeSet<(i32, i32)>) -> f32 {
    let around = |&(a, b): &(i32, i32), far: i32| {
        (-far..=far).flat_map(move |i| (-far..=far).map(move |j| (a + i, b + j)))
    };
    let rim: Vec<&(i32, i32)> = cells
        .iter()
        .filter(|cell| around(cell, 1).any(|beside| !cells.contains(&beside)))
        .collect();
    let beside_floor =
        rim.iter().filter(|cell| around(cell, 2).any(|beside| floor.contains(&beside))).count();
    beside_floor as f32 / rim.len().max(1) as f32
}

/// Returns whether it is another color, and not the floor's color under more or less light.
fn is_other_color(lab: &Lab, floor: &Lab) -> bool {
    !is_same_color(lab, floor) && hue_distance(lab, floor) >= OTHER_HUE
}

/// Groups connected superpoints.
fn group_connected(superpoints_of: &[u32], superpoints: &Superpoints) -> Vec<Vec<u32>> {
    let mut is_member = vec![false; superpoints.patches.len()];
    superpoints_of.iter().for_each(|&s| is_member[s as usize] = true);
    let mut sets = UnionFind::new(superpoints.patches.len());
    for &(a, b) in superpoints
        .adjacent
        .iter()
        .filter(|(a, b)| is_member[*a as usize] && is_member[*b as usize])
    {
        sets.union(a, b);
    }
    let (labels, _) = sets.into_labels();
    let mut groups: BTreeMap<u32, Vec<u32>> = BTreeMap::new();
    superpoints_of.iter().for_each(|&s| groups.entry(labels[s as usize]).or_default().push(s));
    groups.into_values().collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::superpoints::Patch;
    use uniground_geometry::color::srgb_to_lab;
    use uniground_geometry::scene::PointCloud;

    const WOOD: [u8; 3] = [120, 85, 55];
    const RED: [u8; 3] = [150, 40, 45];
    const CAMERA: Point3<f32> = Point3::new(1.0, -2.0, 1.6);

    /// Separates rugs from a floor of 4 by 4 superpoints of half a meter, of which `others` have
    /// another color. Returns the separated superpoints.
    fn separated_rugs(others: &[(u32, [u8; 3])]) -> Vec<u32> {
        separated_rugs_in(&[], &[], &[CAMERA], others)
    }

    /// Does the same with points above the floor (superpoint 16), without some of its superpoints,
    /// and with these cameras.
    fn separated_rugs_in(
        above: &[Point3<f32>],
        absent: &[u32],
        cameras: &[Point3<f32>],
        others: &[(u32, [u8; 3])],
    ) -> Vec<u32> {
        let rgb =
            |s: u32| others.iter().find(|(other, _)| *other == s).map_or(WOOD, |(_, rgb)| *rgb);
        let place = |s: u32| Point3::new((s % 4) as f32 * 0.5, (s / 4) as f32 * 0.5, 0.0);
        let (mut cloud, mut of_point) = (PointCloud::default(), Vec::new());
        for s in 0..16 {
            for at in 0..100 {
                cloud.positions.push(
                    place(s) + Vector3::new((at % 10) as f32 * 0.05, (at / 10) as f32 * 0.05, 0.0),
                );
                of_point.push(s);
            }
        }
        cloud.positions.extend(above);
        of_point.extend(std::iter::repeat_n(16, above.len()));
        let patch = |s| Patch {
            points: 100,
            center: place(s),
            normal: Vector3::z(),
            lab: srgb_to_lab(rgb(s)),
        };
        let right = (0..16).filter(|s| s % 4 < 3).map(|s| (s, s + 1));
        let superpoints = Superpoints {
            of_point,
            patches: (0..17).map(patch).collect(),
            adjacent: right.chain((0..12).map(|s| (s, s + 4))).collect(),
            roughness_m: vec![0.0; 17],
        };
        let floor = Plane {
            structure: Structure::Floor,
            normal: Vector3::z(),
            middle: Point3::origin(),
            area_m2: 4.0,
        };
        let before: Vec<Option<u32>> =
            (0..17).map(|s| (s < 16 && !absent.contains(&s)).then_some(0)).collect();
        let mut after = before.clone();
        separate_rugs(
            &CloudBySuperpoint::of(&cloud, &superpoints),
            &superpoints,
            &[floor],
            cameras,
            &mut after,
        );
        (0..16).filter(|&s| before[s as usize] != after[s as usize]).collect()
    }

    #[test]
    fn rugs_of_another_color_are_separated_from_the_floor() {
        assert_eq!(separated_rugs(&[(5, RED), (6, RED), (9, RED), (10, RED)]), [5, 6, 9, 10]);
        assert_eq!(separated_rugs(&[(12, RED)]), [12], "in a corner");
        assert_eq!(separated_rugs(&[(5, [200, 170, 140])]), [5], "a light rug");
    }

    #[test]
    fn shadows_and_large_areas_are_not_rugs() {
        assert_eq!(
            separated_rugs(&[(5, [60, 42, 27]), (6, [30, 21, 14])]),
            Vec::<u32>::new(),
            "shadows"
        );
        let tiles = [150, 150, 160];
        assert_eq!(
            separated_rugs(&(0..7).map(|s| (s, tiles)).collect::<Vec<_>>()),
            Vec::<u32>::new(),
            "covers nearly half of the floor"
        );
    }

    #[test]
    fn floor_of_the_next_room_is_not_a_rug() {
        let next_room = [12, 13, 14, 15].map(|s| (s, RED));
        assert_eq!(separated_rugs_in(&[], &[8, 9, 11], &[CAMERA], &next_room), Vec::<u32>::new());
        assert_eq!(separated_rugs(&next_room), [12, 13, 14, 15], "a runner along the wall");
    }

    #[test]
    fn areas_hidden_from_all_cameras_are_not_rugs() {
        let red = [(5, RED)];
        let steps =
            || (0..=25).flat_map(|a| (1..=20).map(move |b| (a as f32 * 0.02, b as f32 * 0.02)));
        let sides = |(a, z)| {
            [(a, 0.0), (a, 0.5), (0.0, a), (0.5, a)]
                .map(|(x, y): (f32, f32)| Point3::new(0.5 + x, 0.5 + y, z))
        };
        let stool: Vec<_> = steps().flat_map(sides).collect();
        assert_eq!(separated_rugs_in(&stool, &[], &[CAMERA], &red), Vec::<u32>::new());
        assert_eq!(
            separated_rugs_in(&stool, &[], &[], &red),
            [5],
            "without cameras every point counts as seen"
        );
        let table: Vec<_> = steps().map(|(x, y)| Point3::new(0.5 + x, 0.5 + y, 0.7)).collect();
        assert_eq!(separated_rugs_in(&table, &[], &[CAMERA], &red), [5]);
    }
}
