//! Callers that disconnect during a model call.

use super::{request_by, six_field_reply, start_server, vlm_config};
use crate::scripted_model::{Script, Scripted};
use crate::test_server::{TestServer, expect_problem, open_database};
use std::time::Duration;
use tokio::io::AsyncWriteExt;
use tokio::net::TcpStream;
use tokio::time::{sleep, timeout};
use uniground::config::VlmConfig;
use uniground_types::question::{GroundRequest, ReasonerChoice};

/// Waits until a condition holds.
async fn wait_until(what: &str, mut is_so: impl AsyncFnMut() -> bool) {
    let wait = async {
        while !is_so().await {
            sleep(Duration::from_millis(20)).await;
        }
    };
    assert!(timeout(Duration::from_mins(1), wait).await.is_ok(), "never: {what}");
}

/// Returns the US dollars spent and the number of open calls with reserved money.
async fn fetch_spending(server: &TestServer) -> (f64, i64) {
    let mut database = open_database(server.data()).await;
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
async fn open_request(server: &TestServer, scene: &str, request: &GroundRequest) -> TcpStream {
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
async fn a_caller_that_disconnects_during_a_model_call_frees_its_permit() {
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
            ..vlm_config(&url)
        };
        let (server, scene) = start_server(one).await;
        let asked = request_by(ReasonerChoice::Vlm);
        let caller = open_request(&server, &scene, &asked).await;
        wait_until("the model is called", async || script.calls() == 1).await;
        assert_eq!(
            fetch_spending(&server).await,
            (0.0, 1),
            "{never:?}: money is reserved for the call"
        );
        assert!(
            has_metric(&server, "uniground_vlm_questions_waiting 1").await,
            "{never:?}: no question is waiting"
        );
        assert!(!script.left.is_cancelled(), "{never:?}: the call was cancelled too early");

        drop(caller);
        let left = timeout(Duration::from_mins(1), script.left.cancelled()).await;
        assert!(left.is_ok(), "{never:?}: the model's server is still being called");
        wait_until("the call is settled", async || fetch_spending(&server).await.1 == 0).await;
        assert!(
            fetch_spending(&server).await.0 > 0.5,
            "{never:?}: the abandoned call was not charged"
        );
        wait_until("its permit is free", async || {
            has_metric(&server, "uniground_vlm_questions_waiting 0").await
        })
        .await;
        assert!(
            has_metric(&server, "uniground_vlm_calls_total{outcome=\"abandoned\"} 1").await,
            "{never:?}: the call is not counted as abandoned"
        );

        script.next(vec![six_field_reply("none", "", true, 1)]);
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
        let limited = GroundRequest { timeout_s: Some(seconds), ..request_by(ReasonerChoice::Vlm) };
        assert_eq!(
            expect_problem(server.client.ground(scene, &limited).await).code,
            "question_timed_out"
        );
        if script.calls() > calls {
            return;
        }
    }
    panic!("no question timed out during its model call");
}
