//! Kills while frames are added, batches created and uploads received in parts: every start
//! succeeds, and acknowledged data is there.

use crate::hostile_uploads::ZIP;
use crate::test_scans::{Scan, THINGS};
use crate::test_server::{Process, ask, upload_and_parse, wait_for_job};
use crate::{Form, Report, since};
use camino::Utf8Path;
use reqwest::Method;
use serde_json::json;
use std::collections::BTreeSet;
use std::time::{Duration, Instant};
use uniground_client::Client;
use uniground_types::job::JobState;
use uniground_types::placement::FrameChoice;

/// Camera positions around the room, as fractions of a full turn.
const AROUND: [f32; 4] = [0.0, 0.25, 0.5, 0.75];

/// Data that the server acknowledged.
#[derive(Default)]
struct Acknowledged {
    scenes: BTreeSet<String>,
    batches: BTreeSet<String>,
    jobs: BTreeSet<String>,
    /// Frames that were added to the growing scene.
    additions: usize,
}

/// Returns small frames of the room, different for each number.
fn frames(number: usize) -> Scan {
    Scan::of_room(&THINGS, &AROUND.map(|turn| turn + 0.01 * number as f32))
        .with("note.txt", format!("{number}"))
}

pub async fn run(form: Form, report: &mut Report) {
    run_without_answers(report).await;
    let kills = form.of(6, 100);
    let data = tempfile::tempdir().unwrap();
    let folder = Utf8Path::from_path(data.path()).unwrap();
    let start = Instant::now();
    let first = Process::start(folder);
    let growing = upload_and_parse(&first.client, ZIP, frames(0).zip()).await.id;
    first.kill();
    let mut known = Acknowledged::default();
    for kill in 0..kills {
        // A failed start panics here.
        let process = Process::start(folder);
        let work = tokio::spawn(send_requests(process.client.clone(), growing.clone(), kill));
        tokio::time::sleep(Duration::from_millis(80 + (kill as u64 * 331) % 1400)).await;
        process.kill();
        let Acknowledged { scenes, batches, jobs, additions } = work.await.unwrap();
        known.scenes.extend(scenes);
        known.batches.extend(batches);
        known.jobs.extend(jobs);
        known.additions += additions;
    }
    let process = Process::start(folder);
    let client = &process.client;
    let mut lost = 0;
    for id in &known.scenes {
        lost += usize::from(client.scene(id).await.is_err());
    }
    for id in &known.batches {
        lost += usize::from(client.batch(id).await.is_err());
    }
    let mut failed = 0;
    for id in &known.jobs {
        failed += usize::from(!matches!(
            wait_for_job(client, id).await.state,
            JobState::Succeeded | JobState::Cancelled
        ));
    }
    let grown = client.scene(&growing).await.unwrap();
    let parts = grown.import.map_or(0, |import| import.frames as usize / AROUND.len());
    let answered = client.ground(&growing, &ask("the red sofa")).await.is_ok();
    process.terminate();
    let doctor = run_doctor(folder);
    let answer = format!(
        "{} scenes, {} batches, {} additions",
        known.scenes.len(),
        known.batches.len(),
        known.additions
    );
    let left = format!(
        "lost {lost}, failed {failed}, parts {parts}, doctor: {}",
        doctor.lines().last().unwrap_or_default()
    );
    let whole = doctor.contains("no problems found");
    let held = lost == 0
        && failed == 0
        && answered
        && whole
        && parts > known.additions
        && known.additions > 0;
    report.row(
        &format!("{kills} kills during updates, batches, uploads in parts"),
        &answer,
        since(start),
        None,
        &left,
        held,
    );
}

/// A scene without answers is stopped while its update waits or runs: the next start keeps its
/// parse.
async fn run_without_answers(report: &mut Report) {
    for (case, stop) in [
        ("SIGKILL", Process::kill as fn(Process)),
        ("SIGTERM", |process: Process| assert_eq!(process.terminate(), Some(0))),
    ] {
        let start = Instant::now();
        let data = tempfile::tempdir().unwrap();
        let folder = Utf8Path::from_path(data.path()).unwrap();
        let process = Process::start(folder);
        let scene = upload_and_parse(&process.client, ZIP, frames(0).zip()).await;
        // Another parse comes first, so that the update waits in the queue.
        process.client.create_scene(None, ZIP, Scan::neutral().zip()).await.unwrap();
        let created = process
            .client
            .add_frames(&scene.id, FrameChoice::Source, frames(1).zip())
            .await
            .unwrap();
        stop(process);
        let process = Process::start(folder);
        let job = wait_for_job(&process.client, &created.job.unwrap().id).await;
        let answered = process.client.ground(&scene.id, &ask("the red sofa")).await.is_ok();
        process.terminate();
        let whole = run_doctor(folder).contains("no problems found");
        let held = job.state == JobState::Succeeded && answered && whole;
        report.row(
            &format!("{case} before an update ends, without answers"),
            "starts, updates",
            since(start),
            None,
            "all of it",
            held,
        );
    }
}

fn run_doctor(folder: &Utf8Path) -> String {
    let output = std::process::Command::new(env!("CARGO_BIN_EXE_uniground"))
        .args(["doctor", "--data-dir", folder.as_str()])
        .output()
        .unwrap();
    String::from_utf8_lossy(&output.stdout).into_owned()
}

/// Sends all kinds of requests until the server is gone.
async fn send_requests(client: Client, growing: String, kill: usize) -> Acknowledged {
    let mut known = Acknowledged::default();
    let batch = serde_json::from_value(
        json!({"items": vec![json!({"scene_id": growing, "query": "the red sofa"}); 30]}),
    )
    .unwrap();
    if let Ok(batch) = client.create_batch(&batch, Some(&format!("batch {kill}"))).await {
        known.batches.insert(batch.id);
    }
    // Half of an upload in parts, which the next server still has, and a complete one.
    let scan = Scan::neutral().with("note.txt", format!("in parts {kill}")).zip();
    for end in [scan.len() / 2, scan.len()] {
        let Some(location) = create_upload(&client, scan.len()).await else { return known };
        let part = client
            .request(Method::PATCH, location.trim_start_matches('/'))
            .header("tus-resumable", "1.0.0")
            .header("content-type", "application/offset+octet-stream")
            .header("upload-offset", "0");
        if part.body(scan[..end].to_vec()).send().await.is_err() {
            return known;
        }
    }
    let Ok(created) =
        client.add_frames(&growing, FrameChoice::Source, frames(1 + kill).zip()).await
    else {
        return known;
    };
    known.additions += 1;
    known.jobs.extend(created.job.map(|job| job.id));
    for number in 0..20 {
        let archive = Scan::neutral().with("note.txt", format!("{kill} {number}")).zip();
        let Ok(created) = client.create_scene(None, ZIP, archive).await else { return known };
        known.scenes.insert(created.scene.id);
        known.jobs.extend(created.job.map(|job| job.id));
    }
    known
}

async fn create_upload(client: &Client, length: usize) -> Option<String> {
    let made = client
        .request(Method::POST, "v1/uploads")
        .header("tus-resumable", "1.0.0")
        .header("upload-length", length.to_string())
        .send();
    Some(made.await.ok()?.headers().get("location")?.to_str().ok()?.to_owned())
}
