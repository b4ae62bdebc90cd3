use super::*;
use crate::direction::DirectionConvention;
use crate::solid::tests::{any_solid, turned};
use proptest::prelude::*;
use uniground_geometry::Point3;
use uniground_geometry::boxes::{Aabb, OrientedBox};

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
fn without_a_viewpoint_the_viewer_faces_the_anchor() {
    // For a viewer who faces a bookcase at the wall at +Y, left is -X; the paper's left is +X.
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
fn leaning_requires_contact_and_opposite_requires_distance() {
    let (wall, ladder) =
        (boxed([0.0, 2.5, 1.3], [6.0, 0.1, 2.6]), boxed([1.0, 2.3, 1.0], [0.5, 0.2, 2.0]));
    assert!(leaning(&ladder, &wall) > 0.8 && leaning(&cube(0.0, 0.0, 1.0, 0.5), &wall) < 0.1);
    let (sofa, tv) =
        (boxed([0.0, -2.0, 0.4], [2.0, 0.9, 0.8]), boxed([0.1, 2.0, 0.8], [1.2, 0.1, 0.7]));
    assert!(opposite(&tv, &sofa) > 0.8 && opposite(&cube(1.2, -2.0, 0.4, 0.3), &sofa) < 0.4);
    assert!(facing(&sofa, &tv) > 0.5 && facing(&sofa, &cube(3.0, 1.0, 0.4, 0.3)) < 0.3);
}

#[test]
fn front_of_an_object_at_a_wall_points_into_the_room() {
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
    // A viewer who looks along +Y from behind it sees the opposite.
    let seen = Directions::looking_along(Vector3::y()).unwrap();
    assert!(front(&south, seen) < 0.1);
}

#[test]
fn near_counts_center_distance_and_penalizes_stacking() {
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
    // Two rooms: an object behind a wall is not the nearest.
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
        next(&there) < 0.5 && apart(&here, &desk, false, &two) < apart(&there, &desk, false, &two)
    );
}

#[test]
fn near_never_increases_with_distance() {
    let anchor = cube(0.0, 0.0, 0.5, 0.5);
    let scores: Vec<f32> =
        (0..20_u8).map(|i| near(&cube(0.5 + f32::from(i) * 0.2, 0.0, 0.5, 0.5), &anchor)).collect();
    assert!(scores.windows(2).all(|w| w[0] >= w[1]), "{scores:?}");
    assert_eq!(scores[0], 1.0);
}

/// Returns a box without size: every distance to it is one to its middle.
fn dot(x: f32, y: f32, z: f32) -> Solid {
    boxed([x, y, z], [0.0; 3])
}

fn turned_dot(x: f32, y: f32, yaw_rad: f32) -> Solid {
    let center = Point3::new(x, y, 0.0);
    OrientedBox { center, size: Vector3::zeros(), yaw_rad }.into()
}

/// Returns a stool with a footprint of 0.6 m by 0.8 m (diagonal 1 m).
fn stool(x: f32, z: f32) -> Solid {
    boxed([x, 0.0, z], [0.6, 0.8, 0.5])
}

/// Returns a desk with a footprint of 1.2 m by 1.6 m (diagonal 2 m).
fn desk() -> Solid {
    boxed([0.0, 0.0, 0.25], [1.2, 1.6, 0.5])
}

/// Returns a crate on the floor, 1 m high, with a footprint diagonal of 1 m.
fn crate_1m() -> Solid {
    boxed([0.0, 0.0, 0.5], [0.6, 0.8, 1.0])
}

/// Returns the directions of a viewer who looks along +Y: +X is to the right, -Y in front.
fn looking_north() -> Directions {
    Directions::looking_along(Vector3::y()).unwrap()
}

#[track_caller]
fn assert_close(score: f32, by_hand: f32) {
    assert!((score - by_hand).abs() < 2e-4, "{score}, expected {by_hand}");
}

#[test]
fn fade_halves_at_the_half_distance_and_falls_with_the_square() {
    // 1 / (1 + (d / h)²)
    for (distance, half, by_hand) in [
        (0.0, 0.3, 1.0),
        (0.1, 0.3, 0.9), // 1 / (1 + 1/9)
        (0.3, 0.3, 0.5),
        (0.6, 0.3, 0.2), // 1 / (1 + 4)
        (0.9, 0.3, 0.1), // 1 / (1 + 9)
        (0.3, 0.6, 0.8), // 1 / (1 + 1/4)
        (-2.0, 0.3, 1.0),
    ] {
        let found = fade(distance, half);
        assert!((found - by_hand).abs() < 1e-5, "{distance} {half}: {found}, not {by_hand}");
    }
}

#[test]
fn near_halves_at_the_half_distance() {
    // 0.3 m + 0.25 · (1 m + 2 m) / 2 = 0.675 m; surfaces touch at 0.3 m + 0.6 m = 0.9 m.
    assert_close(near(&stool(0.9, 0.25), &desk()), 1.0);
    assert_close(near(&stool(0.9 + 0.225, 0.25), &desk()), 0.9); // a third of it: 1 / (1 + 1/9)
    assert_close(near(&stool(0.9 + 0.675, 0.25), &desk()), 0.5);
    assert_close(near(&stool(0.9 + 1.35, 0.25), &desk()), 0.2); // twice: 1 / (1 + 4)
    // Aside and above count together: 0.405² + 0.54² = 0.675².
    assert_close(near(&stool(0.9 + 0.405, 0.75 + 0.54), &desk()), 0.5);
}

#[test]
fn next_to_weighs_gap_and_center_distance() {
    // The middles 1.575 m apart, half at 0.6 m + 1.5 m = 2.1 m: 1 / (1 + 0.75²) = 0.64.
    // 0.5 (near) · (0.5 + 0.5 · 0.64) = 0.5 · 0.82.
    assert_close(close(&stool(1.575, 0.25), &desk()), 0.41);
    assert_close(close(&desk(), &stool(1.575, 0.25)), 0.41);
    // Heights are the gap's alone: near is a half as above, the middles are 1.305 m apart on
    // the ground: 1 / (1 + (1.305 / 2.1)²) = 0.721405; 0.5 · (0.5 + 0.5 · 0.721405).
    assert_close(close(&stool(1.305, 1.29), &desk()), 0.430_353);
}

#[test]
fn stacked_objects_keep_seventy_percent_of_next_to() {
    // Touching, middle over middle, resting: 1 · 1 · (1 - 0.3 · 1).
    let cup = boxed([0.0, 0.0, 1.05], [0.3, 0.4, 0.1]);
    assert_close(close(&cup, &crate_1m()), 0.7);
    assert_close(close(&crate_1m(), &cup), 0.7);
}

#[test]
fn holds_is_not_symmetric() {
    let (big, ball) = (boxed([0.0, 0.0, 0.5], [1.0; 3]), cube(0.0, 0.0, 0.5, 0.2));
    assert_close(holds(&big, &ball), 1.0);
    // 0.04 of the crate's footprint, and of its height the 0.6 m up to the ball's top.
    assert_close(holds(&ball, &big), 0.6 * 0.04);
    assert_close(score(RelationKind::Carrying, &big, &[&ball], &looking_north(), &room()), 1.0);
    assert_close(score(RelationKind::Carrying, &ball, &[&big], &looking_north(), &room()), 0.024);
}

#[test]
fn around_scales_with_the_anchor_size_and_height() {
    // Half at 0.3 m + 0.25 · 2 m = 0.8 m from the desk, at 0.3 m above or below it.
    assert_close(around(&stool(0.9, 0.25), &desk()), 1.0);
    assert_close(around(&stool(0.9 + 0.8, 0.25), &desk()), 0.5);
    assert_close(around(&stool(0.9 + 0.8, 0.75 + 0.3), &desk()), 0.25);
    assert_close(around(&stool(0.9, 0.75 + 0.6), &desk()), 0.2);
    // Of the stool it is half at 0.3 m + 0.25 · 1 m = 0.55 m, and 1 / (1 + 4) at 1.1 m.
    assert_close(around(&desk(), &stool(0.9 + 0.55, 0.25)), 0.5);
    assert_close(around(&desk(), &stool(0.9 + 1.1, 0.25)), 0.2);
}

#[test]
fn reaching_halves_at_the_reach_at_any_height() {
    assert_close(reaching(&stool(0.9 + 0.8, 0.25), &desk(), 0.8), 0.5);
    assert_close(reaching(&stool(0.9 + 0.8, 9.0), &desk(), 0.8), 0.5);
    assert_close(reaching(&stool(0.9 + 0.8, 0.25), &desk(), 1.6), 0.8); // 1 / (1 + 1/4)
    assert_close(reaching(&stool(0.9 + 0.8, 0.25), &desk(), 0.4), 0.2); // 1 / (1 + 4)
}

#[test]
fn side_score_is_full_within_45_degrees_and_zero_beyond_80() {
    let (here, right) = (dot(0.0, 0.0, 0.0), Vector3::x());
    // Half a meter away, near is half at 0.3 m: 1 / (1 + 25/9) = 9/34; 0.4 + 0.6 · 9/34.
    let nearness = 0.558_824;
    for (x, y, aligned) in [
        (0.5, 0.0, 1.0),
        (0.4, 0.3, 1.0),     // cosine 0.8: (0.8 - 0.2) / 0.5 = 1.2
        (0.3, 0.4, 0.8),     // cosine 0.6: 0.4 / 0.5
        (0.14, 0.48, 0.16),  // cosine 0.28: 0.08 / 0.5
        (0.09, 0.4918, 0.0), // cosine 0.18
        (0.0, 0.5, 0.0),
        (-0.4, 0.3, 0.0),
    ] {
        let found = beside(&dot(x, y, 0.0), &here, &right);
        assert!((found - aligned * nearness).abs() < 1e-3, "{x} {y}: {found}");
    }
    // Height counts for near, not for the direction: 0.3² + 0.4² aside and 1.2 m above are
    // 1.3 m away, 1 / (1 + (13/3)²) = 0.050562.
    assert_close(beside(&dot(0.3, 0.4, 1.2), &here, &right), 0.8 * (0.4 + 0.6 * 0.050_562));
    assert_close(beside(&here, &here, &right), 0.0);
}

#[test]
fn side_relations_without_a_near_anchor_keep_forty_percent() {
    // Near is a half, straight to the right: 0.4 + 0.6 · 0.5.
    assert_close(beside(&stool(1.575, 0.25), &desk(), &Vector3::x()), 0.7);
    assert_close(beside(&desk(), &stool(1.575, 0.25), &Vector3::x()), 0.0);
    assert_close(beside(&desk(), &stool(1.575, 0.25), &-Vector3::x()), 0.7);
    // 30 m are a hundred times the half distance: 0.4 + 0.6 / 10001.
    assert_close(beside(&dot(30.0, 0.0, 0.0), &dot(0.0, 0.0, 0.0), &Vector3::x()), 0.400_06);
}

#[test]
fn stacked_objects_are_not_beside_each_other() {
    // Touching: 1 · (1 - share of the footprint over the other's) · (0.4 + 0.6).
    let big = boxed([0.0, 0.0, 0.5], [1.0; 3]);
    assert_close(beside(&boxed([0.5, 0.0, 1.5], [1.0; 3]), &big, &Vector3::x()), 0.5);
    // Half of the small one is over the big one, and 0.08 of the big one under it.
    let small = boxed([0.5, 0.0, 1.2], [0.4; 3]);
    assert_close(beside(&small, &big, &Vector3::x()), 0.5);
    assert_close(beside(&big, &small, &-Vector3::x()), 0.5);
}

#[test]
fn each_side_relation_uses_its_own_direction() {
    // Ahead to the right of a viewer: cosine 0.6 to the right of the anchor, 0.8 behind it.
    let (to_the_right, behind) = (0.8 * 0.558_824, 0.558_824);
    let here = dot(0.0, 0.0, 0.0);
    let of = |kind, thing: &Solid| score(kind, thing, &[&here], &looking_north(), &room());
    let thing = dot(0.3, 0.4, 0.0);
    assert_close(of(RelationKind::RightOf, &thing), to_the_right);
    assert_close(of(RelationKind::LeftOf, &thing), 0.0);
    assert_close(of(RelationKind::Behind, &thing), behind);
    assert_close(of(RelationKind::InFrontOf, &thing), 0.0);
    let other = dot(-0.3, -0.4, 0.0);
    assert_close(of(RelationKind::RightOf, &other), 0.0);
    assert_close(of(RelationKind::LeftOf, &other), to_the_right);
    assert_close(of(RelationKind::Behind, &other), 0.0);
    assert_close(of(RelationKind::InFrontOf, &other), behind);
}

#[test]
fn given_viewpoint_skips_the_faced_direction() {
    let unasked = || unreachable!("no viewer faces it");
    let (thing, here) = (dot(0.3, 0.4, 0.0), dot(0.0, 0.0, 0.0));
    let (found, seen_by) = at_side(RelationKind::RightOf, &thing, &here, &looking_north(), unasked);
    assert_close(found, 0.447_059);
    assert_eq!(seen_by, SeenBy::Directions);
}

#[test]
fn without_a_viewer_the_better_of_convention_and_facing_counts() {
    // The viewer's convention: right is +X, front is -Y. A viewer who faces the object looks
    // along -Y: right is -X, front is +Y.
    let (thing, here) = (dot(0.3, 0.4, 0.0), dot(0.0, 0.0, 0.0));
    let (aside, ahead) = (0.447_059, 0.558_824);
    let south = Some(-Vector3::y());
    let north = Some(Vector3::y());
    let directions: Directions = DirectionConvention::Viewer.into();
    use RelationKind::{Behind, InFrontOf, LeftOf, RightOf};
    for (kind, ahead_is, has_a_front, by_hand, seen_by) in [
        (RightOf, None, false, aside, SeenBy::Directions),
        (RightOf, None, true, aside, SeenBy::Directions),
        (RightOf, south, true, aside, SeenBy::Directions),
        (LeftOf, south, false, 0.85 * aside, SeenBy::WhoFacesIt),
        (LeftOf, south, true, 0.85 * aside, SeenBy::WhoFacesIt),
        (LeftOf, None, false, 0.0, SeenBy::Directions),
        // In front: from the middle of the room 0.85, from its own front all of it.
        (InFrontOf, south, false, 0.85 * ahead, SeenBy::WhoFacesIt),
        (InFrontOf, south, true, ahead, SeenBy::WhoFacesIt),
        // Behind by the convention: all of it, and half where the object has its own front.
        (Behind, south, false, ahead, SeenBy::Directions),
        (Behind, south, true, 0.5 * ahead, SeenBy::Directions),
        // Both agree: 0.85 of it is less than all, all is more than half.
        (Behind, north, false, ahead, SeenBy::Directions),
        (Behind, north, true, ahead, SeenBy::WhoFacesIt),
        // Neither agrees.
        (LeftOf, north, false, 0.0, SeenBy::Directions),
    ] {
        let faced = || Faced { ahead: ahead_is, has_a_front };
        let found = at_side(kind, &thing, &here, &directions, faced);
        assert!(
            (found.0 - by_hand).abs() < 1e-4 && found.1 == seen_by,
            "{kind:?} {ahead_is:?} {has_a_front}: {found:?}, not {by_hand} {seen_by:?}"
        );
    }
}

#[test]
fn in_front_of_the_observer_means_ahead() {
    let (me, ahead, back) = (dot(0.0, 0.0, 0.0), dot(0.3, 0.4, 0.0), dot(-0.3, -0.4, 0.0));
    let of = |kind, thing: &Solid| to_observer(kind, thing, &me, &looking_north(), &room());
    assert_close(of(RelationKind::InFrontOf, &ahead), 0.558_824);
    assert_close(of(RelationKind::Opposite, &ahead), 0.558_824);
    assert_close(of(RelationKind::Behind, &ahead), 0.0);
    assert_close(of(RelationKind::InFrontOf, &back), 0.0);
    assert_close(of(RelationKind::Opposite, &back), 0.0);
    assert_close(of(RelationKind::Behind, &back), 0.558_824);
    assert_close(of(RelationKind::RightOf, &ahead), 0.447_059);
    assert_close(of(RelationKind::LeftOf, &ahead), 0.0);
}

#[test]
fn wall_between_keeps_forty_percent_of_near_and_around() {
    let wall = boxed([0.75, 0.0, 1.3], [0.02, 5.0, 2.6]);
    let outline = boxed([0.0, 0.0, 1.3], [6.0, 5.0, 2.6]);
    let (open, two) = (Room::new(outline, vec![]), Room::new(outline, vec![wall]));
    let (thing, anchor) = (stool(1.575, 0.25), desk());
    let of = |kind, room: &Room| score(kind, &thing, &[&anchor], &looking_north(), room);
    // Next to: 0.41, as above. Around: 0.675 m of 0.8 m, 1 / (1 + 0.84375²) = 0.584142.
    assert_close(of(RelationKind::Near, &open), 0.41);
    assert_close(of(RelationKind::Near, &two), 0.4 * 0.41);
    assert_close(of(RelationKind::Around, &open), 0.584_142);
    assert_close(of(RelationKind::Around, &two), 0.4 * 0.584_142);
    // Comparisons add the way around the wall instead, and far is unchanged.
    assert_close(of(RelationKind::Closest, &two), 0.41);
    assert_close(of(RelationKind::Far, &two), 0.59);
    assert_close(of(RelationKind::Farthest, &two), 0.59);
}

#[test]
fn apart_measures_centers_with_two_meters_per_wall_and_gaps_to_structure() {
    let wall = boxed([0.75, 0.0, 1.3], [0.02, 5.0, 2.6]);
    let outline = boxed([0.0, 0.0, 1.3], [6.0, 5.0, 2.6]);
    let (open, two) = (Room::new(outline, vec![]), Room::new(outline, vec![wall]));
    let (thing, anchor) = (stool(1.575, 0.25), desk());
    assert_close(apart(&thing, &anchor, false, &open), 1.575);
    assert_close(apart(&thing, &anchor, false, &two), 3.575);
    // The gap, and a twentieth of the middles: 0.675 + 0.05 · 1.575.
    assert_close(apart(&thing, &anchor, true, &open), 0.753_75);
    assert_close(apart(&thing, &anchor, true, &two), 0.753_75);
    // Higher up it is as far by the middles: hypot(0.675, 1) + 0.07875 by the gap.
    assert_close(apart(&stool(1.575, 1.75), &anchor, false, &open), 1.575);
    assert_close(apart(&stool(1.575, 1.75), &anchor, true, &open), 1.285_24);
}

#[test]
fn each_relation_kind_uses_its_own_geometry() {
    // A box leans half over a crate's rim, 0.3 m deep in it.
    let (thing, anchor) = (boxed([0.3, 0.1, 0.95], [0.3, 0.4, 0.5]), crate_1m());
    let of = |kind, x: &Solid, y: &Solid| score(kind, x, &[y], &looking_north(), &room());
    for (kind, expected) in [
        (RelationKind::Near, close(&thing, &anchor)),
        (RelationKind::Closest, close(&thing, &anchor)),
        (RelationKind::Between, close(&thing, &anchor)),
        (RelationKind::Far, 1.0 - close(&thing, &anchor)),
        (RelationKind::Farthest, 1.0 - close(&thing, &anchor)),
        (RelationKind::Around, around(&thing, &anchor)),
        (RelationKind::Above, above(&thing, &anchor)),
        (RelationKind::Below, above(&anchor, &thing)),
        (RelationKind::On, on(&thing, &anchor)),
        (RelationKind::Carrying, holds(&thing, &anchor)),
        (RelationKind::Opposite, opposite(&thing, &anchor)),
        (RelationKind::Facing, facing(&thing, &anchor)),
        (RelationKind::Leaning, leaning(&thing, &anchor)),
    ] {
        let found = of(kind, &thing, &anchor);
        assert!((found - expected).abs() < 1e-6, "{kind:?}: {found}, not {expected}");
    }
    assert!(
        above(&thing, &anchor) > 0.1 && above(&anchor, &thing) == 0.0,
        "above is not symmetric"
    );
    // On the crate counts 0.8 of inside where that is more: resting, it is not inside at all.
    let cup = boxed([0.0, 0.0, 1.05], [0.3, 0.4, 0.1]);
    assert_close(of(RelationKind::Inside, &cup, &anchor), 0.8);
    assert_close(of(RelationKind::Inside, &cube(0.0, 0.0, 0.5, 0.2), &anchor), 1.0);
}

#[test]
fn room_relations_take_no_anchor_and_others_require_one() {
    let of = |kind, thing: &Solid| score(kind, thing, &[], &looking_north(), &room());
    let thing = boxed([2.0, 0.0, 0.25], [0.5; 3]);
    // 0.75 m to the side at +X: 1 / (1 + (0.75 / 0.3)²).
    assert_close(of(RelationKind::AgainstWall, &thing), 0.137_931);
    // 1 / (1 + (0.75 / 0.5)²) · 1 / (1 + (2.25 / 0.5)²) = 0.307692 · 0.047059.
    assert_close(of(RelationKind::InCorner, &thing), 0.014_480);
    // 4.75 m on one side, 0.75 m on the other, of 6 m: 1 / (1 + (4 / 6 / 0.45)²).
    assert_close(of(RelationKind::InMiddle, &thing), 0.313_012);
    for kind in RelationKind::ALL.into_iter().filter(|kind| !kind.is_of_the_room()) {
        assert_eq!(of(kind, &thing), 0.0, "{kind:?}");
    }
    // Of several anchors the first counts, except for between.
    let (here, there) = (stool(1.575, 0.25), stool(9.0, 0.25));
    let near = score(RelationKind::Near, &here, &[&desk(), &there], &looking_north(), &room());
    assert_close(near, 0.41);
}

#[test]
fn above_is_full_at_half_the_sum_of_both_heights() {
    let picture = |z: f32| boxed([0.0, 0.0, z], [0.3, 0.4, 0.5]);
    // Touching: 0.75 m between the middles, half of 1 m + 0.5 m.
    assert_close(above(&picture(1.25), &crate_1m()), 1.0);
    assert_close(above(&picture(3.0), &crate_1m()), 1.0);
    assert_close(above(&crate_1m(), &picture(1.25)), 0.0);
    // Sunk by 0.3 m: 0.45 / 0.75 = 0.6 of the height; 0.3 m - 0.1 · 0.5 m = 0.25 m of
    // 0.1 m + 0.3 · 0.5 m = 0.25 m leaves a half.
    assert_close(above(&picture(0.95), &crate_1m()), 0.3);
    // Sunk by 0.05 m, a tenth of its height, is not sunk: 0.7 / 0.75.
    assert_close(above(&picture(1.2), &crate_1m()), 0.933_333);
    // For thin boxes a full step is at least 5 cm: 0.03 / 0.05.
    let sheet = |z: f32| boxed([0.0, 0.0, z], [0.3, 0.4, 0.02]);
    assert_close(above(&sheet(1.03), &sheet(1.0)), 0.6);
}

#[test]
fn above_without_overlap_scores_at_most_seventy_percent() {
    // Half at 0.15 m + 0.25 · 0.5 m, the smaller diagonal: 0.275 m aside of 0.3 m + 0.15 m.
    let picture = |x: f32| boxed([x, 0.0, 2.0], [0.3, 0.4, 0.5]);
    assert_close(above(&picture(0.45 + 0.275), &crate_1m()), 0.35);
    assert_close(above(&picture(0.45 + 0.55), &crate_1m()), 0.14); // 0.7 / (1 + 4)
    assert_close(above(&picture(0.449), &crate_1m()), 0.7);
    // A shelf beside a small object also has the reach of the small one.
    let low = |x: f32| boxed([x, 0.0, 0.25], [0.3, 0.4, 0.5]);
    assert_close(above(&boxed([0.0, 0.0, 2.0], [0.6, 0.8, 1.0]), &low(0.45 + 0.275)), 0.35);
    // Over 0.24 of it: 0.24 / 0.3; from 0.3 on it is straight above. Half of 0.6 m and of
    // 0.5 m are 0.55 m; 0.12 m and 0.15 m of 0.5 m overlap.
    let box_at = |x: f32, z: f32| boxed([x, 0.0, z], [0.5, 0.5, 0.5]);
    assert_close(above(&box_at(0.43, 2.0), &crate_1m()), 0.8);
    assert_close(above(&box_at(0.39, 2.0), &crate_1m()), 1.0);
    // A wide box over 0.24 of a small one.
    assert_close(above(&boxed([0.43, 0.0, 2.0], [0.6, 0.8, 1.0]), &box_at(0.0, 0.25)), 0.8);
}

#[test]
fn on_halves_six_centimeters_above_the_top() {
    let cup = |x: f32, bottom: f32| boxed([x, 0.0, bottom + 0.05], [0.3, 0.4, 0.1]);
    assert_close(on(&cup(0.0, 1.0), &crate_1m()), 1.0);
    assert_close(on(&cup(0.0, 1.06), &crate_1m()), 0.5);
    assert_close(on(&cup(0.0, 1.12), &crate_1m()), 0.2);
    // A quarter of its footprint over it counts a half, half of it all: the rim is at 0.3 m,
    // half of the cup 0.15 m.
    assert_close(on(&cup(0.3 + 0.15 - 0.075, 1.0), &crate_1m()), 0.5);
    assert_close(on(&cup(0.3, 1.0), &crate_1m()), 1.0);
    assert_close(on(&cup(0.2, 1.0), &crate_1m()), 1.0);
    // A quarter of a table top over a small column: the column's share does not count.
    let (top, column) =
        (boxed([0.0, 0.0, 1.05], [1.0, 1.0, 0.1]), boxed([0.0, 0.0, 0.5], [0.5, 0.5, 1.0]));
    assert_close(on(&top, &column), 0.5);
    assert_close(on(&column, &top), 0.0);
}

#[test]
fn on_an_inner_board_halves_at_forty_percent_of_the_height() {
    let cup = |bottom: f32| boxed([0.0, 0.0, bottom + 0.05], [0.3, 0.4, 0.1]);
    // Sunk by up to 5 cm it rests on top.
    assert_close(on(&cup(0.95), &crate_1m()), 1.0);
    // 1 m - 0.55 m - 0.05 m = 0.4 m, of 0.4 · 1 m.
    assert_close(on(&cup(0.55), &crate_1m()), 0.5);
    // 0.85 m: 1 / (1 + 2.125²) = 0.181303. In the lowest 0.3 m it may stand under it:
    // (0.1 m + 0.02 m) / 0.3 m = 0.4.
    assert_close(on(&cup(0.1), &crate_1m()), 0.072_521);
    // The same a meter higher.
    let shelf = boxed([0.0, 0.0, 1.5], [0.6, 0.8, 1.0]);
    assert_close(on(&cup(1.1), &shelf), 0.072_521);
    assert_close(on(&cup(0.9), &shelf), 0.0);
    // Thin boxes use at least 4 cm and 2 cm for the two: 0.01 / 0.04 is 1 / (1 + 1/16), times
    // (0.07 - 0.08 + 0.02) / 0.02. From 0.08 m to 0.13 m; the cup 0.06 m below its top.
    let plate = boxed([0.0, 0.0, 0.105], [0.6, 0.8, 0.05]);
    assert_close(on(&cup(0.07), &plate), 0.941_176 * 0.5);
}

#[test]
fn on_a_wall_requires_flat_contact() {
    let wall = boxed([0.0, 0.0, 2.0], [6.0, 0.1, 2.0]);
    // A picture 4 cm thick; 7 cm from the wall's middle its back touches it.
    let picture = |gap: f32, z: f32| boxed([1.0, 0.07 + gap, z], [0.5, 0.04, 0.4]);
    assert_close(on(&picture(0.0, 2.0), &wall), 0.9);
    assert_close(on(&picture(0.119, 2.0), &wall), 0.9);
    assert_close(on(&picture(0.121, 2.0), &wall), 0.0);
    // The wall begins at 1 m: a box with its middle there or below does not hang on it.
    assert_close(on(&picture(0.05, 1.01), &wall), 0.9);
    assert_close(on(&picture(0.05, 1.0), &wall), 0.0);
    assert_close(on(&picture(0.05, 0.99), &wall), 0.0);
    assert_close(on(&wall, &picture(0.05, 2.0)), 0.0);
}

#[test]
fn an_upright_plane_is_thin_high_and_long() {
    for (size, expected) in [
        ([0.81, 0.14, 1.01], true),
        ([0.14, 0.81, 1.01], true),
        ([0.81, 0.15, 1.01], false),
        ([0.81, 0.14, 1.0], false),
        ([0.8, 0.14, 1.01], false),
        ([0.81, 0.3, 1.01], false),
        ([0.81, 0.14, 0.5], false),
        ([0.5, 0.14, 1.01], false),
    ] {
        assert_eq!(is_upright_plane(&boxed([0.0; 3], size)), expected, "{size:?}");
    }
}

#[test]
fn inside_is_the_share_of_the_volume() {
    let ball = |x: f32, z: f32| cube(x, 0.0, z, 0.2);
    assert_close(inside(&ball(0.0, 0.5), &crate_1m()), 1.0);
    assert_close(inside(&ball(0.0, 1.0), &crate_1m()), 0.5);
    assert_close(inside(&ball(0.3, 0.5), &crate_1m()), 0.5);
    assert_close(inside(&ball(0.3, 1.0), &crate_1m()), 0.25);
    assert_close(inside(&ball(0.0, 1.1), &crate_1m()), 0.0);
    assert_close(inside(&ball(0.0, 1.5), &crate_1m()), 0.0);
    // The crate's footprint is 0.48 m², the ball's 0.04 m²; 0.6 m of the crate's height are
    // counted from its bottom to the ball's top.
    assert_close(inside(&crate_1m(), &ball(0.0, 0.5)), 0.6 * 0.04 / 0.48);
    // Flat boxes have no height to share: their footprint counts.
    assert_close(inside(&boxed([0.3, 0.0, 0.5], [0.2, 0.2, 0.0]), &crate_1m()), 0.5);
    assert_close(inside(&boxed([0.0, 0.0, 0.5], [0.2, 0.2, 0.0]), &crate_1m()), 1.0);
    let film = inside(&boxed([0.0, 0.0, 1.0], [0.2, 0.2, 1e-3]), &crate_1m());
    assert!((film - 0.5).abs() < 1e-2, "half of a millimeter: {film}");
}

#[test]
fn between_is_full_in_the_middle_sixty_percent_of_the_line() {
    let (a, b) = (dot(0.0, 0.0, 0.0), dot(4.0, 0.0, 0.0));
    let at = |x: f32, y: f32, z: f32| between(&dot(x, y, z), &a, &b);
    assert_close(at(2.0, 0.0, 0.0), 1.0);
    assert_close(at(3.2, 0.0, 0.0), 1.0); // 0.3 of the length from the middle
    assert_close(at(3.8, 0.0, 0.0), 0.5); // 0.15 more
    assert_close(at(0.2, 0.0, 0.0), 0.5);
    assert_close(at(4.4, 0.0, 0.0), 0.2); // 0.3 more
    // Aside it halves at 0.35 · 4 m + 0.2 m = 1.6 m.
    assert_close(at(2.0, 1.6, 0.0), 0.5);
    assert_close(at(2.0, -1.6, 0.0), 0.5);
    assert_close(at(2.0, 3.2, 0.0), 0.2);
    assert_close(at(3.8, 1.6, 0.0), 0.25);
    // Along a line of 3, 4 and 5 that begins at (1, 1), 0.35 · 5 m + 0.2 m = 1.95 m aside:
    // (2.5, 3) + 1.95 · (-0.8, 0.6).
    let (c, d) = (dot(1.0, 1.0, 0.0), dot(4.0, 5.0, 0.0));
    assert_close(between(&dot(2.5, 3.0, 0.0), &c, &d), 1.0);
    assert_close(between(&dot(0.94, 4.17, 0.0), &c, &d), 0.5);
    assert_close(between(&dot(0.94, 4.17, 0.0), &d, &c), 0.5);
    // 0.95 of the way, and 0.05 of it.
    assert_close(between(&dot(3.85, 4.8, 0.0), &c, &d), 0.5);
    assert_close(between(&dot(1.15, 1.2, 0.0), &c, &d), 0.5);
    // Nothing is between an object and itself, or between anchors that almost coincide.
    assert_close(between(&a, &a, &a), 0.0);
    assert_close(between(&a, &a, &dot(0.0005, 0.0, 0.0)), 0.0);
    let of =
        score(RelationKind::Between, &a, &[&b, &dot(-4.0, 0.0, 0.0)], &looking_north(), &room());
    assert_close(of, 1.0);
}

#[test]
fn between_halves_a_meter_above_or_below_both() {
    let (a, b) = (dot(0.0, 0.0, 0.0), dot(4.0, 0.0, 1.0));
    let at = |z: f32| between(&dot(2.0, 0.0, z), &a, &b);
    assert_close(at(0.0), 1.0);
    assert_close(at(1.0), 1.0);
    assert_close(at(2.0), 0.5);
    assert_close(at(-1.0), 0.5);
    assert_close(at(3.0), 0.2);
}

#[test]
fn between_is_low_for_an_object_that_carries_an_anchor() {
    let board = boxed([2.0, 0.0, 0.5], [5.0, 1.0, 1.0]);
    let cup = |x: f32, z: f32| boxed([x, 0.0, z], [0.2, 0.2, 0.1]);
    // 1 - 0.8 · 1, on whichever end it stands.
    assert_close(between(&board, &cup(0.0, 1.05), &cup(4.0, 1.05)), 0.2);
    assert_close(between(&cup(2.0, 1.05), &cup(0.0, 1.05), &cup(4.0, 1.05)), 1.0);
    // Carried by a half: 6 cm above it, 1 - 0.8 · 0.5.
    assert_close(between(&board, &cup(0.0, 1.11), &cup(4.0, 1.11)), 0.6 / (1.0 + 0.06 * 0.06));
}

#[test]
fn opposite_requires_alignment_with_the_anchor_and_distance() {
    let here = dot(0.0, 0.0, 0.0);
    // Half a meter away, near is 9/34: 1 - 0.8 · 9/34.
    let apart = 0.788_235;
    assert_close(opposite(&dot(0.5, 0.0, 0.0), &here), apart);
    assert_close(opposite(&dot(0.0, -0.5, 0.0), &here), apart);
    assert_close(opposite(&dot(0.4, 0.3, 0.0), &here), 0.4 * apart); // (0.8 - 0.7) / 0.25
    assert_close(opposite(&dot(-0.3, 0.4, 0.0), &here), 0.4 * apart);
    assert_close(opposite(&dot(0.353_553, 0.353_553, 0.0), &here), 0.028_427 * apart);
    assert_close(opposite(&here, &here), 0.0);
    // In line with an axis of the anchor, not with one of its own: (0.8, 0.6) and (-0.6, 0.8).
    let yaw = 0.6_f32.atan2(0.8);
    assert_close(opposite(&dot(0.4, 0.3, 0.0), &turned_dot(0.0, 0.0, yaw)), apart);
    assert_close(opposite(&dot(-0.3, 0.4, 0.0), &turned_dot(0.0, 0.0, yaw)), apart);
    assert_close(opposite(&turned_dot(0.4, 0.3, yaw), &here), 0.4 * apart);
}

#[test]
fn facing_requires_alignment_with_the_target_and_prefers_near_ones() {
    let here = dot(0.0, 0.0, 0.0);
    // Half a meter of 1.5 m: 0.5 + 0.5 / (1 + 1/9) = 0.95.
    assert_close(facing(&dot(0.5, 0.0, 0.0), &here), 0.95);
    assert_close(facing(&dot(0.0, 1.5, 0.0), &here), 0.75); // 0.5 + 0.5 · 0.5
    assert_close(facing(&dot(3.0, 0.0, 0.0), &here), 0.6); // 0.5 + 0.5 · 0.2
    assert_close(facing(&dot(0.4, 0.3, 0.0), &here), 0.4 * 0.95);
    assert_close(facing(&dot(-0.3, 0.4, 0.0), &here), 0.4 * 0.95);
    assert_close(facing(&here, &here), 0.0);
    // In line with an axis of its own, not with one of the anchor.
    let yaw = 0.6_f32.atan2(0.8);
    assert_close(facing(&turned_dot(0.4, 0.3, yaw), &here), 0.95);
    assert_close(facing(&turned_dot(-0.3, 0.4, yaw), &here), 0.95);
    assert_close(facing(&dot(0.4, 0.3, 0.0), &turned_dot(0.0, 0.0, yaw)), 0.4 * 0.95);
}

#[test]
fn leaning_halves_15_centimeters_aside_and_10_above() {
    let here = dot(0.0, 0.0, 0.0);
    assert_close(leaning(&here, &here), 1.0);
    assert_close(leaning(&dot(0.15, 0.0, 0.0), &here), 0.5);
    assert_close(leaning(&dot(0.0, 0.3, 0.0), &here), 0.2);
    assert_close(leaning(&dot(0.0, 0.0, 0.1), &here), 0.5);
    assert_close(leaning(&dot(0.15, 0.0, 0.1), &here), 0.25);
}

/// Returns the box mirrored along X.
fn mirrored(solid: &Solid) -> Solid {
    let center = Point3::new(-solid.center.x, solid.center.y, solid.center.z);
    let yaw_rad = -solid.axis.y.atan2(solid.axis.x);
    OrientedBox { center, size: Vector3::from(solid.size), yaw_rad }.into()
}

fn moved(solid: &Solid, by: Vector3<f32>) -> Solid {
    let yaw_rad = solid.axis.y.atan2(solid.axis.x);
    let center = solid.center + by;
    OrientedBox { center, size: Vector3::from(solid.size), yaw_rad }.into()
}

proptest! {
    /// Mirroring swaps left and right, and changes nothing else.
    #[test]
    fn mirroring_swaps_only_left_and_right(
        a in any_solid(), b in any_solid(), c in any_solid()
    ) {
        let outline = boxed([0.0, 0.0, 1.3], [9.0, 9.0, 2.6]);
        let room = Room::new(outline, vec![]);
        let of = |kind, x: &Solid, y: &Solid, z: &Solid| {
            score(kind, x, &[y, z], &looking_north(), &room)
        };
        for kind in RelationKind::ALL {
            let swapped = match kind {
                RelationKind::LeftOf => RelationKind::RightOf,
                RelationKind::RightOf => RelationKind::LeftOf,
                kind => kind,
            };
            let plain = of(kind, &a, &b, &c);
            let mirror = of(swapped, &mirrored(&a), &mirrored(&b), &mirrored(&c));
            prop_assert!((plain - mirror).abs() < 0.01, "{kind:?} {plain} {mirror}");
        }
    }

    /// Moving all boxes together changes no score.
    #[test]
    fn scores_do_not_depend_on_position(
        a in any_solid(), b in any_solid(), c in any_solid(),
        by in prop::array::uniform3(-2.0_f32..2.0)
    ) {
        let by = Vector3::from(by);
        let (ma, mb, mc) = (moved(&a, by), moved(&b, by), moved(&c, by));
        for (name, plain, there) in [
            ("close", close(&a, &b), close(&ma, &mb)),
            ("around", around(&a, &b), around(&ma, &mb)),
            ("above", above(&a, &b), above(&ma, &mb)),
            ("inside", inside(&a, &b), inside(&ma, &mb)),
            ("between", between(&a, &b, &c), between(&ma, &mb, &mc)),
            ("opposite", opposite(&a, &b), opposite(&ma, &mb)),
            ("facing", facing(&a, &b), facing(&ma, &mb)),
            ("leaning", leaning(&a, &b), leaning(&ma, &mb)),
        ] {
            prop_assert!((plain - there).abs() < 0.01, "{name} {plain} {there}");
        }
    }

    /// Moving away along a line never increases near, around, leaning or reaching.
    #[test]
    fn proximity_never_increases_with_distance(
        a in any_solid(), far in 0.0_f32..2.0, more in 0.01_f32..2.0
    ) {
        let from = |x: f32| moved(&a, Vector3::new(x - a.center.x, 0.0, 0.0));
        let (here, there) = (from(far), from(far + more));
        let anchor = boxed([0.0, a.center.y, a.center.z], [1.0; 3]);
        for (name, nearer, farther) in [
            ("near", near(&here, &anchor), near(&there, &anchor)),
            ("around", around(&here, &anchor), around(&there, &anchor)),
            ("leaning", leaning(&here, &anchor), leaning(&there, &anchor)),
            ("reaching", reaching(&here, &anchor, 1.5), reaching(&there, &anchor, 1.5)),
        ] {
            prop_assert!(nearer + 1e-3 >= farther, "{name} {nearer} {farther}");
        }
    }
}

proptest! {
    /// Scores stay in their range, and do not change when world and directions rotate together.
    #[test]
    fn scores_are_in_range_and_rotation_invariant(a in any_solid(), b in any_solid(), c in any_solid(), by in -3.0_f32..3.0) {
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

    /// Scores of contact do not change when sizes and distances scale together.
    #[test]
    fn contact_scores_do_not_depend_on_scale(size in 0.05_f32..3.0) {
        let (below, onto) = (cube(0.0, 0.0, size / 2.0, size), cube(0.0, 0.0, 1.25 * size, size / 2.0));
        prop_assert!(on(&onto, &below) > 0.9 && near(&onto, &below) > 0.99 && above(&onto, &below) > 0.7);
        prop_assert!(inside(&cube(0.0, 0.0, size / 2.0, size / 3.0), &below) > 0.99);
    }
}
