//! Clients that send slowly do not block others.

use crate::scripted_model::{Script, Scripted};
use crate::test_scans::Scan;
use crate::test_server::TestServer;
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::time::{sleep, timeout};
use uniground::config::{LimitsConfig, VlmConfig};
use uniground_client::Client;
use uniground_types::problem::Problem;

/// The lowest connection limit that a server accepts.
const CONNECTIONS: u32 = 8;

fn few_connections() -> LimitsConfig {
    LimitsConfig { max_connections: CONNECTIONS, ..LimitsConfig::default() }
}

async fn connect(server: &TestServer, text: &str) -> TcpStream {
    let mut stream = TcpStream::connect(server.url().trim_start_matches("http://")).await.unwrap();
    stream.write_all(text.as_bytes()).await.unwrap();
    stream
}

/// Returns the head of a request with a body of 60 kB, and its first byte.
fn slow_request_start(path: &str, media_type: &str) -> String {
    format!(
        "POST {path} HTTP/1.1\r\nhost: 127.0.0.1\r\ncontent-type: {media_type}\r\n\
         accept: application/json, text/event-stream\r\ncontent-length: 60000\r\n\r\n "
    )
}

/// Returns whether a new client gets a response.
async fn is_answered(server: &TestServer) -> bool {
    let client = Client::new(&server.url(), None).unwrap();
    timeout(Duration::from_secs(20), client.bytes("healthz"))
        .await
        .is_ok_and(|answer| answer.is_ok())
}

#[tokio::test]
async fn slow_request_bodies_do_not_block_other_clients() {
    let server = TestServer::start_with(few_connections()).await;
    for (path, media_type) in [
        ("/mcp", "application/json"),
        ("/v1/batches", "application/json"),
        ("/v1/batches", "application/jsonl"),
        ("/v1/scenes", "application/zip"),
        ("/v1/ground", "application/json"),
    ] {
        let mut dripping = Vec::new();
        for _ in 0..3 * CONNECTIONS {
            dripping.push(connect(&server, &slow_request_start(path, media_type)).await);
        }
        for round in 0..3 {
            // Wait until the accepted requests are being read.
            sleep(Duration::from_millis(100)).await;
            assert!(is_answered(&server).await, "{path} as {media_type}, round {round}");
            for stream in &mut dripping {
                // Requests that lost their connection are closed.
                let _ = stream.write_all(b" ").await;
            }
        }
    }
    server.stop().await;
}

/// A large upload that makes progress is not disconnected.
#[tokio::test]
async fn an_upload_with_progress_is_not_disconnected() {
    const PIECE: usize = 64 << 10;
    let server = TestServer::start_with(few_connections()).await;
    let archive = Scan::neutral()
        .with(
            "noise.bin",
            (0..4 << 20)
                .map(|i: u32| (i.wrapping_mul(2_654_435_761) >> 13) as u8)
                .collect::<Vec<_>>(),
        )
        .tar();
    let head = format!(
        "POST /v1/scenes?parse=false HTTP/1.1\r\nhost: 127.0.0.1\r\nconnection: close\r\ncontent-length: {}\r\n\r\n",
        archive.len()
    );
    let mut upload = connect(&server, &head).await;
    let mut dripping = Vec::new();
    for piece in archive.chunks(PIECE) {
        upload.write_all(piece).await.unwrap();
        dripping.push(connect(&server, &slow_request_start("/mcp", "application/json")).await);
        sleep(Duration::from_millis(5)).await;
    }
    let mut answer = String::new();
    upload.read_to_string(&mut answer).await.unwrap();
    assert!(answer.starts_with("HTTP/1.1 202"), "{answer}");
    assert!(is_answered(&server).await, "a new client got no response");
    server.stop().await;
}

/// If every connection is busy with a request, a new one gets a regular problem response.
#[tokio::test]
async fn a_client_over_the_connection_limit_gets_a_problem() {
    let script = Script::default();
    let url = script.serve(vec![Scripted::Stall]).await;
    let vlm = VlmConfig {
        vlm_url: Some(url),
        vlm_model: Some("scripted".into()),
        ..VlmConfig::default()
    };
    let server = TestServer::start_configured(few_connections(), vlm).await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await.id;
    let body = r#"{"query": "the red sofa", "reasoner": "vlm"}"#;
    let question = format!(
        "POST /v1/scenes/{scene}/ground HTTP/1.1\r\nhost: 127.0.0.1\r\ncontent-type: application/json\r\ncontent-length: {}\r\n\r\n{body}",
        body.len()
    );
    let mut answered = Vec::new();
    for _ in 0..CONNECTIONS {
        answered.push(connect(&server, &question).await);
    }
    while script.calls() < CONNECTIONS as usize {
        sleep(Duration::from_millis(20)).await;
    }
    let mut refusal = String::new();
    connect(&server, "").await.read_to_string(&mut refusal).await.unwrap();
    let (head, body) = refusal.split_once("\r\n\r\n").unwrap();
    let problem: Problem = serde_json::from_str(body).unwrap();
    assert!(head.starts_with("HTTP/1.1 503") && head.contains("retry-after: 1"), "{head}");
    assert_eq!((problem.status, problem.code.as_str()), (503, "overloaded"));
    drop(answered);
    let mut tries = 0;
    while server.client.bytes("readyz").await.is_err() {
        tries += 1;
        assert!(tries < 100, "closed connections must be available again");
        sleep(Duration::from_millis(100)).await;
    }
    server.stop().await;
}
