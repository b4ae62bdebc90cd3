//! Response times while the most expensive questions, uploads and batches run.

use crate::hostile_uploads::{self, ZIP};
use crate::test_scans::Scan;
use crate::test_server::upload_and_parse;
use crate::{Form, Report, Target, since};
use reqwest::Method;
use serde_json::json;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use uniground_client::Client;

/// The slowest of a hundred responses of `/healthz` must be below this, in milliseconds.
const MOST_MS: f64 = 250.0;
/// Concurrent questions.
const QUESTIONS: usize = 8;

/// Returns questions of maximum length that are the most expensive to parse.
fn worst_questions() -> Vec<String> {
    let longest = |pattern: &str| pattern.chars().cycle().take(1000).collect::<String>();
    [
        ",",
        "a,",
        "what x, ",
        "i need to, ",
        "put it, ",
        "(",
        "no, the ",
        "something to sit on and ",
        "between the ",
    ]
    .map(longest)
    .to_vec()
}

pub async fn run(form: Form, report: &mut Report) {
    let target = Target::start();
    let client = &target.process.client;
    let scene = upload_and_parse(client, ZIP, Scan::neutral().zip()).await;
    let over = Arc::new(AtomicBool::new(false));
    let mut work = Vec::new();
    for worker in 0..QUESTIONS {
        work.push(tokio::spawn(ask_until_over(
            client.clone(),
            scene.id.clone(),
            worker,
            over.clone(),
        )));
    }
    let lines: String = worst_questions()
        .iter()
        .cycle()
        .take(200)
        .map(|query| format!("{}\n", json!({"scene_id": scene.id, "query": query})))
        .collect();
    client.create_batch_of_lines(lines, &[("concurrency", "8".to_owned())], None).await.unwrap();
    work.push(tokio::spawn(upload_until_over(
        client.clone(),
        hostile_uploads::glb_of_indices(40_000_000),
        over.clone(),
    )));
    work.push(tokio::spawn(upload_until_over(
        client.clone(),
        hostile_uploads::a_large_manifest(11 << 20),
        over.clone(),
    )));
    let start = Instant::now();
    let seconds = form.of(8, 60);
    let mut times = Vec::new();
    while start.elapsed() < Duration::from_secs(seconds) {
        let asked = Instant::now();
        let answered = client.bytes("healthz").await.is_ok();
        times.push(if answered { asked.elapsed().as_secs_f64() * 1e3 } else { f64::INFINITY });
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    over.store(true, Ordering::Relaxed);
    let mut asked = 0;
    for work in work {
        asked += work.await.unwrap();
    }
    times.sort_by(f64::total_cmp);
    let (p99, longest) = (times[times.len() * 99 / 100], times[times.len() - 1]);
    let stopping = Instant::now();
    let Target { data: _data, process } = target;
    let code = process.terminate();
    let stopped = since(stopping);
    report.row(
        "health during the worst questions and uploads",
        &format!("p99 {p99:.0}, longest {longest:.0} ms"),
        since(start),
        None,
        &format!("{} probes, {asked} other requests, stopped in {stopped:.1} s", times.len()),
        p99 < MOST_MS && asked > QUESTIONS && code == Some(0) && stopped < 10.0,
    );
}

/// Sends the worst questions one after another and returns how many were answered.
async fn ask_until_over(
    client: Client,
    scene: String,
    worker: usize,
    over: Arc<AtomicBool>,
) -> usize {
    let questions = worst_questions();
    let mut asked = 0;
    while !over.load(Ordering::Relaxed) {
        let query = &questions[(worker + asked) % questions.len()];
        let request = client.request(Method::POST, &format!("v1/scenes/{scene}/ground"));
        let body = json!({"query": query, "timeout_s": 1.0}).to_string();
        let _ = request.header("content-type", "application/json").body(body).send().await;
        asked += 1;
    }
    asked
}

async fn upload_until_over(client: Client, archive: Vec<u8>, over: Arc<AtomicBool>) -> usize {
    let mut sent = 0;
    while !over.load(Ordering::Relaxed) {
        let _ = client.create_scene(None, ZIP, archive.clone()).await;
        sent += 1;
    }
    sent
}
