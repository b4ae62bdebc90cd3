//! Data and jobs survive a kill or a stop of the server.

use crate::archives::Scan;
use crate::server::{Process, ask, finished, parsed};
use camino::Utf8Path;
use std::fs;
use std::process::Command;
use uniground_storage::JobState;
use uniground_types::scenes::SceneStatus;

#[tokio::test]
async fn a_killed_server_comes_back_with_scenes_instances_and_answers() {
    let data = tempfile::tempdir().unwrap();
    let data = Utf8Path::from_path(data.path()).unwrap();
    let server = Process::start(data);
    let scene = parsed(&server.client, "application/zip", Scan::neutral().zip()).await;
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
async fn a_stopped_server_goes_on_with_its_queue() {
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
        assert_eq!(finished(&server.client, &job).await.state, JobState::Succeeded);
        assert_eq!(server.client.scene(&scene).await.unwrap().status, SceneStatus::Ready);
    }
    assert_eq!(server.terminate(), Some(0));
}

/// A closed terminal (SIGHUP) shuts the server down as cleanly as SIGTERM.
#[tokio::test]
async fn a_hangup_stops_a_server_cleanly() {
    const SIGHUP_BIT: u64 = 1;
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let ignored = status
        .lines()
        .find_map(|line| u64::from_str_radix(line.strip_prefix("SigIgn:")?.trim(), 16).ok());
    if ignored.is_some_and(|mask| mask & SIGHUP_BIT != 0) {
        eprintln!("left out: these tests run under nohup");
        return;
    }
    let data = tempfile::tempdir().unwrap();
    let mut server = Process::start(Utf8Path::from_path(data.path()).unwrap());
    assert!(server.client.bytes("healthz").await.is_ok());
    Command::new("kill").args(["-HUP", &server.child.id().to_string()]).status().unwrap();
    assert_eq!(server.child.wait().unwrap().code(), Some(0));
}
