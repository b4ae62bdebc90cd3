//! Answers in other coordinates than the scene's: those of a map and those of the source files.

use crate::test_server::{TestServer, ask, expect_problem};
use serde_json::{Value, json};
use uniground_core::grounding::Status;
use uniground_types::placement::{FrameChoice, SceneToMap};
use uniground_types::question::{GroundRequest, Observer};
use uniground_types::scenes::SceneChange;

const QUERY: &str = "the red sofa";
/// A quarter turn to the left.
const QUARTER: [f64; 4] =
    [0.0, 0.0, std::f64::consts::FRAC_1_SQRT_2, std::f64::consts::FRAC_1_SQRT_2];

fn sample_scan() -> Vec<u8> {
    std::fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/examples/living_room.zip")).unwrap()
}

fn is_near(a: [f64; 3], b: [f64; 3]) -> bool {
    a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-4)
}

#[tokio::test(flavor = "multi_thread")]
async fn boxes_use_map_coordinates_once_the_scene_is_placed() {
    let server = TestServer::start().await;
    let client = &server.client;
    let scene = server.upload_and_parse(sample_scan()).await;
    assert_eq!((scene.scene_to_map, scene.map_frame_id), (None, None));
    let in_map = GroundRequest { frame: FrameChoice::Map, min_confidence: Some(0.0), ..ask(QUERY) };
    let refused = expect_problem(client.ground(&scene.id, &in_map).await);
    assert_eq!((refused.status, refused.code.as_str()), (409, "no_map"));

    let place = SceneToMap { rotation: QUARTER, translation_m: [10.0, 20.0, 0.5] };
    let change = SceneChange {
        scene_to_map: Some(Some(place)),
        map_frame_id: Some(Some("map".into())),
        ..SceneChange::default()
    };
    let changed = client.change_scene(&scene.id, &change).await.unwrap();
    assert_eq!(
        (changed.name.as_str(), changed.scene_to_map, changed.map_frame_id.as_deref()),
        (scene.name.as_str(), Some(place), Some("map"))
    );
    // Omitted fields keep their values.
    let renamed = client.rename_scene(&scene.id, "den").await.unwrap();
    assert_eq!((renamed.scene_to_map, renamed.map_frame_id.as_deref()), (Some(place), Some("map")));

    let answer = client.ground(&scene.id, &in_map).await.unwrap();
    assert_eq!(answer.status, Status::Grounded);
    let (placed, target) = (answer.in_frame.clone().unwrap(), &answer.targets[0]);
    assert_eq!(
        (placed.frame, placed.frame_id.as_deref(), placed.boxes.len()),
        (FrameChoice::Map, Some("map"), answer.targets.len())
    );
    let [x, y, z] = [0, 1, 2].map(|axis| f64::from(target.oriented_box.center[axis]));
    assert!(is_near(placed.boxes[0].center, [10.0 - y, 20.0 + x, 0.5 + z]), "{placed:?}");
    assert_eq!(placed.boxes[0].id, target.id);
    // The placement is stored as given; boxes in the scene's own frame do not change.
    let kept = client.answer(&answer.id).await.unwrap();
    assert_eq!((kept.in_frame, kept.aabb), (answer.in_frame.clone(), answer.aabb));
    let plain = client.ground(&scene.id, &ask(QUERY)).await.unwrap();
    assert_eq!((plain.in_frame, plain.aabb), (None, answer.aabb));

    // A viewer given in map coordinates equals the same viewer in scene coordinates.
    let nearest = |frame, position, yaw_rad| {
        let observer = Some(Observer { position, yaw_rad });
        GroundRequest { frame, observer, ..ask("the chair closest to me") }
    };
    let here = client
        .ground(&scene.id, &nearest(FrameChoice::Scene, [1.5, -1.0, 1.5], 0.0))
        .await
        .unwrap();
    let there = client
        .ground(
            &scene.id,
            &nearest(FrameChoice::Map, [11.0, 21.5, 2.0], std::f32::consts::FRAC_PI_2),
        )
        .await
        .unwrap();
    assert_eq!((there.answer.predicted_id, there.status), (here.answer.predicted_id, here.status));

    let bad = SceneToMap { rotation: [1.0, 1.0, 0.0, 0.0], ..place };
    let refused = expect_problem(
        client
            .change_scene(
                &scene.id,
                &SceneChange { scene_to_map: Some(Some(bad)), ..SceneChange::default() },
            )
            .await,
    );
    assert_eq!(
        (refused.status, refused.errors[0].pointer.as_str()),
        (422, "/scene_to_map/rotation")
    );
    // `null` removes the placement.
    let body: Value = json!({"scene_to_map": null, "map_frame_id": null});
    let change: SceneChange = serde_json::from_value(body).unwrap();
    let without = client.change_scene(&scene.id, &change).await.unwrap();
    assert_eq!(
        (without.scene_to_map, without.map_frame_id, without.name.as_str()),
        (None, None, "den")
    );
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn boxes_can_use_the_coordinates_of_the_source_files() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(sample_scan()).await;
    let request = GroundRequest { frame: FrameChoice::Source, ..ask(QUERY) };
    let answer = server.client.ground(&scene.id, &request).await.unwrap();
    let placed = answer.in_frame.unwrap();
    let source = scene.import.unwrap().source_to_scene.unwrap();
    let center = [0, 1, 2].map(|axis| f64::from(answer.targets[0].oriented_box.center[axis]));
    assert!(is_near(source.apply(placed.boxes[0].center), center), "{placed:?}");
    assert_eq!((placed.frame, placed.frame_id), (FrameChoice::Source, None));
    server.stop().await;
}
