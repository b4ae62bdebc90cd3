//! Snapshots of texts that people read: an answer, problems, a report. `INSTA_UPDATE=always cargo
//! test --release` rewrites them.

use crate::test_server::TestServer;
use reqwest::Method;
use serde_json::{Value, json};
use std::fs;
use std::process::Command;
use uniground_types::question::GroundRequest;

const SAMPLE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/living_room.zip");

#[tokio::test]
async fn answers_match_their_snapshots() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(fs::read(SAMPLE).unwrap()).await;
    for (name, query) in
        [("answer_found", "the mug on the coffee table"), ("answer_no_match", "the purple beds")]
    {
        let answer = server
            .client
            .ground(&scene.id, &GroundRequest { top_k: 3, ..GroundRequest::new(query) })
            .await
            .unwrap();
        insta::assert_json_snapshot!(name, answer, {
            ".id" => "[id]", ".scene_id" => "[scene]", ".timings_ms" => "[times]", ".evidence[]" => "[path]", ".candidates[].view" => "[path]",
        });
    }
    server.stop().await;
}

#[tokio::test]
async fn problems_match_their_snapshot() {
    let server = TestServer::start().await;
    let scene = "01a1f829-2f28-76eb-afa7-c7b611e3e457";
    let ground = format!("v1/scenes/{scene}/ground");
    let json_type = "application/json";
    let mut problems = Vec::new();
    for (what, method, path, media_type, body) in [
        ("an unknown scene", Method::GET, format!("v1/scenes/{scene}"), json_type, ""),
        ("an unknown route", Method::GET, "v1/rooms".to_owned(), json_type, ""),
        (
            "a method that the route does not support",
            Method::PUT,
            "v1/scenes".to_owned(),
            json_type,
            "",
        ),
        ("invalid JSON", Method::POST, ground.clone(), json_type, "{\"query\": "),
        (
            "an unknown field",
            Method::POST,
            ground.clone(),
            json_type,
            r#"{"query": "the mug", "top": 3}"#,
        ),
        (
            "a value out of range",
            Method::POST,
            ground.clone(),
            json_type,
            r#"{"query": "the mug", "top_k": 0}"#,
        ),
        ("an empty question", Method::POST, ground.clone(), json_type, r#"{"query": " "}"#),
        ("an unsupported media type", Method::POST, ground, "text/plain", "the mug"),
        (
            "an upload of an unsupported type",
            Method::POST,
            "v1/scenes".to_owned(),
            "video/mp4",
            "\0\0\0\x18ftypmp42",
        ),
        (
            "an upload that is not an archive",
            Method::POST,
            "v1/scenes".to_owned(),
            "application/zip",
            "x",
        ),
    ] {
        let request = server
            .client
            .request(method, &path)
            .header("content-type", media_type)
            .header("x-request-id", "mine");
        let response = request.body(body).send().await.unwrap();
        let retry = response.headers().get("retry-after").cloned();
        assert_eq!(response.headers()["content-type"], "application/problem+json", "{what}");
        let problem: Value = serde_json::from_slice(&response.bytes().await.unwrap()).unwrap();
        problems.push(json!({"what": what, "problem": problem, "retry_after": retry.map(|v| v.to_str().unwrap().to_owned())}));
    }
    insta::assert_json_snapshot!("problems", problems);
    server.stop().await;
}

#[test]
fn the_evaluation_report_matches_its_snapshot() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let run = Command::new(env!("CARGO_BIN_EXE_uniground"))
        .args([
            "eval",
            concat!(env!("CARGO_MANIFEST_DIR"), "/examples"),
            "--matrix",
            "source=oracle,oracle-boxes",
            "--label",
            "snapshot",
        ])
        .arg("--out")
        .arg(&out)
        .output()
        .unwrap();
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    let report = fs::read_to_string(out.join("report.md")).unwrap();
    insta::with_settings!({filters => vec![
        // Times and the machine.
        (r"\d{4}-\d{2}-\d{2}T[0-9:]+Z", "[time]"),
        (r"(?m)^.*(?:machine|cores).*$", "[machine]"),
        (r"\d+(?:\.\d+)? ms", "[ms]"),
        // The latency columns in the summary, before calls, tokens and dollars.
        (r"\| \d+\.\d+ \| \d+\.\d+ (\| \d+\.\d+ \| \d+ \| \d+\.\d+ \|)", "| [ms] | [ms] $1"),
    ]}, {
        insta::assert_snapshot!("report", report);
    });
}
