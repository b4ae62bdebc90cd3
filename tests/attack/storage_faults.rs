//! Databases and files that are locked or lost, and folders that are not data folders.

use crate::hostile_uploads::ZIP;
use crate::test_scans::Scan;
use crate::test_server::{
    Process, ask, expect_problem, serve_command, upload_and_parse, wait_for_job,
};
use crate::{Form, Report, Target, since};
use camino::Utf8Path;
use sqlx::Connection;
use sqlx::sqlite::{SqliteConnectOptions, SqliteConnection};
use std::fs;
use std::process::Command;
use std::time::{Duration, Instant};
use uniground_types::job::JobState;

pub async fn run(_: Form, report: &mut Report) {
    run_lost_database(report).await;
    run_foreign_folder(report);
    run_lost_files(report).await;
    run_locked_database(report).await;
}

fn folder_bytes(folder: &Utf8Path) -> u64 {
    let entries = folder.read_dir_utf8().unwrap().map(Result::unwrap);
    entries
        .map(|entry| {
            if entry.file_type().unwrap().is_dir() {
                folder_bytes(entry.path())
            } else {
                entry.metadata().unwrap().len()
            }
        })
        .sum()
}

async fn run_lost_database(report: &mut Report) {
    for (case, is_empty) in [("the database is gone", false), ("the database is empty", true)] {
        let target = Target::start();
        let scene = upload_and_parse(&target.process.client, ZIP, Scan::neutral().zip()).await;
        let Target { data, process } = target;
        process.terminate();
        let folder = Utf8Path::from_path(data.path()).unwrap();
        let before = folder_bytes(&folder.join("blobs"));
        for file in ["uniground.sqlite", "uniground.sqlite-wal", "uniground.sqlite-shm"] {
            let _ = fs::remove_file(folder.join(file));
        }
        if is_empty {
            fs::write(folder.join("uniground.sqlite"), "").unwrap();
        }
        let start = Instant::now();
        let process = Process::start(folder);
        let scenes = process.client.scenes(10, None).await.unwrap().scenes.len();
        let after = folder_bytes(&folder.join("blobs"));
        // The same scan uploaded again reuses its folder and is complete.
        let again = upload_and_parse(&process.client, ZIP, Scan::neutral().zip()).await;
        let held = before == after && scenes == 0 && again.content_hash == scene.content_hash;
        report.row(
            case,
            &format!("{scenes} scenes, uploads work"),
            since(start),
            None,
            &format!("{before} -> {after} bytes"),
            held,
        );
        process.kill();
    }
}

fn run_foreign_folder(report: &mut Report) {
    let data = tempfile::tempdir().unwrap();
    let folder = Utf8Path::from_path(data.path()).unwrap();
    fs::create_dir(folder.join("tmp")).unwrap();
    fs::write(folder.join("tmp/thesis.txt"), "years").unwrap();
    let start = Instant::now();
    let output = serve_command(folder, "127.0.0.1:0").output().unwrap();
    let told = String::from_utf8_lossy(&output.stderr);
    let held = !output.status.success()
        && told.contains("not a uniground data folder")
        && folder.join("tmp/thesis.txt").exists();
    report.row(
        "--data-dir on a foreign folder",
        "refused to start",
        since(start),
        None,
        "all of it",
        held,
    );
}

async fn run_lost_files(report: &mut Report) {
    let target = Target::start();
    fs::write(target.folder().join("blobs/contents/note.txt"), "stray").unwrap();
    let scene = upload_and_parse(&target.process.client, ZIP, Scan::neutral().zip()).await;
    let target = target.again();
    let client = &target.process.client;
    let kept = client.scene(&scene.id).await.is_ok()
        && target.folder().join("blobs/contents/note.txt").exists();
    report.row("a stray file in blobs/", "starts", 0.0, None, "all of it", kept);

    let start = Instant::now();
    let parse = target
        .folder()
        .join("blobs/parses")
        .read_dir_utf8()
        .unwrap()
        .next()
        .unwrap()
        .unwrap()
        .into_path();
    let cloud = parse.join("cloud.ply");
    let mut bytes = fs::read(&cloud).unwrap();
    *bytes.last_mut().unwrap() ^= 0xff;
    fs::write(&cloud, bytes).unwrap();
    let path = format!("v1/scenes/{}/cloud.ply", scene.id);
    let told = expect_problem(client.bytes(&path).await);
    let job = client.scene(&scene.id).await.unwrap().job_id.unwrap();
    let healed = wait_for_job(client, &job).await.state == JobState::Succeeded
        && client.bytes(&path).await.is_ok();
    report.row(
        "a damaged cloud",
        &format!("{} {}", told.status, told.code),
        since(start),
        None,
        "recreated",
        told.code == "parse_damaged" && healed,
    );

    let start = Instant::now();
    for folder in ["blobs/contents", "blobs/parses", "blobs/checkpoints"] {
        for entry in target.folder().join(folder).read_dir_utf8().unwrap().map(Result::unwrap) {
            if entry.file_type().unwrap().is_dir() {
                fs::remove_dir_all(entry.path()).unwrap();
            }
        }
    }
    let again = upload_and_parse(client, ZIP, Scan::neutral().zip()).await;
    let whole = client.bytes(&format!("v1/scenes/{}/cloud.ply", again.id)).await.is_ok();
    report.row(
        "all files lost, the scan uploaded again",
        "parsed again",
        since(start),
        None,
        "recreated",
        whole,
    );
    target.process.terminate();
    let doctor = Command::new(env!("CARGO_BIN_EXE_uniground"))
        .args(["doctor", "--data-dir", target.data.path().to_str().unwrap()])
        .output()
        .unwrap();
    let told = String::from_utf8_lossy(&doctor.stdout);
    let alone = told.contains("stray file") && !told.contains("parse ") && !told.contains("scan ");
    report.row(
        "then the doctor",
        if alone { "a stray file, nothing else" } else { "more" },
        0.0,
        None,
        "",
        alone,
    );
}

async fn run_locked_database(report: &mut Report) {
    let target = Target::start();
    let client = &target.process.client;
    let scene = upload_and_parse(client, ZIP, Scan::neutral().zip()).await;
    let created =
        client.create_scene(None, ZIP, Scan::neutral().with("note.txt", "2").zip()).await.unwrap();
    let options = SqliteConnectOptions::new().filename(target.folder().join("uniground.sqlite"));
    let mut other = SqliteConnection::connect_with(&options).await.unwrap();
    sqlx::query("BEGIN IMMEDIATE").execute(&mut other).await.unwrap();
    let start = Instant::now();
    let answer = client.ground(&scene.id, &ask("the red sofa")).await.unwrap();
    let seconds = since(start);
    report.row(
        "a question while the database is locked",
        if answer.stored { "stored?" } else { "answered, not stored" },
        seconds,
        None,
        "",
        !answer.stored && seconds < 8.0,
    );
    let start = Instant::now();
    let told = expect_problem(client.rename_scene(&scene.id, "hall").await);
    let seconds = since(start);
    report.row(
        "a change while the database is locked",
        &format!("{} {}", told.status, told.code),
        seconds,
        None,
        "",
        told.status == 503 && told.retry_after_s.is_some() && seconds < 8.0,
    );
    let ready = client.request(reqwest::Method::GET, "readyz").send().await.unwrap().status();
    report.row(
        "readiness while the database is locked",
        ready.as_str(),
        0.0,
        None,
        "",
        ready == 503,
    );
    tokio::time::sleep(Duration::from_secs(5)).await;
    drop(other);
    let start = Instant::now();
    let job = tokio::time::timeout(
        Duration::from_mins(1),
        wait_for_job(client, &created.job.unwrap().id),
    )
    .await;
    let held = job.as_ref().is_ok_and(|job| job.state == JobState::Succeeded);
    report.row(
        "a job that ended while locked",
        if held { "succeeded" } else { "never ended" },
        since(start),
        None,
        "",
        held,
    );
    let ready = client.bytes("readyz").await.is_ok();
    report.row(
        "readiness afterwards",
        if ready { "ready" } else { "not ready" },
        0.0,
        None,
        "",
        ready,
    );
}
