//! Handmade rooms: level floors and hollow boxes of points.

use crate::approach::{Occupancy, Places, Wish, approach};
use uniground_geometry::boxes::Aabb;
use uniground_geometry::scene::{Instance, InstanceId, Structure, Support};
use uniground_geometry::{Point3, Vector3};
use uniground_testing::thing;
use uniground_types::approach::{FloorPoint, Robot, StandingPose};

/// Distance between points, meters.
const SPACING_M: f32 = 0.02;
pub const ROBOT: Robot = Robot { radius_m: 0.25, height_m: 1.2, eye_height_m: 1.1, reach_m: None };

/// Points and the instances they belong to.
#[derive(Default, Clone)]
pub struct Room {
    pub positions: Vec<Point3<f32>>,
    pub of_point: Vec<InstanceId>,
    pub instances: Vec<Instance>,
}

impl Room {
    /// Creates four walls, 2.4 m high, around a floor, which is the first instance.
    pub fn empty(width: f32, depth: f32) -> Self {
        let mut room = Self::default();
        room.add([0.0, 0.0, 0.0], [width, depth, 0.0], Support::Floor);
        room.instances[0].structure = Some(Structure::Floor);
        for (low, high) in [
            ([0.0, 0.0], [width, 0.0]),
            ([0.0, depth], [width, depth]),
            ([0.0, 0.0], [0.0, depth]),
            ([width, 0.0], [width, depth]),
        ] {
            room.add([low[0], low[1], 0.0], [high[0], high[1], 2.4], Support::Floor);
        }
        room
    }

    /// Adds the surface of a box and returns its id.
    pub fn add(&mut self, low: [f32; 3], high: [f32; 3], support: Support) -> InstanceId {
        let id = InstanceId(self.instances.len() as u32 + 1);
        let (low, high) = (Point3::from(low), Point3::from(high));
        let steps = (high - low).map(|side| (side / SPACING_M).round() as usize);
        for x in 0..=steps.x {
            for y in 0..=steps.y {
                for z in 0..=steps.z {
                    let inside = [(x, steps.x), (y, steps.y), (z, steps.z)]
                        .iter()
                        .all(|(at, last)| (1..*last).contains(at));
                    if !inside {
                        self.positions
                            .push(low + Vector3::new(x as f32, y as f32, z as f32) * SPACING_M);
                        self.of_point.push(id);
                    }
                }
            }
        }
        let aabb = Aabb::from_corners(low, high);
        let known =
            thing(id.0, [aabb.center.x, aabb.center.y], aabb.size.into(), low.z, support, [90; 3]);
        self.instances.push(known);
        id
    }

    /// Adds a table: a top of 5 cm on four legs.
    pub fn add_table(&mut self, low: [f32; 2], high: [f32; 2], height: f32) -> InstanceId {
        let id =
            self.add([low[0], low[1], height - 0.05], [high[0], high[1], height], Support::Floor);
        let legs = [
            (low[0], low[1]),
            (high[0] - 0.04, low[1]),
            (low[0], high[1] - 0.04),
            (high[0] - 0.04, high[1] - 0.04),
        ];
        for (x, y) in legs {
            let leg = self.add([x, y, 0.0], [x + 0.04, y + 0.04, height - 0.05], Support::Floor);
            self.of_point.iter_mut().filter(|of| **of == leg).for_each(|of| *of = id);
            self.instances.pop();
        }
        let aabb = Aabb::from_corners(
            Point3::new(low[0], low[1], 0.0),
            Point3::new(high[0], high[1], height),
        );
        let table = &mut self.instances[id.0 as usize - 1];
        (table.aabb, table.raw_box) = (aabb, aabb);
        id
    }

    pub fn occupancy(&self) -> Occupancy {
        Occupancy::of(&self.positions, &self.of_point, &self.instances)
    }

    pub fn places(&self, id: InstanceId, wish: &Wish) -> Places {
        approach(&self.occupancy(), &self.instances, id, wish).unwrap()
    }

    pub fn poses(&self, id: InstanceId, wish: &Wish) -> Vec<StandingPose> {
        self.places(id, wish).poses.unwrap()
    }
}

pub fn wish(robot: Robot, from: Option<(f32, f32)>) -> Wish {
    Wish {
        robot,
        from: from.map(|(x, y)| FloorPoint { x: x.into(), y: y.into(), z: 0.0 }),
        distances_m: [0.0, 2.5],
        max_poses: 4,
    }
}
