//! Conversations: sessions, and items of a batch that follow earlier ones.

use crate::batches::{fetch_results, wait_for_batch};
use crate::test_scans::Scan;
use crate::test_server::{TestServer, ask, assert_contains, expect_problem, wait_for_job};
use serde_json::{Value, json};
use uniground_client::{Client, ClientError};
use uniground_types::answer::Answer;
use uniground_types::batch::{Batch, BatchRequest, BatchState};
use uniground_types::question::{GroundRequest, QuestionContext};
use uniground_types::scene::InstanceId;

fn in_session(query: &str, session: &str) -> GroundRequest {
    let context = QuestionContext { session: Some(session.into()), ..QuestionContext::default() };
    GroundRequest { context: Some(context), min_confidence: Some(0.0), ..ask(query) }
}

async fn ground(client: &Client, scene: &str, request: GroundRequest) -> Answer {
    client.ground(scene, &request).await.unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_question_follows_the_latest_answer_of_its_session() {
    let server = TestServer::start().await;
    let client = &server.client;
    let sample = uniground_service::sample::LIVING_ROOM.to_vec();
    let scene = server.upload_and_parse(sample).await.id;
    let sofa = ground(client, &scene, in_session("how big is the sofa?", "kim")).await;
    assert_eq!((sofa.session.as_deref(), &sofa.follows), (Some("kim"), &None));
    assert_eq!(sofa.understood_as, None);
    // Another conversation in between.
    let shelf = ground(client, &scene, in_session("how tall is the bookshelf?", "lee")).await;
    let stool = ground(client, &scene, in_session("and the stool?", "kim")).await;
    assert_eq!(stool.understood_as.as_deref(), Some("how big is the stool"));
    assert_eq!(stool.follows.as_ref(), Some(&sofa.id));
    let tv = ground(client, &scene, in_session("and the TV?", "kim")).await;
    assert_eq!(tv.follows.as_ref(), Some(&stool.id));
    let tv = ground(client, &scene, in_session("and the TV?", "lee")).await;
    assert_eq!(tv.follows.as_ref(), Some(&shelf.id));
    assert_eq!(tv.understood_as.as_deref(), Some("how tall is the tv"));
    assert_eq!(client.answer(&tv.id).await.unwrap(), tv);
    // "This" can be given in a session, too.
    let mut this = in_session("what is this?", "kim");
    this.context.as_mut().unwrap().instance = Some(InstanceId(1));
    assert_eq!(ground(client, &scene, this).await.answer.predicted_id, Some(InstanceId(1)));

    // A session is about one scene and one version of it.
    let other = server.upload_and_parse(Scan::frames_only().zip()).await.id;
    let first = ground(client, &other, in_session("how big is the box?", "kim")).await;
    assert_eq!(first.follows, None);
    let job = client.parse(&other, &json!({"preset": "paper"})).await.unwrap();
    wait_for_job(client, &job.id).await;
    let again = ground(client, &other, in_session("how big is the sofa?", "kim")).await;
    assert_eq!((again.parse_version, again.follows), (2, None));

    for (context, pointer) in [
        (json!({"session": ""}), "/context/session"),
        (json!({"session": "x".repeat(101)}), "/context/session"),
        (json!({"session": "a\nb"}), "/context/session"),
        (json!({"session": "kim", "answer_id": sofa.id}), "/context"),
        (json!({"item": 0}), "/context/item"),
        (json!({}), "/context"),
    ] {
        let context = serde_json::from_value(context).unwrap();
        let request = GroundRequest { context: Some(context), ..ask("and it?") };
        let problem = expect_problem(client.ground(&scene, &request).await);
        assert_eq!((problem.status, problem.code.as_str()), (422, "invalid_request"));
        assert_eq!(problem.errors[0].pointer, pointer);
    }
    server.stop().await;
}

async fn submit(client: &Client, items: Value) -> Result<Batch, ClientError> {
    let items = serde_json::from_value(items).unwrap();
    let request = BatchRequest { items, concurrency: Some(8), ..BatchRequest::default() };
    client.create_batch(&request, None).await
}

#[tokio::test(flavor = "multi_thread")]
async fn items_of_a_batch_follow_earlier_items() {
    let server = TestServer::start().await;
    let client = &server.client;
    let sample = uniground_service::sample::LIVING_ROOM.to_vec();
    let scene = &server.upload_and_parse(sample).await.id;
    let item = |query: &str, context: Value| {
        let mut item = json!({"scene_id": scene, "query": query, "min_confidence": 0.0});
        if !context.is_null() {
            item["context"] = context;
        }
        item
    };
    let chain = json!([
        item("how big is the sofa?", Value::Null),
        item("and the stool?", json!({"item": 0})),
        item("and the TV?", json!({"item": 1})),
        item("what is next to it?", json!({"item": 0})),
        item("what is this?", json!({"instance": 99_999})),
        item("and the lamp?", json!({"item": 4})),
    ]);
    let batch = submit(client, chain).await.unwrap();
    let batch = wait_for_batch(client, &batch.id).await;
    assert_eq!((batch.state, batch.done), (BatchState::Succeeded, 6));
    let results = fetch_results(client, &batch.id, 0, false).await;
    let answer = |i: usize| {
        let body = results[i].answer.clone().unwrap();
        serde_json::from_value::<Answer>(body).unwrap()
    };
    assert_eq!(answer(0).follows, None);
    for (i, earlier, understood) in [(1, 0, "how big is the stool"), (2, 1, "how big is the tv")] {
        assert_eq!(answer(i).follows, Some(results[earlier].answer_id.clone()));
        assert_eq!(answer(i).understood_as.as_deref(), Some(understood));
    }
    let sofa = answer(0).answer.predicted_id.unwrap();
    assert_eq!(answer(3).understood_as, Some(format!("what is next to #{sofa}")));
    // What follows a failed item fails.
    let errors: Vec<_> = results[4..].iter().map(|item| item.error.as_ref().unwrap()).collect();
    assert_contains(&errors[0].detail, "/context/instance");
    assert_contains(&errors[1].detail, "item 4 has no answer");

    // Nothing runs if a reference is invalid.
    let other = "01a1f829-2f28-76eb-afa7-c7b611e3e457";
    for (wrong, pointer) in [
        (json!([item("it", json!({"item": 0}))]), "/items/0/context/item"),
        (
            json!([item("the sofa", Value::Null), item("it", json!({"item": 2}))]),
            "/items/1/context/item",
        ),
        (
            json!([{"scene_id": other, "query": "a"}, item("it", json!({"item": 0}))]),
            "/items/1/context/item",
        ),
        (json!([item("it", json!({"session": "kim"}))]), "/items/0/context/session"),
    ] {
        let problem = expect_problem(submit(client, wrong).await);
        assert_eq!((problem.status, problem.code.as_str()), (422, "invalid_request"));
        assert_eq!(problem.errors[0].pointer, pointer);
    }
    assert_eq!(client.batches(10, None).await.unwrap().batches.len(), 1);
    server.stop().await;
}

/// One question at a time, and more questions than are read from the database at once.
#[tokio::test(flavor = "multi_thread")]
async fn long_chains_are_answered_in_order() {
    let server = TestServer::start().await;
    let client = &server.client;
    let scene = server.upload_and_parse(Scan::frames_only().zip()).await.id;
    let items: Vec<Value> = (0..600)
        .map(|i| match i {
            0 => json!({"scene_id": scene, "query": "how big is the blue box?"}),
            i => json!({"scene_id": scene, "query": "and the sofa?", "context": {"item": i - 1}}),
        })
        .collect();
    let batch = submit(client, items.into()).await.unwrap();
    let batch = wait_for_batch(client, &batch.id).await;
    assert_eq!((batch.state, batch.done), (BatchState::Succeeded, 600));
    assert_eq!(batch.by_status.get("failed"), None, "{:?}", batch.by_status);
    server.stop().await;
}
