//! Webhooks at the end of jobs.

use crate::test_scans::Scan;
use crate::test_server::{Process, serve_command, upload_and_parse, wait_for_job};
use axum::body::Bytes;
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use axum::routing::post;
use camino::Utf8Path;
use serde_json::{Value, json};
use std::process::Stdio;
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tokio::time::sleep;

/// A received message: the webhook's id and its body.
type ReceivedMessages = Arc<Mutex<Vec<(String, Value)>>>;

/// Accepts every message except the first.
async fn receive_webhook(
    State(heard): State<ReceivedMessages>,
    headers: HeaderMap,
    body: Bytes,
) -> StatusCode {
    assert!(
        headers["webhook-signature"].to_str().unwrap().starts_with("v1,")
            && headers.contains_key("webhook-timestamp")
    );
    let mut heard = heard.lock().unwrap();
    heard.push((
        headers["webhook-id"].to_str().unwrap().to_owned(),
        serde_json::from_slice(&body).unwrap(),
    ));
    if heard.len() == 1 { StatusCode::SERVICE_UNAVAILABLE } else { StatusCode::NO_CONTENT }
}

async fn wait_for_messages(heard: &ReceivedMessages, number: usize) -> Vec<(String, Value)> {
    for _ in 0..600 {
        if heard.lock().unwrap().len() >= number {
            break;
        }
        sleep(Duration::from_millis(50)).await;
    }
    heard.lock().unwrap().clone()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_webhook_is_retried_until_it_is_accepted() {
    let heard = ReceivedMessages::default();
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("http://{}/hook", listener.local_addr().unwrap());
    let router =
        axum::Router::new().route("/hook", post(receive_webhook)).with_state(heard.clone());
    tokio::spawn(async move { axum::serve(listener, router).await });

    let data = tempfile::tempdir().unwrap();
    let folder = Utf8Path::from_path(data.path()).unwrap();
    let start = |more: &[&str]| {
        let mut command = serve_command(folder, "127.0.0.1:0");
        command.args(["--webhook-url", &url]).args(more);
        command
            .env("UNIGROUND_WEBHOOK_SECRET", "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw")
            .stderr(Stdio::null());
        command
    };
    let refused = start(&[]).output().unwrap();
    assert_eq!(refused.status.code(), Some(1), "loopback addresses must be refused for webhooks");
    let process = Process::spawn(&mut start(&["--webhook-allow-private"]));
    let scene = upload_and_parse(&process.client, "application/zip", Scan::neutral().zip()).await;
    wait_for_messages(&heard, 1).await;
    // The message was not accepted and the server is killed: the next server sends it again.
    process.kill();
    let process = Process::spawn(&mut start(&["--webhook-allow-private"]));
    let told = wait_for_messages(&heard, 2).await;
    let [(first, event), (second, _)] = told.as_slice() else { panic!("{told:?}") };
    assert_eq!((first, &event["type"]), (second, &json!("job.succeeded")));
    let job = &event["data"]["job"];
    assert_eq!(
        (&job["subject"], &job["kind"], &event["timestamp"]),
        (&json!(scene.id), &json!("parse"), &job["finished_at"])
    );

    let batch = json!({"items": [{"query": "the red sofa", "scene_id": scene.id}]});
    let batch =
        process.client.create_batch(&serde_json::from_value(batch).unwrap(), None).await.unwrap();
    wait_for_job(&process.client, batch.job_id.as_deref().unwrap()).await;
    let told = wait_for_messages(&heard, 3).await;
    assert_eq!(
        (&told[2].1["data"]["batch"]["state"], told.len()),
        (&json!("succeeded"), 3),
        "{told:?}"
    );
    assert_eq!(process.terminate(), Some(0));
}
