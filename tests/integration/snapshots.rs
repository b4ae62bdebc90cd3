//! What people read, kept word by word: an answer, problems, a report. `INSTA_UPDATE=always cargo
//! test --release` writes them anew.

use crate::server::TestServer;
use reqwest::Method;
use serde_json::{Value, json};
use std::fs;
use std::process::Command;
use uniground_types::question::GroundRequest;

const SAMPLE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/living_room.zip");

#[tokio::test]
async fn an_answer_is_what_it_was() {
    let server = TestServer::start().await;
    let scene = server.parsed(fs::read(SAMPLE).unwrap()).await;
    for (name, query) in [
        ("answer_grounded", "the mug on the coffee table"),
        ("answer_no_match", "the green fridge"),
    ] {
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
async fn problems_say_what_is_wrong_and_where() {
    let server = TestServer::start().await;
    let scene = "01a1f829-2f28-76eb-afa7-c7b611e3e457";
    let ground = format!("v1/scenes/{scene}/ground");
    let json_type = "application/json";
    let mut problems = Vec::new();
    for (what, method, path, media_type, body) in [
        ("a scene nobody has", Method::GET, format!("v1/scenes/{scene}"), json_type, ""),
        ("a route nobody has", Method::GET, "v1/rooms".to_owned(), json_type, ""),
        ("a method a route does not know", Method::PUT, "v1/scenes".to_owned(), json_type, ""),
        ("no JSON", Method::POST, ground.clone(), json_type, "{\"query\": "),
        (
            "a field nobody knows",
            Method::POST,
            ground.clone(),
            json_type,
            r#"{"query": "the mug", "top": 3}"#,
        ),
        (
            "a value out of its range",
            Method::POST,
            ground.clone(),
            json_type,
            r#"{"query": "the mug", "top_k": 0}"#,
        ),
        ("a question that is none", Method::POST, ground.clone(), json_type, r#"{"query": " "}"#),
        ("another media type", Method::POST, ground, "text/plain", "the mug"),
        (
            "an upload of a strange kind",
            Method::POST,
            "v1/scenes".to_owned(),
            "video/mp4",
            "\0\0\0\x18ftypmp42",
        ),
        (
            "an upload that is no archive",
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
fn a_report_reads_as_it_did() {
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
        // Times, and what the machine is.
        (r"\d{4}-\d{2}-\d{2}T[0-9:]+Z", "[time]"),
        (r"(?m)^.*(?:machine|cores).*$", "[machine]"),
        (r"\d+(?:\.\d+)? ms", "[ms]"),
        // The columns of latency in the summary, before calls, tokens and dollars.
        (r"\| \d+\.\d+ \| \d+\.\d+ (\| \d+\.\d+ \| \d+ \| \d+\.\d+ \|)", "| [ms] | [ms] $1"),
    ]}, {
        insta::assert_snapshot!("report", report);
    });
}
