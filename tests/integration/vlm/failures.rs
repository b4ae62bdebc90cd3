//! A model that fails, is down, or takes too long.

use super::{
    QUERY, builtin_answer, corrections, request_by, six_field_reply, start_server, vlm_config,
};
use crate::scripted_model::{Script, Scripted, fails, says};
use crate::test_server::{TestServer, ask, expect_problem};
use serde_json::json;
use std::time::Duration;
use uniground::config::VlmConfig;
use uniground_types::question::{GroundRequest, ReasonerChoice};

/// Asserts that questions do not wait for a model whose server is down.
async fn assert_unavailable_at_once(server: &TestServer, scene: &str) {
    let asked_at = std::time::Instant::now();
    let error = expect_problem(server.client.ground(scene, &request_by(ReasonerChoice::Vlm)).await);
    assert_eq!((error.status, error.code.as_str()), (503, "vlm_down"), "{}", error.detail);
    assert!(error.retry_after_s.is_some_and(|wait| (1..=10).contains(&wait)), "{error:?}");
    let answer = server.client.ground(scene, &ask(QUERY)).await.unwrap();
    assert!(
        answer.degraded && corrections(&answer).contains("is down"),
        "{}",
        corrections(&answer)
    );
    assert!(asked_at.elapsed() < Duration::from_secs(1), "{:?}", asked_at.elapsed());
}

/// A question with a timeout gets an answer in time, from the built-in reasoner if necessary.
#[tokio::test(flavor = "multi_thread")]
async fn the_built_in_answer_is_returned_at_the_timeout() {
    let script = Script::default();
    let url = script.serve(vec![Scripted::Stall]).await;
    let (server, scene) = start_server(vlm_config(&url)).await;
    let plain = builtin_answer(&server, &scene).await;
    let hurried = |reasoner| GroundRequest { timeout_s: Some(0.5), ..request_by(reasoner) };
    let answer = server.client.ground(&scene, &hurried(ReasonerChoice::Auto)).await.unwrap();
    assert!(answer.degraded && answer.answer == plain.answer, "{answer:?}");
    assert!(
        corrections(&answer).contains("did not answer within 0.5 s"),
        "{}",
        corrections(&answer)
    );
    let error = expect_problem(server.client.ground(&scene, &hurried(ReasonerChoice::Vlm)).await);
    assert_eq!((error.status, error.code.as_str()), (504, "question_timed_out"));
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_failing_model_is_reported_or_replaced() {
    let script = Script::default();
    let url = script.serve(vec![says("-")]).await;
    let (server, scene) = start_server(vlm_config(&url)).await;
    let plain = builtin_answer(&server, &scene).await;
    // The failure, the number of attempts, and the reported message.
    for (answers, attempts, told) in [
        (vec![fails(401, "bad key")], 1, "401 Unauthorized: bad key"),
        (vec![fails(404, "no such model")], 1, "no such model"),
        (vec![fails(500, "oops")], 5, "500 Internal Server Error: oops"),
        (vec![Scripted::After(429, "0")], 5, "429"),
        (vec![Scripted::Text("<html>".into())], 1, "check the address of --vlm-url"),
        (vec![Scripted::Json(200, json!({"object": "chat.completion"}))], 1, "it has no choices"),
        (
            vec![Scripted::Json(200, json!({"error": {"message": "no pictures", "code": 400}}))],
            1,
            "400 Bad Request: no pictures",
        ),
        (
            vec![Scripted::Json(
                200,
                json!({"choices": [{"finish_reason": "length", "message": {"content": ""}}]}),
            )],
            1,
            "finish_reason length",
        ),
        (vec![Scripted::Json(200, json!({"choices": []}))], 5, "it has no choices"),
        (vec![Scripted::Flood], 1, "longer than"),
    ] {
        script.take();
        script.next(answers);
        let error =
            expect_problem(server.client.ground(&scene, &request_by(ReasonerChoice::Vlm)).await);
        assert_eq!(
            (error.status, error.code.as_str(), script.calls()),
            (502, "vlm_unavailable", attempts),
            "{told}: {}",
            error.detail
        );
        assert!(
            error.detail.contains(told)
                && error.detail.contains(&format!("in {attempts} attempts")),
            "{told}: {}",
            error.detail
        );

        let answer = server.client.ground(&scene, &request_by(ReasonerChoice::Auto)).await.unwrap();
        assert!(
            answer.degraded
                && answer.models.reasoner == "builtin-3"
                && answer.answer == plain.answer,
            "{told}"
        );
        assert!(corrections(&answer).contains(told), "{}", corrections(&answer));
        let call = &answer.trace.unwrap().calls[0];
        assert_eq!(
            (call.attempts as usize, call.error.as_ref().is_some_and(|e| e.contains(told))),
            (attempts, true),
            "{told}"
        );
        assert_eq!(answer.usage.vlm_calls, 0);
        let reply = server.client.answer_reply(&answer.id).await.unwrap();
        assert!(
            reply.calls[0].text.is_none() && reply.calls[0].error.as_ref().unwrap().contains(told)
        );
    }
    // A requested `Retry-After` is honored.
    script.take();
    script.next(vec![
        Scripted::After(429, "1"),
        six_field_reply(plain.answer.predicted_id.unwrap(), "", true, 1),
    ]);
    let asked_at = std::time::Instant::now();
    let answer = server.client.ground(&scene, &request_by(ReasonerChoice::Vlm)).await.unwrap();
    assert_eq!(answer.trace.unwrap().calls[0].attempts, 2);
    assert!(asked_at.elapsed() >= Duration::from_secs(1), "{:?}", asked_at.elapsed());
    server.stop().await;

    // A body that never ends: from then on the server is considered down.
    script.next(vec![Scripted::Stall]);
    let (server, scene) =
        start_server(VlmConfig { vlm_attempts: 2, vlm_timeout_s: 1, ..vlm_config(&url) }).await;
    let error =
        expect_problem(server.client.ground(&scene, &request_by(ReasonerChoice::Vlm)).await);
    assert_eq!((error.status, error.code.as_str()), (502, "vlm_unavailable"));
    assert!(
        error.detail.contains("timed out") && error.detail.contains("in 2 attempts"),
        "{}",
        error.detail
    );
    assert_unavailable_at_once(&server, &scene).await;
    server.stop().await;
    // Nothing listens there; the server does not speak TLS.
    let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    for url in [format!("http://127.0.0.1:{port}/v1"), url.replace("http://", "https://")] {
        let (server, scene) =
            start_server(VlmConfig { vlm_attempts: 2, vlm_timeout_s: 1, ..vlm_config(&url) }).await;
        // If the startup probe is some seconds old, the first question tries the model.
        assert!(server.client.ground(&scene, &ask(QUERY)).await.unwrap().degraded);
        assert_unavailable_at_once(&server, &scene).await;
        server.stop().await;
    }
    // No model is configured: a question that requires one gets an error, any other the built-in
    // answer, which is not degraded.
    let (server, scene) = start_server(VlmConfig::default()).await;
    let error =
        expect_problem(server.client.ground(&scene, &request_by(ReasonerChoice::Vlm)).await);
    assert_eq!((error.status, error.code.as_str()), (409, "vlm_not_configured"));
    assert!(!server.client.ground(&scene, &ask(QUERY)).await.unwrap().degraded);
    assert_eq!(
        expect_problem(server.client.name_instances(&scene).await).code,
        "vlm_not_configured"
    );
    server.stop().await;
}
