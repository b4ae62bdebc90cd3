//! Concurrent requests and awkward orders of requests.

use crate::test_scans::Scan;
use crate::test_server::{
    Process, TestServer, database_location, expect_problem, serve_command, wait_for_job,
};
use camino::Utf8Path;
use futures::future::join_all;
use reqwest::Method;
use serde_json::json;
use uniground::config::LimitsConfig;
use uniground_core::geometry::up_axis::UpAxis;
use uniground_storage::{JobState, Location};

#[tokio::test]
async fn concurrent_requests_with_one_idempotency_key_create_one_scene() {
    let server = TestServer::start().await;
    let post = |_| async {
        let request = server
            .client
            .request(Method::POST, "v1/scenes")
            .header("content-type", "application/zip");
        let response = request
            .header("idempotency-key", "once")
            .body(Scan::neutral().zip())
            .send()
            .await
            .unwrap();
        response.json::<serde_json::Value>().await.unwrap()["scene"]["id"]
            .as_str()
            .unwrap()
            .to_owned()
    };
    let ids = join_all((0..6).map(post)).await;
    assert!(ids.iter().all(|id| *id == ids[0]), "{ids:?}");
    assert_eq!(server.client.scenes(10, None).await.unwrap().scenes.len(), 1);
    server.stop().await;
}

#[tokio::test]
async fn an_upload_refused_for_a_full_queue_leaves_no_scene() {
    let server =
        TestServer::start_with(LimitsConfig { max_queued_jobs: 0, ..LimitsConfig::default() })
            .await;
    let refusal = expect_problem(
        server.client.create_scene(None, "application/zip", Scan::neutral().zip()).await,
    );
    assert_eq!((refusal.status, refusal.code.as_str()), (429, "queue_full"));
    assert_eq!(server.client.scenes(10, None).await.unwrap().scenes, []);
    server.stop().await;
}

#[tokio::test]
async fn a_second_server_on_the_same_folder_is_refused() {
    let data = tempfile::tempdir().unwrap();
    let data = Utf8Path::from_path(data.path()).unwrap();
    if matches!(database_location(data), Location::Postgres(_)) {
        eprintln!("skipped: several processes may share a PostgreSQL database (cluster.rs)");
        return;
    }
    let first = Process::start(data);
    let second = serve_command(data, "127.0.0.1:0").output().unwrap();
    let message = String::from_utf8_lossy(&second.stderr);
    assert_eq!(second.status.code(), Some(1), "{message}");
    assert!(message.contains("another server"), "{message}");
    first.client.scenes(1, None).await.unwrap();
    assert_eq!(first.terminate(), Some(0));
}

#[tokio::test]
async fn the_up_axis_survives_a_reparse() {
    let server = TestServer::start().await;
    let post = server
        .client
        .request(Method::POST, "v1/scenes?up=y")
        .header("content-type", "application/zip");
    let created: serde_json::Value =
        post.body(Scan::cloud_only().zip()).send().await.unwrap().json().await.unwrap();
    let id = created["scene"]["id"].as_str().unwrap();
    wait_for_job(&server.client, created["job"]["id"].as_str().unwrap()).await;
    let before = server.client.scene(id).await.unwrap();
    let job = server
        .client
        .parse(id, &json!({"settings": {"parsing": {"views": {"count": 4}}}}))
        .await
        .unwrap();
    assert_eq!(wait_for_job(&server.client, &job.id).await.state, JobState::Succeeded);
    let after = server.client.scene(id).await.unwrap();
    assert_eq!(
        (after.import.unwrap().up, after.extent, after.parse_version),
        (UpAxis::Y, before.extent, 2)
    );
    server.stop().await;
}

#[tokio::test]
async fn the_latest_requested_parse_wins() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await;
    let slow = server
        .client
        .parse(&scene.id, &json!({"settings": {"parsing": {"superpoints": {"seed_m": 0.31}}}}))
        .await
        .unwrap();
    let stored = server.client.parse(&scene.id, &json!({})).await.unwrap();
    assert_eq!(stored.state, JobState::Succeeded);
    assert_eq!(wait_for_job(&server.client, &slow.id).await.state, JobState::Succeeded);
    let settings = server.client.scene(&scene.id).await.unwrap().settings.unwrap();
    assert_eq!(settings, scene.settings.unwrap());
    server.stop().await;
}

#[tokio::test]
async fn deleting_a_scene_stops_its_jobs() {
    let server = TestServer::start().await;
    let created =
        server.client.create_scene(None, "application/zip", Scan::neutral().zip()).await.unwrap();
    let again = server.client.parse(&created.scene.id, &json!({"preset": "paper"})).await.unwrap();
    server.client.delete_scene(&created.scene.id).await.unwrap();
    for id in [created.job.unwrap().id, again.id] {
        let job = wait_for_job(&server.client, &id).await;
        assert!(matches!(job.state, JobState::Cancelled | JobState::Succeeded), "{job:?}");
    }
    assert_eq!(
        (server.list_folder("blobs/contents").len(), server.list_folder("blobs/parses").len()),
        (0, 0)
    );
    server.stop().await;
}
