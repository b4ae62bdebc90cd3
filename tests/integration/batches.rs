//! Batches: lists of questions answered in the background.

use crate::scripted_model::{Script, says};
use crate::test_scans::Scan;
use crate::test_server::{Process, TestServer, ask, expect_problem, post_raw, upload_and_parse};
use camino::Utf8Path;
use serde_json::{Value, json};
use std::collections::{BTreeMap, HashSet};
use std::process::{Command, Stdio};
use std::time::Duration;
use tokio::time::sleep;
use uniground::config::{LimitsConfig, VlmConfig};
use uniground_client::{Client, ClientError};
use uniground_types::batch::{Batch, BatchRequest, BatchResult, BatchState};
use uniground_types::job::JobState;

const QUERIES: [&str; 4] = [
    "the red sofa",
    "the purple beds",
    "all the things on the table",
    "the sofa closest to the table",
];

/// Returns `number` questions about a scene, one per line.
fn question_lines(scene: &str, number: usize) -> String {
    (0..number)
        .map(|i| json!({"scene_id": scene, "query": QUERIES[i % QUERIES.len()]}).to_string() + "\n")
        .collect()
}

pub async fn fetch_results(
    client: &Client,
    batch: &str,
    from: u32,
    follow: bool,
) -> Vec<BatchResult> {
    let mut results = Vec::new();
    let take = |_: &[u8], result| {
        results.push(result);
        Ok::<(), ClientError>(())
    };
    client.batch_results(batch, from, follow, take).await.unwrap();
    results
}

pub async fn wait_for_batch(client: &Client, id: &str) -> Batch {
    loop {
        let batch = client.batch(id).await.unwrap();
        if batch.state != BatchState::Running {
            return batch;
        }
        sleep(Duration::from_millis(20)).await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn every_item_gets_an_answer_or_an_error_in_order() {
    let server = TestServer::start().await;
    let client = &server.client;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await.id;
    let nowhere = "018f0000-0000-7000-8000-000000000000";
    let items = json!([
        {"query": "the red sofa", "min_confidence": 0.0},
        {"query": "the purple beds", "include": []},
        {"query": ""},
        {"query": "the red sofa", "top_k": 0},
        {"query": "the red sofa", "colour": "red"},
        {"query": "the red sofa", "scene_id": nowhere},
        {"scene_id": scene},
        {"query": "the red sofa", "min_confidence": 0.99},
    ]);
    let request =
        json!({"items": items, "defaults": {"scene_id": scene, "top_k": 3}, "label": "monday"});
    let request: BatchRequest = serde_json::from_value(request).unwrap();
    let batch = client.create_batch(&request, None).await.unwrap();
    assert_eq!((batch.items, batch.label.as_deref()), (8, Some("monday")));
    let results_told = fetch_results(client, &batch.id, 0, true).await;
    let told: Vec<(u32, &str, Option<&str>)> = results_told
        .iter()
        .map(|r| (r.item, r.status.as_str(), r.error.as_ref().map(|e| e.code.as_str())))
        .collect();
    let expected = [
        (0, "grounded", None),
        (1, "no_match", None),
        (2, "failed", Some("invalid_request")),
        (3, "failed", Some("invalid_request")),
        (4, "failed", Some("invalid_request")),
        (5, "failed", Some("scene_not_found")),
        (6, "failed", Some("invalid_request")),
        (7, "uncertain", None),
    ];
    assert_eq!(told, expected);
    assert!(
        results_told[4].error.as_ref().unwrap().detail.contains("colour"),
        "{:?}",
        results_told[4].error
    );
    // Each answer equals the answer to the same single question and is stored under its id.
    let alone = client.ground(&scene, &ask("the red sofa")).await.unwrap();
    let of_batch = results_told[0].answer.as_ref().unwrap();
    assert_eq!(of_batch["answer"], serde_json::to_value(&alone.answer).unwrap());
    assert_eq!(
        of_batch["candidates"].as_array().unwrap().len().min(3),
        of_batch["candidates"].as_array().unwrap().len()
    );
    assert_eq!(client.answer(&results_told[0].answer_id).await.unwrap().query, "the red sofa");

    let batch = wait_for_batch(client, &batch.id).await;
    assert_eq!((batch.state, batch.done, batch.cost_usd), (BatchState::Succeeded, 8, 0.0));
    let numbers = [("failed", 5), ("grounded", 1), ("no_match", 1), ("uncertain", 1)]
        .map(|(status, n)| (status.to_owned(), n));
    assert_eq!(batch.by_status, BTreeMap::from(numbers));
    assert_eq!(
        client.job(batch.job_id.as_deref().unwrap()).await.unwrap().state,
        JobState::Succeeded
    );
    assert_eq!(client.batches(10, None).await.unwrap().batches, std::slice::from_ref(&batch));
    // A client that lost its connection resumes.
    assert_eq!(fetch_results(client, &batch.id, 6, false).await, results_told[6..]);
    let table = String::from_utf8(
        client.bytes(&format!("v1/batches/{}/results?format=csv", batch.id)).await.unwrap(),
    )
    .unwrap();
    let rows: Vec<&str> = table.lines().collect();
    assert!(
        rows.len() == 9
            && rows[0].starts_with("item,scene_id,query,status")
            && rows[1].contains("the red sofa,grounded"),
        "{table}"
    );
    // Defaults in the first line leave the scene of the URL in place.
    let lines = "{\"defaults\": {\"min_confidence\": 0}}\n{\"query\": \"the red sofa\"}\n";
    let id =
        client.create_batch_of_lines(lines, &[("scene_id", scene.clone())], None).await.unwrap().id;
    assert_eq!(fetch_results(client, &id, 0, true).await[0].status, "grounded");
    // An answer that was deleted with its scene is reported as missing.
    client.delete_scene(&scene).await.unwrap();
    let left = fetch_results(client, &batch.id, 0, false).await;
    assert_eq!((left[0].status.as_str(), &left[0].answer), ("grounded", &None));
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_invalid_batch_is_refused_as_a_whole() {
    let server = TestServer::start().await;
    let client = &server.client;
    for (media_type, body, status, code, pointer) in [
        ("application/jsonl", "{\"query\": \"a\"}\nnot json\n", 422, "invalid_request", "/items/1"),
        ("application/jsonl", "[1]\n", 422, "invalid_request", "/items/0"),
        ("application/jsonl", "\n\n", 422, "invalid_request", "/items"),
        ("application/json", "{\"items\": []}", 422, "invalid_request", "/items"),
        ("application/json", "{\"items\": 3}", 422, "invalid_request", "/items"),
        (
            "application/json",
            "{\"items\": [{}], \"concurrency\": 0}",
            422,
            "invalid_request",
            "/concurrency",
        ),
        (
            "application/json",
            "{\"items\": [{}], \"max_cost_usd\": -1}",
            422,
            "invalid_request",
            "/max_cost_usd",
        ),
        ("text/csv", "query", 415, "unsupported_media_type", ""),
    ] {
        let problem = post_raw(client, "v1/batches", media_type, body).await;
        let pointers: Vec<&str> = problem.errors.iter().map(|e| e.pointer.as_str()).collect();
        assert_eq!(
            (problem.status, problem.code.as_str(), pointers.first().copied().unwrap_or_default()),
            (status, code, pointer),
            "{body}"
        );
    }
    assert_eq!(client.batches(10, None).await.unwrap().batches, []);
    let missing = "018f0000-0000-7000-8000-000000000000";
    assert_eq!(expect_problem(client.batch(missing).await).code, "batch_not_found");
    assert_eq!(
        expect_problem(client.control_batch(missing, "pause").await).code,
        "batch_not_found"
    );
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_idempotency_key_creates_one_batch() {
    let server = TestServer::start().await;
    let client = &server.client;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await.id;
    let submit =
        async |lines: String| client.create_batch_of_lines(lines, &[], Some("monday")).await;
    let (first, second) =
        tokio::join!(submit(question_lines(&scene, 900)), submit(question_lines(&scene, 900)));
    assert_eq!(first.unwrap().id, second.unwrap().id);
    assert_eq!(
        expect_problem(submit(question_lines(&scene, 901)).await).code,
        "idempotency_key_reused"
    );
    let batches = client.batches(10, None).await.unwrap().batches;
    assert_eq!((batches.len(), batches[0].items), (1, 900));
    let batch = wait_for_batch(client, &batches[0].id).await;
    assert_eq!((batch.state, batch.done), (BatchState::Succeeded, 900));
    assert_eq!(expect_problem(client.control_batch(&batch.id, "pause").await).code, "batch_over");
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_batch_can_be_paused_resumed_and_cancelled() {
    let server = TestServer::start().await;
    let client = &server.client;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await.id;
    let options = [("concurrency", "1".to_owned())];
    let batch =
        client.create_batch_of_lines(question_lines(&scene, 1500), &options, None).await.unwrap();
    let paused = client.control_batch(&batch.id, "pause").await.unwrap();
    assert_eq!((paused.state, paused.reason), (BatchState::Paused, None));
    // The item in progress finishes; then nothing changes.
    client.follow_job(paused.job_id.as_deref().unwrap(), |_| {}).await.unwrap();
    let before = client.batch(&batch.id).await.unwrap().done;
    assert!(before < 1500, "{before}");
    assert_eq!(fetch_results(client, &batch.id, 0, false).await.len(), before as usize);
    let resumed = client.control_batch(&batch.id, "resume").await.unwrap();
    assert_eq!(resumed.state, BatchState::Running);
    while client.batch(&batch.id).await.unwrap().done == before {
        sleep(Duration::from_millis(5)).await;
    }
    client.control_batch(&batch.id, "cancel").await.unwrap();
    let over = wait_for_batch(client, &batch.id).await;
    assert_eq!((over.state, over.finished_at.is_some()), (BatchState::Cancelled, true));
    assert_eq!(expect_problem(client.control_batch(&batch.id, "resume").await).code, "batch_over");
    // Cancelling the job leaves a batch that can be resumed.
    let batch =
        client.create_batch_of_lines(question_lines(&scene, 1500), &options, None).await.unwrap();
    let job = client.cancel_job(batch.job_id.as_deref().unwrap()).await.unwrap();
    client.follow_job(&job.id, |_| {}).await.unwrap();
    let stopped = client.batch(&batch.id).await.unwrap();
    assert_eq!((stopped.state, stopped.reason.as_deref()), (BatchState::Paused, Some("job_ended")));
    client.control_batch(&batch.id, "resume").await.unwrap();
    assert_eq!(wait_for_batch(client, &batch.id).await.done, 1500);
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_batch_never_exceeds_its_budget_and_pauses_instead() {
    let script = Script::default();
    let reply = "Predicted ID: 1\nExplanation: x\nCandidate Names: 1 -> sofa\nTarget name matches?: true\nAnchor ID: none\nRelation used: none";
    let url = script.serve(vec![says(reply)]).await;
    let vlm = VlmConfig {
        vlm_url: Some(url),
        vlm_model: Some("scripted".into()),
        vlm_prompt_usd: 2.0,
        vlm_completion_usd: 8.0,
        vlm_backoff_ms: 1,
        ..VlmConfig::default()
    };
    let server = TestServer::start_configured(LimitsConfig::default(), vlm).await;
    let client = &server.client;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await.id;
    let one = client.ground(&scene, &ask("the red sofa")).await.unwrap().usage.cost_usd;
    assert!(one > 0.0, "a call costs {one} USD");
    let calls_of_one = script.calls();
    let calls = script.calls();
    let items: String = (0..8)
        .map(|_| json!({"scene_id": scene, "query": "the red sofa"}).to_string() + "\n")
        .collect();
    let limit = 4.5 * one;
    let options = [("max_cost_usd", limit.to_string()), ("concurrency", "1".to_owned())];
    let batch = client.create_batch_of_lines(items, &options, None).await.unwrap();
    let batch = wait_for_batch(client, &batch.id).await;
    assert_eq!(
        (batch.state, batch.reason.as_deref()),
        (BatchState::Paused, Some("budget_spent")),
        "{batch:?}"
    );
    assert!(batch.cost_usd <= limit && (1..8).contains(&batch.done), "{batch:?}");
    assert!((batch.cost_usd - f64::from(batch.done) * one).abs() < 1e-6, "{batch:?}: {one} each");
    assert_eq!(
        fetch_results(client, &batch.id, 0, true).await.len(),
        batch.done as usize,
        "a paused batch ends the stream of a follower"
    );
    let for_the_last = script.calls() - calls - calls_of_one * batch.done as usize;
    assert!(for_the_last < calls_of_one, "an item was asked more than once");
    // With a budget of zero no item is sent to the model, and nothing else answers.
    let items = json!({"scene_id": scene, "query": "the red sofa"}).to_string();
    let calls = script.calls();
    let batch = client
        .create_batch_of_lines(items, &[("max_cost_usd", "0".to_owned())], None)
        .await
        .unwrap();
    let batch = wait_for_batch(client, &batch.id).await;
    assert_eq!((batch.state, batch.done, script.calls()), (BatchState::Paused, 0, calls));
    server.stop().await;
}

/// After several kills every item has exactly one answer, under its assigned id, equal to that of
/// an undisturbed run.
#[tokio::test(flavor = "multi_thread")]
async fn a_batch_survives_kills_without_repeated_or_lost_items() {
    const ITEMS: usize = 2000;
    let data = tempfile::tempdir().unwrap();
    let data = Utf8Path::from_path(data.path()).unwrap();
    let server = Process::start(data);
    let scene = upload_and_parse(&server.client, "application/zip", Scan::neutral().zip()).await.id;
    let batch = server
        .client
        .create_batch_of_lines(question_lines(&scene, ITEMS), &[], Some("kills"))
        .await
        .unwrap();
    let mut server = server;
    for pause_ms in [30, 120, 250, 60] {
        sleep(Duration::from_millis(pause_ms)).await;
        server.kill();
        server = Process::start(data);
    }
    let over = wait_for_batch(&server.client, &batch.id).await;
    assert_eq!((over.state, over.done as usize), (BatchState::Succeeded, ITEMS));
    assert_eq!(over.by_status.get("failed"), None);
    let told = fetch_results(&server.client, &batch.id, 0, false).await;
    assert!(
        told.iter().zip(0..).all(|(result, i)| result.item == i),
        "items are missing or out of order"
    );
    assert_eq!(told.iter().map(|result| &result.answer_id).collect::<HashSet<_>>().len(), ITEMS);
    // The same question gets the same answer from every server.
    let core = |result: &BatchResult| {
        let answer = result.answer.as_ref().unwrap();
        [
            &answer["status"],
            &answer["answer"],
            &answer["box"],
            &answer["confidence"],
            &answer["targets"],
        ]
        .map(Value::to_string)
    };
    let first: Vec<_> = told[..QUERIES.len()].iter().map(core).collect();
    assert!(told.iter().enumerate().all(|(i, result)| core(result) == first[i % QUERIES.len()]));
    server.terminate();
}

#[tokio::test(flavor = "multi_thread")]
async fn the_batch_command_resumes_an_incomplete_output_file() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await.id;
    let folder = tempfile::tempdir().unwrap();
    let (file, out) = (folder.path().join("questions.txt"), folder.path().join("results.jsonl"));
    std::fs::write(&file, QUERIES.join("\n\n")).unwrap();
    let url = server.url();
    let run = async || {
        let (file, out, url, scene) = (file.clone(), out.clone(), url.clone(), scene.clone());
        let run = tokio::task::spawn_blocking(move || {
            Command::new(env!("CARGO_BIN_EXE_uniground"))
                .args(["batch", "run"])
                .arg(file)
                .arg("--out")
                .arg(out)
                .args(["--server", &url, "--scene", &scene])
                .stdout(Stdio::null())
                .output()
        });
        run.await.unwrap().unwrap()
    };
    let done = run().await;
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let whole = std::fs::read_to_string(&out).unwrap();
    assert_eq!(whole.lines().count(), QUERIES.len());
    assert!(
        String::from_utf8_lossy(&done.stderr).contains("4 of 4 questions done"),
        "{}",
        String::from_utf8_lossy(&done.stderr)
    );
    // The output file is cut in the middle of a line.
    std::fs::write(&out, &whole[..whole.len() / 2]).unwrap();
    assert!(run().await.status.success());
    assert_eq!(
        std::fs::read_to_string(&out).unwrap(),
        whole,
        "only the missing results are appended"
    );
    assert_eq!(server.client.batches(10, None).await.unwrap().batches.len(), 1);
    server.stop().await;
}
