//! Relations as geometry: soft scores in `0..=1` of boxes against boxes.
//!
//! Distances are measured between surfaces and in units of the things' own sizes, so that "next to" means centimetres for
//! mugs and half a metre for sofas.

use super::direction::Directions;
use super::query::RelationKind;
use crate::geometry::boxes::Aabb;
use crate::geometry::{Point3, Vector3};

/// Extent of the scene, for relations to the room itself.
#[derive(Debug, Clone, Copy)]
pub struct Room {
    pub extent: Aabb,
}

/// Score of `target` standing in a relation to `anchors`; [`RelationKind::Between`] takes two, the room relations none, all others one.
///
/// Comparisons among several targets (closest, farthest) are the reasoner's: here they score like near and far.
#[must_use]
pub fn score(kind: RelationKind, target: &Aabb, anchors: &[&Aabb], directions: &Directions, room: &Room) -> f32 {
    match (kind, anchors) {
        (RelationKind::Between, [a, b]) => between(target, a, b),
        (RelationKind::AgainstWall, _) => against_wall(target, room),
        (RelationKind::InCorner, _) => in_corner(target, room),
        (_, [anchor, ..]) => pairwise(kind, target, anchor, directions),
        (_, []) => 0.0,
    }
}

fn pairwise(kind: RelationKind, target: &Aabb, anchor: &Aabb, directions: &Directions) -> f32 {
    match kind {
        RelationKind::Near | RelationKind::Closest | RelationKind::Between => near(target, anchor),
        RelationKind::Far | RelationKind::Farthest => 1.0 - near(target, anchor),
        RelationKind::LeftOf => beside(target, anchor, &-directions.right),
        RelationKind::RightOf => beside(target, anchor, &directions.right),
        RelationKind::InFrontOf => beside(target, anchor, &directions.front),
        RelationKind::Behind => beside(target, anchor, &-directions.front),
        RelationKind::Above => above(target, anchor),
        RelationKind::Below => above(anchor, target),
        RelationKind::On => on(target, anchor),
        RelationKind::Inside => inside(target, anchor).max(0.8 * on(target, anchor)),
        RelationKind::AgainstWall | RelationKind::InCorner => 0.0,
    }
}

/// 1 at zero, one half at `half`, towards 0 beyond.
fn fade(distance: f32, half: f32) -> f32 {
    1.0 / (1.0 + (distance.max(0.0) / half).powi(2))
}

/// Gap between surfaces in units of the things' sizes.
#[must_use]
pub fn near(a: &Aabb, b: &Aabb) -> f32 {
    let reach = 0.3 + 0.25 * (a.size.xy().norm() + b.size.xy().norm()) / 2.0;
    fade(a.gap(b), reach)
}

/// On the side of the anchor that `direction` (unit, horizontal) points to: how well the line between the centres follows it, and near.
#[must_use]
pub fn beside(target: &Aabb, anchor: &Aabb, direction: &Vector3<f32>) -> f32 {
    let between = target.center - anchor.center;
    let horizontal = Vector3::new(between.x, between.y, 0.0);
    let Some(unit) = horizontal.try_normalize(1e-4) else { return 0.0 };
    // Within 45 degrees it is that side; at 90 degrees it is not.
    let aligned = ((unit.dot(direction) - 0.2) / 0.5).clamp(0.0, 1.0);
    aligned * (0.4 + 0.6 * near(target, anchor))
}

/// Higher, and over the anchor's footprint.
#[must_use]
pub fn above(upper: &Aabb, lower: &Aabb) -> f32 {
    let gap = upper.gap_per_axis(lower);
    let aside = gap.xy().map(|g| g.max(0.0)).norm();
    let reach = 0.15 + 0.25 * upper.size.xy().norm().min(lower.size.xy().norm());
    let higher = ((upper.center.z - lower.center.z) / (0.5 * (upper.size.z + lower.size.z)).max(0.05)).clamp(0.0, 1.0);
    // Overlapping in height is not above; touching is.
    let clear = fade(-gap.z.min(0.0) - 0.1 * upper.size.z, 0.1 + 0.3 * upper.size.z);
    higher * clear * fade(aside, reach)
}

/// Resting on: over the footprint, the underside at the anchor's top, or on a board inside it (shelves); or flat against it (walls).
#[must_use]
pub fn on(target: &Aabb, anchor: &Aabb) -> f32 {
    let over = (target.footprint_overlap(anchor) / 0.5).min(1.0);
    let (bottom, top) = (target.min().z, anchor.max().z);
    let rest = if bottom >= top { fade(bottom - top, 0.06) } else { fade(top - bottom - 0.05, 0.4 * anchor.size.z.max(0.1)) };
    let not_under = ((bottom - anchor.min().z + 0.02) / (0.3 * anchor.size.z).max(0.02)).clamp(0.0, 1.0);
    let hangs = is_upright_plane(anchor) && target.gap(anchor) < 0.12 && target.center.z > anchor.min().z;
    (over * rest * not_under).max(if hangs { 0.9 } else { 0.0 })
}

fn is_upright_plane(aabb: &Aabb) -> bool {
    aabb.size.x.min(aabb.size.y) < 0.15 && aabb.size.z > 1.0 && aabb.size.x.max(aabb.size.y) > 0.8
}

/// Share of the target's volume within the anchor.
#[must_use]
pub fn inside(target: &Aabb, anchor: &Aabb) -> f32 {
    let gap = target.gap_per_axis(anchor);
    let share = |axis: usize| (-gap[axis]).clamp(0.0, target.size[axis]) / target.size[axis].max(1e-3);
    if target.size[2] < 1e-3 { share(0) * share(1) } else { (share(0) * share(1) * share(2)).min(1.0) }
}

/// Near the middle of the line between the anchors' centres, on the ground plan.
#[must_use]
pub fn between(target: &Aabb, a: &Aabb, b: &Aabb) -> f32 {
    let (start, end, at): (Point3<f32>, Point3<f32>, Point3<f32>) = (a.center, b.center, target.center);
    let line = (end - start).xy();
    let length = line.norm();
    if length < 1e-3 {
        return 0.0;
    }
    let along = (at - start).xy().dot(&line) / (length * length);
    let aside = (at - start).xy().perp(&line).abs() / length;
    let within = fade((along - 0.5).abs() - 0.3, 0.15);
    within * fade(aside, 0.35 * length + 0.2)
}

/// Close to one side of the room.
#[must_use]
pub fn against_wall(target: &Aabb, room: &Room) -> f32 {
    wall_gaps(target, room).map(|g| fade(g, 0.3)).into_iter().fold(0.0, f32::max)
}

/// Close to two sides of the room that meet.
#[must_use]
pub fn in_corner(target: &Aabb, room: &Room) -> f32 {
    let [x_low, x_high, y_low, y_high] = wall_gaps(target, room).map(|g| fade(g, 0.5));
    x_low.max(x_high) * y_low.max(y_high)
}

fn wall_gaps(target: &Aabb, room: &Room) -> [f32; 4] {
    let (lo, hi) = (target.min(), target.max());
    let (room_lo, room_hi) = (room.extent.min(), room.extent.max());
    [lo.x - room_lo.x, room_hi.x - hi.x, lo.y - room_lo.y, room_hi.y - hi.y]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grounding::direction::DirectionConvention;
    use proptest::prelude::*;

    fn cube(x: f32, y: f32, z: f32, size: f32) -> Aabb {
        Aabb { center: Point3::new(x, y, z), size: Vector3::repeat(size) }
    }

    #[test]
    fn a_mug_on_a_table_is_on_it_and_not_under_it() {
        let table = Aabb { center: Point3::new(0.0, 0.0, 0.375), size: Vector3::new(1.4, 0.8, 0.75) };
        let mug = cube(0.3, 0.1, 0.8, 0.1);
        let bin = cube(0.3, 0.1, 0.15, 0.3);
        assert!(on(&mug, &table) > 0.9 && on(&bin, &table) < 0.2, "{} {}", on(&mug, &table), on(&bin, &table));
        assert!(above(&mug, &table) > 0.7);
        let lamp = cube(0.0, 0.0, 2.0, 0.3);
        assert!(above(&lamp, &table) > 0.8 && on(&lamp, &table) < 0.1);
    }

    #[test]
    fn left_follows_the_convention() {
        let (anchor, thing) = (cube(0.0, 0.0, 0.5, 0.5), cube(1.0, 0.0, 0.5, 0.5));
        let room = Room { extent: cube(0.0, 0.0, 1.0, 6.0) };
        let left = |c: DirectionConvention| score(RelationKind::LeftOf, &thing, &[&anchor], &c.into(), &room);
        assert!(left(DirectionConvention::Paper) > 0.5 && left(DirectionConvention::Viewer) == 0.0);
    }

    #[test]
    fn corners_and_walls_are_the_room_s() {
        let room = Room { extent: Aabb { center: Point3::new(0.0, 0.0, 1.3), size: Vector3::new(6.0, 5.0, 2.6) } };
        assert!(in_corner(&cube(2.7, 2.2, 0.3, 0.5), &room) > 0.9);
        assert!(in_corner(&cube(0.0, 2.2, 0.3, 0.5), &room) < 0.1 && against_wall(&cube(0.0, 2.2, 0.3, 0.5), &room) > 0.9);
        assert!(against_wall(&cube(0.0, 0.0, 0.3, 0.5), &room) < 0.1);
    }

    fn any_box() -> impl Strategy<Value = Aabb> {
        (prop::array::uniform3(-3.0_f32..3.0), prop::array::uniform3(0.02_f32..2.0))
            .prop_map(|(center, size)| Aabb { center: Point3::from(center), size: Vector3::from(size) })
    }

    proptest! {
        #[test]
        fn scores_are_scores(a in any_box(), b in any_box(), c in any_box()) {
            let room = Room { extent: cube(0.0, 0.0, 0.0, 8.0) };
            let directions = DirectionConvention::Paper.into();
            use RelationKind::*;
            for kind in [Near, Far, Closest, Farthest, LeftOf, RightOf, InFrontOf, Behind, Above, Below, On, Inside, Between, AgainstWall, InCorner] {
                let s = score(kind, &a, &[&b, &c], &directions, &room);
                prop_assert!((0.0..=1.0).contains(&s), "{kind:?} {s}");
            }
        }

        #[test]
        fn left_and_right_mirror_each_other(a in any_box(), b in any_box()) {
            let room = Room { extent: cube(0.0, 0.0, 0.0, 8.0) };
            let directions: Directions = DirectionConvention::Viewer.into();
            let left = score(RelationKind::LeftOf, &a, &[&b], &directions, &room);
            let right = score(RelationKind::RightOf, &b, &[&a], &directions, &room);
            prop_assert!((left - right).abs() < 1e-5);
            prop_assert!((near(&a, &b) - near(&b, &a)).abs() < 1e-6);
        }
    }
}
