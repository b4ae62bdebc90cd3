//! Data and jobs survive a kill or a stop of the server.

use crate::test_scans::{EIGHTHS, Scan, THINGS};
use crate::test_server::{Process, ask, storage_env, upload_and_parse, wait_for_job};
use camino::Utf8Path;
use std::fs;
use std::process::Command;
use uniground_storage::JobState;
use uniground_types::placement::FrameChoice;
use uniground_types::scenes::SceneStatus;

#[tokio::test]
async fn scenes_instances_and_answers_survive_a_kill() {
    let data = tempfile::tempdir().unwrap();
    let data = Utf8Path::from_path(data.path()).unwrap();
    let server = Process::start(data);
    let scene = upload_and_parse(&server.client, "application/zip", Scan::neutral().zip()).await;
    let instances = server.client.instances(&scene.id, 1000).await.unwrap();
    let answer = server.client.ground(&scene.id, &ask("the red sofa")).await.unwrap();
    server.kill();

    let server = Process::start(data);
    assert_eq!(server.client.scene(&scene.id).await.unwrap(), scene);
    assert_eq!(server.client.instances(&scene.id, 1000).await.unwrap(), instances);
    assert_eq!(server.client.answer(&answer.id).await.unwrap(), answer);
    let again = server.client.ground(&scene.id, &ask("the red sofa")).await.unwrap();
    assert_eq!(
        (again.answer, again.aabb, again.candidates),
        (answer.answer, answer.aabb, answer.candidates)
    );
    // Nothing is parsed again, neither the stored scene nor the same bytes.
    let same =
        server.client.create_scene(None, "application/zip", Scan::neutral().zip()).await.unwrap();
    assert_eq!(
        (same.scene.status, same.job.unwrap().state),
        (SceneStatus::Ready, JobState::Succeeded)
    );
    assert_eq!(server.terminate(), Some(0));
}

#[tokio::test]
async fn queued_jobs_run_after_a_restart() {
    let data = tempfile::tempdir().unwrap();
    let data = Utf8Path::from_path(data.path()).unwrap();
    let server = Process::start(data);
    let mut waiting = Vec::new();
    for i in 0..4 {
        // An additional file changes the bytes of the same room.
        let archive = Scan::neutral().with("note.txt", format!("{i}")).zip();
        let created = server.client.create_scene(None, "application/zip", archive).await.unwrap();
        waiting.push((created.scene.id, created.job.unwrap().id));
    }
    assert_eq!(server.terminate(), Some(0));

    let server = Process::start(data);
    for (scene, job) in waiting {
        assert_eq!(wait_for_job(&server.client, &job).await.state, JobState::Succeeded);
        assert_eq!(server.client.scene(&scene).await.unwrap().status, SceneStatus::Ready);
    }
    assert_eq!(server.terminate(), Some(0));
}

/// A closed terminal (SIGHUP) shuts the server down as cleanly as SIGTERM.
#[tokio::test]
async fn a_hangup_signal_stops_the_server_cleanly() {
    const SIGHUP_BIT: u64 = 1;
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let ignored = status
        .lines()
        .find_map(|line| u64::from_str_radix(line.strip_prefix("SigIgn:")?.trim(), 16).ok());
    if ignored.is_some_and(|mask| mask & SIGHUP_BIT != 0) {
        eprintln!("skipped: these tests run under nohup");
        return;
    }
    let data = tempfile::tempdir().unwrap();
    let mut server = Process::start(Utf8Path::from_path(data.path()).unwrap());
    server.client.bytes("healthz").await.unwrap();
    Command::new("kill").args(["-HUP", &server.child.id().to_string()]).status().unwrap();
    assert_eq!(server.child.wait().unwrap().code(), Some(0));
}

#[tokio::test]
async fn a_scene_with_a_pending_update_keeps_its_parse_over_a_restart() {
    let data = tempfile::tempdir().unwrap();
    let data = Utf8Path::from_path(data.path()).unwrap();
    let server = Process::start(data);
    // No question is asked, so no answer refers to the first parse.
    let scene =
        upload_and_parse(&server.client, "application/zip", Scan::of_room(&THINGS, &EIGHTHS).zip())
            .await;
    server
        .client
        .create_scene(None, "application/zip", Scan::neutral().with("note.txt", "in front").zip())
        .await
        .unwrap();
    let between = EIGHTHS.map(|turn| turn + 0.05);
    let created = server
        .client
        .add_frames(&scene.id, FrameChoice::Source, Scan::of_room(&THINGS, &between).zip())
        .await
        .unwrap();
    server.kill();

    let server = Process::start(data);
    assert_eq!(
        wait_for_job(&server.client, &created.job.unwrap().id).await.state,
        JobState::Succeeded
    );
    server.client.ground(&scene.id, &ask("the red sofa")).await.unwrap();
    assert_eq!(server.client.scene(&scene.id).await.unwrap().parse_version, 2);
    assert_eq!(server.terminate(), Some(0));
    let found = Command::new(env!("CARGO_BIN_EXE_uniground"))
        .args(["doctor", "--data-dir", data.as_str()])
        .envs(storage_env(data))
        .output()
        .unwrap();
    assert!(found.status.success(), "{}", String::from_utf8_lossy(&found.stdout));
}
