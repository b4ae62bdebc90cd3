//! Defaults that the items of a batch share. They are stored once, and the items behave as if each
//! contained them.

use crate::batches::{fetch_results, wait_for_batch};
use crate::test_scans::Scan;
use crate::test_server::{TestServer, open_database, post_raw};
use serde_json::{Map, Value, json};
use sha2::{Digest, Sha256};
use sqlx::AnyConnection;
use uniground_client::Client;
use uniground_types::batch::{BatchRequest, BatchResult, BatchState};

fn batch_request(items: &Value, defaults: &Value) -> BatchRequest {
    serde_json::from_value(json!({"items": items, "defaults": defaults, "label": "monday"}))
        .unwrap()
}

async fn query_number(rows: &mut AnyConnection, sql: &'static str, batch: &str) -> i64 {
    sqlx::query_scalar(sql).bind(batch).fetch_one(rows).await.unwrap()
}

const OF_ITEMS: &str =
    "SELECT CAST(sum(length(request)) AS bigint) FROM batch_items WHERE batch_id = $1";
const OF_DEFAULTS: &str = "SELECT CAST(length(defaults) AS bigint) FROM batches WHERE id = $1";

/// Returns a result without the fields that differ between two answers to the same question.
fn without_ids(result: &BatchResult) -> Value {
    let answer = result.answer.as_ref().map(|answer| {
        json!([answer["query"], answer["answer"], answer["candidates"], answer["confidence"]])
    });
    json!([result.item, result.scene_id, result.query, result.status, result.error, answer])
}

async fn results_without_ids(client: &Client, batch: &str) -> Vec<Value> {
    fetch_results(client, batch, 0, false).await.iter().map(without_ids).collect()
}

/// A request of 50 kB is stored as 50 kB, however many items share its defaults.
#[tokio::test(flavor = "multi_thread")]
async fn defaults_are_stored_once() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await.id;
    let mut items = vec![json!({}); 500];
    items[7] = json!({"query": "the red sofa"});
    let request =
        batch_request(&items.into(), &json!({"scene_id": scene, "query": "a".repeat(50_000)}));
    let batch = server.client.create_batch(&request, None).await.unwrap();
    let mut database = open_database(server.data()).await;
    let (of_items, of_defaults) = (
        query_number(&mut database, OF_ITEMS, &batch.id).await,
        query_number(&mut database, OF_DEFAULTS, &batch.id).await,
    );
    assert!(
        of_items < 2000 && (50_000..51_000).contains(&of_defaults),
        "{of_items} and {of_defaults} bytes"
    );
    let over = wait_for_batch(&server.client, &batch.id).await;
    assert_eq!(
        (over.by_status["failed"], over.by_status["uncertain"]),
        (499, 1),
        "a query that is too long fails each item"
    );
    let told = fetch_results(&server.client, &batch.id, 0, false).await;
    assert_eq!(
        (told[7].query.as_str(), told[8].query.len(), told[8].scene_id.as_str()),
        ("the red sofa", 50_000, scene.as_str())
    );
    server.stop().await;
}

/// An item's stored error does not repeat the defaults either.
#[tokio::test(flavor = "multi_thread")]
async fn a_stored_error_does_not_repeat_the_defaults() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await.id;
    let mut defaults = json!({"scene_id": scene, "query": "the red sofa"});
    defaults["x".repeat(50_000)] = 1.into();
    let request = batch_request(&vec![json!({}); 20].into(), &defaults);
    let batch = server.client.create_batch(&request, None).await.unwrap();
    assert_eq!(wait_for_batch(&server.client, &batch.id).await.by_status["failed"], 20);
    let mut database = open_database(server.data()).await;
    let of_errors =
        "SELECT CAST(sum(length(error)) AS bigint) FROM batch_items WHERE batch_id = $1";
    assert!(
        query_number(&mut database, of_errors, &batch.id).await < 25_000,
        "the stored errors repeat the defaults"
    );
    let told = fetch_results(&server.client, &batch.id, 0, false).await;
    assert!(
        told[0].error.as_ref().unwrap().detail.contains("unknown field `xxx"),
        "{:?}",
        told[0].error
    );
    server.stop().await;
}

/// A batch stored by an earlier version returns the same results and matches the same idempotency
/// key.
#[tokio::test(flavor = "multi_thread")]
async fn a_batch_stored_without_shared_defaults_gives_the_same_results() {
    let server = TestServer::start().await;
    let client = &server.client;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await.id;
    let defaults =
        json!({"scene_id": scene, "query": "the red sofa", "top_k": 3, "min_confidence": 0.1});
    let items = json!([
        {},
        {"query": "the fridge", "include": []},
        {"query": null},
        {"query": 7},
        {"top_k": 0},
        {"colour": "red"},
        {"scene_id": "018f0000-0000-7000-8000-000000000000"},
        {"scene_id": 3},
        {"query": "the blue box", "min_confidence": 0.99},
    ]);
    let request = batch_request(&items, &defaults);
    let batch = client.create_batch(&request, Some("monday")).await.unwrap();
    assert_eq!(wait_for_batch(client, &batch.id).await.state, BatchState::Succeeded);
    let of_today = results_without_ids(client, &batch.id).await;
    assert_eq!(of_today.len(), 9);
    assert_eq!(client.create_batch(&request, Some("monday")).await.unwrap().id, batch.id);

    // The earlier format: whole requests, and a digest over them.
    let mut database = open_database(server.data()).await;
    let mut digest = Sha256::new();
    digest.update(serde_json::to_vec(&(Some("monday"), None::<u32>, None::<f64>)).unwrap());
    for (item, own) in (0_i64..).zip(&request.items) {
        let mut all = request.defaults.clone();
        all.extend(own.clone());
        let scene = all.remove("scene_id").unwrap();
        let whole = Value::Object(all).to_string();
        digest.update(scene.as_str().unwrap_or_default());
        digest.update(&whole);
        digest.update(b"\n");
        let sql = "UPDATE batch_items SET request = $1, answer_id = $2, status = NULL, error_code = NULL, error = NULL
                   WHERE batch_id = $3 AND item = $4";
        sqlx::query(sql)
            .bind(whole)
            .bind(format!("018f0000-0000-7000-8000-00000000000{item}"))
            .bind(&batch.id)
            .bind(item)
            .execute(&mut database)
            .await
            .unwrap();
    }
    let digest: String = digest.finalize().iter().map(|byte| format!("{byte:02x}")).collect();
    let sql = "UPDATE batches SET defaults = NULL, request = $1, state = 'paused', finished_at = NULL WHERE id = $2";
    sqlx::query(sql).bind(digest).bind(&batch.id).execute(&mut database).await.unwrap();
    client.control_batch(&batch.id, "resume").await.unwrap();
    assert_eq!(wait_for_batch(client, &batch.id).await.state, BatchState::Succeeded);
    assert_eq!(results_without_ids(client, &batch.id).await, of_today);
    assert_eq!(
        fetch_results(client, &batch.id, 0, false).await[0].answer_id,
        "018f0000-0000-7000-8000-000000000000"
    );
    assert_eq!(
        client.create_batch(&request, Some("monday")).await.unwrap().id,
        batch.id,
        "the idempotency key is known"
    );
    server.stop().await;
}

/// A batch that is too large is refused as a whole. The error names the place, and no row is left.
#[tokio::test(flavor = "multi_thread")]
async fn a_batch_that_is_too_large_is_refused_and_leaves_no_rows() {
    let server = TestServer::start().await;
    let client = &server.client;
    let long = "a".repeat(70_000);
    let half: Map<String, Value> =
        [("a".to_owned(), "a".repeat(40_000).into())].into_iter().collect();
    let other_half: Map<String, Value> =
        [("b".to_owned(), "b".repeat(40_000).into())].into_iter().collect();
    let small_items = "{\"query\": \"a\"}\n".repeat(600);
    for (media_type, body, pointer) in [
        (
            "application/json",
            json!({"items": [{}], "defaults": {"query": long}}).to_string(),
            "/defaults",
        ),
        (
            "application/json",
            json!({"items": [{}], "defaults": {"scene_id": long}}).to_string(),
            "/defaults/scene_id",
        ),
        ("application/json", json!({"items": [{}, {"query": long}]}).to_string(), "/items/1"),
        (
            "application/jsonl",
            format!("{}\n{{}}\n", json!({"defaults": {"scene_id": "a".repeat(100)}})),
            "/defaults/scene_id",
        ),
        // Enough items before it that some have already been written.
        ("application/jsonl", format!("{small_items}{}\n", json!({"query": long})), "/items/600"),
        (
            "application/jsonl",
            format!("{}\n{}\n{{}}\n", json!({"defaults": half}), json!({"defaults": other_half})),
            "/defaults",
        ),
    ] {
        let problem = post_raw(client, "v1/batches", media_type, &body).await;
        assert_eq!(
            (problem.status, problem.errors[0].pointer.as_str()),
            (422, pointer),
            "{}",
            problem.detail
        );
        assert!(problem.detail.len() < 300, "{}", problem.detail);
    }
    let mut database = open_database(server.data()).await;
    for sql in ["SELECT count(*) FROM batches", "SELECT count(*) FROM batch_items"] {
        let left: i64 = sqlx::query_scalar(sql).fetch_one(&mut database).await.unwrap();
        assert_eq!(left, 0, "{sql}");
    }
    server.stop().await;
}
