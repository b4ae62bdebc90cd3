//! Recovery at startup, and repairs by `uniground doctor`.

use crate::archives::{EIGHTHS, Scan, THINGS};
use crate::server::{Process, TestServer, ask, finished, in_places, location, loose_rows, parsed};
use camino::Utf8Path;
use sqlx::Connection;
use std::process::{Command, Output};
use uniground_storage::{JobState, Location};
use uniground_types::placement::FrameChoice;

fn doctor(data: &Utf8Path, more: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_uniground"));
    command
        .args(["doctor", "--data-dir", data.as_str()])
        .envs(in_places(data))
        .args(more)
        .output()
        .unwrap()
}

fn text(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned()
}

#[tokio::test]
async fn a_scene_that_was_growing_keeps_its_parse_over_a_restart() {
    let data = tempfile::tempdir().unwrap();
    let data = Utf8Path::from_path(data.path()).unwrap();
    let server = Process::start(data);
    // No question is asked, so no answer refers to the first parse.
    let scene =
        parsed(&server.client, "application/zip", Scan::of_room(&THINGS, &EIGHTHS).zip()).await;
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
    assert_eq!(finished(&server.client, &created.job.unwrap().id).await.state, JobState::Succeeded);
    server.client.ground(&scene.id, &ask("the red sofa")).await.unwrap();
    assert_eq!(server.client.scene(&scene.id).await.unwrap().parse_version, 2);
    assert_eq!(server.terminate(), Some(0));
    let found = doctor(data, &[]);
    assert!(found.status.success(), "{}", text(&found));
}

#[tokio::test]
async fn references_that_point_nowhere_are_found_and_repaired() {
    let server = TestServer::start().await;
    let scene = server.parsed(Scan::neutral().zip()).await;
    let data = server.give_back().await;
    let folder = Utf8Path::from_path(data.path()).unwrap();
    if matches!(location(folder), Location::Postgres(_)) {
        println!("left out: PostgreSQL enforces its own references");
        return;
    }
    let mut rows = loose_rows(folder).await;
    let sql =
        "INSERT INTO corrections (id, parse_id, change, author, created_at) VALUES ('c', 'nowhere', '{}', NULL, '2026-01-01T00:00:00Z');
               UPDATE scenes SET parse_id = 'nowhere'";
    sqlx::raw_sql(sql).execute(&mut rows).await.unwrap();
    rows.close().await.unwrap();

    let found = doctor(folder, &[]);
    assert!(!found.status.success());
    let told = text(&found);
    assert!(
        told.contains("1 rows of scenes refer by parse_id to rows of parses that do not exist"),
        "{told}"
    );
    assert!(told.contains("1 rows of corrections refer by parse_id"), "{told}");
    let repaired = doctor(folder, &["--repair"]);
    assert!(
        repaired.status.success(),
        "{}{}",
        text(&repaired),
        String::from_utf8_lossy(&repaired.stderr)
    );
    assert!(doctor(folder, &[]).status.success());

    // The scene has its parse again: the stored one, or a new one.
    let server = Process::start(folder);
    let job = server.client.scene(&scene.id).await.unwrap().job_id.unwrap();
    assert_eq!(finished(&server.client, &job).await.state, JobState::Succeeded);
    server.client.ground(&scene.id, &ask("the red sofa")).await.unwrap();
    assert_eq!(server.terminate(), Some(0));
}
