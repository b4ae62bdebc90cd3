//! Relations as geometry: soft scores in `0..=1` of upright boxes against upright boxes.
//!
//! Distances are measured between surfaces and in units of the things' own sizes, so that "next to" means centimetres for
//! mugs and half a metre for sofas. Turning the world about Z changes no score, as long as the directions turn with it.

use super::direction::Directions;
use super::query::RelationKind;
use super::solid::Solid;
use crate::geometry::{Vector2, Vector3};

/// What relations to the room itself are measured against.
#[derive(Debug, Clone, PartialEq)]
pub struct Room {
    /// The smallest upright box around everything.
    pub outline: Solid,
    /// Boxes of the instances flagged as walls; may be empty.
    pub walls: Vec<Solid>,
    /// Pairs of walls that meet at an angle, by index.
    corners: Vec<(usize, usize)>,
}

impl Room {
    /// A room with this outline and these walls.
    #[must_use]
    pub fn new(outline: Solid, walls: Vec<Solid>) -> Self {
        const MEET_M: f32 = 0.4;
        const AT_AN_ANGLE: f32 = 0.5;
        let meet = |a: &Solid, b: &Solid| along(a).perp(&along(b)).abs() > AT_AN_ANGLE && a.horizontal_gap(b) < MEET_M;
        let pairs = (0..walls.len()).flat_map(|i| (i + 1..walls.len()).map(move |j| (i, j)));
        let corners = pairs.filter(|&(i, j)| meet(&walls[i], &walls[j])).collect();
        Self { outline, walls, corners }
    }
}

/// The direction of the longer side.
fn along(solid: &Solid) -> Vector2<f32> {
    if solid.size[0] >= solid.size[1] { solid.axis } else { Vector2::new(-solid.axis.y, solid.axis.x) }
}

/// Score of `target` standing in a relation to `anchors`; [`RelationKind::Between`] takes two, the room relations none, all others one.
///
/// Comparisons among several targets (closest, farthest) are the reasoner's: here they score like near and far.
#[must_use]
pub fn score(kind: RelationKind, target: &Solid, anchors: &[&Solid], directions: &Directions, room: &Room) -> f32 {
    match (kind, anchors) {
        (RelationKind::Between, [a, b]) => between(target, a, b),
        (RelationKind::AgainstWall, _) => against_wall(target, room),
        (RelationKind::InCorner, _) => in_corner(target, room),
        (RelationKind::InMiddle, _) => in_middle(target, room),
        (kind, [anchor, ..]) if kind.is_a_side() => at_side(kind, target, anchor, directions, room, || own_front(anchor, room)).0,
        (_, [anchor, ..]) => pairwise(kind, target, anchor),
        (_, []) => 0.0,
    }
}

/// Whose left, right, front and back a side was told by.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SeenBy {
    /// The directions in force: somebody's whom the words or the request tell of, or the convention's.
    Directions,
    /// Somebody who faces the anchor.
    WhoFacesIt,
}

/// Score of `target` at a side of the anchor, and by whose view; `front` tells the anchor's own front (unit, horizontal), and is asked only
/// where nobody's view is meant.
#[must_use]
pub fn at_side(
    kind: RelationKind,
    target: &Solid,
    anchor: &Solid,
    directions: &Directions,
    room: &Room,
    front: impl Fn() -> Option<Vector3<f32>>,
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
    // What stands against a wall has a front of its own. In the open, nobody tells from where: people look from the middle of the room.
    let own = front();
    let ahead = own.map(|front| -front).or_else(|| horizontal_between(&room.outline, anchor));
    let faced = ahead
        .and_then(Directions::looking_along)
        .map_or(0.0, |directions| beside(target, anchor, &side(&directions)));
    let (viewed, faced) = match kind {
        RelationKind::InFrontOf | RelationKind::Behind if own.is_some() => (AGAINST_OWN_FRONT * viewed, faced),
        _ => (viewed, FROM_THE_MIDDLE * faced),
    };
    if faced > viewed { (faced, SeenBy::WhoFacesIt) } else { (viewed, SeenBy::Directions) }
}

/// Score of `target` standing in a relation to somebody whose directions these are: what is in front of them lies ahead.
#[must_use]
pub fn to_observer(kind: RelationKind, target: &Solid, observer: &Solid, directions: &Directions, room: &Room) -> f32 {
    match kind {
        RelationKind::InFrontOf | RelationKind::Opposite => beside(target, observer, &-directions.front),
        RelationKind::Behind => beside(target, observer, &directions.front),
        _ => score(kind, target, &[observer], directions, room),
    }
}

fn pairwise(kind: RelationKind, target: &Solid, anchor: &Solid) -> f32 {
    match kind {
        RelationKind::Near | RelationKind::Closest | RelationKind::Between => near(target, anchor),
        RelationKind::Far | RelationKind::Farthest => 1.0 - near(target, anchor),
        RelationKind::Around => around(target, anchor),
        RelationKind::Above => above(target, anchor),
        RelationKind::Below => above(anchor, target),
        RelationKind::On => on(target, anchor),
        RelationKind::Carrying => on(anchor, target).max(inside(anchor, target)),
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

/// Away from the wall a thing stands against, a side of the room or a wall within; `None` in the open and, unless the thing is long, in corners.
#[must_use]
pub fn own_front(anchor: &Solid, room: &Room) -> Option<Vector3<f32>> {
    const AT_THE_WALL_M: f32 = 0.35;
    const NEXT_WALL_M: f32 = 0.3;
    let [a, b] = room_axes(room);
    let sides = side_gaps(anchor, room).into_iter().zip([a, -a, b, -b]);
    let inwards = |wall: &Solid| {
        let across = Vector2::new(-along(wall).y, along(wall).x);
        across * (anchor.center - wall.center).xy().dot(&across).signum()
    };
    let walls = room.walls.iter().map(|wall| (anchor.horizontal_gap(wall), inwards(wall)));
    let backs: Vec<(f32, Vector2<f32>)> = sides.chain(walls).collect();
    let (gap, front) = *backs.iter().min_by(|x, y| x.0.total_cmp(&y.0))?;
    let other = backs
        .iter()
        .filter(|(_, other)| other.dot(&front).abs() < 0.5)
        .map(|(gap, _)| *gap)
        .fold(f32::INFINITY, f32::min);
    let flat = anchor.sides().0 > 2.0 * anchor.sides().1;
    // In a corner only a long thing tells which wall it has at its back.
    let clear = other > gap + NEXT_WALL_M || flat && along(anchor).dot(&front).abs() < 0.3;
    (gap <= AT_THE_WALL_M && clear).then(|| Vector3::new(front.x, front.y, 0.0))
}

/// 1 at zero, one half at `half`, towards 0 beyond.
fn fade(distance: f32, half: f32) -> f32 {
    1.0 / (1.0 + (distance.max(0.0) / half).powi(2))
}

/// How far two things are apart as people compare it, metres: between their middles on the ground plan. Boxes of things that reach far,
/// walls and floors, say little by their middles: there it is the gap that counts.
#[must_use]
pub fn apart(target: &Solid, anchor: &Solid, of_the_building: bool) -> f32 {
    let middles = (target.center - anchor.center).xy().norm();
    if of_the_building { target.gap(anchor) + 0.05 * middles } else { middles }
}

/// 1 where surfaces touch, falling with the gap: one half at 0.3 m plus a quarter of the mean footprint diagonal.
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

/// Beside the anchor at its own height: chairs around a table. One half at a gap of 0.3 m plus a quarter of the anchor's diagonal.
#[must_use]
pub fn around(target: &Solid, anchor: &Solid) -> f32 {
    fade(target.horizontal_gap(anchor), 0.3 + 0.25 * anchor.diagonal()) * fade(target.vertical_gap(anchor), 0.3)
}

/// On the side of the anchor that `direction` (unit, horizontal) points to: how well the line between the centres follows it, times how
/// near it is. Within 45 degrees it is fully that side, beyond 80 not at all.
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
    let higher = ((upper.center.z - lower.center.z) / (0.5 * (upper.size[2] + lower.size[2])).max(0.05)).clamp(0.0, 1.0);
    // Overlapping in height is not above; touching is.
    let sunk = (-upper.vertical_gap(lower)).max(0.0);
    let clear = fade(sunk - 0.1 * upper.size[2], 0.1 + 0.3 * upper.size[2]);
    higher * clear * aside
}

/// Resting on: over the footprint, the underside at the anchor's top, or on a board inside it (shelves); or flat against it (walls).
#[must_use]
pub fn on(target: &Solid, anchor: &Solid) -> f32 {
    let over = (target.footprint_overlap(anchor) / 0.5).min(1.0);
    let (bottom, top) = (target.bottom, anchor.top);
    let rest = if bottom >= top { fade(bottom - top, 0.06) } else { fade(top - bottom - 0.05, 0.4 * anchor.size[2].max(0.1)) };
    let not_under = ((bottom - anchor.bottom + 0.02) / (0.3 * anchor.size[2]).max(0.02)).clamp(0.0, 1.0);
    let hangs = is_upright_plane(anchor) && target.gap(anchor) < 0.12 && target.center.z > anchor.bottom;
    (over * rest * not_under).max(if hangs { 0.9 } else { 0.0 })
}

fn is_upright_plane(solid: &Solid) -> bool {
    let (long, short) = solid.sides();
    short < 0.15 && solid.size[2] > 1.0 && long > 0.8
}

/// Share of the target's volume within the anchor.
#[must_use]
pub fn inside(target: &Solid, anchor: &Solid) -> f32 {
    let height = (-target.vertical_gap(anchor)).clamp(0.0, target.size[2]) / target.size[2].max(1e-3);
    target.footprint_overlap(anchor) * if target.size[2] < 1e-3 { 1.0 } else { height }
}

/// Near the middle of the line between the anchors' centres, on the ground plan.
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
    within * fade(aside, 0.35 * length + 0.2)
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

/// Turned towards: boxes have no front, so any of the four sides counts that the anchor lies straight ahead of; nearer is likelier.
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

/// Close to a wall, or to one side of the room.
#[must_use]
pub fn against_wall(target: &Solid, room: &Room) -> f32 {
    let walls = room.walls.iter().map(|wall| fade(target.horizontal_gap(wall), 0.25));
    side_gaps(target, room).into_iter().map(|g| fade(g, 0.3)).chain(walls).fold(0.0, f32::max)
}

/// Close to two sides of the room, or two walls, that meet: rooms may be L-shaped.
#[must_use]
pub fn in_corner(target: &Solid, room: &Room) -> f32 {
    let [a, b, c, d] = side_gaps(target, room).map(|g| fade(g, 0.5));
    let near = |wall: usize| fade(target.horizontal_gap(&room.walls[wall]), 0.5);
    let meeting = room.corners.iter().map(|&(i, j)| near(i) * near(j)).fold(0.0, f32::max);
    meeting.max(a.max(b) * c.max(d))
}

/// Near the middle of the room's outline, measured by the room's size.
#[must_use]
pub fn in_middle(target: &Solid, room: &Room) -> f32 {
    let aside = |axis: usize| {
        let offset = (target.center - room.outline.center).xy().dot(&room_axes(room)[axis]).abs();
        offset / (room.outline.size[axis] / 2.0).max(0.1)
    };
    fade(aside(0), 0.45) * fade(aside(1), 0.45)
}

fn room_axes(room: &Room) -> [Vector2<f32>; 2] {
    [room.outline.axis, Vector2::new(-room.outline.axis.y, room.outline.axis.x)]
}

/// Gaps to the four sides of the room's outline: two along each of its axes.
fn side_gaps(target: &Solid, room: &Room) -> [f32; 4] {
    let outline = &room.outline;
    let mut gaps = [0.0; 4];
    for (i, axis) in room_axes(room).iter().enumerate() {
        let along = target.corners.map(|p| (p - outline.center.xy()).dot(axis));
        let half = outline.size[i] / 2.0;
        gaps[2 * i] = along.iter().copied().fold(f32::INFINITY, f32::min) + half;
        gaps[2 * i + 1] = half - along.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    }
    gaps
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Point3;
    use crate::geometry::boxes::Aabb;
    use crate::grounding::direction::DirectionConvention;
    use crate::grounding::solid::tests::{any_solid, turned};
    use proptest::prelude::*;

    fn boxed(center: [f32; 3], size: [f32; 3]) -> Solid {
        Aabb { center: Point3::from(center), size: Vector3::from(size) }.into()
    }

    fn cube(x: f32, y: f32, z: f32, size: f32) -> Solid {
        boxed([x, y, z], [size; 3])
    }

    fn room() -> Room {
        Room::new(boxed([0.0, 0.0, 1.3], [6.0, 5.0, 2.6]), vec![boxed([0.0, 2.55, 1.3], [6.0, 0.1, 2.6])])
    }

    #[test]
    fn a_mug_on_a_table_is_on_it_and_not_under_it() {
        let table = boxed([0.0, 0.0, 0.375], [1.4, 0.8, 0.75]);
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
        let left = |c: DirectionConvention| score(RelationKind::LeftOf, &thing, &[&anchor], &c.into(), &room());
        assert!(left(DirectionConvention::Paper) > 0.5 && left(DirectionConvention::Viewer) == 0.0);
    }

    #[test]
    fn corners_walls_and_the_middle_are_the_room_s() {
        let room = room();
        assert!(in_corner(&cube(2.7, 2.2, 0.3, 0.5), &room) > 0.9);
        assert!(in_corner(&cube(0.0, 2.2, 0.3, 0.5), &room) < 0.1 && against_wall(&cube(0.0, 2.2, 0.3, 0.5), &room) > 0.9);
        assert!(against_wall(&cube(0.0, 0.0, 0.3, 0.5), &room) < 0.1);
        assert!(in_middle(&cube(0.2, -0.2, 0.3, 0.5), &room) > 0.8 && in_middle(&cube(2.7, 2.2, 0.3, 0.5), &room) < 0.1);
    }

    #[test]
    fn corners_within_the_outline_are_corners() {
        // An L-shaped room: two walls meet at (0, 0.5), in the middle of its outline.
        let walls = vec![boxed([-1.5, 0.5, 1.3], [3.0, 0.1, 2.6]), boxed([0.0, 1.5, 1.3], [0.1, 2.0, 2.6])];
        let l_shaped = Room::new(room().outline, walls);
        let thing = cube(0.4, 0.8, 0.25, 0.5);
        assert!(in_corner(&thing, &l_shaped) > 0.8 && in_corner(&thing, &room()) < 0.1);
        assert!(in_corner(&cube(1.5, 0.5, 0.25, 0.5), &l_shaped) < 0.2);
        // A long shelf at the inner wall has its back there.
        let shelf = boxed([-1.5, 0.3, 0.9], [1.2, 0.3, 1.8]);
        assert!(own_front(&shelf, &l_shaped).is_some_and(|front| front.y < -0.9) && own_front(&shelf, &room()).is_none());
    }

    #[test]
    fn who_does_not_say_from_where_faces_the_thing() {
        // Left of a bookcase at the wall at +Y, for who faces it, is -X; the paper's left is +X.
        let bookcase = boxed([0.0, 2.3, 1.0], [0.8, 0.4, 2.0]);
        let left =
            |x: f32| score(RelationKind::LeftOf, &cube(x, 2.2, 0.25, 0.4), &[&bookcase], &DirectionConvention::Paper.into(), &room());
        assert!(left(0.9) > left(-0.9) && left(-0.9) > 0.5, "{} {}", left(0.9), left(-0.9));
        let seen = Directions::looking_along(Vector3::y()).unwrap();
        assert_eq!(score(RelationKind::LeftOf, &cube(0.9, 2.2, 0.25, 0.4), &[&bookcase], &seen, &room()), 0.0);
    }

    #[test]
    fn leaning_touches_and_opposite_stands_across() {
        let (wall, ladder) = (boxed([0.0, 2.5, 1.3], [6.0, 0.1, 2.6]), boxed([1.0, 2.3, 1.0], [0.5, 0.2, 2.0]));
        assert!(leaning(&ladder, &wall) > 0.8 && leaning(&cube(0.0, 0.0, 1.0, 0.5), &wall) < 0.1);
        let (sofa, tv) = (boxed([0.0, -2.0, 0.4], [2.0, 0.9, 0.8]), boxed([0.1, 2.0, 0.8], [1.2, 0.1, 0.7]));
        assert!(opposite(&tv, &sofa) > 0.8 && opposite(&cube(1.2, -2.0, 0.4, 0.3), &sofa) < 0.4);
        assert!(facing(&sofa, &tv) > 0.5 && facing(&sofa, &cube(3.0, 1.0, 0.4, 0.3)) < 0.3);
    }

    #[test]
    fn what_stands_at_a_wall_has_its_front_to_the_room() {
        // A bookcase at the wall at +Y: its front is -Y. One at -Y: its front is +Y, though the convention says -Y.
        let (north, south) = (boxed([0.0, 2.3, 1.0], [0.8, 0.4, 2.0]), boxed([0.5, -2.3, 1.0], [0.8, 0.4, 2.0]));
        let stool = cube(0.3, -1.2, 0.25, 0.4);
        let front = |anchor: &Solid, directions: Directions| score(RelationKind::InFrontOf, &stool, &[anchor], &directions, &room());
        let paper: Directions = DirectionConvention::Paper.into();
        assert!(front(&north, paper) > 0.3 && front(&south, paper) > 0.5);
        // Somebody who looks along -Y from behind it sees it the other way round.
        let seen = Directions::looking_along(Vector3::y()).unwrap();
        assert!(front(&south, seen) < 0.1);
        assert!(own_front(&cube(0.0, 0.0, 0.4, 0.5), &room()).is_none() && own_front(&cube(2.7, 2.2, 0.3, 0.5), &room()).is_none());
    }

    #[test]
    fn nearer_is_nearer() {
        let anchor = cube(0.0, 0.0, 0.5, 0.5);
        let scores: Vec<f32> = (0..20_u8).map(|i| near(&cube(0.5 + f32::from(i) * 0.2, 0.0, 0.5, 0.5), &anchor)).collect();
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
            let turned_directions = Directions { right: turn * directions.right, front: turn * directions.front, of_somebody: false };
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
