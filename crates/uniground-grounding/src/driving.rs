//! Checks approach poses against renders: in annotated rooms a robot gets questions, stands at the
//! returned poses, and checks that the target is visible.

use super::memory_scene::{MemoryScene, SceneAlbum};
use super::pipeline::{Ask, answer};
use super::{Question, Status};
use crate::approach::{Occupancy, Wish, approach};
use camino::{Utf8Path, Utf8PathBuf};
use futures::executor::block_on;
use serde_json::Value;
use std::sync::Arc;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::InstanceId;
use uniground_geometry::{Point2, Point3};
use uniground_ingest::ScanFolder;
use uniground_models::neural::Models;
use uniground_parsing::checkpoints::Checkpoints;
use uniground_parsing::scan::{ParsedScan, parse_scan};
use uniground_render::{RenderScene, render_frame};
use uniground_types::approach::{FloorPoint, Robot, StandingPose};
use uniground_types::settings::ParseSettings;

/// Radius of a typical home robot, and a larger one. For the larger one, furnished rooms break up
/// into disconnected corners.
const RADII_M: [f32; 2] = [0.17, 0.25];
const HEIGHT_M: f32 = 1.3;
const EYE_HEIGHT_M: f32 = 1.2;
/// An answer is right if its overlap with the annotated box is at least this.
const RIGHT_IOU: f32 = 0.25;
/// A point of the target is in sight if its depth and the rendered depth differ by no more than
/// this, meters.
const DEPTH_SLACK_M: f32 = 0.06;
/// The target is in the picture if at least this share of its points is in sight; a closed object
/// hides half of itself.
const IN_SIGHT: f32 = 0.1;
/// A path over cells is exact to half of a cell's diagonal, meters.
const PATH_SLACK_M: f32 = 0.036;

/// A parsed room and the questions about it.
struct DrivingScene {
    scan: ParsedScan,
    occupancy: Occupancy,
    questions: Vec<(String, Aabb)>,
}

/// Counts of questions.
#[derive(Debug, Default, Clone, Copy)]
struct Tally {
    asked: usize,
    /// Answered correctly.
    right: usize,
    /// Of these, with an approach pose.
    told: usize,
    /// Of these, with the target in the picture from the first pose.
    seen: usize,
    /// Of these, with an obstacle within the robot's radius at the pose or on the path.
    hit: usize,
}

impl Tally {
    fn with(self, other: Self) -> Self {
        let Self { asked, right, told, seen, hit } = other;
        Self {
            asked: self.asked + asked,
            right: self.right + right,
            told: self.told + told,
            seen: self.seen + seen,
            hit: self.hit + hit,
        }
    }
}

fn robot(radius_m: f32) -> Robot {
    Robot { radius_m, height_m: HEIGHT_M, eye_height_m: EYE_HEIGHT_M, reach_m: None }
}

fn room(folder: &Utf8Path, name: &str) -> DrivingScene {
    let unpacked = ScanFolder::open(&folder.join(format!("{name}.zip"))).unwrap();
    let (settings, progress) = (ParseSettings::default(), Progress::silent());
    let scan = parse_scan(
        &unpacked.path,
        &settings,
        &Models::default(),
        &Checkpoints::disabled(),
        &progress,
    )
    .unwrap();
    let json = |kind: &str| -> Value {
        serde_json::from_slice(&std::fs::read(folder.join(format!("{name}.{kind}.json"))).unwrap())
            .unwrap()
    };
    let (annotated, asked) = (json("scene"), json("queries"));
    let corner = |object: &Value, which: &str| {
        Point3::from([0, 1, 2].map(|axis| object[which][axis].as_f64().unwrap() as f32))
    };
    let box_of = |id: &Value| {
        let object =
            annotated["objects"].as_array().unwrap().iter().find(|object| &object["id"] == id)?;
        Some(Aabb::from_corners(corner(object, "min"), corner(object, "max")))
    };
    let wanted = asked
        .as_array()
        .unwrap()
        .iter()
        .filter_map(|q| Some((q["query"].as_str()?.to_owned(), box_of(&q["target_id"])?)));
    let questions = wanted.collect();
    let scene = &scan.scene;
    let occupancy =
        Occupancy::of(&scene.cloud.positions, &scene.instance_of_point, &scene.instances);
    DrivingScene { scan, occupancy, questions }
}

impl DrivingScene {
    /// Returns where a robot starts: the camera position from which most of the room can be
    /// reached. The person with the camera also stood in corners that a robot cannot leave.
    fn start(&self, radius_m: f32) -> Option<FloorPoint> {
        let frames = self.scan.frames.iter().map(|frame| frame.camera_to_world.translation.vector);
        let reaches = |at: &FloorPoint| {
            let wish = Wish {
                robot: robot(radius_m),
                from: Some(*at),
                distances_m: [0.0, 20.0],
                max_poses: 1,
            };
            approach(&self.occupancy, &self.scan.scene.instances, InstanceId(1), &wish)
                .unwrap()
                .cells
                .connected
        };
        frames.map(|at| FloorPoint { x: at.x.into(), y: at.y.into(), z: 0.0 }).max_by_key(reaches)
    }
}

/// Returns the points of an instance, as rendered.
fn points_of(scan: &ParsedScan, id: InstanceId) -> Vec<Point3<f32>> {
    let (scene, instance) = (&scan.scene, &scan.scene.instances[id.0 as usize - 1]);
    let own = scene.instance_of_point.iter().map(|of| *of == id || instance.things.contains(of));
    let points =
        scene.cloud.positions.iter().zip(own).filter(|(p, own)| *own && instance.aabb.contains(p));
    points.map(|(p, _)| *p).collect()
}

/// Returns the share of the target's points that are in the picture, at the rendered depth.
fn share_in_picture(
    render_scene: &RenderScene,
    pose: &StandingPose,
    points: &[Point3<f32>],
) -> f32 {
    let [x, y, z] = pose.position;
    let (camera, picture, depth_m) = render_frame(
        render_scene,
        &Point3::new(x, y, z + EYE_HEIGHT_M),
        &Point3::from(pose.look_at),
    );
    let is_seen = |point: &&Point3<f32>| {
        camera.project(point).is_some_and(|pixel| {
            let (column, row) = pixel.cell();
            pixel.z_m <= depth_m[(row * picture.width() + column) as usize] + DEPTH_SLACK_M
        })
    };
    points.iter().filter(is_seen).count() as f32 / points.len() as f32
}

/// Returns how near the cloud comes to the robot's middle, meters: at the pose, and on the path to
/// it.
fn room_around(asked: &DrivingScene, pose: &StandingPose) -> [f32; 2] {
    let from_floor = |p: &&Point3<f32>| {
        let height = p.z - asked.occupancy.floor_z_m();
        (0.055..HEIGHT_M - 0.005).contains(&height)
    };
    let obstacles: Vec<Point2<f32>> =
        asked.scan.scene.cloud.positions.iter().filter(from_floor).map(Point3::xy).collect();
    let to_leg = |p: &Point2<f32>, leg: &[[f32; 2]]| {
        let (a, b) = (Point2::from(leg[0]), Point2::from(leg[1]));
        let share = (p - a).dot(&(b - a)) / (b - a).norm_squared().max(1e-9);
        (p - (a + (b - a) * share.clamp(0.0, 1.0))).norm()
    };
    let there = Point2::new(pose.position[0], pose.position[1]);
    let standing = obstacles.iter().map(|p| (p - there).norm()).fold(f32::INFINITY, f32::min);
    let legs = || pose.path.windows(2);
    [
        standing,
        obstacles
            .iter()
            .flat_map(|p| legs().map(move |leg| to_leg(p, leg)))
            .fold(f32::INFINITY, f32::min),
    ]
}

/// Returns one tally for each radius.
fn drive(folder: &Utf8Path, name: &str) -> [Tally; 2] {
    let asked = room(folder, name);
    let parsed = &asked.scan.scene;
    let render_scene = RenderScene::with_building(parsed.cloud.clone(), &parsed.instances);
    let album = Arc::new(SceneAlbum::new(
        parsed.extent,
        render_scene,
        None,
        asked.scan.models.encoder.clone(),
        Vec::new(),
    ));
    let scene = album.scene(parsed.instances.clone().into());
    let answers: Vec<Option<InstanceId>> =
        asked.questions.iter().map(|(query, truth)| right_answer(&scene, query, truth)).collect();
    RADII_M.map(|radius_m| {
        let from = asked.start(radius_m);
        let mut tally = Tally { asked: answers.len(), right: answers.iter().flatten().count(), ..Tally::default() };
        for ((query, _), id) in asked.questions.iter().zip(&answers).filter_map(|(question, id)| Some((question, (*id)?))) {
            let wish = Wish { robot: robot(radius_m), from, distances_m: [0.0, 2.5], max_poses: 3 };
            let places = approach(&asked.occupancy, &parsed.instances, id, &wish).unwrap();
            let pose = match places.poses {
                Ok(poses) => poses[0].clone(),
                Err(failed) => {
                    println!("{name}, {radius_m} m: {query:?}: nowhere, {failed:?}, {:?}", places.cells);
                    continue;
                }
            };
            tally.told += 1;
            let share = share_in_picture(&album.render_scene, &pose, &points_of(&asked.scan, id));
            let [standing, driving] = room_around(&asked, &pose);
            let hit = standing < radius_m || driving < radius_m - PATH_SLACK_M;
            tally.hit += usize::from(hit);
            tally.seen += usize::from(share >= IN_SIGHT);
            println!(
                "{name}, {radius_m} m: {query:?}: {share:.2} in the picture, {standing:.2} and {driving:.2} m of room; {}",
                pose.why
            );
        }
        println!("{name}, {radius_m} m, from {from:?}: {tally:?}");
        tally
    })
}

fn right_answer(scene: &Arc<MemoryScene>, query: &str, truth: &Aabb) -> Option<InstanceId> {
    let grounding = block_on(answer(scene, Ask::of(Question::of(query)))).unwrap().grounding;
    let is_right = grounding.status == Status::Grounded
        && grounding.aabb.is_some_and(|found| found.iou(truth) >= RIGHT_IOU);
    grounding.answer.predicted_id.filter(|_| is_right)
}

#[test]
#[cfg_attr(debug_assertions, ignore = "takes a minute without optimization; make test runs it")]
fn poses_in_the_sample_room_see_the_target_without_collisions() {
    let folder = Utf8PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples"));
    for tally in drive(&folder, "living_room") {
        assert!(tally.right >= 3 && tally.seen == tally.right && tally.hit == 0, "{tally:?}");
    }
}

/// The rooms are in a folder beside the checkout where this project is built.
/// `UNIGROUND_REQUIRE_SHARED=1` makes missing ones a failure.
#[test]
#[cfg_attr(debug_assertions, ignore = "takes minutes without optimization; make test runs it")]
fn poses_in_annotated_rooms_see_the_target_without_collisions() {
    let folder = Utf8PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/scenes"));
    if !folder.join("room1.zip").is_file() {
        assert!(
            std::env::var_os("UNIGROUND_REQUIRE_SHARED").is_none(),
            "{folder}/room1.zip is missing"
        );
        println!("left out: annotated rooms are not beside this checkout");
        return;
    }
    let mut all = [Tally::default(); 2];
    for name in ["room1", "room2", "room3", "room4", "room5"] {
        let of_room = drive(&folder, name);
        all = [0, 1].map(|i| all[i].with(of_room[i]));
    }
    println!("all rooms, radius {RADII_M:?} m: {all:?}");
    for tally in all {
        assert!(tally.told > 0 && tally.hit == 0 && tally.seen * 100 >= tally.told * 95, "{all:?}");
    }
    // Desks part one room: a robot does not get to all targets.
    assert!(all[0].seen * 100 >= all[0].right * 90, "{all:?}");
}
