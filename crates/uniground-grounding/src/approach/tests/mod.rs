//! Tests with handmade rooms, and property tests over random rooms.

mod room;

use super::floor::Cell;
use super::{Floor, Occupancy, approach_points};
use proptest::prelude::*;
use room::{ROBOT, Room, wish};
use uniground_geometry::Point3;
use uniground_geometry::scene::{InstanceId, Level, Support};
use uniground_types::approach::{FailedCondition, Robot};

const ON_FLOOR: Support = Support::Floor;

fn cell_at(floor: &Floor, x: f32, y: f32) -> Cell {
    floor.cells[floor.grid.cell(x, y).unwrap()]
}

#[test]
fn table_is_an_obstacle_only_for_robots_too_tall_to_fit_under_it() {
    let mut room = Room::empty(4.0, 3.0);
    room.add_table([1.5, 1.0], [2.7, 1.8], 0.75);
    let occupancy = room.occupancy();
    assert!((occupancy.floor_z_m()).abs() < 1e-6);
    let (low, high) = (Floor::of(&occupancy, 0.6), Floor::of(&occupancy, 1.2));
    assert_eq!((cell_at(&low, 2.1, 1.4), cell_at(&high, 2.1, 1.4)), (Cell::Floor, Cell::Obstacle));
    assert_eq!((cell_at(&low, 1.51, 1.01), cell_at(&low, 0.5, 0.5)), (Cell::Obstacle, Cell::Floor));
    let rim = high.cells[0];
    assert_eq!(rim, Cell::Unknown, "nothing was seen behind the walls");
}

/// The picture's first row is the greatest y, its first column the least x. Gray values are those
/// of `map_server`.
#[test]
fn map_shows_the_room_from_above() {
    let mut room = Room::empty(4.0, 3.0);
    // In the corner of the greatest x and the least y.
    room.add([3.4, 0.1, 0.0], [3.9, 0.6, 0.5], ON_FLOOR);
    let (map, picture) = Floor::of(&room.occupancy(), 1.2).map();
    let shade = |x: f32, y: f32| {
        let [column, row] =
            [x - map.origin[0], y - map.origin[1]].map(|c| (c / map.resolution) as u32);
        picture.get_pixel(column, map.height - 1 - row).0[0]
    };
    assert_eq!(
        (shade(3.65, 0.35), shade(0.35, 0.35), shade(3.65, 2.65), shade(0.35, 2.65)),
        (0, 254, 254, 254)
    );
    assert_eq!(picture.get_pixel(picture.width() - 1, picture.height() - 1).0[0], 205);
    let right_lower: u32 = (picture.height() / 2..picture.height())
        .flat_map(|y| (picture.width() / 2..picture.width()).map(move |x| (x, y)))
        .filter(|&(x, y)| picture.get_pixel(x, y).0[0] == 0)
        .count() as u32;
    let left_upper = (0..picture.height() / 2)
        .flat_map(|y| (0..picture.width() / 2).map(move |x| (x, y)))
        .filter(|&(x, y)| picture.get_pixel(x, y).0[0] == 0)
        .count() as u32;
    assert!(right_lower > left_upper + 50, "{right_lower} {left_upper}");
    let occupied = |p: f32| (255.0 - p) / 255.0;
    assert!(occupied(254.0) < map.free_thresh && occupied(0.0) > map.occupied_thresh);
    assert!(occupied(205.0) > map.free_thresh && occupied(205.0) < map.occupied_thresh);
}

#[test]
fn robot_stands_at_the_table_for_a_mug_on_it() {
    let mut room = Room::empty(5.0, 4.0);
    let table = room.add_table([1.8, 1.4], [3.2, 2.4], 0.75);
    let mug = room.add([2.0, 1.5, 0.76], [2.08, 1.58, 0.86], Support::Instance { id: table });
    let wish = wish(ROBOT, None);
    let poses = room.poses(mug, &wish);
    let best = &poses[0];
    let [x, y, z] = best.position;
    let to_table = (1.8 - x).max(x - 3.2).max(1.4 - y).max(y - 2.4);
    assert!((ROBOT.radius_m..ROBOT.radius_m + 0.4).contains(&to_table), "{best:?}");
    assert!(z.abs() < 1e-6 && best.visible_share > 0.9, "{best:?}");
    assert!((best.yaw_rad - (1.54 - y).atan2(2.04 - x)).abs() < 0.1, "{best:?}");
    assert!(best.why.contains("on the object"), "{}", best.why);
    for (i, one) in poses.iter().enumerate() {
        for other in &poses[..i] {
            let away =
                (one.position[0] - other.position[0]).hypot(one.position[1] - other.position[1]);
            assert!(away >= 0.6, "{away}: {one:?} {other:?}");
        }
    }
    // A short arm reaches it from the near corner of the table, but not from the far one.
    let reaching = super::Wish { robot: Robot { reach_m: Some(0.4), ..ROBOT }, ..wish };
    for pose in room.poses(mug, &reaching) {
        assert!(pose.reach_m <= 0.4 && pose.position[0] < 2.6, "{pose:?}");
    }
    let short = super::Wish { robot: Robot { reach_m: Some(0.05), ..ROBOT }, ..wish };
    let places = room.places(mug, &short);
    assert_eq!(places.poses, Err(FailedCondition::OutOfReach));
    assert!(places.cells.connected > 0 && places.cells.in_reach == 0, "{:?}", places.cells);
}

#[test]
fn wall_blocks_the_view_and_paths_go_around_it() {
    let mut room = Room::empty(6.0, 4.0);
    // From the least y up to a gap of one meter.
    room.add([3.0, 0.0, 0.0], [3.06, 3.0, 2.4], ON_FLOOR);
    let chest = room.add([3.4, 0.3, 0.0], [3.9, 0.8, 0.5], ON_FLOOR);
    let wish = wish(ROBOT, Some((1.0, 0.6)));
    let places = room.places(chest, &wish);
    let start = places.start.unwrap();
    assert!(start.was_free && start.moved_m < 0.05, "{start:?}");
    for pose in places.poses.unwrap() {
        assert!(pose.position[0] > 3.0, "it is not visible from behind the wall: {pose:?}");
        let path = &pose.path;
        assert!(path.len() >= 3 && pose.path_m.unwrap() > 5.0, "{pose:?}");
        assert!(
            path.iter().any(|at| at[1] > 3.0 && (2.5..3.6).contains(&at[0])),
            "the path leads through the gap: {path:?}"
        );
        assert_eq!(path.last().unwrap(), &[pose.position[0], pose.position[1]]);
        assert!(pose.why.contains("m to drive"), "{}", pose.why);
    }
    // Wider than the gap.
    let wide = super::Wish { robot: Robot { radius_m: 0.6, ..ROBOT }, ..wish };
    assert_eq!(room.places(chest, &wide).poses, Err(FailedCondition::NotReachable));
    let near_the_start = super::Wish {
        from: Some(uniground_types::approach::FloorPoint { x: 5.0, y: 2.0, z: 0.0 }),
        ..wide
    };
    assert!(room.places(chest, &near_the_start).poses.is_ok());
}

#[test]
fn tall_robots_do_not_pass_under_low_beams() {
    let mut room = Room::empty(8.0, 3.0);
    // A beam over the whole width, 1.5 m above the floor, and a chest behind it.
    room.add([3.0, 0.0, 1.5], [3.2, 3.0, 2.4], ON_FLOOR);
    let chest = room.add([6.5, 1.2, 0.0], [7.0, 1.7, 0.5], ON_FLOOR);
    let low = wish(ROBOT, Some((1.0, 1.5)));
    assert!(room.poses(chest, &low).iter().all(|pose| pose.position[0] > 3.2));
    let tall = super::Wish { robot: Robot { height_m: 1.8, ..ROBOT }, ..low };
    let places = room.places(chest, &tall);
    assert_eq!(places.poses, Err(FailedCondition::NotReachable));
    assert!(places.cells.clear > 0 && places.cells.connected == 0, "{:?}", places.cells);
}

#[test]
fn enclosed_objects_are_not_visible() {
    let mut room = Room::empty(4.0, 4.0);
    let inside = room.add([1.9, 1.9, 0.2], [2.0, 2.0, 0.3], ON_FLOOR);
    room.add([1.6, 1.6, 0.0], [2.4, 2.4, 1.0], ON_FLOOR);
    let places = room.places(inside, &wish(ROBOT, None));
    assert_eq!(places.poses, Err(FailedCondition::NotVisible));
    assert!(places.cells.looked_from > 0 && places.cells.visible == 0, "{:?}", places.cells);
}

#[test]
fn no_pose_is_returned_without_a_floor() {
    let mut room = Room::default();
    room.add([0.0, 0.0, 0.0], [4.0, 0.0, 2.4], ON_FLOOR);
    room.add([0.0, 0.0, 0.0], [0.0, 4.0, 2.4], ON_FLOOR);
    let chest = room.add([1.5, 1.5, 0.0], [2.0, 2.0, 0.5], ON_FLOOR);
    let places = room.places(chest, &wish(ROBOT, None));
    assert_eq!(places.poses, Err(FailedCondition::NoFloor));
    assert!(places.cells.near > 1000 && places.cells.floor == 0, "{:?}", places.cells);
}

/// A corner behind a row of boxes is large enough for a robot, but no robot can get in.
#[test]
fn poses_are_not_placed_in_unreachable_pockets() {
    let mut room = Room::empty(6.0, 4.0);
    let lamp = room.add([0.1, 3.6, 0.0], [0.3, 3.9, 0.4], ON_FLOOR);
    room.add([1.0, 2.8, 0.0], [1.3, 4.0, 2.0], ON_FLOOR);
    room.add([0.0, 2.6, 0.0], [1.3, 2.8, 2.0], ON_FLOOR);
    let near = super::Wish { distances_m: [0.0, 0.8], ..wish(ROBOT, None) };
    let places = room.places(lamp, &near);
    assert_eq!(places.poses, Err(FailedCondition::NotReachable));
    assert!(places.cells.clear > 0 && places.cells.connected == 0, "{:?}", places.cells);
    // The pocket is the whole room: a closet.
    let mut closet = Room::empty(1.2, 1.2);
    let lamp = closet.add([0.1, 0.9, 0.0], [0.3, 1.1, 0.4], ON_FLOOR);
    assert!(closet.places(lamp, &near).poses.is_ok());
}

#[test]
fn occupied_start_moves_to_a_near_free_cell_or_fails() {
    let mut room = Room::empty(6.0, 4.0);
    let block = room.add([2.0, 1.0, 0.0], [4.0, 3.0, 1.0], ON_FLOOR);
    let beside = room.places(block, &wish(ROBOT, Some((2.1, 2.0))));
    let start = beside.start.unwrap();
    assert!(!start.was_free && (0.2..0.5).contains(&start.moved_m), "{start:?}");
    let within = room.places(block, &wish(ROBOT, Some((3.0, 2.0))));
    assert_eq!((within.poses, within.start), (Err(FailedCondition::StartNotFree), None));
    assert_eq!(
        room.places(block, &wish(ROBOT, Some((50.0, -70.0)))).poses,
        Err(FailedCondition::StartNotFree)
    );
}

/// A merged instance has the voxels of its members, and a part those within its box.
#[test]
fn merged_instances_and_parts_have_their_own_voxels() {
    let mut room = Room::empty(5.0, 4.0);
    let left = room.add([1.0, 1.5, 0.0], [1.4, 1.9, 0.5], ON_FLOOR);
    let right = room.add([3.6, 1.5, 0.0], [4.0, 1.9, 0.5], ON_FLOOR);
    let occupancy = room.occupancy();
    let mut merged = room.instances[left.0 as usize - 1].clone();
    let (a, b) = (merged.aabb, room.instances[right.0 as usize - 1].aabb);
    merged.id = InstanceId(room.instances.len() as u32 + 1);
    merged.aabb =
        uniground_geometry::boxes::Aabb::around(a.corners().iter().chain(&b.corners())).unwrap();
    merged.merged_from = vec![left, right];
    let mut part = room.instances[right.0 as usize - 1].clone();
    part.id = InstanceId(merged.id.0 + 1);
    (part.level, part.things) = (Level::Part, vec![right]);
    (part.aabb.size.z, part.aabb.center.z) = (0.1, 0.45);
    let ids = (merged.id, part.id);
    room.instances.extend([merged, part]);
    let voxels = |id| super::target::Target::of(&occupancy, &room.instances, id).unwrap().voxels;
    let mut both = voxels(left);
    both.extend(voxels(right));
    both.sort_unstable();
    assert_eq!(voxels(ids.0), both);
    let of_part = voxels(ids.1);
    assert!(
        !of_part.is_empty()
            && of_part.len() < voxels(right).len()
            && of_part.iter().all(|&v| occupancy.center(v).z > 0.35)
    );
    assert!(
        super::approach(&occupancy, &room.instances, InstanceId(99), &wish(ROBOT, None)).is_none()
    );
    assert!(
        super::approach(&occupancy, &room.instances, InstanceId(0), &wish(ROBOT, None)).is_none()
    );
}

#[test]
fn empty_clouds_and_outlier_points_are_handled() {
    use uniground_geometry::Point3;
    let none = Occupancy::of(&[], &[], &[]);
    assert!(Floor::of(&none, 1.0).map().1.pixels().all(|pixel| pixel.0[0] == 205));
    let mut room = Room::empty(3.0, 3.0);
    for stray in [
        Point3::new(9000.0, -9000.0, 3.0),
        Point3::new(f32::NAN, 0.0, 0.0),
        Point3::new(-8000.0, 100.0, -50.0),
    ] {
        room.positions.push(stray);
        room.of_point.push(InstanceId(0));
    }
    let occupancy = room.occupancy();
    assert!((occupancy.grid.cell_m - 0.05).abs() < 1e-6, "strays do not make cells larger");
    assert!(cell_at(&Floor::of(&occupancy, 1.0), 1.5, 1.5) == Cell::Floor);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, ..ProptestConfig::default() })]

    /// No pose and no path lies within the robot's radius of an obstacle's cell; every path lies on
    /// floor that was seen.
    #[test]
    fn poses_and_paths_keep_the_robot_radius_from_obstacles(
        boxes in prop::collection::vec((0.0_f32..5.0, 0.0_f32..4.0, 0.1_f32..1.5, 0.1_f32..1.5, 0.1_f32..2.0), 1..7),
        radius_m in 0.1_f32..0.5,
        height_m in 0.3_f32..1.6,
        from in prop::option::of((0.0_f32..5.0, 0.0_f32..4.0)),
    ) {
        let mut room = Room::empty(5.0, 4.0);
        for (x, y, dx, dy, dz) in &boxes {
            room.add([*x, *y, 0.0], [(x + dx).min(5.0), (y + dy).min(4.0), *dz], ON_FLOOR);
        }
        let occupancy = room.occupancy();
        let robot = Robot { radius_m, height_m, eye_height_m: height_m, reach_m: None };
        let wish = wish(robot, from);
        let places = super::approach(&occupancy, &room.instances, InstanceId(6), &wish).unwrap();
        prop_assert_eq!(&super::approach(&occupancy, &room.instances, InstanceId(6), &wish).unwrap(), &places);
        let floor = Floor::of(&occupancy, height_m);
        let grid = floor.grid;
        let obstacles: Vec<_> = (0..grid.len()).filter(|&cell| floor.cells[cell] == Cell::Obstacle).map(|cell| grid.center(cell)).collect();
        let room_at = |x: f32, y: f32| {
            let beyond = |from: f32, to: f32| ((from - to).abs() - grid.cell_m / 2.0).max(0.0);
            obstacles.iter().map(|o| beyond(x, o.x).hypot(beyond(y, o.y))).fold(f32::INFINITY, f32::min)
        };
        for pose in places.poses.iter().flatten() {
            let [x, y, _] = pose.position;
            prop_assert!(cell_at(&floor, x, y) == Cell::Floor && room_at(x, y) >= radius_m - 1e-4, "{:?}", pose);
            prop_assert!(pose.visible_share >= 0.1 && pose.clearance_m.unwrap() <= room_at(x, y) + 1e-4, "{:?}", pose);
            for leg in pose.path.windows(2) {
                let steps = ((leg[1][0] - leg[0][0]).hypot(leg[1][1] - leg[0][1]) / 0.02) as usize + 1;
                for step in 0..=steps {
                    let [x, y] = [0, 1].map(|axis| leg[0][axis] + (leg[1][axis] - leg[0][axis]) * step as f32 / steps as f32);
                    // A cell is free by its middle: a line touches it up to half a diagonal off the
                    // middle.
                    prop_assert!(cell_at(&floor, x, y) == Cell::Floor && room_at(x, y) >= radius_m - 0.036, "{x} {y} {:?}", pose);
                }
            }
        }
    }
}

/// A corner behind a wardrobe: the poses are on its side.
#[test]
fn unseen_points_are_looked_at_from_where_nothing_hides_them() {
    let mut room = Room::empty(5.0, 4.0);
    room.add([1.5, 2.0, 0.0], [2.0, 4.0, 2.0], ON_FLOOR);
    let occupancy = room.occupancy();
    let behind: Vec<Point3<f32>> =
        (0..5).map(|i| Point3::new(0.5, 2.5 + 0.2 * i as f32, 0.4)).collect();
    let places =
        approach_points(&occupancy, &behind, "unseen region 1", &wish(ROBOT, None)).unwrap();
    let poses = places.poses.unwrap();
    assert!(!poses.is_empty());
    for pose in &poses {
        let [x, y, _] = pose.position;
        let yaw_rad = (pose.look_at[1] - y).atan2(pose.look_at[0] - x);
        assert!(x < 1.5 || y < 2.0, "{pose:?}");
        assert!((yaw_rad - pose.yaw_rad).abs() < 1e-4, "{pose:?}");
        assert!(pose.why.contains("from the unseen region 1"), "{}", pose.why);
    }
    let below = [Point3::new(0.5, 2.5, -3.0)];
    assert!(approach_points(&occupancy, &below, "a", &wish(ROBOT, None)).is_none());
}
