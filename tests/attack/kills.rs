//! Kills at any moment: acknowledged data is there, and started jobs finish.

use crate::hostile_uploads::ZIP;
use crate::test_scans::Scan;
use crate::test_server::{Process, ask, wait_for_job};
use crate::{Form, Report, since};
use camino::Utf8Path;
use reqwest::Method;
use std::collections::BTreeMap;
use std::time::{Duration, Instant};
use uniground_types::job::JobState;
use uniground_types::scenes::Created;

pub async fn run(form: Form, report: &mut Report) {
    let kills = form.of(10, 100);
    let data = tempfile::tempdir().unwrap();
    let folder = Utf8Path::from_path(data.path()).unwrap();
    let start = Instant::now();
    // Acknowledged scenes by idempotency key, and acknowledged answers by id.
    let (mut scenes, mut answers) = (BTreeMap::new(), BTreeMap::new());
    let mut without_job = 0;
    for kill in 0..kills {
        let process = Process::start(folder);
        let client = process.client.clone();
        let known: Vec<String> = scenes.values().cloned().collect();
        let work = tokio::spawn(async move {
            let (mut made, mut given, mut without_job) = (Vec::new(), Vec::new(), 0);
            for round in 0..50 {
                // Every key is used in two rounds and by the next server, which sometimes finds the
                // scene already created.
                let key = format!("key-{}", kill * 3 + round / 2);
                let archive = Scan::neutral().with("note.txt", key.clone()).zip();
                let request = client
                    .request(Method::POST, "v1/scenes")
                    .header("content-type", ZIP)
                    .header("idempotency-key", &key);
                let Ok(response) = request.body(archive).send().await else { break };
                let Ok(created) = response.json::<Created>().await else { break };
                without_job += usize::from(created.job.is_none());
                made.push((key, created.scene.id.clone()));
                for scene in known.iter().rev().take(2) {
                    if let Ok(answer) = client.ground(scene, &ask("the red sofa")).await {
                        given.push((answer.id.clone(), answer.answer.predicted_id));
                    }
                }
            }
            (made, given, without_job)
        });
        // Moments spread over the whole run, the same every time.
        tokio::time::sleep(Duration::from_millis(50 + (kill * 397) % 1300)).await;
        process.kill();
        let (made, given, none) = work.await.unwrap();
        scenes.extend(made);
        answers.extend(given);
        without_job += none;
    }
    let process = Process::start(folder);
    let client = &process.client;
    let (mut lost, mut failed) = (0, 0);
    for id in scenes.values() {
        match client.scene(id).await {
            Ok(scene) => {
                let Some(job) = scene.job_id else {
                    without_job += 1;
                    continue;
                };
                failed +=
                    usize::from(wait_for_job(client, &job).await.state != JobState::Succeeded);
            }
            Err(_) => lost += 1,
        }
    }
    let mut lost_answers = 0;
    for (id, chosen) in &answers {
        lost_answers += usize::from(
            client.answer(id).await.map(|answer| answer.answer.predicted_id).ok() != Some(*chosen),
        );
    }
    let mut chosen: Vec<_> = Vec::new();
    for id in scenes.values() {
        chosen.push(
            client
                .ground(id, &ask("the red sofa"))
                .await
                .map(|answer| (answer.answer.predicted_id, answer.aabb))
                .unwrap(),
        );
    }
    let alike = chosen.windows(2).all(|pair| pair[0] == pair[1]);
    process.terminate();
    let doctor = std::process::Command::new(env!("CARGO_BIN_EXE_uniground"))
        .args(["doctor", "--data-dir", folder.as_str()])
        .output()
        .unwrap();
    let told = String::from_utf8_lossy(&doctor.stdout);
    let sound = !told.contains("database") && !told.contains("parse ") && !told.contains("scan ");
    let answer = format!("{} scenes, {} answers", scenes.len(), answers.len());
    let left = format!(
        "lost {lost}+{lost_answers}, failed {failed}, without job {without_job}, answers equal {alike}, intact {sound}"
    );
    let held =
        lost + lost_answers + failed + without_job == 0 && alike && sound && !scenes.is_empty();
    report.row(&format!("8, 16 {kills} kills"), &answer, since(start), None, &left, held);

    let process = Process::start(folder);
    let upload = |note: &'static str| {
        let archive = Scan::neutral().with("note.txt", note).zip();
        process
            .client
            .request(Method::POST, "v1/scenes")
            .header("content-type", ZIP)
            .header("idempotency-key", "mine")
            .body(archive)
            .send()
    };
    let (first, second) = (upload("one").await.unwrap(), upload("two").await.unwrap());
    let held = first.status() == 202 && second.status() == 422;
    report.row("the same key with another body", second.status().as_str(), 0.0, None, "", held);
    process.kill();
}
