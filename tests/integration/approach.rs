//! The approach endpoint: where a robot should stand for a target, and the map of the floor.

use crate::test_scans::Scan;
use crate::test_server::{TestServer, expect_problem, post_raw};
use uniground_core::grounding::Status;
use uniground_core::scene::InstanceId;
use uniground_types::approach::{
    ApproachRequest, ApproachStatus, FailedCondition, FloorPoint, Robot,
};
use uniground_types::corrections::Change;
use uniground_types::instances::Levels;
use uniground_types::placement::{FrameChoice, SceneToMap};
use uniground_types::scenes::SceneChange;

const ROBOT: Robot = Robot { radius_m: 0.2, height_m: 1.3, eye_height_m: 1.2, reach_m: None };

fn approach_request(query: &str) -> ApproachRequest {
    ApproachRequest {
        // Names in the sample room are guesses.
        min_confidence: Some(0.0),
        from: Some(FloorPoint { x: 1.43, y: 0.16, ..FloorPoint::default() }),
        ..ApproachRequest::for_query(query, ROBOT)
    }
}

#[tokio::test]
async fn an_approach_returns_poses_with_paths_on_free_floor() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(uniground_service::sample::LIVING_ROOM.to_vec()).await;
    let client = &server.client;
    let told =
        client.approach(&scene.id, &approach_request("the mug on the coffee table")).await.unwrap();
    assert_eq!(
        (told.status, told.answer_status, told.failed),
        (ApproachStatus::Found, Some(Status::Grounded), None),
        "{told:?}"
    );
    let (target, best) = (told.target.clone().unwrap(), &told.poses[0]);
    assert_eq!(
        client.answer(&told.answer_id.clone().unwrap()).await.unwrap().answer.predicted_id,
        Some(target.id),
        "it is kept"
    );
    let [x, y, _] = best.position;
    let (to_x, to_y) = (target.aabb.center.x - x, target.aabb.center.y - y);
    assert!(to_x.hypot(to_y) < 2.6 && (to_y.atan2(to_x) - best.yaw_rad).abs() < 0.2, "{told:?}");
    assert!(
        best.visible_share > 0.5
            && best.path_m.unwrap() > 0.5
            && best.clearance_m.unwrap() >= ROBOT.radius_m,
        "{best:?}"
    );
    let (start, end) = (told.start.unwrap(), best.path.last().unwrap());
    assert!(
        best.path[0] == [start.x, start.y] && *end == [x, y] && start.moved_m < 0.05,
        "{told:?}"
    );

    // The map follows map_server: the origin is its lower left corner, and its first row has the
    // greatest y.
    let map = client.floor(&scene.id, ROBOT.height_m).await.unwrap();
    let png = client
        .bytes(&format!("/v1/scenes/{}/floor.png?height_m={}", scene.id, ROBOT.height_m))
        .await
        .unwrap();
    let picture = image::load_from_memory(&png).unwrap().into_luma8();
    assert_eq!(picture.dimensions(), (map.width, map.height));
    let shade = |x: f32, y: f32| {
        let [column, row] =
            [x - map.origin[0], y - map.origin[1]].map(|at| (at / map.resolution) as u32);
        picture.get_pixel(column, map.height - 1 - row).0[0]
    };
    for pose in &told.poses {
        assert_eq!(shade(pose.position[0], pose.position[1]), 254, "{pose:?}");
        assert!(pose.path.iter().all(|at| shade(at[0], at[1]) == 254), "{pose:?}");
    }
    assert_eq!(shade(target.aabb.center.x, target.aabb.center.y), 0, "a table stands there");

    // A target given by id yields the same poses. An arm that is too short is reported.
    let by_id =
        ApproachRequest { instance_id: Some(target.id), query: None, ..approach_request("") };
    let again = client.approach(&scene.id, &by_id).await.unwrap();
    assert_eq!(
        (again.poses, again.answer_id, again.answer_status),
        (told.poses.clone(), None, None)
    );
    let short = ApproachRequest { robot: Robot { reach_m: Some(0.01), ..ROBOT }, ..by_id.clone() };
    let none = client.approach(&scene.id, &short).await.unwrap();
    assert_eq!(
        (none.status, none.failed),
        (ApproachStatus::NonePossible, Some(FailedCondition::OutOfReach)),
        "{none:?}"
    );
    assert!(
        none.poses.is_empty()
            && none.detail.contains("out of reach")
            && none.cells.unwrap().connected > 0,
        "{none:?}"
    );

    // Corrections are applied.
    client
        .correct(
            &scene.id,
            &Change::Rename { instance_id: target.id, name: "Grandma's cup".into() },
        )
        .await
        .unwrap();
    let renamed = client.approach(&scene.id, &approach_request("the cup")).await.unwrap();
    assert_eq!(
        renamed.target.as_ref().map(|target| &*target.name),
        Some("Grandma's cup"),
        "{renamed:?}"
    );
    assert!(renamed.poses[0].why.contains("Grandma's cup"), "{renamed:?}");
    client.correct(&scene.id, &Change::Dismiss { instance_ids: vec![target.id] }).await.unwrap();
    let refused = expect_problem(client.approach(&scene.id, &by_id).await);
    assert_eq!(
        (refused.status, refused.code.as_str(), refused.errors[0].pointer.as_str()),
        (422, "invalid_request", "/instance_id")
    );
    server.stop().await;
}

/// A quarter turn to the left: the scene's X is the map's Y.
#[tokio::test]
async fn requests_and_poses_can_use_map_coordinates() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(uniground_service::sample::LIVING_ROOM.to_vec()).await;
    let client = &server.client;
    let in_scene = approach_request("the mug on the coffee table");
    let in_map = ApproachRequest {
        frame: FrameChoice::Map,
        from: Some(FloorPoint { x: 9.84, y: 21.43, z: 0.5 }),
        ..in_scene.clone()
    };
    let refused = expect_problem(client.approach(&scene.id, &in_map).await);
    assert_eq!((refused.status, refused.code.as_str()), (409, "no_map"));
    let half = std::f64::consts::FRAC_1_SQRT_2;
    let place = SceneToMap { rotation: [0.0, 0.0, half, half], translation_m: [10.0, 20.0, 0.5] };
    let change = SceneChange {
        scene_to_map: Some(Some(place)),
        map_frame_id: Some(Some("map".into())),
        ..SceneChange::default()
    };
    client.change_scene(&scene.id, &change).await.unwrap();

    let (here, there) = (
        client.approach(&scene.id, &in_scene).await.unwrap(),
        client.approach(&scene.id, &in_map).await.unwrap(),
    );
    assert_eq!(
        (&here.in_frame, &here.poses),
        (&None, &there.poses),
        "map and scene coordinates give the same poses"
    );
    let told = there.in_frame.unwrap();
    assert_eq!(
        (told.frame, told.frame_id.as_deref(), told.poses.len()),
        (FrameChoice::Map, Some("map"), there.poses.len())
    );
    let near = |a: f64, b: f32| (a - f64::from(b)).abs() < 1e-4;
    for (placed, pose) in told.poses.iter().zip(&there.poses) {
        let [x, y, z] = pose.position;
        assert!(
            near(placed.position[0], 10.0 - y)
                && near(placed.position[1], 20.0 + x)
                && near(placed.position[2], 0.5 + z),
            "{placed:?}"
        );
        let (half_yaw, [_, _, sin, cos]) =
            (f32::midpoint(pose.yaw_rad, std::f32::consts::FRAC_PI_2), placed.orientation);
        assert!(
            (sin * f64::from(half_yaw.cos()) - cos * f64::from(half_yaw.sin())).abs() < 1e-6,
            "{placed:?}"
        );
        assert!(
            placed.path.len() == pose.path.len() && placed.path.last().unwrap() == &placed.position,
            "{placed:?}"
        );
    }
    // Map coordinates far from their origin, as surveyors use them, lose no precision.
    let far =
        SceneToMap { rotation: [0.0, 0.0, 0.0, 1.0], translation_m: [500_000.3, 5_000_000.2, 0.0] };
    client
        .change_scene(
            &scene.id,
            &SceneChange { scene_to_map: Some(Some(far)), ..SceneChange::default() },
        )
        .await
        .unwrap();
    let from = in_scene.from.unwrap();
    let from =
        FloorPoint { x: from.x + far.translation_m[0], y: from.y + far.translation_m[1], ..from };
    let far = client
        .approach(
            &scene.id,
            &ApproachRequest { frame: FrameChoice::Map, from: Some(from), ..in_scene },
        )
        .await
        .unwrap();
    assert_eq!(far.poses, here.poses);
    // A question for several objects yields no pose.
    let several = client.approach(&scene.id, &approach_request("all the chairs")).await.unwrap();
    assert!(
        several.status == ApproachStatus::NotGrounded && several.detail.contains("things"),
        "{several:?}"
    );
    server.stop().await;
}

#[tokio::test]
async fn merged_instances_are_approached_as_one() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await;
    let client = &server.client;
    let things = client.all_instances(&scene.id, Levels::Things).await.unwrap();
    let ids: Vec<InstanceId> = things
        .iter()
        .filter(|thing| thing.structure.is_none())
        .take(2)
        .map(|thing| thing.id)
        .collect();
    let made = client
        .correct(&scene.id, &Change::Merge { instance_ids: ids, name: Some("pair".into()) })
        .await
        .unwrap();
    let told = client
        .approach(&scene.id, &ApproachRequest::for_instance(made.made.unwrap(), ROBOT))
        .await
        .unwrap();
    assert_eq!(
        (told.status, told.target.unwrap().name.as_str()),
        (ApproachStatus::Found, "pair"),
        "{:?}",
        told.detail
    );
    assert!(
        told.poses.iter().all(|pose| pose.path_m.is_none() && pose.path.is_empty()),
        "{:?}",
        told.poses
    );
    server.stop().await;
}

#[tokio::test]
async fn ambiguous_targets_get_no_pose_and_invalid_requests_are_refused() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await;
    let client = &server.client;
    let told = client
        .approach(&scene.id, &ApproachRequest::for_query("the theremin", ROBOT))
        .await
        .unwrap();
    assert_eq!(
        (told.status, told.answer_status),
        (ApproachStatus::NotGrounded, Some(Status::NoMatch))
    );
    assert!(
        told.poses.is_empty()
            && told.target.is_none()
            && told.answer_id.is_some()
            && told.detail.contains("guess"),
        "{told:?}"
    );
    // Without a model, a name is a guess from measures, and a robot does not drive to a guess.
    let guessed = client
        .approach(&scene.id, &ApproachRequest::for_query("the red sofa", ROBOT))
        .await
        .unwrap();
    assert_eq!(
        (guessed.status, guessed.answer_status, guessed.poses.len()),
        (ApproachStatus::NotGrounded, Some(Status::Uncertain), 0)
    );
    let nowhere = ApproachRequest {
        from: Some(FloorPoint { x: 900.0, ..FloorPoint::default() }),
        ..ApproachRequest::for_instance(InstanceId(1), ROBOT)
    };
    assert_eq!(
        client.approach(&scene.id, &nowhere).await.unwrap().failed,
        Some(FailedCondition::StartNotFree)
    );

    let path = format!("v1/scenes/{}/approach", scene.id);
    let robot = r#""robot": {"radius_m": 0.2, "height_m": 1.3, "eye_height_m": 1.2}"#;
    for (body, status, code, pointer) in [
        (format!("{{{robot}}}"), 422, "invalid_request", Some("")),
        (format!(r#"{{"instance_id": 1, "query": "the sofa", {robot}}}"#), 422, "invalid_request", Some("")),
        (format!(r#"{{"query": " ", {robot}}}"#), 422, "invalid_request", Some("/query")),
        (format!(r#"{{"instance_id": 1, "max_poses": 0, {robot}}}"#), 422, "invalid_request", Some("/max_poses")),
        (format!(r#"{{"instance_id": 1, "from": {{"x": 1}}, {robot}}}"#), 422, "invalid_request", Some("/from")),
        (format!(r#"{{"instance_id": 1, "form": null, {robot}}}"#), 422, "invalid_request", Some("/form")),
        (
            r#"{"instance_id": 1, "robot": {"radius_m": 0.2, "height_m": 1.3, "eye_height_m": 1.4}}"#.into(),
            422,
            "invalid_request",
            Some("/robot/eye_height_m"),
        ),
        (format!(r#"{{"instance_id": 0, {robot}}}"#), 404, "instance_not_found", None),
        (format!(r#"{{"instance_id": 9999, {robot}}}"#), 404, "instance_not_found", None),
    ] {
        let refusal = post_raw(client, &path, "application/json", &body).await;
        assert_eq!((refusal.status, refusal.code.as_str()), (status, code), "{body}: {}", refusal.detail);
        if let Some(pointer) = pointer {
            assert_eq!(refusal.errors[0].pointer, pointer, "{body}: {}", refusal.detail);
        }
    }
    for query in ["height_m=0", "height_m=9", "height=1"] {
        let refusal = expect_problem(
            client.bytes(&format!("v1/scenes/{}/floor.png?{query}", scene.id)).await,
        );
        assert_eq!(
            (refusal.status, refusal.code.as_str()),
            (422, "invalid_request"),
            "{query}: {}",
            refusal.detail
        );
    }
    let nobody = "018f0000-0000-7000-8000-000000000000";
    assert_eq!(expect_problem(client.floor(nobody, 1.0).await).code, "scene_not_found");
    assert_eq!(
        expect_problem(client.approach(nobody, &approach_request("the sofa")).await).code,
        "scene_not_found"
    );
    server.stop().await;
}
