//! Scenes: upload, parse, ask, list, rename and delete.

use crate::test_scans::Scan;
use crate::test_server::{
    TestServer, ask, assert_contains, expect_problem, upload_and_parse, wait_for_job,
};
use reqwest::{Method, StatusCode};
use serde_json::json;
use std::fs;
use uniground_client::Client;
use uniground_core::grounding::Status;
use uniground_core::scene::{InstanceId, Level};
use uniground_storage::JobState;
use uniground_types::instances::Levels;
use uniground_types::question::ShortlistRequest;
use uniground_types::scenes::{Created, SceneReport, SceneStatus};

#[tokio::test]
async fn a_scan_is_uploaded_parsed_and_queried() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await;
    assert_eq!(
        (scene.name.as_str(), scene.status, scene.parse_version),
        ("test room", SceneStatus::Ready, 1)
    );
    let import = scene.import.unwrap();
    assert_eq!(
        (import.format.as_str(), import.frames, import.cloud_points),
        ("uniground-scene/1", 8, None)
    );
    assert!(import.reprojection_agreement.unwrap() > 0.5, "{import:?}");

    let instances = server.client.instances(&scene.id, 1000).await.unwrap().instances;
    assert_eq!(scene.counts.unwrap().instances as usize, instances.len());
    let ids: Vec<u32> = instances.iter().map(|i| i.id.0).collect();
    assert_eq!(ids, (1..=instances.len() as u32).collect::<Vec<_>>());

    let answer = server.client.ground(&scene.id, &ask("the red sofa")).await.unwrap();
    // Without an encoder, names are guesses.
    assert_eq!(answer.status, Status::Uncertain, "{answer:?}");
    assert!(answer.answer.explanation.contains("Names here are guessed"), "{answer:?}");
    let aabb = answer.aabb.unwrap();
    // The sofa of the test room spans (-1, 0.6, 0) to (1, 1.5, 0.8).
    assert!(
        (aabb.center - uniground_core::geometry::Point3::new(0.0, 1.05, 0.4)).norm() < 0.15,
        "{aabb:?}"
    );
    assert!(
        (aabb.size - uniground_core::geometry::Vector3::new(2.0, 0.9, 0.8)).norm() < 0.25,
        "{aabb:?}"
    );
    let oriented = answer.oriented_box.unwrap();
    assert!(
        oriented.yaw_rad.abs() < 0.1 && (oriented.center - aabb.center).norm() < 0.1,
        "{oriented:?}"
    );
    assert_eq!(answer.models.reasoner, "builtin-3");

    assert_eq!(server.client.answer(&answer.id).await.unwrap(), answer);
    let picture = server.client.bytes(&answer.evidence.unwrap()[0]).await.unwrap();
    let picture = image::load_from_memory(&picture).unwrap().into_rgb8();
    let green = picture.pixels().filter(|p| p.0[1] > 120 && p.0[0] < 60 && p.0[2] < 110).count();
    assert!(green > 500, "the answer's box is not in the picture ({green} green pixels)");

    let sofa = answer.answer.predicted_id.unwrap();
    for picture in ["frame", "crop"] {
        let bytes = server
            .client
            .bytes(&format!(
                "v1/scenes/{}/instances/{sofa}/views/0.jpg?picture={picture}",
                scene.id
            ))
            .await
            .unwrap();
        let image = image::load_from_memory(&bytes).unwrap().into_rgb8();
        let red = image.pixels().filter(|p| p.0[0] > 120 && p.0[1] < 80).count();
        assert!(
            red as f32 > 0.1 * (image.width() * image.height()) as f32,
            "{picture} does not show the red sofa"
        );
    }
    for file in ["cloud.ply", "instances.ply"] {
        let ply = server.client.bytes(&format!("v1/scenes/{}/{file}", scene.id)).await.unwrap();
        assert!(ply.starts_with(b"ply\n") && ply.len() > 10_000, "{file}");
    }
    server.stop().await;
}

#[tokio::test]
async fn the_six_fields_describe_the_decision() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await;
    let grounded = server
        .client
        .ground(&scene.id, &ask("the trash can farthest from the sofa"))
        .await
        .unwrap()
        .answer;
    assert!(
        grounded.predicted_id.is_some()
            && grounded.anchor_id.is_some()
            && grounded.predicted_id != grounded.anchor_id,
        "{grounded:?}"
    );
    assert_eq!(grounded.relation_used.as_deref(), Some("farthest from the sofa"));
    assert!(!grounded.explanation.is_empty() && !grounded.candidate_names.is_empty());

    let absent = server.client.ground(&scene.id, &ask("the green sofas")).await.unwrap();
    assert_eq!(
        (absent.status, absent.aabb, absent.answer.predicted_id),
        (Status::NoMatch, None, None),
        "{absent:?}"
    );

    let request =
        serde_json::from_value(json!({"query": "the red sofa", "top_k": 2, "include": ["trace"]}))
            .unwrap();
    let short = server.client.ground(&scene.id, &request).await.unwrap();
    assert_eq!((short.candidates, short.evidence, short.trace.is_some()), (None, None, true));
    // Fields that are left out of a response are stored all the same.
    assert!(server.client.answer(&short.id).await.unwrap().candidates.unwrap().len() <= 2);

    let shortlist = server
        .client
        .shortlist(&scene.id, &ShortlistRequest { top_k: 3, ..ShortlistRequest::new("red sofa") })
        .await
        .unwrap();
    assert_eq!(shortlist.candidates[0].id, short.answer.predicted_id.unwrap());
    server.stop().await;
}

#[tokio::test]
async fn every_archive_format_and_layout_gives_the_same_scene() {
    let server = TestServer::start().await;
    let zip = server.upload_and_parse(Scan::neutral().zip()).await;
    let reference = server.client.instances(&zip.id, 1000).await.unwrap();
    let plain = Scan::frames_only();
    let nested = Scan(
        plain
            .0
            .iter()
            .map(|(name, content)| (format!("my room/{name}"), content.clone()))
            .collect(),
    );
    for (media_type, archive) in [
        ("application/x-tar", Scan::neutral().tar()),
        ("application/zstd", Scan::neutral().tar_zst()),
        ("application/zip", plain.zip()),
        ("application/zip", nested.zip()),
    ] {
        let scene = upload_and_parse(&server.client, media_type, archive).await;
        assert_eq!(
            server.client.instances(&scene.id, 1000).await.unwrap(),
            reference,
            "{media_type} {}",
            scene.import.unwrap().format
        );
    }
    server.stop().await;
}

#[tokio::test]
async fn a_cloud_alone_is_a_scene_without_pictures() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::cloud_only().zip()).await;
    assert!(scene.report.unwrap().warnings.iter().any(|w| w.contains("no frames")));
    let instances = server.client.instances(&scene.id, 1000).await.unwrap().instances;
    // The sofa's top is its largest surface: red, 2.0 x 0.9 m, at 0.8 m. Nothing supports it, so
    // its box extends to the floor.
    let top = instances
        .iter()
        .find(|i| i.mean_rgb[0] > 150 && (i.raw_box.center.z - 0.8).abs() < 0.05)
        .unwrap();
    assert!(top.aabb.min().z < 0.05, "{top:?}");
    assert!(
        (top.aabb.size.xy() - uniground_core::geometry::Vector2::new(2.0, 0.9)).norm() < 0.1,
        "{top:?}"
    );
    let missing = server
        .client
        .bytes(&format!("v1/scenes/{}/instances/{}/views/0.jpg", scene.id, top.id))
        .await;
    assert_eq!(expect_problem(missing).code, "view_not_found");
    server.stop().await;
}

#[tokio::test]
async fn the_same_content_and_settings_are_parsed_once() {
    let server = TestServer::start().await;
    let first = server.upload_and_parse(Scan::neutral().zip()).await;
    let again = server
        .client
        .create_scene(Some("again"), "application/zip", Scan::neutral().zip())
        .await
        .unwrap();
    let job = again.job.unwrap();
    assert_eq!(
        (again.scene.status, job.state, job.started_at == job.finished_at),
        (SceneStatus::Ready, JobState::Succeeded, true)
    );
    assert_eq!(again.scene.content_hash, first.content_hash);
    let unnamed = server
        .client
        .create_scene(None, "application/zip", Scan::neutral().zip())
        .await
        .unwrap()
        .scene;
    assert_eq!(unnamed.name, "test room");
    server.client.delete_scene(&unnamed.id).await.unwrap();
    assert_eq!(
        (server.list_folder("blobs/contents").len(), server.list_folder("blobs/parses").len()),
        (1, 1)
    );

    let other = server
        .client
        .parse(&first.id, &json!({"settings": {"parsing": {"superpoints": {"seed_m": 0.3}}}}))
        .await
        .unwrap();
    assert_eq!(wait_for_job(&server.client, &other.id).await.state, JobState::Succeeded);
    let reparsed = server.client.scene(&first.id).await.unwrap();
    assert_eq!(
        (reparsed.parse_version, reparsed.settings.unwrap().parsing.superpoints.seed_m),
        (2, 0.3)
    );
    assert_eq!(server.list_folder("blobs/parses").len(), 2);

    // Both scenes share the content, which stays until the last one is deleted.
    server.client.delete_scene(&first.id).await.unwrap();
    assert!(
        server.client.ground(&again.scene.id, &ask("the red sofa")).await.unwrap().aabb.is_some()
    );
    server.client.delete_scene(&again.scene.id).await.unwrap();
    assert_eq!(
        (server.list_folder("blobs/contents").len(), server.list_folder("blobs/parses").len()),
        (0, 0)
    );
    assert_eq!(
        server.list_folder("blobs/checkpoints").len(),
        0,
        "checkpoints are deleted with the content"
    );
    server.stop().await;
}

fn reused_stages(report: &SceneReport) -> Vec<&str> {
    let stages = &report.parse.as_ref().unwrap().stages;
    stages.iter().filter(|s| s.reused).map(|s| s.stage.as_str()).collect()
}

#[tokio::test]
async fn the_report_covers_every_stage_with_pictures() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await;
    let report = server.client.report(&scene.id).await.unwrap();
    let stages: Vec<&str> =
        report.parse.as_ref().unwrap().stages.iter().map(|s| s.stage.as_str()).collect();
    let expected = [
        "import",
        "superpoints",
        "masks_and_lifting",
        "gaps",
        "planes",
        "merging",
        "part_merging",
        "hierarchy",
        "refinement",
        "views",
        "instances",
    ];
    assert_eq!(stages, expected);
    let may_be_nothing = |stage: &str| ["gaps", "hierarchy"].contains(&stage);
    assert!(
        report
            .parse
            .as_ref()
            .unwrap()
            .stages
            .iter()
            .all(|s| s.produced > 0 || may_be_nothing(&s.stage)),
        "{report:?}"
    );
    assert_eq!((report.parse_version, reused_stages(&report)), (1, vec![]));
    let names: Vec<&str> = report.pictures.iter().map(|p| p.name.as_str()).collect();
    assert_eq!(names, ["superpoints", "instances", "frame-1", "frame-2", "frame-3"]);
    for picture in &report.pictures {
        let bytes = server.client.bytes(picture.url.trim_start_matches('/')).await.unwrap();
        let image = image::load_from_memory(&bytes).unwrap().into_rgb8();
        let first = *image.get_pixel(0, 0);
        assert!(image.pixels().any(|p| *p != first), "{} is blank", picture.name);
    }
    let wrong = server.client.bytes(&format!("v1/scenes/{}/report/..%2Findex.jpg", scene.id)).await;
    assert_eq!(expect_problem(wrong).code, "report_picture_not_found");

    // Settings of a late stage: earlier stages are reused.
    let job = server
        .client
        .parse(&scene.id, &json!({"settings": {"parsing": {"merging": {"min_points": 60}}}}))
        .await
        .unwrap();
    assert_eq!(wait_for_job(&server.client, &job.id).await.state, JobState::Succeeded);
    let again = server.client.report(&scene.id).await.unwrap();
    assert_eq!(
        (again.parse_version, reused_stages(&again)),
        (2, vec!["import", "superpoints", "masks_and_lifting"])
    );

    // Another import makes another cloud, so no stage is reused.
    let job = server
        .client
        .parse(&scene.id, &json!({"settings": {"import": {"fusion": {"voxel_m": 0.03}}}}))
        .await
        .unwrap();
    let job = wait_for_job(&server.client, &job.id).await;
    assert_eq!((job.state, job.error), (JobState::Succeeded, None));
    let coarser = server.client.report(&scene.id).await.unwrap();
    assert_eq!((coarser.parse_version, reused_stages(&coarser)), (3, vec![]));
    assert!(coarser.parse.unwrap().points < again.parse.unwrap().points);
    server.stop().await;
}

/// Uploads the sample scan, and cancels its parse when frames are processed: earlier stages are
/// then done.
async fn cancel_a_parse_of_frames(client: &Client) -> Created {
    let sample =
        std::fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/examples/living_room.zip")).unwrap();
    let created = client.create_scene(None, "application/zip", sample).await.unwrap();
    let id = &created.job.as_ref().unwrap().id;
    loop {
        let job = client.job(id).await.unwrap();
        assert!(!job.state.is_final(), "the parse was over before it could be cancelled: {job:?}");
        if job.stage.as_deref() == Some("masks_and_lifting") {
            break;
        }
    }
    client.cancel_job(id).await.unwrap();
    assert_eq!(wait_for_job(client, id).await.state, JobState::Cancelled);
    created
}

#[tokio::test]
async fn a_restarted_job_resumes_where_it_was_cancelled() {
    let server = TestServer::start().await;
    let created = cancel_a_parse_of_frames(&server.client).await;
    let job = server.client.parse(&created.scene.id, &json!({})).await.unwrap();
    assert_eq!(wait_for_job(&server.client, &job.id).await.state, JobState::Succeeded);
    let report = server.client.report(&created.scene.id).await.unwrap();
    assert_eq!(reused_stages(&report)[..2], ["import", "superpoints"]);
    server.stop().await;
}

#[tokio::test]
async fn the_imported_cloud_is_available_as_a_draft() {
    let server = TestServer::start().await;
    let scene = cancel_a_parse_of_frames(&server.client).await.scene;
    let points = async |query: &str| {
        let path = format!("v1/scenes/{}/points.bin{query}", scene.id);
        server.client.request(Method::GET, &path).send().await.unwrap()
    };
    assert_eq!(points("").await.status(), StatusCode::CONFLICT);
    let draft = points("?draft=true").await.bytes().await.unwrap();
    let count = u32::from_le_bytes(draft[4..8].try_into().unwrap()) as usize;
    assert_eq!((&draft[..4], draft.len()), (&b"UGP1"[..], 32 + 12 * count));
    assert!(count > 10_000, "{count} points");
    assert!(draft[32..].chunks(12).all(|point| point[9..] == [0; 3]), "a point has an object");

    let job = server.client.parse(&scene.id, &json!({})).await.unwrap();
    assert_eq!(wait_for_job(&server.client, &job.id).await.state, JobState::Succeeded);
    let parsed = points("").await.bytes().await.unwrap();
    assert_eq!(points("?draft=true").await.bytes().await.unwrap(), parsed);
    assert!(parsed[32..].chunks(12).any(|point| point[9..] != [0; 3]));
    server.stop().await;
}

#[tokio::test]
async fn an_idempotency_key_creates_one_scene() {
    let server = TestServer::start().await;
    let post = || async {
        let request = server
            .client
            .request(Method::POST, "v1/scenes?name=once")
            .header("content-type", "application/zip");
        let response = request
            .header("idempotency-key", "k1")
            .body(Scan::neutral().zip())
            .send()
            .await
            .unwrap();
        response.json::<serde_json::Value>().await.unwrap()["scene"]["id"]
            .as_str()
            .unwrap()
            .to_owned()
    };
    assert_eq!(post().await, post().await);
    assert_eq!(server.client.scenes(10, None).await.unwrap().scenes.len(), 1);
    server.stop().await;
}

#[tokio::test]
async fn scenes_are_listed_renamed_and_deleted() {
    let server = TestServer::start().await;
    let mut ids = Vec::new();
    for i in 0..5 {
        let request = server
            .client
            .request(Method::POST, &format!("v1/scenes?parse=false&name=room{i}"))
            .header("content-type", "application/zip");
        let body: serde_json::Value =
            request.body(Scan::neutral().zip()).send().await.unwrap().json().await.unwrap();
        assert_eq!((&body["scene"]["status"], &body["job"]), (&json!("uploaded"), &json!(null)));
        ids.push(body["scene"]["id"].as_str().unwrap().to_owned());
    }
    let (mut seen, mut cursor) = (Vec::new(), None);
    loop {
        let page = server.client.scenes(2, cursor.as_deref()).await.unwrap();
        seen.extend(page.scenes.into_iter().map(|s| s.id));
        cursor = page.next_cursor;
        if cursor.is_none() {
            break;
        }
    }
    ids.reverse();
    assert_eq!(seen, ids);

    assert_eq!(server.client.rename_scene(&ids[0], "kitchen").await.unwrap().name, "kitchen");
    let not_ready = expect_problem(server.client.ground(&ids[0], &ask("the sofa")).await);
    assert_eq!((not_ready.status, not_ready.code.as_str()), (409, "scene_not_ready"));
    server.client.delete_scene(&ids[0]).await.unwrap();
    assert_eq!(expect_problem(server.client.scene(&ids[0]).await).code, "scene_not_found");
    server.stop().await;
}

#[tokio::test]
async fn job_events_report_progress_and_can_be_resumed() {
    let server = TestServer::start().await;
    let created =
        server.client.create_scene(None, "application/zip", Scan::neutral().zip()).await.unwrap();
    let id = created.job.unwrap().id;
    let mut progress = Vec::new();
    let job = server.client.follow_job(&id, |job| progress.push(job.progress)).await.unwrap();
    assert_eq!((job.state, job.progress), (JobState::Succeeded, 1.0));
    assert!(progress.windows(2).all(|w| w[0] <= w[1]), "{progress:?}");

    let events = |last: Option<String>| {
        let mut request = server.client.request(Method::GET, &format!("v1/jobs/{id}/events"));
        if let Some(last) = last {
            request = request.header("last-event-id", last);
        }
        async move { request.send().await.unwrap().text().await.unwrap() }
    };
    let text = events(None).await;
    let last = text.lines().find_map(|l| l.strip_prefix("id: ")).unwrap().to_owned();
    assert!(text.contains("event: done"), "{text}");
    // A client that has already seen the end gets the final event again.
    assert_contains(events(Some(last)).await, "event: done");
    server.stop().await;
}

/// The sample scan resembles the clutter of a real room.
#[tokio::test]
async fn parts_and_wholes_are_listed_next_to_things() {
    let server = TestServer::start().await;
    let sample =
        fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/examples/living_room.zip")).unwrap();
    let scene = server.upload_and_parse(sample).await.id;
    let listed = async |levels| server.client.all_instances(&scene, levels).await.unwrap();
    let things = listed(Levels::Things).await;
    let (parts, wholes) = (listed(Levels::Parts).await, listed(Levels::Wholes).await);
    let all = listed(Levels::All).await;
    let report = server.client.report(&scene).await.unwrap().parse.unwrap();
    assert_eq!(
        (things.len(), parts.len() + wholes.len()),
        (report.instances as usize, report.parts_and_wholes as usize)
    );
    assert_eq!(
        all.iter().map(|i| i.id.0).collect::<Vec<_>>(),
        (1..=all.len() as u32).collect::<Vec<_>>()
    );
    assert!(things.iter().all(|i| i.level == Level::Thing && i.things.is_empty()));
    assert!(
        !parts.is_empty() && parts.iter().all(|i| i.level == Level::Part && i.things.len() == 1)
    );
    assert!(
        !wholes.is_empty() && wholes.iter().all(|i| i.level == Level::Whole && i.things.len() >= 2)
    );
    let thing = |id: InstanceId| &things[id.0 as usize - 1];
    for whole in &wholes {
        assert_eq!(
            whole.point_count,
            whole.things.iter().map(|&id| thing(id).point_count).sum::<u32>()
        );
    }
    for part in &parts {
        assert!(part.point_count < thing(part.things[0]).point_count, "{part:?}");
        let picture = server
            .client
            .bytes(&format!("v1/scenes/{scene}/instances/{}/views/0.jpg", part.id))
            .await;
        assert!(part.views.is_empty() || image::load_from_memory(&picture.unwrap()).is_ok());
    }
    let wrong = server.client.bytes(&format!("v1/scenes/{scene}/instances?level=bits")).await;
    assert_eq!(expect_problem(wrong).status, 422);
    server.stop().await;
}

#[tokio::test]
async fn instances_can_be_read_singly_and_in_pages() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await;
    let all = server.client.instances(&scene.id, 1000).await.unwrap();
    let page = server.client.instances(&scene.id, 1).await.unwrap();
    assert_eq!((page.instances.len(), page.next_cursor), (1, Some(1)));
    let bytes = server.client.bytes(&format!("v1/scenes/{}/instances/1", scene.id)).await.unwrap();
    let one: uniground_types::instances::InstanceView = serde_json::from_slice(&bytes).unwrap();
    assert_eq!((one.id, &one), (InstanceId(1), &all.instances[0]));
    server.stop().await;
}
