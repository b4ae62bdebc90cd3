//! Relations as geometry: soft scores in `0..=1` for pairs of upright boxes.
//!
//! Distances are measured between surfaces and in units of the objects' own sizes. So "next to"
//! means centimeters for mugs and half a meter for sofas. Turning the world about Z changes no
//! score, as long as the directions turn with it.

use super::direction::Directions;
use super::room::{Faced, Room};
use super::solid::Solid;
use uniground_geometry::Vector3;
use uniground_language::RelationKind;

/// Returns the score of `target` in a relation to `anchors`. [`RelationKind::Between`] takes two
/// anchors, the room relations none, all others one.
///
/// Comparisons among several targets (closest, farthest) are done by the reasoner; here they score
/// like near and far.
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

/// By whose view a side was decided.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SeenBy {
    /// The directions in force: those of a viewer given by the words or the request, or of the
    /// convention.
    Directions,
    /// A viewer who faces the anchor.
    WhoFacesIt,
}

/// Returns the score of `target` at a side of the anchor, and by whose view. `faced` returns how a
/// viewer faces the anchor; it is called only where no viewer is given.
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

/// Returns the score of `target` in a relation to an observer with these directions. In front of
/// the observer means ahead.
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

/// Returns how near two objects are as people judge it: by the gap between their surfaces and by
/// the distance of their middles on the ground plan. Stacked objects are seldom meant by "next to".
#[must_use]
pub fn close(a: &Solid, b: &Solid) -> f32 {
    const BY_MIDDLES: f32 = 0.5;
    const NOT_BESIDE: f32 = 0.3;
    let by_middles =
        fade((a.center - b.center).xy().norm(), 0.6 + f32::midpoint(a.diagonal(), b.diagonal()));
    let held = holds(a, b).max(holds(b, a));
    near(a, b) * (1.0 - BY_MIDDLES + BY_MIDDLES * by_middles) * (1.0 - NOT_BESIDE * held)
}

/// Returns the degree to which an object stands on or in another, `0..=1`.
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

/// Weight of the view from the middle of the room, relative to the convention.
const FROM_THE_MIDDLE: f32 = 0.85;
/// Weight of the convention's front where the object has a front of its own.
const AGAINST_OWN_FRONT: f32 = 0.5;

/// Factor of nearness where a wall stands between the two.
const THROUGH_A_WALL: f32 = 0.4;

/// Returns 1 at zero, one half at `half`, and falls towards 0 beyond.
pub(super) fn fade(distance: f32, half: f32) -> f32 {
    1.0 / (1.0 + (distance.max(0.0) / half).powi(2))
}

/// Returns how far apart two objects are as people compare it, meters: between their middles on the
/// ground plan. The middles of large building parts such as walls and floors tell little, so their
/// gap counts instead. A wall between the two adds the way around it.
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

/// Returns 1 where surfaces touch, falling with the gap: one half at 0.3 m plus a quarter of the
/// mean footprint diagonal.
#[must_use]
pub fn near(a: &Solid, b: &Solid) -> f32 {
    let reach = 0.3 + 0.25 * (a.diagonal() + b.diagonal()) / 2.0;
    fade(a.gap(b), reach)
}

/// Returns 1 where footprints touch, one half at a gap of `reach_m`.
#[must_use]
pub fn reaching(target: &Solid, anchor: &Solid, reach_m: f32) -> f32 {
    fade(target.horizontal_gap(anchor), reach_m)
}

/// Scores a target beside the anchor at its own height: chairs around a table. One half at a gap of
/// 0.3 m plus a quarter of the anchor's diagonal.
#[must_use]
pub fn around(target: &Solid, anchor: &Solid) -> f32 {
    fade(target.horizontal_gap(anchor), 0.3 + 0.25 * anchor.diagonal())
        * fade(target.vertical_gap(anchor), 0.3)
}

/// Scores a target on the side of the anchor that `direction` (unit, horizontal) points to: how
/// well the line between the centers follows it, times how near it is. Within 45 degrees it is
/// fully that side, beyond 80 not at all.
#[must_use]
pub fn beside(target: &Solid, anchor: &Solid, direction: &Vector3<f32>) -> f32 {
    let Some(unit) = horizontal(target, anchor) else { return 0.0 };
    let aligned = ((unit.dot(direction) - 0.2) / 0.5).clamp(0.0, 1.0);
    // A target that stands on the anchor or hangs above it is not beside it.
    let stacked = target.footprint_overlap(anchor).max(anchor.footprint_overlap(target));
    aligned * (1.0 - stacked) * (0.4 + 0.6 * near(target, anchor))
}

/// Returns the horizontal direction from the anchor's center to the target's.
fn horizontal(target: &Solid, anchor: &Solid) -> Option<Vector3<f32>> {
    horizontal_between(anchor, target)
}

/// Returns the horizontal direction from one center to another.
fn horizontal_between(from: &Solid, to: &Solid) -> Option<Vector3<f32>> {
    let between = to.center - from.center;
    Vector3::new(between.x, between.y, 0.0).try_normalize(1e-4)
}

/// Scores a target that is higher than the anchor and over its footprint.
#[must_use]
pub fn above(upper: &Solid, lower: &Solid) -> f32 {
    let reach = 0.15 + 0.25 * upper.diagonal().min(lower.diagonal());
    let over = upper.footprint_overlap(lower).max(lower.footprint_overlap(upper));
    // Straight above counts fully; to the side, like a picture above a sofa, a little less.
    let aside = ((over / 0.3).min(1.0)).max(0.7 * fade(upper.horizontal_gap(lower), reach));
    let higher = ((upper.center.z - lower.center.z)
        / (0.5 * (upper.size[2] + lower.size[2])).max(0.05))
    .clamp(0.0, 1.0);
    // A target that overlaps in height is not above; one that touches is.
    let sunk = (-upper.vertical_gap(lower)).max(0.0);
    let clear = fade(sunk - 0.1 * upper.size[2], 0.1 + 0.3 * upper.size[2]);
    higher * clear * aside
}

/// Scores a target that rests on the anchor: over the footprint, with its underside at the anchor's
/// top, or on a board inside it (shelves); or flat against it (walls).
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

/// Returns the share of the target's volume within the anchor.
#[must_use]
pub fn inside(target: &Solid, anchor: &Solid) -> f32 {
    let height =
        (-target.vertical_gap(anchor)).clamp(0.0, target.size[2]) / target.size[2].max(1e-3);
    target.footprint_overlap(anchor) * if target.size[2] < 1e-3 { 1.0 } else { height }
}

/// Scores a target near the middle of the line between the anchors' centers, on the ground plan. It
/// must not be a story above or below both, nor carry them.
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

/// Scores a target on the opposite side: apart, and in line with one of the anchor's axes.
#[must_use]
pub fn opposite(target: &Solid, anchor: &Solid) -> f32 {
    let Some(unit) = horizontal(target, anchor) else { return 0.0 };
    let along = unit.xy().dot(&anchor.axis).abs();
    let across = unit.xy().perp(&anchor.axis).abs();
    let in_line = ((along.max(across) - 0.7) / 0.25).clamp(0.0, 1.0);
    in_line * (1.0 - 0.8 * near(target, anchor))
}

/// Scores a target that is turned towards the anchor. Boxes have no front, so any of the four sides
/// counts that the anchor lies straight ahead of; nearer is likelier.
#[must_use]
pub fn facing(target: &Solid, anchor: &Solid) -> f32 {
    let Some(unit) = horizontal(anchor, target) else { return 0.0 };
    let along = unit.xy().dot(&target.axis).abs();
    let across = unit.xy().perp(&target.axis).abs();
    ((along.max(across) - 0.7) / 0.25).clamp(0.0, 1.0) * (0.5 + 0.5 * fade(target.gap(anchor), 1.5))
}

/// Scores a target that touches the anchor from the side, at about the same height.
#[must_use]
pub fn leaning(target: &Solid, anchor: &Solid) -> f32 {
    fade(target.horizontal_gap(anchor), 0.15) * fade(target.vertical_gap(anchor), 0.1)
}

#[cfg(test)]
mod tests;
