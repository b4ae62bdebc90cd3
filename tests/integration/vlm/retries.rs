//! Questions repeated under the same idempotency key.

use super::{builtin_answer, request_by, six_field_reply, start_server, vlm_config};
use crate::scripted_model::{Script, Scripted, says};
use reqwest::{Method, Response};
use std::time::Duration;
use tokio::time::sleep;
use uniground_types::answer::Answer;
use uniground_types::problem::Problem;
use uniground_types::question::{GroundRequest, Include, ReasonerChoice};

async fn send_question(
    client: &uniground_client::Client,
    scene: &str,
    key: &str,
    request: &GroundRequest,
) -> Response {
    let asked = client
        .request(Method::POST, &format!("v1/scenes/{scene}/ground"))
        .header("idempotency-key", key);
    asked.json(request).send().await.unwrap()
}

/// Returns the answer and whether it is a replay.
async fn read_answer(response: Response) -> (Answer, bool) {
    let replayed = response.headers().get("idempotent-replayed").is_some_and(|told| told == "true");
    (response.json().await.unwrap(), replayed)
}

#[tokio::test(flavor = "multi_thread")]
async fn a_retry_is_not_billed_twice() {
    let script = Script::default();
    let url = script.serve(vec![says("-")]).await;
    let (server, scene) = start_server(vlm_config(&url)).await;
    let client = &server.client;
    let plain = builtin_answer(&server, &scene).await;
    script.next(vec![six_field_reply(plain.answer.predicted_id.unwrap(), "", true, 1)]);
    let asked = request_by(ReasonerChoice::Vlm);

    let (first, replayed) = read_answer(send_question(client, &scene, "k1", &asked).await).await;
    assert!(!replayed && first.usage.cost_usd > 0.0, "{:?}", first.usage);
    let (again, replayed) = read_answer(send_question(client, &scene, "k1", &asked).await).await;
    assert_eq!((&again, replayed, script.calls()), (&first, true, 1));
    // Another question needs another key, and the same question under another key is asked again.
    let other = GroundRequest { top_k: 3, ..asked.clone() };
    let refused: Problem = send_question(client, &scene, "k1", &other).await.json().await.unwrap();
    assert_eq!((refused.status, refused.code.as_str()), (422, "idempotency_key_reused"));
    let (own, replayed) = read_answer(send_question(client, &scene, "k2", &asked).await).await;
    assert!(own.id != first.id && !replayed, "{} {}", own.id, first.id);

    // Fields left out of the first response are left out of the replay.
    let brief = GroundRequest { include: Some(vec![Include::Trace]), ..asked.clone() };
    for replayed in [false, true] {
        let (answer, again) = read_answer(send_question(client, &scene, "k3", &brief).await).await;
        assert!(again == replayed && answer.candidates.is_none() && answer.trace.is_some());
    }
    let refused: Problem =
        send_question(client, &scene, &"k".repeat(300), &asked).await.json().await.unwrap();
    assert_eq!((refused.status, refused.errors[0].pointer.as_str()), (422, "Idempotency-Key"));
    server.stop().await;
}

/// A repeated request waits while the first is in progress, and a caller that disconnected gets its
/// answer.
#[tokio::test(flavor = "multi_thread")]
async fn a_lost_connection_causes_no_second_call() {
    let script = Script::default();
    let url = script.serve(vec![says("-")]).await;
    let (server, scene) = start_server(vlm_config(&url)).await;
    let client = &server.client;
    let id = builtin_answer(&server, &scene).await.answer.predicted_id.unwrap();
    let slow = |id| {
        Scripted::Slowly(Duration::from_millis(600), Box::new(six_field_reply(id, "", true, 1)))
    };
    script.next(vec![slow(id)]);
    let asked = request_by(ReasonerChoice::Vlm);
    let gone = tokio::time::timeout(
        Duration::from_millis(200),
        send_question(client, &scene, "k", &asked),
    )
    .await;
    assert!(gone.is_err(), "the client must time out before the model answers");
    let (one, two) = tokio::join!(
        send_question(client, &scene, "k", &asked),
        send_question(client, &scene, "k", &asked)
    );
    let (one, two) = (read_answer(one).await, read_answer(two).await);
    assert_eq!((&one, script.calls()), (&two, 1));
    assert!(one.1 && one.0.usage.cost_usd > 0.0, "both requests must get the same answer");
    // A question that failed can be asked again.
    script.next(vec![crate::scripted_model::fails(400, "no")]);
    assert_eq!(send_question(client, &scene, "f", &asked).await.status(), 502);
    script.next(vec![six_field_reply(id, "", true, 1)]);
    sleep(Duration::from_millis(50)).await;
    assert!(!read_answer(send_question(client, &scene, "f", &asked).await).await.1);
    server.stop().await;
}

/// An endpoint that comes up after the service is used at its first sign of life, by everybody, and
/// a question that only it can answer waits for it.
#[tokio::test(flavor = "multi_thread")]
async fn an_endpoint_that_comes_up_is_used_at_once() {
    let free = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let mut vlm = vlm_config(&format!("http://{free}/v1"));
    vlm.vlm_attempts = 1;
    let (server, scene) = start_server(vlm).await;
    let client = &server.client;
    let id = builtin_answer(&server, &scene).await.answer.predicted_id.unwrap();
    let asked = request_by(ReasonerChoice::Vlm);
    let refused = send_question(client, &scene, "a", &asked).await;
    assert!([502, 503].contains(&refused.status().as_u16()), "{}", refused.status());
    let waiting = GroundRequest { timeout_s: Some(30.0), ..asked.clone() };
    let waiting = tokio::spawn({
        let (client, scene) = (client.clone(), scene.clone());
        async move { client.ground(&scene, &waiting).await }
    });
    sleep(Duration::from_millis(300)).await;
    assert!(!waiting.is_finished());
    let script = Script::default();
    let reply =
        Scripted::Slowly(Duration::from_millis(300), Box::new(six_field_reply(id, "", true, 1)));
    script.serve_at(&free.to_string(), vec![reply]).await;
    waiting.await.unwrap().unwrap();
    let all = (0..12).map(|_| client.ground(&scene, &asked));
    let answers = futures::future::join_all(all).await;
    assert!(answers.iter().all(|answer| !answer.as_ref().unwrap().degraded), "{answers:?}");
    server.stop().await;
}
