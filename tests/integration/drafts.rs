//! Drafts: with neural networks, a new scene can be asked after the fast parse, and the full parse
//! replaces it.

use crate::neural::{fast_settings, tiny_models};
use crate::test_scans::{EIGHTHS, Scan, THINGS};
use crate::test_server::{
    Process, TestServer, ask, serve_command, serve_config, test_limits, wait_for_job,
};
use camino::Utf8Path;
use serde_json::json;
use std::process::Stdio;
use std::time::Duration;
use uniground::config::{ParseChoice, ServeConfig};
use uniground_client::Client;
use uniground_storage::JobState;
use uniground_types::changes::Changes;
use uniground_types::corrections::Change;
use uniground_types::instances::Levels;
use uniground_types::job::Job;
use uniground_types::placement::FrameChoice;
use uniground_types::question::{GroundRequest, WaitFor};
use uniground_types::scene::{InstanceId, Structure};
use uniground_types::scenes::{ParseQuality, SceneStatus};

fn room() -> Vec<u8> {
    Scan::of_room(&THINGS, &EIGHTHS).zip()
}

async fn start_server(parse: ParseChoice) -> TestServer {
    let data = tempfile::tempdir().unwrap();
    let config = serve_config(Utf8Path::from_path(data.path()).unwrap());
    let config = ServeConfig { models: tiny_models(), parse, limits: test_limits(), ..config };
    TestServer::start_config(data, config).await
}

/// Uploads a scan and requests its parse. Returns the scene's id and the finished first job.
async fn upload(client: &Client, archive: Vec<u8>) -> (String, Job) {
    let stored = client.upload(archive, &[("parse", "false")]).await.unwrap();
    let settings = json!({"settings": {"parsing": fast_settings()}});
    let job = client.parse(&stored.scene.id, &settings).await.unwrap();
    (stored.scene.id, wait_for_job(client, &job.id).await)
}

async fn floor(client: &Client, scene_id: &str) -> InstanceId {
    let things = client.all_instances(scene_id, Levels::Things).await.unwrap();
    things.iter().find(|i| i.structure == Some(Structure::Floor)).unwrap().id
}

fn ask_fully_parsed(query: &str) -> GroundRequest {
    GroundRequest { wait: Some(WaitFor::Full), ..ask(query) }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_draft_answers_at_once_and_the_full_parse_keeps_ids_and_corrections() {
    let server = start_server(ParseChoice::DraftFirst).await;
    let client = &server.client;
    let (id, draft) = upload(client, room()).await;
    assert_eq!((draft.kind.as_str(), draft.state), ("parse", JobState::Succeeded));
    let floor = floor(client, &id).await;
    // Whether this corrects the draft or the full parse depends on the speed of the machine.
    let rename = Change::Rename { instance_id: floor, name: "landing".into() };
    client.correct(&id, &rename).await.unwrap();
    client.ground(&id, &ask("the red sofa")).await.unwrap();

    let answer = client.ground(&id, &ask_fully_parsed("the landing")).await.unwrap();
    let scene = client.scene(&id).await.unwrap();
    assert_eq!((scene.status, scene.quality), (SceneStatus::Ready, Some(ParseQuality::Full)));
    assert_eq!((scene.parse_version, answer.parse_version), (2, 2));
    assert!(scene.models.unwrap().masks.starts_with("tiny-segmenter@"));
    let full = client.job(&scene.job_id.unwrap()).await.unwrap();
    assert_eq!((full.kind.as_str(), full.state), ("full_parse", JobState::Succeeded));
    let now = client.all_instances(&id, Levels::Things).await.unwrap();
    let renamed = now.iter().find(|i| i.id == floor).unwrap();
    assert_eq!(renamed.structure, Some(Structure::Floor));
    assert_eq!(renamed.label, "landing");
    assert_eq!(client.corrections(&id).await.unwrap().corrections.len(), 1);
    // The room is the same: objects were found again, regrouped, or seen for the first time.
    let Changes { appeared, gone, moved, not_seen, .. } =
        client.changes_since(&id, 1).await.unwrap().changes;
    assert!(appeared.is_empty() && gone.is_empty() && moved.is_empty() && not_seen.is_empty());

    // The same bytes again: the full parse is used at once.
    let (again, job) = upload(client, room()).await;
    assert_eq!((job.kind.as_str(), job.state), ("parse", JobState::Succeeded));
    assert_eq!(client.scene(&again).await.unwrap().quality, Some(ParseQuality::Full));
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn drafts_do_not_wait_for_full_parses_and_scenes_of_the_same_scan_share_both() {
    let server = start_server(ParseChoice::DraftFirst).await;
    let client = &server.client;
    let mut scenes = Vec::new();
    for note in ["first", "second", "first"] {
        let archive = Scan::of_room(&THINGS, &EIGHTHS).with("note.txt", note).zip();
        scenes.push(upload(client, archive).await.0);
    }
    for id in &scenes {
        client.ground(id, &ask_fully_parsed("the red sofa")).await.unwrap();
        let scene = client.scene(id).await.unwrap();
        assert_eq!(scene.quality, Some(ParseQuality::Full), "{scene:?}");
    }
    let of = async |id: &str| client.all_instances(id, Levels::All).await.unwrap();
    assert_eq!(of(&scenes[0]).await, of(&scenes[2]).await);
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_draft_only_server_parses_fully_on_request() {
    let server = start_server(ParseChoice::DraftOnly).await;
    let client = &server.client;
    let (id, _) = upload(client, room()).await;
    let scene = client.scene(&id).await.unwrap();
    let last = client.job(&scene.job_id.unwrap()).await.unwrap();
    assert_eq!((scene.quality, last.kind.as_str()), (Some(ParseQuality::Draft), "parse"));
    let settings = json!({"settings": {"parsing": fast_settings()}});
    let full = client.parse(&id, &settings).await.unwrap();
    assert_eq!(full.kind, "full_parse");
    assert_eq!(wait_for_job(client, &full.id).await.error, None);
    assert_eq!(client.scene(&id).await.unwrap().quality, Some(ParseQuality::Full));
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_scene_that_grows_while_it_is_a_draft_is_parsed_fully() {
    let server = start_server(ParseChoice::DraftFirst).await;
    let client = &server.client;
    let (first, second) = EIGHTHS.split_at(5);
    let (id, _) = upload(client, Scan::of_room(&THINGS, first).zip()).await;
    let before = client.scene(&id).await.unwrap().job_id.unwrap();
    let grown = client
        .add_frames(&id, FrameChoice::Source, Scan::of_room(&THINGS, second).zip())
        .await
        .unwrap();
    let job = wait_for_job(client, &grown.job.unwrap().id).await;
    assert_eq!((job.kind.as_str(), job.error), ("full_parse", None));
    assert!(wait_for_job(client, &before).await.state.is_final());
    let scene = client.scene(&id).await.unwrap();
    assert_eq!(scene.quality, Some(ParseQuality::Full));
    assert_eq!(scene.counts.unwrap().frames_used as usize, EIGHTHS.len());
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_server_killed_at_any_moment_still_makes_draft_and_full_parse() {
    let data = tempfile::tempdir().unwrap();
    let data = Utf8Path::from_path(data.path()).unwrap();
    let start = || {
        let models = tiny_models();
        let bundles = &models.bundles;
        let library = bundles.runtime.onnxruntime_lib.clone().unwrap();
        Process::spawn(
            serve_command(data, "127.0.0.1:0")
                .envs([
                    ("UNIGROUND_MASKS", &*models.masks),
                    ("UNIGROUND_ENCODER", &*models.encoder),
                ])
                .args(["--models", bundles.models.as_str()])
                .args(["--onnxruntime-lib", library.as_str()])
                .stderr(Stdio::null()),
        )
    };
    let server = start();
    let stored = server.client.upload(room(), &[("parse", "false")]).await.unwrap();
    let settings = json!({"settings": {"parsing": fast_settings()}});
    server.client.parse(&stored.scene.id, &settings).await.unwrap();
    let id = stored.scene.id;
    let (mut server, mut first_floor) = (server, None);
    for pause_ms in [150, 700, 1500] {
        tokio::time::sleep(Duration::from_millis(pause_ms)).await;
        server.kill();
        server = start();
        let scene = server.client.scene(&id).await.unwrap();
        assert_ne!(scene.status, SceneStatus::Failed, "{scene:?}");
        if scene.quality.is_some() {
            let floor = floor(&server.client, &id).await;
            assert_eq!(*first_floor.get_or_insert(floor), floor);
        }
    }
    server.client.ground(&id, &ask_fully_parsed("the red sofa")).await.unwrap();
    let scene = server.client.scene(&id).await.unwrap();
    assert_eq!((scene.quality, scene.error), (Some(ParseQuality::Full), None));
    assert_eq!(server.terminate(), Some(0));
}
