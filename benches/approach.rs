//! Approach poses in halls of five million points, and scene graphs of their instances: `cargo
//! bench --bench approach`.

#![allow(missing_docs, clippy::unwrap_used)] // a bench that can not set up has nothing to time

use std::time::Instant;
use uniground_core::approach::{Occupancy, Wish, approach};
use uniground_core::geometry::boxes::Aabb;
use uniground_core::geometry::{Point3, Vector3};
use uniground_core::grounding::graph::{Graph, Guessed};
use uniground_core::grounding::{NameIndex, SceneView};
use uniground_core::scene::{Instance, InstanceId, PointCloud};
use uniground_evaluation::annotations::{Annotations, SceneObject};
use uniground_evaluation::systems::{NamedBy, instances_of};
use uniground_types::approach::{FloorPoint, Robot};
use uniground_types::instances::Levels;

const POINTS: usize = 5_000_000;
/// Side of a square hall in meters, and the number of tables in rows and objects on them.
const HALLS: [(f32, usize); 2] = [(15.0, 100), (30.0, 300)];
const CALLS: usize = 200;

/// Returns instances on a grid; every second one stands on the table before it.
fn hall(room_m: f32, things: usize) -> Vec<Instance> {
    let side = ((things / 2) as f32).sqrt().ceil() as usize;
    let apart = room_m / side as f32;
    let object = |i: usize| {
        let (column, row) = ((i / 2) % side, (i / 2) / side);
        let is_table = i.is_multiple_of(2);
        let (size, base) = if is_table { ([1.2, 0.8, 0.75], 0.0) } else { ([0.2, 0.2, 0.3], 0.75) };
        let size = Vector3::from(size);
        let center = Point3::new(
            (column as f32 + 0.5) * apart,
            (row as f32 + 0.5) * apart,
            base + size.z / 2.0,
        );
        let name = if is_table { "table" } else { "lamp" }.to_owned();
        let aabb = Aabb { center, size };
        SceneObject {
            id: i as u32 + 1,
            name,
            aabb,
            rotated: None,
            cloud_points: 0,
            mean_rgb: None,
            colors: Vec::new(),
            seen_as: None,
        }
    };
    instances_of(
        &Annotations { objects: (0..things).map(object).collect(), of_point: None },
        &PointCloud::default(),
        NamedBy::Encoder,
    )
}

/// Returns points: a third on the floor, the rest on the instances' surfaces; the same every time.
fn cloud(room_m: f32, instances: &[Instance]) -> (Vec<Point3<f32>>, Vec<InstanceId>) {
    let mut state = 1_u64;
    let mut chance = || {
        state =
            state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1_u64 << 24) as f32
    };
    let mut positions = Vec::with_capacity(POINTS);
    let mut of_point = Vec::with_capacity(POINTS);
    for point in 0..POINTS {
        if point.is_multiple_of(3) {
            positions.push(Point3::new(chance() * room_m, chance() * room_m, 0.004 * chance()));
            of_point.push(InstanceId(0));
            continue;
        }
        let instance = &instances[(point / 3) % instances.len()];
        let mut at = Vector3::new(chance(), chance(), chance());
        let face = (chance() * 6.0) as usize % 6;
        at[face / 2] = (face % 2) as f32;
        positions.push(instance.aabb.min() + at.component_mul(&instance.aabb.size));
        of_point.push(instance.id);
    }
    (positions, of_point)
}

/// Returns the milliseconds of each call in ascending order.
fn time_calls(calls: usize, mut call: impl FnMut(usize)) -> Vec<f64> {
    let mut taken: Vec<f64> = (0..calls)
        .map(|i| {
            let start = Instant::now();
            call(i);
            start.elapsed().as_secs_f64() * 1e3
        })
        .collect();
    taken.sort_by(f64::total_cmp);
    taken
}

fn main() {
    HALLS.into_iter().for_each(|(room_m, things)| measure(room_m, things));
}

fn measure(room_m: f32, things: usize) {
    println!("{room_m} x {room_m} m, {things} things");
    let instances = hall(room_m, things);
    let (positions, of_point) = cloud(room_m, &instances);
    let start = Instant::now();
    let occupancy = Occupancy::of(&positions, &of_point, &instances);
    println!(
        "columns of {POINTS} points, once per parse: {:.0} ms, {} MB",
        start.elapsed().as_secs_f64() * 1e3,
        occupancy.bytes() >> 20
    );
    let robot = Robot { radius_m: 0.25, height_m: 1.3, eye_height_m: 1.2, reach_m: None };
    for (what, from, reach_m) in [
        ("to see", None, None),
        ("to see, with the way there", Some(FloorPoint { x: 0.3, y: 0.3, z: 0.0 }), None),
        ("to reach, with the way there", Some(FloorPoint { x: 0.3, y: 0.3, z: 0.0 }), Some(0.8)),
    ] {
        let wish =
            Wish { robot: Robot { reach_m, ..robot }, from, distances_m: [0.0, 2.5], max_poses: 3 };
        let mut found = 0;
        let taken = time_calls(CALLS, |i| {
            let id = InstanceId((i * 37 % things) as u32 + 1);
            found +=
                usize::from(approach(&occupancy, &instances, id, &wish).unwrap().poses.is_ok());
        });
        println!(
            "a place {what}: p50 {:.1} ms, p95 {:.1} ms, {found} of {CALLS} found",
            taken[CALLS / 2],
            taken[CALLS * 95 / 100]
        );
    }
    let extent = Aabb::around(&positions).unwrap();
    let names = NameIndex::of(&instances);
    let view = SceneView { instances: &instances, extent, names: &names, appearance: None };
    let taken = time_calls(20, |_| {
        assert!(!Graph::of(view, Levels::All, Guessed::ByLooks).edges.is_empty());
    });
    println!("the graph of {things} things: p50 {:.1} ms", taken[10]);
}
