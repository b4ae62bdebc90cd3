//! Joins leaves into plants: no mask shows a plant as one, and its leaves barely touch.
//!
//! Connected green pieces are one plant. A part under it, no wider than its leaves, is its pot.

use super::{RegionFacts, join_sets};
use crate::superpoints::Superpoints;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::color::ColorName;
use uniground_geometry::union_find::UnionFind;

/// Minimum share of green points for a piece to be part of a plant.
const GREEN: f32 = 0.6;
/// Maximum size of a piece, meters; larger ones are furniture.
const LARGEST_M: f32 = 0.7;
/// Leaves within this distance belong to one plant, meters.
const NEAR_M: f32 = 0.06;
/// Maximum height of a plant, meters; anything taller is several.
const TALLEST_M: f32 = 2.2;
/// Maximum horizontal extent of a plant, meters.
const WIDEST_M: f32 = 1.2;
/// Maximum size of a pot, meters.
const POT_M: f32 = 0.5;
/// Maximum gap between a pot and the lowest leaf, meters: the stem is not always scanned.
const STEM_M: f32 = 0.25;

/// Joins leaves with each other and with their pots. Returns the regions, and the facts of those
/// that did not change.
pub(super) fn join_foliage(
    superpoints: &Superpoints,
    region_of: Vec<u32>,
    parts: &[RegionFacts],
) -> (Vec<u32>, Vec<Option<RegionFacts>>) {
    let mut points = vec![[0.0_f32; 2]; parts.len()];
    for (patch, &region) in superpoints.patches.iter().zip(&region_of) {
        let [all, green] = &mut points[region as usize];
        *all += patch.points as f32;
        *green += if ColorName::from_lab(&patch.lab) == ColorName::Green {
            patch.points as f32
        } else {
            0.0
        };
    }
    let is_leaves = |i: usize| {
        !parts[i].is_structural
            && points[i][1] >= GREEN * points[i][0]
            && parts[i].aabb.size.max() <= LARGEST_M
    };
    let leaves: Vec<usize> = (0..parts.len()).filter(|&i| is_leaves(i)).collect();
    let plants = group_leaves(&leaves, parts);
    let mut sets = UnionFind::new(parts.len());
    // A single green piece can be a cushion on a stool, so it is not joined.
    for (leaves, members) in plants.iter().filter(|(_, members)| members.len() > 1) {
        let pots = (0..parts.len()).filter(|&i| !is_leaves(i) && is_pot(&parts[i], leaves));
        let pot = pots.max_by(|&a, &b| parts[a].points.total_cmp(&parts[b].points));
        members.iter().copied().skip(1).chain(pot).for_each(|i| {
            sets.union(i as u32, members[0] as u32);
        });
    }
    join_sets(sets, region_of, parts)
}

/// Groups leaves that are connected: the box around each group, and its members.
fn group_leaves(leaves: &[usize], parts: &[RegionFacts]) -> Vec<(Aabb, Vec<usize>)> {
    let mut plants: Vec<(Aabb, Vec<usize>)> =
        leaves.iter().map(|&i| (parts[i].aabb, vec![i])).collect();
    let mut plant_of: Vec<usize> = (0..leaves.len()).collect();
    for (a, &leaf) in leaves.iter().enumerate() {
        for b in a + 1..leaves.len() {
            let (one, other) = (plant_of[a], plant_of[b]);
            if one == other || parts[leaf].aabb.gap(&parts[leaves[b]].aabb) > NEAR_M {
                continue;
            }
            let both = union_box(&plants[one].0, &plants[other].0);
            if both.size.z <= TALLEST_M && both.size.x.max(both.size.y) <= WIDEST_M {
                let moved = std::mem::take(&mut plants[other].1);
                plant_of.iter_mut().filter(|plant| **plant == other).for_each(|plant| *plant = one);
                plants[one].0 = both;
                plants[one].1.extend(moved);
            }
        }
    }
    plants.retain(|(_, members)| !members.is_empty());
    plants
}

fn union_box(a: &Aabb, b: &Aabb) -> Aabb {
    Aabb::from_corners(
        a.min().coords.inf(&b.min().coords).into(),
        a.max().coords.sup(&b.max().coords).into(),
    )
}

/// Returns whether a part is centered under the leaves, not wider than they are, and ends where
/// they begin.
fn is_pot(part: &RegionFacts, leaves: &Aabb) -> bool {
    let (size, above) = (part.aabb.size, leaves.min().z - part.aabb.max().z);
    let aside = (part.aabb.center - leaves.center).xy();
    !part.is_structural
        && size.max() <= POT_M
        && size.x * size.y <= leaves.size.x * leaves.size.y
        && aside.x.abs() <= 0.5 * leaves.size.x
        && aside.y.abs() <= 0.5 * leaves.size.y
        && part.aabb.center.z < leaves.min().z
        && (-0.5 * size.z..=STEM_M).contains(&above)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::superpoints::Patch;
    use uniground_geometry::color::srgb_to_lab;
    use uniground_geometry::{Point3, Vector3};

    const LEAF: [u8; 3] = [50, 120, 40];
    const CLAY: [u8; 3] = [150, 80, 50];

    /// Joins the foliage among colored blocks (two corners, meters). Returns the region of each
    /// block.
    fn join_blocks(blocks: &[([f32; 3], [f32; 3], [u8; 3])]) -> Vec<u32> {
        let part = |(low, high, _): &([f32; 3], [f32; 3], [u8; 3])| {
            let at = |axis: usize, k: u32| low[axis] + (high[axis] - low[axis]) * k as f32 / 9.0;
            let cells = (0..1000_u32).map(|i| (i % 10, i / 10 % 10, i / 100));
            RegionFacts::measure(
                &cells
                    .map(|(x, y, z)| Point3::new(at(0, x), at(1, y), at(2, z)))
                    .collect::<Vec<_>>(),
            )
        };
        let patch = |rgb: [u8; 3]| Patch {
            points: 1000,
            center: Point3::origin(),
            normal: Vector3::z(),
            lab: srgb_to_lab(rgb),
        };
        let superpoints = Superpoints {
            of_point: Vec::new(),
            patches: blocks.iter().map(|block| patch(block.2)).collect(),
            adjacent: Vec::new(),
            roughness_m: vec![0.0; blocks.len()],
        };
        join_foliage(
            &superpoints,
            (0..blocks.len() as u32).collect(),
            &blocks.iter().map(part).collect::<Vec<_>>(),
        )
        .0
    }

    #[test]
    fn leaves_and_pot_join_into_one_plant() {
        let pot = ([0.1, 0.1, 0.0], [0.3, 0.3, 0.3], CLAY);
        let leaves = [
            ([0.0, 0.0, 0.4], [0.25, 0.25, 0.7], LEAF),
            ([0.2, 0.2, 0.5], [0.45, 0.45, 0.9], LEAF),
        ];
        assert_eq!(join_blocks(&[pot, leaves[0], leaves[1]]), [0, 0, 0]);
        let far = ([2.0, 0.0, 0.4], [2.3, 0.3, 0.8], LEAF);
        assert_eq!(join_blocks(&[leaves[0], far]), [0, 1], "another plant");
        assert_eq!(join_blocks(&[pot, leaves[0]]), [0, 1], "a cushion on its stool");
    }

    #[test]
    fn wide_supports_are_not_pots_and_furniture_is_not_foliage() {
        let leaves = ([0.2, 0.2, 0.8], [0.5, 0.5, 1.2], LEAF);
        assert_eq!(
            join_blocks(&[([0.0, 0.0, 0.3], [0.6, 0.6, 0.75], CLAY), leaves]),
            [0, 1],
            "a plant on a stool"
        );
        let sofa = ([0.0, 0.0, 0.0], [1.8, 0.8, 0.8], LEAF);
        assert_eq!(
            join_blocks(&[sofa, ([0.2, 0.2, 0.8], [0.6, 0.6, 1.1], LEAF)]),
            [0, 1],
            "a green cushion on a green sofa"
        );
        assert_eq!(
            join_blocks(&[
                ([0.0, 0.0, 0.0], [0.2, 0.2, 0.3], CLAY),
                ([0.2, 0.0, 0.0], [0.4, 0.2, 0.3], CLAY)
            ]),
            [0, 1]
        );
    }
}
