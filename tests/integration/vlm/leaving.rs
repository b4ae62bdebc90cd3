//! Callers that disconnect during a model call.

use super::{by, config, six_lines, start};
use crate::scripted_model::{Script, Scripted};
use crate::server::{TestServer, problem, rows};
use std::time::Duration;
use tokio::io::AsyncWriteExt;
use tokio::net::TcpStream;
use tokio::time::{sleep, timeout};
use uniground::config::VlmConfig;
use uniground_types::question::{GroundRequest, ReasonerChoice};

/// Waits until a condition holds.
async fn until(what: &str, mut is_so: impl AsyncFnMut() -> bool) {
    let wait = async {
        while !is_so().await {
            sleep(Duration::from_millis(20)).await;
        }
    };
    assert!(timeout(Duration::from_mins(1), wait).await.is_ok(), "never: {what}");
}

/// Returns the US dollars spent and the number of open calls with reserved money.
async fn spending(server: &TestServer) -> (f64, i64) {
    let mut database = rows(server.data()).await;
    let usd: Option<f64> =
        sqlx::query_scalar("SELECT sum(usd) FROM spending").fetch_one(&mut database).await.unwrap();
    let reserved: i64 = sqlx::query_scalar("SELECT count(*) FROM reservations")
        .fetch_one(&mut database)
        .await
        .unwrap();
    (usd.unwrap_or(0.0), reserved)
}

async fn has_metric(server: &TestServer, line: &str) -> bool {
    let metrics = String::from_utf8(server.client.bytes("metrics").await.unwrap()).unwrap();
    metrics.lines().any(|metric| metric == line)
}

/// Asks a question over a connection of its own, which closes when the returned stream is dropped.
async fn send(server: &TestServer, scene: &str, request: &GroundRequest) -> TcpStream {
    let address = server.url().trim_start_matches("http://").to_owned();
    let body = serde_json::to_string(request).unwrap();
    let head = format!(
        "POST /v1/scenes/{scene}/ground HTTP/1.1\r\nhost: {address}\r\ncontent-type: application/json\r\ncontent-length: {}\r\n\r\n",
        body.len()
    );
    let mut stream = TcpStream::connect(&address).await.unwrap();
    stream.write_all((head + &body).as_bytes()).await.unwrap();
    stream
}

/// When the caller disconnects, the model call ends, its possible cost is recorded, and the next
/// question gets its permit, whether or not the model has begun to answer.
#[tokio::test(flavor = "multi_thread")]
async fn a_caller_that_hangs_up_during_a_model_call_stops_it_and_frees_its_place() {
    for never in [Scripted::Silent, Scripted::Stall] {
        let script = Script::default();
        let url = script.serve(vec![never.clone()]).await;
        // One call at a time, about a dollar each.
        let one = VlmConfig {
            vlm_prompt_usd: 1000.0,
            vlm_completion_usd: 5000.0,
            vlm_concurrency: 1,
            vlm_attempts: 1,
            vlm_timeout_s: 300,
            ..config(&url)
        };
        let (server, scene) = start(one).await;
        let asked = by(ReasonerChoice::Vlm);
        let caller = send(&server, &scene, &asked).await;
        until("the model is called", async || script.calls() == 1).await;
        assert_eq!(spending(&server).await, (0.0, 1), "{never:?}: money is reserved for the call");
        assert!(has_metric(&server, "uniground_vlm_questions_waiting 1").await);
        assert!(!script.left.is_cancelled(), "{never:?}: the call is under way");

        drop(caller);
        let left = timeout(Duration::from_mins(1), script.left.cancelled()).await;
        assert!(left.is_ok(), "{never:?}: the model's server is still being called");
        until("the call is settled", async || spending(&server).await.1 == 0).await;
        assert!(
            spending(&server).await.0 > 0.5,
            "{never:?}: the model was asked, whoever waits for it"
        );
        until("its place is free", async || {
            has_metric(&server, "uniground_vlm_questions_waiting 0").await
        })
        .await;
        assert!(has_metric(&server, "uniground_vlm_calls_total{outcome=\"abandoned\"} 1").await);

        script.next(vec![six_lines("none", "", true, 1)]);
        let next = server.client.ground(&scene, &asked).await.unwrap();
        assert_eq!(
            (next.usage.vlm_calls > 0, next.degraded),
            (true, false),
            "{never:?}: the only permit is free again"
        );
        server.stop().await;
    }
}

/// Asks with growing timeouts until one question times out during its model call.
pub async fn time_out_during_a_call(server: &TestServer, scene: &str, script: &Script) {
    let calls = script.calls();
    for seconds in [0.3, 1.0, 4.0, 16.0] {
        let limited = GroundRequest { timeout_s: Some(seconds), ..by(ReasonerChoice::Vlm) };
        assert_eq!(problem(server.client.ground(scene, &limited).await).code, "question_timed_out");
        if script.calls() > calls {
            return;
        }
    }
    panic!("the model is never called within a question's time");
}
