//! The log of the binary at the default level: each error is logged once, with the ids needed to
//! find it.

use crate::scripted_model::{Script, fails};
use crate::test_scans::Scan;
use crate::test_server::{Process, ask, serve_command, wait_for_job};
use reqwest::Method;
use serde_json::Value;
use std::fs;
use std::time::Duration;
use uniground_client::Client;

fn read_lines(log: &camino::Utf8Path) -> Vec<Value> {
    fs::read_to_string(log)
        .unwrap()
        .lines()
        .filter_map(|line| serde_json::from_str(line).ok())
        .collect()
}

/// Returns the spans around a line, outermost first.
fn enclosing_spans(line: &Value) -> Vec<Value> {
    line["spans"].as_array().cloned().unwrap_or_default()
}

#[tokio::test]
async fn an_error_is_logged_once_with_route_request_and_cause() {
    let folder = tempfile::tempdir().unwrap();
    let data = camino::Utf8Path::from_path(folder.path()).unwrap();
    let log = data.join("log");
    let process = Process::start_logging(&data.join("data"), &log);
    let created = process
        .client
        .create_scene(Some("room"), "application/zip", Scan::neutral().zip())
        .await
        .unwrap();
    let job = wait_for_job(&process.client, &created.job.unwrap().id).await;
    // The cloud file is deleted.
    let parses = data.join("data/blobs/parses");
    let parse = parses.read_dir_utf8().unwrap().next().unwrap().unwrap().into_path();
    fs::remove_file(parse.join("cloud.ply")).unwrap();
    let path = format!("v1/scenes/{}/cloud.ply", created.scene.id);
    let response = process
        .client
        .request(Method::GET, &path)
        .header("x-request-id", "look-me-up")
        .send()
        .await
        .unwrap();
    assert_eq!(response.status(), 503);
    assert_eq!(
        process.client.request(Method::GET, "v1/scenes/none").send().await.unwrap().status(),
        404
    );
    tokio::time::sleep(Duration::from_millis(200)).await;
    process.kill();

    let lines = read_lines(&log);
    let of_request = |line: &&Value| {
        line["level"] == "ERROR"
            && enclosing_spans(line).iter().any(|span| span["id"] == "look-me-up")
    };
    let about: Vec<&Value> = lines.iter().filter(of_request).collect();
    assert_eq!(about.len(), 1, "{about:#?}");
    let (line, request) = (about[0], &enclosing_spans(about[0])[0]);
    assert_eq!(
        (line["level"].as_str(), line["fields"]["code"].as_str()),
        (Some("ERROR"), Some("parse_damaged"))
    );
    assert!(line["fields"]["cause"].as_str().unwrap().contains("cloud.ply is missing"), "{line}");
    assert_eq!(
        (request["name"].as_str(), request["route"].as_str()),
        (Some("request"), Some("/v1/scenes/{scene_id}/cloud.ply"))
    );
    let of_job: Vec<&Value> = lines
        .iter()
        .filter(|line| enclosing_spans(line).iter().any(|span| span["id"] == job.id.as_str()))
        .collect();
    assert!(of_job.iter().any(|line| line["fields"]["message"] == "job succeeded"), "{of_job:#?}");
    let job_span = &enclosing_spans(of_job[0])[0];
    assert_eq!(
        (job_span["kind"].as_str(), job_span["subject"].as_str()),
        (Some("parse"), Some(created.scene.id.as_str()))
    );
    assert!(
        !lines.iter().any(|line| line["level"] == "ERROR" && line != about[0]),
        "a client error must not be logged as an error"
    );
}

/// API keys of callers, of the model, and in URLs never appear in the log, even at the most verbose
/// level.
#[tokio::test]
async fn secrets_never_reach_the_log() {
    let folder = tempfile::tempdir().unwrap();
    let data = camino::Utf8Path::from_path(folder.path()).unwrap();
    let log = data.join("log");
    let script = Script::default();
    let url = script.serve(vec![fails(500, "planted-model-key was wrong")]).await;
    let address =
        url.replace("http://", "http://user:planted-password@") + "?api-key=planted-in-address";
    let mut command = serve_command(&data.join("data"), "127.0.0.1:0");
    command
        .env("UNIGROUND_API_KEY", "planted-service-key")
        .env("UNIGROUND_VLM_API_KEY", "planted-model-key")
        .env("RUST_LOG", "trace")
        .args(["--vlm-url", &address, "--vlm-model", "scripted", "--vlm-attempts", "1"])
        .stderr(fs::File::create(&log).unwrap());
    let mut process = Process::spawn(&mut command);
    let own = process
        .client
        .request(Method::GET, "healthz")
        .build()
        .unwrap()
        .url()
        .origin()
        .ascii_serialization();
    process.client = Client::new(&own, Some("planted-service-key".into())).unwrap();
    let created =
        process.client.create_scene(None, "application/zip", Scan::neutral().zip()).await.unwrap();
    wait_for_job(&process.client, &created.job.unwrap().id).await;
    process.client.ground(&created.scene.id, &ask("the red sofa")).await.unwrap();
    process.kill();
    let log = fs::read_to_string(&log).unwrap();
    assert!(log.lines().count() > 100, "{}", log.lines().count());
    let told: Vec<&str> = log.lines().filter(|line| line.contains("planted")).take(3).collect();
    assert_eq!(told, [""; 0]);
}
