//! Scenes with ground truth that lie beside the checkout where this project is built. They are for measuring and never enter
//! the repository; where they are missing, one line says so. `UNIGROUND_REQUIRE_SHARED=1` makes missing ones a failure.

use crate::server::{TestServer, ask, parsed};
use camino::{Utf8Path, Utf8PathBuf};
use serde_json::Value;
use std::fs;
use uniground::geometry::Point3;
use uniground::geometry::boxes::Aabb;
use uniground::geometry::up_axis::UpAxis;
use uniground::grounding::Status;
use uniground::scene::Structure;

fn shared_scene(name: &str) -> Option<Utf8PathBuf> {
    let folder = Utf8Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/scenes");
    if folder.join(name).is_file() {
        return Some(folder);
    }
    assert!(std::env::var_os("UNIGROUND_REQUIRE_SHARED").is_none(), "{folder}/{name} is missing");
    println!("left out: {name} is not beside this checkout");
    None
}

/// Annotated boxes of movable things with at least 200 points; ids 1 to 6 are floor, ceiling and walls.
fn truth(folder: &Utf8Path, room: &str) -> Vec<Aabb> {
    let scene: Value = serde_json::from_slice(&fs::read(folder.join(format!("{room}.scene.json"))).unwrap()).unwrap();
    let corner = |v: &Value| Point3::from([0, 1, 2].map(|i| v[i].as_f64().unwrap() as f32));
    let objects = scene["objects"].as_array().unwrap().iter();
    objects
        .filter(|o| o["id"].as_u64().unwrap() > 6 && o["cloud_points"].as_u64().unwrap() >= 200)
        .map(|o| Aabb::from_corners(corner(&o["min"]), corner(&o["max"])))
        .collect()
}

/// Floors a little under what is measured (see benches/README.md).
#[tokio::test]
async fn instances_cover_the_annotated_objects() {
    for (room, floor_25, floor_50) in [("room1", 0.75, 0.65), ("room2", 0.74, 0.45)] {
        let Some(folder) = shared_scene(&format!("{room}.zip")) else { return };
        let server = TestServer::start().await;
        let scene = server.parsed(fs::read(folder.join(format!("{room}.zip"))).unwrap()).await;
        let instances = server.client.instances(&scene.id, 1000).await.unwrap().instances;
        let truth = truth(&folder, room);
        let best: Vec<f32> = truth.iter().map(|t| instances.iter().map(|i| i.aabb.iou(t)).fold(0.0, f32::max)).collect();
        let recall = |at: f32| best.iter().filter(|iou| **iou >= at).count() as f32 / best.len() as f32;
        println!(
            "{room}: {} instances, box recall {:.3} at 0.25, {:.3} at 0.5 over {} objects",
            instances.len(),
            recall(0.25),
            recall(0.5),
            best.len()
        );
        assert!(recall(0.25) >= floor_25 && recall(0.5) >= floor_50, "{room}: {:.3} / {:.3}", recall(0.25), recall(0.5));
        assert!(instances.iter().any(|i| i.structure == Some(Structure::Floor)), "no floor in {room}");
        server.stop().await;
    }
}

/// Real scans that do not say which way is up: the cameras do.
#[tokio::test]
async fn real_scans_are_turned_upright() {
    for (name, up) in [("redkitchen.zip", UpAxis::NegY), ("hololens.zip", UpAxis::Y)] {
        let Some(folder) = shared_scene(name) else { return };
        let server = TestServer::start().await;
        let scene = parsed(&server.client, "application/zip", fs::read(folder.join(name)).unwrap()).await;
        let import = scene.import.unwrap();
        println!("{name}: up {}, agreement {:?}, {:?}", import.up.name(), import.reprojection_agreement, scene.counts.unwrap());
        assert_eq!(import.up, up, "{name}");
        assert!(import.reprojection_agreement.unwrap() > 0.4, "{name}: {import:?}");
        // A room is a few metres high, whatever its length.
        assert!((1.0..6.0).contains(&scene.extent.unwrap().size.z), "{name}: {:?}", scene.extent);
        let answer = server.client.ground(&scene.id, &ask("the theremin")).await.unwrap();
        assert_eq!(answer.status, Status::NoMatch);
        server.stop().await;
    }
}
