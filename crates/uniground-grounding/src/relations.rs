//! Relations as geometry: soft scores in `0..=1` of upright boxes against upright boxes.
//!
//! Distances are measured between surfaces and in units of the things' own sizes, so that "next to"
//! means centimetres for mugs and half a metre for sofas. Turning the world about Z changes no
//! score, as long as the directions turn with it.

use super::direction::Directions;
use super::room::{Faced, Room};
use super::solid::Solid;
use uniground_geometry::Vector3;
use uniground_language::RelationKind;

/// Score of `target` standing in a relation to `anchors`; [`RelationKind::Between`] takes two, the
/// room relations none, all others one.
///
/// Comparisons among several targets (closest, farthest) are the reasoner's: here they score like
/// near and far.
#[must_use]
pub fn score(
    kind: RelationKind,
    target: &Solid,
    anchors: &[&Solid],
    directions: &Directions,
    room: &Room,
) -> f32 {
    match (kind, anchors) {
        (RelationKind::Between, [a, b]) => between(target, a, b),
        (RelationKind::AgainstWall, _) => room.against_wall(target),
        (RelationKind::InCorner, _) => room.in_corner(target),
        (RelationKind::InMiddle, _) => room.in_middle(target),
        (kind, [anchor, ..]) if kind.is_a_side() => {
            at_side(kind, target, anchor, directions, || room.faced(anchor)).0
        }
        (RelationKind::Near | RelationKind::Around, [anchor, ..])
            if room.apart_by_a_wall(target, anchor) =>
        {
            THROUGH_A_WALL * pairwise(kind, target, anchor)
        }
        (_, [anchor, ..]) => pairwise(kind, target, anchor),
        (_, []) => 0.0,
    }
}

/// Whose left, right, front and back a side was told by.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SeenBy {
    /// The directions in force: somebody's whom the words or the request tell of, or the
    /// convention's.
    Directions,
    /// Somebody who faces the anchor.
    WhoFacesIt,
}

/// Score of `target` at a side of the anchor, and by whose view; `faced` tells how somebody looks
/// who faces the anchor, and is asked only where nobody's view is meant.
#[must_use]
pub fn at_side(
    kind: RelationKind,
    target: &Solid,
    anchor: &Solid,
    directions: &Directions,
    faced: impl Fn() -> Faced,
) -> (f32, SeenBy) {
    let side = |directions: &Directions| match kind {
        RelationKind::LeftOf => -directions.right,
        RelationKind::RightOf => directions.right,
        RelationKind::Behind => -directions.front,
        _ => directions.front,
    };
    let viewed = beside(target, anchor, &side(directions));
    if directions.of_somebody {
        return (viewed, SeenBy::Directions);
    }
    let Faced { ahead, has_a_front } = faced();
    let faced = ahead
        .and_then(Directions::looking_along)
        .map_or(0.0, |directions| beside(target, anchor, &side(&directions)));
    let (viewed, faced) = match kind {
        RelationKind::InFrontOf | RelationKind::Behind if has_a_front => {
            (AGAINST_OWN_FRONT * viewed, faced)
        }
        _ => (viewed, FROM_THE_MIDDLE * faced),
    };
    if faced > viewed { (faced, SeenBy::WhoFacesIt) } else { (viewed, SeenBy::Directions) }
}

/// Score of `target` standing in a relation to somebody whose directions these are: what is in
/// front of them lies ahead.
#[must_use]
pub fn to_observer(
    kind: RelationKind,
    target: &Solid,
    observer: &Solid,
    directions: &Directions,
    room: &Room,
) -> f32 {
    match kind {
        RelationKind::InFrontOf | RelationKind::Opposite => {
            beside(target, observer, &-directions.front)
        }
        RelationKind::Behind => beside(target, observer, &directions.front),
        _ => score(kind, target, &[observer], directions, room),
    }
}

/// How near two things are as people mean it: by the gap between their surfaces and by their
/// middles on the ground plan. What stands on a thing or in it is hardly meant by "next to" it.
#[must_use]
pub fn close(a: &Solid, b: &Solid) -> f32 {
    const BY_MIDDLES: f32 = 0.5;
    const NOT_BESIDE: f32 = 0.3;
    let by_middles =
        fade((a.center - b.center).xy().norm(), 0.6 + f32::midpoint(a.diagonal(), b.diagonal()));
    let held = holds(a, b).max(holds(b, a));
    near(a, b) * (1.0 - BY_MIDDLES + BY_MIDDLES * by_middles) * (1.0 - NOT_BESIDE * held)
}

/// Whether a thing stands on another, or in it, `0..=1`.
#[must_use]
pub fn holds(holder: &Solid, held: &Solid) -> f32 {
    on(held, holder).max(inside(held, holder))
}

fn pairwise(kind: RelationKind, target: &Solid, anchor: &Solid) -> f32 {
    match kind {
        RelationKind::Near | RelationKind::Closest | RelationKind::Between => close(target, anchor),
        RelationKind::Far | RelationKind::Farthest => 1.0 - close(target, anchor),
        RelationKind::Around => around(target, anchor),
        RelationKind::Above => above(target, anchor),
        RelationKind::Below => above(anchor, target),
        RelationKind::On => on(target, anchor),
        RelationKind::Carrying => holds(target, anchor),
        RelationKind::Inside => inside(target, anchor).max(0.8 * on(target, anchor)),
        RelationKind::Opposite => opposite(target, anchor),
        RelationKind::Facing => facing(target, anchor),
        RelationKind::Leaning => leaning(target, anchor),
        RelationKind::LeftOf
        | RelationKind::RightOf
        | RelationKind::InFrontOf
        | RelationKind::Behind
        | RelationKind::AgainstWall
        | RelationKind::InCorner
        | RelationKind::InMiddle => 0.0,
    }
}

/// What a look from the middle of the room counts against the convention.
const FROM_THE_MIDDLE: f32 = 0.85;
/// What the convention's front counts where the thing has a front of its own.
const AGAINST_OWN_FRONT: f32 = 0.5;

/// What is left of being near where a wall stands between the two.
const THROUGH_A_WALL: f32 = 0.4;

/// 1 at zero, one half at `half`, towards 0 beyond.
pub(super) fn fade(distance: f32, half: f32) -> f32 {
    1.0 / (1.0 + (distance.max(0.0) / half).powi(2))
}

/// How far two things are apart as people compare it, metres: between their middles on the ground
/// plan. Boxes of things that reach far, walls and floors, say little by their middles: there it is
/// the gap that counts. Who is behind a wall has to walk around it.
#[must_use]
pub fn apart(target: &Solid, anchor: &Solid, of_the_building: bool, room: &Room) -> f32 {
    const AROUND_A_WALL_M: f32 = 2.0;
    let middles = (target.center - anchor.center).xy().norm();
    match () {
        () if of_the_building => target.gap(anchor) + 0.05 * middles,
        () if room.apart_by_a_wall(target, anchor) => middles + AROUND_A_WALL_M,
        () => middles,
    }
}

/// 1 where surfaces touch, falling with the gap: one half at 0.3 m plus a quarter of the mean
/// footprint diagonal.
#[must_use]
pub fn near(a: &Solid, b: &Solid) -> f32 {
    let reach = 0.3 + 0.25 * (a.diagonal() + b.diagonal()) / 2.0;
    fade(a.gap(b), reach)
}

/// 1 where footprints touch, one half at a gap of `reach_m`.
#[must_use]
pub fn reaching(target: &Solid, anchor: &Solid, reach_m: f32) -> f32 {
    fade(target.horizontal_gap(anchor), reach_m)
}

/// Beside the anchor at its own height: chairs around a table. One half at a gap of 0.3 m plus a
/// quarter of the anchor's diagonal.
#[must_use]
pub fn around(target: &Solid, anchor: &Solid) -> f32 {
    fade(target.horizontal_gap(anchor), 0.3 + 0.25 * anchor.diagonal())
        * fade(target.vertical_gap(anchor), 0.3)
}

/// On the side of the anchor that `direction` (unit, horizontal) points to: how well the line
/// between the centres follows it, times how near it is. Within 45 degrees it is fully that side,
/// beyond 80 not at all.
#[must_use]
pub fn beside(target: &Solid, anchor: &Solid, direction: &Vector3<f32>) -> f32 {
    let Some(unit) = horizontal(target, anchor) else { return 0.0 };
    let aligned = ((unit.dot(direction) - 0.2) / 0.5).clamp(0.0, 1.0);
    // What stands on the other or hangs above it is not beside it.
    let stacked = target.footprint_overlap(anchor).max(anchor.footprint_overlap(target));
    aligned * (1.0 - stacked) * (0.4 + 0.6 * near(target, anchor))
}

/// The horizontal direction from the anchor's centre to the target's.
fn horizontal(target: &Solid, anchor: &Solid) -> Option<Vector3<f32>> {
    horizontal_between(anchor, target)
}

/// The horizontal direction from one centre to another.
fn horizontal_between(from: &Solid, to: &Solid) -> Option<Vector3<f32>> {
    let between = to.center - from.center;
    Vector3::new(between.x, between.y, 0.0).try_normalize(1e-4)
}

/// Higher, and over the anchor's footprint.
#[must_use]
pub fn above(upper: &Solid, lower: &Solid) -> f32 {
    let reach = 0.15 + 0.25 * upper.diagonal().min(lower.diagonal());
    let over = upper.footprint_overlap(lower).max(lower.footprint_overlap(upper));
    // Straight above; aside, a picture above a sofa, a little less.
    let aside = ((over / 0.3).min(1.0)).max(0.7 * fade(upper.horizontal_gap(lower), reach));
    let higher = ((upper.center.z - lower.center.z)
        / (0.5 * (upper.size[2] + lower.size[2])).max(0.05))
    .clamp(0.0, 1.0);
    // Overlapping in height is not above; touching is.
    let sunk = (-upper.vertical_gap(lower)).max(0.0);
    let clear = fade(sunk - 0.1 * upper.size[2], 0.1 + 0.3 * upper.size[2]);
    higher * clear * aside
}

/// Resting on: over the footprint, the underside at the anchor's top, or on a board inside it
/// (shelves); or flat against it (walls).
#[must_use]
pub fn on(target: &Solid, anchor: &Solid) -> f32 {
    let over = (target.footprint_overlap(anchor) / 0.5).min(1.0);
    let (bottom, top) = (target.bottom, anchor.top);
    let rest = if bottom >= top {
        fade(bottom - top, 0.06)
    } else {
        fade(top - bottom - 0.05, 0.4 * anchor.size[2].max(0.1))
    };
    let not_under =
        ((bottom - anchor.bottom + 0.02) / (0.3 * anchor.size[2]).max(0.02)).clamp(0.0, 1.0);
    let hangs =
        is_upright_plane(anchor) && target.gap(anchor) < 0.12 && target.center.z > anchor.bottom;
    (over * rest * not_under).max(if hangs { 0.9 } else { 0.0 })
}

fn is_upright_plane(solid: &Solid) -> bool {
    let (long, short) = solid.sides();
    short < 0.15 && solid.size[2] > 1.0 && long > 0.8
}

/// Share of the target's volume within the anchor.
#[must_use]
pub fn inside(target: &Solid, anchor: &Solid) -> f32 {
    let height =
        (-target.vertical_gap(anchor)).clamp(0.0, target.size[2]) / target.size[2].max(1e-3);
    target.footprint_overlap(anchor) * if target.size[2] < 1e-3 { 1.0 } else { height }
}

/// Near the middle of the line between the anchors' centres, on the ground plan, no storey above or
/// below both, and not what carries them.
#[must_use]
pub fn between(target: &Solid, a: &Solid, b: &Solid) -> f32 {
    let line = (b.center - a.center).xy();
    let length = line.norm();
    if length < 1e-3 {
        return 0.0;
    }
    let from_a = (target.center - a.center).xy();
    let (along, aside) = (from_a.dot(&line) / (length * length), from_a.perp(&line).abs() / length);
    let within = fade((along - 0.5).abs() - 0.3, 0.15);
    let on_the_line = within * fade(aside, 0.35 * length + 0.2);
    if on_the_line <= 0.0 {
        return 0.0;
    }
    let off_their_height = target.vertical_gap(a).min(target.vertical_gap(b)).max(0.0);
    let carries_them = holds(target, a).max(holds(target, b));
    on_the_line * fade(off_their_height, 1.0) * (1.0 - 0.8 * carries_them)
}

/// On the other side, vis-à-vis: apart, and in line with one of the anchor's axes.
#[must_use]
pub fn opposite(target: &Solid, anchor: &Solid) -> f32 {
    let Some(unit) = horizontal(target, anchor) else { return 0.0 };
    let along = unit.xy().dot(&anchor.axis).abs();
    let across = unit.xy().perp(&anchor.axis).abs();
    let in_line = ((along.max(across) - 0.7) / 0.25).clamp(0.0, 1.0);
    in_line * (1.0 - 0.8 * near(target, anchor))
}

/// Turned towards: boxes have no front, so any of the four sides counts that the anchor lies
/// straight ahead of; nearer is likelier.
#[must_use]
pub fn facing(target: &Solid, anchor: &Solid) -> f32 {
    let Some(unit) = horizontal(anchor, target) else { return 0.0 };
    let along = unit.xy().dot(&target.axis).abs();
    let across = unit.xy().perp(&target.axis).abs();
    ((along.max(across) - 0.7) / 0.25).clamp(0.0, 1.0) * (0.5 + 0.5 * fade(target.gap(anchor), 1.5))
}

/// Touching it from the side, at about the same height.
#[must_use]
pub fn leaning(target: &Solid, anchor: &Solid) -> f32 {
    fade(target.horizontal_gap(anchor), 0.15) * fade(target.vertical_gap(anchor), 0.1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::direction::DirectionConvention;
    use crate::solid::tests::{any_solid, turned};
    use proptest::prelude::*;
    use uniground_geometry::Point3;
    use uniground_geometry::boxes::Aabb;

    fn boxed(center: [f32; 3], size: [f32; 3]) -> Solid {
        Aabb { center: Point3::from(center), size: Vector3::from(size) }.into()
    }

    fn cube(x: f32, y: f32, z: f32, size: f32) -> Solid {
        boxed([x, y, z], [size; 3])
    }

    fn room() -> Room {
        Room::new(
            boxed([0.0, 0.0, 1.3], [6.0, 5.0, 2.6]),
            vec![boxed([0.0, 2.55, 1.3], [6.0, 0.1, 2.6])],
        )
    }

    #[test]
    fn a_mug_on_a_table_is_on_it_and_not_under_it() {
        let table = boxed([0.0, 0.0, 0.375], [1.4, 0.8, 0.75]);
        let mug = cube(0.3, 0.1, 0.8, 0.1);
        let bin = cube(0.3, 0.1, 0.15, 0.3);
        assert!(
            on(&mug, &table) > 0.9 && on(&bin, &table) < 0.2,
            "{} {}",
            on(&mug, &table),
            on(&bin, &table)
        );
        assert!(above(&mug, &table) > 0.7);
        let lamp = cube(0.0, 0.0, 2.0, 0.3);
        assert!(above(&lamp, &table) > 0.8 && on(&lamp, &table) < 0.1);
    }

    #[test]
    fn left_follows_the_convention() {
        let (anchor, thing) = (cube(0.0, 0.0, 0.5, 0.5), cube(1.0, 0.0, 0.5, 0.5));
        let left = |c: DirectionConvention| {
            score(RelationKind::LeftOf, &thing, &[&anchor], &c.into(), &room())
        };
        assert!(left(DirectionConvention::Paper) > 0.5 && left(DirectionConvention::Viewer) == 0.0);
    }

    #[test]
    fn who_does_not_say_from_where_faces_the_thing() {
        // Left of a bookcase at the wall at +Y, for who faces it, is -X; the paper's left is +X.
        let bookcase = boxed([0.0, 2.3, 1.0], [0.8, 0.4, 2.0]);
        let left = |x: f32| {
            score(
                RelationKind::LeftOf,
                &cube(x, 2.2, 0.25, 0.4),
                &[&bookcase],
                &DirectionConvention::Paper.into(),
                &room(),
            )
        };
        assert!(left(0.9) > left(-0.9) && left(-0.9) > 0.5, "{} {}", left(0.9), left(-0.9));
        let seen = Directions::looking_along(Vector3::y()).unwrap();
        assert_eq!(
            score(RelationKind::LeftOf, &cube(0.9, 2.2, 0.25, 0.4), &[&bookcase], &seen, &room()),
            0.0
        );
    }

    #[test]
    fn leaning_touches_and_opposite_stands_across() {
        let (wall, ladder) =
            (boxed([0.0, 2.5, 1.3], [6.0, 0.1, 2.6]), boxed([1.0, 2.3, 1.0], [0.5, 0.2, 2.0]));
        assert!(leaning(&ladder, &wall) > 0.8 && leaning(&cube(0.0, 0.0, 1.0, 0.5), &wall) < 0.1);
        let (sofa, tv) =
            (boxed([0.0, -2.0, 0.4], [2.0, 0.9, 0.8]), boxed([0.1, 2.0, 0.8], [1.2, 0.1, 0.7]));
        assert!(opposite(&tv, &sofa) > 0.8 && opposite(&cube(1.2, -2.0, 0.4, 0.3), &sofa) < 0.4);
        assert!(facing(&sofa, &tv) > 0.5 && facing(&sofa, &cube(3.0, 1.0, 0.4, 0.3)) < 0.3);
    }

    #[test]
    fn in_front_of_what_stands_at_a_wall_is_the_room() {
        // A bookcase at the wall at +Y: its front is -Y. One at -Y: its front is +Y, though the
        // convention says -Y.
        let (north, south) =
            (boxed([0.0, 2.3, 1.0], [0.8, 0.4, 2.0]), boxed([0.5, -2.3, 1.0], [0.8, 0.4, 2.0]));
        let stool = cube(0.3, -1.2, 0.25, 0.4);
        let front = |anchor: &Solid, directions: Directions| {
            score(RelationKind::InFrontOf, &stool, &[anchor], &directions, &room())
        };
        let paper: Directions = DirectionConvention::Paper.into();
        assert!(front(&north, paper) > 0.3 && front(&south, paper) > 0.5);
        // Somebody who looks along -Y from behind it sees it the other way round.
        let seen = Directions::looking_along(Vector3::y()).unwrap();
        assert!(front(&south, seen) < 0.1);
    }

    #[test]
    fn near_goes_by_the_middles_too_and_not_on_top_of_it() {
        let desk = boxed([0.0, 0.0, 0.375], [1.6, 0.8, 0.75]);
        // Both touch the desk: one tucked in at its middle, one at its corner.
        let (middle, corner) =
            (boxed([0.2, 0.6, 0.25], [0.4, 0.4, 0.5]), boxed([1.0, 0.6, 0.25], [0.4, 0.4, 0.5]));
        assert_eq!((near(&middle, &desk), near(&corner, &desk)), (1.0, 1.0));
        assert!(
            close(&middle, &desk) > 1.03 * close(&corner, &desk) && close(&corner, &desk) > 0.75,
            "{}",
            close(&corner, &desk)
        );
        assert!(close(&cube(0.0, 0.0, 0.8, 0.1), &desk) < close(&corner, &desk));
        // Two rooms: what is nearest without a wall between is nearest.
        let wall = boxed([1.5, 0.0, 1.3], [0.1, 5.0, 2.6]);
        let two = Room::new(room().outline, vec![wall]);
        let (here, there) = (cube(-1.4, 0.0, 0.3, 0.4), cube(2.0, 0.0, 0.3, 0.4));
        let next = |target: &Solid| {
            score(
                RelationKind::Near,
                target,
                &[&cube(0.6, 0.0, 0.3, 0.4)],
                &DirectionConvention::Paper.into(),
                &two,
            )
        };
        assert!(
            next(&there) < 0.5
                && apart(&here, &desk, false, &two) < apart(&there, &desk, false, &two)
        );
    }

    #[test]
    fn nearer_is_nearer() {
        let anchor = cube(0.0, 0.0, 0.5, 0.5);
        let scores: Vec<f32> = (0..20_u8)
            .map(|i| near(&cube(0.5 + f32::from(i) * 0.2, 0.0, 0.5, 0.5), &anchor))
            .collect();
        assert!(scores.windows(2).all(|w| w[0] >= w[1]), "{scores:?}");
        assert_eq!(scores[0], 1.0);
    }

    proptest! {
        /// Scores stay in their range, and turn with the world: with the directions where those matter.
        #[test]
        fn scores_are_scores_and_turn_with_the_world(a in any_solid(), b in any_solid(), c in any_solid(), by in -3.0_f32..3.0) {
            let room = room();
            let directions: Directions = DirectionConvention::Viewer.into();
            let turned_room = Room::new(turned(&room.outline, by), room.walls.iter().map(|w| turned(w, by)).collect());
            let turn = nalgebra::Rotation3::from_axis_angle(&Vector3::z_axis(), by);
            let turned_directions = Directions { right: turn * directions.right, front: turn * directions.front, ..directions };
            let (ta, tb, tc) = (turned(&a, by), turned(&b, by), turned(&c, by));
            for kind in RelationKind::ALL {
                let s = score(kind, &a, &[&b, &c], &directions, &room);
                prop_assert!((0.0..=1.0).contains(&s), "{kind:?} {s}");
                let t = score(kind, &ta, &[&tb, &tc], &turned_directions, &turned_room);
                prop_assert!((s - t).abs() < 0.01, "{kind:?} {s} {t}");
            }
        }

        #[test]
        fn opposites_mirror_each_other(a in any_solid(), b in any_solid()) {
            let directions = Directions { of_somebody: true, ..DirectionConvention::Viewer.into() };
            let of = |kind: RelationKind, x: &Solid, y: &Solid| score(kind, x, &[y], &directions, &room());
            for kind in [RelationKind::LeftOf, RelationKind::Above] {
                prop_assert!((of(kind, &a, &b) - of(kind.inverse(), &b, &a)).abs() < 1e-5, "{kind:?}");
            }
            prop_assert!((near(&a, &b) - near(&b, &a)).abs() < 1e-4);
        }

        /// Twice the size at twice the distance is not farther: scores of contact do not depend on scale alone.
        #[test]
        fn what_touches_touches_at_any_scale(size in 0.05_f32..3.0) {
            let (below, onto) = (cube(0.0, 0.0, size / 2.0, size), cube(0.0, 0.0, 1.25 * size, size / 2.0));
            prop_assert!(on(&onto, &below) > 0.9 && near(&onto, &below) > 0.99 && above(&onto, &below) > 0.7);
            prop_assert!(inside(&cube(0.0, 0.0, size / 2.0, size / 3.0), &below) > 0.99);
        }
    }
}
