//! Budgets for model calls, and what happens when they are spent.

use super::disconnects::time_out_during_a_call;
use super::{
    QUERY, builtin_answer, corrections, request_by, six_field_reply, start_server, vlm_config,
};
use crate::scripted_model::{Script, Scripted, fails, says};
use crate::test_server::{TestServer, ask, expect_problem, open_database};
use camino::Utf8Path;
use jiff::Timestamp;
use serde_json::json;
use sqlx::Connection;
use std::collections::BTreeSet;
use uniground::config::{LimitsConfig, ModelsConfig, VlmConfig};
use uniground_types::many::ManyGroundRequest;
use uniground_types::question::{GroundRequest, ReasonerChoice};

#[tokio::test(flavor = "multi_thread")]
async fn a_search_over_many_scenes_asks_the_model_within_the_question_budget() {
    let script = Script::default();
    let dear = VlmConfig {
        vlm_prompt_usd: 1000.0,
        vlm_completion_usd: 5000.0,
        ..vlm_config(&script.serve(vec![says("-")]).await)
    };
    let (server, scene) = start_server(dear).await;
    let again = server.upload_and_parse(uniground_service::sample::LIVING_ROOM.to_vec()).await;
    let id = builtin_answer(&server, &scene).await.answer.predicted_id.unwrap();
    let asked = async |usd| {
        let request = ManyGroundRequest {
            reasoner: ReasonerChoice::Vlm,
            max_cost_usd: usd,
            ..ManyGroundRequest::new(QUERY)
        };
        server.client.ground_many(&request).await
    };
    script.next(vec![six_field_reply(id, "", true, 1), six_field_reply(id, "", true, 1)]);
    let found = asked(None).await.unwrap();
    let scenes: BTreeSet<&str> =
        found.answers.iter().map(|found| found.answer.scene_id.as_str()).collect();
    assert_eq!((scenes, script.calls()), (BTreeSet::from([scene.as_str(), again.id.as_str()]), 2));
    assert!(found.answers.iter().all(|found| found.answer.usage.cost_usd > 0.5), "{found:?}");
    // Too little for one call: the model is not called, and the answer says so.
    script.take();
    let error = expect_problem(asked(Some(0.5)).await);
    assert_eq!((error.status, error.code.as_str(), script.calls()), (402, "budget_spent", 0));
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn question_and_daily_budgets_are_enforced() {
    let script = Script::default();
    let url = script.serve(vec![says("-")]).await;
    // 700 and 40 tokens at 1000 and 5000 dollars per million: 0.9 dollars a call. The estimate
    // before the call is several dollars.
    let dear = VlmConfig {
        vlm_prompt_usd: 1000.0,
        vlm_completion_usd: 5000.0,
        vlm_daily_usd: Some(20.0),
        ..vlm_config(&url)
    };
    let (server, scene) = start_server(dear.clone()).await;
    let plain = builtin_answer(&server, &scene).await;
    script.next(vec![six_field_reply(plain.answer.predicted_id.unwrap(), "", true, 1)]);
    let limited = |reasoner, usd| GroundRequest { max_cost_usd: Some(usd), ..request_by(reasoner) };

    // With a budget of zero the model is not called.
    assert!(
        !server.client.ground(&scene, &limited(ReasonerChoice::Auto, 0.0)).await.unwrap().degraded
    );
    let error =
        expect_problem(server.client.ground(&scene, &limited(ReasonerChoice::Vlm, 0.0)).await);
    assert_eq!((error.status, error.code.as_str(), script.calls()), (402, "budget_spent", 0));
    // Too little for one call.
    let error =
        expect_problem(server.client.ground(&scene, &limited(ReasonerChoice::Vlm, 0.5)).await);
    assert_eq!((error.status, error.code.as_str(), script.calls()), (402, "budget_spent", 0));
    assert!(error.detail.contains("this question"), "{}", error.detail);
    let answer = server.client.ground(&scene, &limited(ReasonerChoice::Auto, 0.5)).await.unwrap();
    assert!(
        answer.degraded && corrections(&answer).contains("budget of this question"),
        "{answer:?}"
    );

    // If the model's server reports no token counts, they are estimated.
    let uncounted =
        json!({"choices": [{"message": {"content": "Predicted ID: none"}}], "usage": null});
    script.next(vec![Scripted::Json(200, uncounted)]);
    let answer = server.client.ground(&scene, &request_by(ReasonerChoice::Vlm)).await.unwrap();
    assert!(answer.usage.prompt_tokens > 1000 && answer.usage.cost_usd > 1.0, "{:?}", answer.usage);
    script.next(vec![six_field_reply(plain.answer.predicted_id.unwrap(), "", true, 1)]);
    script.take();

    // Every call counts towards the daily budget, also after a restart.
    let mut paid = 0;
    while server.client.ground(&scene, &request_by(ReasonerChoice::Vlm)).await.is_ok() {
        paid += 1;
        assert!(paid < 20, "the daily budget is never exhausted");
    }
    assert!(paid >= 1 && script.calls() == paid, "{paid} paid, {} calls", script.calls());
    let answer = server.client.ground(&scene, &ask(QUERY)).await.unwrap();
    assert!(
        answer.degraded && corrections(&answer).contains("budget of today"),
        "{}",
        corrections(&answer)
    );
    let data = server.stop_and_keep_data().await;
    let server =
        TestServer::start_on(data, LimitsConfig::default(), dear, ModelsConfig::builtin()).await;
    let error =
        expect_problem(server.client.ground(&scene, &request_by(ReasonerChoice::Vlm)).await);
    assert_eq!((error.code.as_str(), script.calls()), ("budget_spent", paid));
    server.stop().await;
}

/// A budget that cannot be enforced is refused at startup.
#[tokio::test(flavor = "multi_thread")]
async fn budgets_require_prices() {
    let script = Script::default();
    let free = VlmConfig {
        vlm_prompt_usd: 0.0,
        vlm_completion_usd: 0.0,
        ..vlm_config(&script.serve(vec![says("Predicted ID: none")]).await)
    };
    for (wrong, told) in [
        (VlmConfig { vlm_daily_usd: Some(1.0), ..free.clone() }, "--vlm-daily-usd requires"),
        (VlmConfig { vlm_prompt_usd: -1.0, ..free.clone() }, "--vlm-prompt-usd: must be 0 or more"),
        (VlmConfig { vlm_model: None, ..free.clone() }, "--vlm-url requires --vlm-model"),
    ] {
        let error = wrong
            .client(uniground_endpoints::chat::ReplayCache::Off)
            .map(|_| ())
            .unwrap_err()
            .to_string();
        assert!(error.contains(told), "{error}");
    }
    let (server, scene) = start_server(free).await;
    let limited = GroundRequest { max_cost_usd: Some(1.0), ..ask(QUERY) };
    let error = expect_problem(server.client.ground(&scene, &limited).await);
    assert_eq!(
        (error.status, error.errors[0].pointer.as_str(), script.calls()),
        (422, "/max_cost_usd", 0)
    );
    let unasked = GroundRequest { reasoner: ReasonerChoice::Builtin, ..limited };
    server.client.ground(&scene, &unasked).await.unwrap();
    server.stop().await;
}

/// Attempts without a response count as possibly billed, and a server that is killed during a call
/// remembers the reserved amount.
#[tokio::test(flavor = "multi_thread")]
async fn possibly_billed_calls_count_and_survive_a_restart() {
    let script = Script::default();
    let url = script.serve(vec![fails(503, "overloaded")]).await;
    let dear = VlmConfig {
        vlm_prompt_usd: 1000.0,
        vlm_completion_usd: 5000.0,
        vlm_daily_usd: Some(100.0),
        vlm_attempts: 2,
        ..vlm_config(&url)
    };
    let (server, scene) = start_server(dear.clone()).await;
    let spent = async |server: &TestServer| {
        let mut database = open_database(server.data()).await;
        let usd: Option<f64> = sqlx::query_scalar("SELECT sum(usd) FROM spending")
            .fetch_one(&mut database)
            .await
            .unwrap();
        let open: i64 = sqlx::query_scalar("SELECT count(*) FROM reservations")
            .fetch_one(&mut database)
            .await
            .unwrap();
        (usd.unwrap_or(0.0), open)
    };
    assert_eq!(
        expect_problem(server.client.ground(&scene, &request_by(ReasonerChoice::Vlm)).await).status,
        502
    );
    let (usd, open) = spent(&server).await;
    assert!(
        usd > 1.0 && open == 0 && script.calls() == 2,
        "two attempts behind an error of the server's own: {usd}"
    );
    // The request was refused before it was processed: nothing is billed.
    script.next(vec![fails(401, "who are you")]);
    assert_eq!(
        expect_problem(server.client.ground(&scene, &request_by(ReasonerChoice::Vlm)).await).status,
        502
    );
    assert_eq!(spent(&server).await, (usd, 0));

    // A caller that disconnects during a call is still charged for it.
    script.next(vec![Scripted::Stall]);
    time_out_during_a_call(&server, &scene, &script).await;
    while spent(&server).await.1 > 0 {
        tokio::time::sleep(std::time::Duration::from_millis(20)).await;
    }
    assert!(
        spent(&server).await.0 > usd + 0.5,
        "the call of the disconnected caller was not charged"
    );

    let data = server.stop_and_keep_data().await;
    let mut database = open_database(Utf8Path::from_path(data.path()).unwrap()).await;
    // The reserved amount of an expensive call that a killed server left open.
    let today = &Timestamp::now().to_string()[..10];
    sqlx::query("INSERT INTO reservations (id, day, usd) VALUES ('killed', $1, 99.0)")
        .bind(today)
        .execute(&mut database)
        .await
        .unwrap();
    database.close().await.unwrap();
    let server =
        TestServer::start_on(data, LimitsConfig::default(), dear, ModelsConfig::builtin()).await;
    assert_eq!(
        expect_problem(server.client.ground(&scene, &request_by(ReasonerChoice::Vlm)).await).code,
        "budget_spent"
    );
    assert!(spent(&server).await.0 > 99.0, "the call of the killed server was not charged");
    server.stop().await;
}
