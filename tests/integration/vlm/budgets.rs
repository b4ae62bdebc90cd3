//! What a model may cost, and what happens when that is spent.

use super::leaving::time_out_during_a_call;
use super::{QUERY, builtin, by, config, corrections, six_lines, start};
use crate::scripted_model::{Script, Scripted, fails, says};
use crate::server::{TestServer, ask, problem, rows};
use camino::Utf8Path;
use jiff::Timestamp;
use serde_json::json;
use sqlx::Connection;
use std::collections::BTreeSet;
use uniground::config::{LimitsConfig, ModelsConfig, VlmConfig};
use uniground_types::many::ManyGroundRequest;
use uniground_types::question::{GroundRequest, ReasonerChoice};

#[tokio::test(flavor = "multi_thread")]
async fn the_likeliest_of_many_scenes_are_asked_of_the_model_for_what_one_question_may_cost() {
    let script = Script::default();
    let dear = VlmConfig {
        vlm_prompt_usd: 1000.0,
        vlm_completion_usd: 5000.0,
        ..config(&script.serve(vec![says("-")]).await)
    };
    let (server, scene) = start(dear).await;
    let again = server.parsed(uniground_service::sample::LIVING_ROOM.to_vec()).await;
    let id = builtin(&server, &scene).await.answer.predicted_id.unwrap();
    let asked = async |usd| {
        let request = ManyGroundRequest {
            reasoner: ReasonerChoice::Vlm,
            max_cost_usd: usd,
            ..ManyGroundRequest::new(QUERY)
        };
        server.client.ground_many(&request).await
    };
    script.next(vec![six_lines(id, "", true, 1), six_lines(id, "", true, 1)]);
    let found = asked(None).await.unwrap();
    let scenes: BTreeSet<&str> =
        found.answers.iter().map(|found| found.answer.scene_id.as_str()).collect();
    assert_eq!((scenes, script.calls()), (BTreeSet::from([scene.as_str(), again.id.as_str()]), 2));
    assert!(found.answers.iter().all(|found| found.answer.usage.cost_usd > 0.5), "{found:?}");
    // Too little for one call: nobody is asked, and that is told.
    script.take();
    let error = problem(asked(Some(0.5)).await);
    assert_eq!((error.status, error.code.as_str(), script.calls()), (402, "budget_spent", 0));
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn money_ends() {
    let script = Script::default();
    let url = script.serve(vec![says("-")]).await;
    // 700 and 40 tokens at 1000 and 5000 dollars a million: 0.9 dollars a call, thought to be
    // several before it is made.
    let dear = VlmConfig {
        vlm_prompt_usd: 1000.0,
        vlm_completion_usd: 5000.0,
        vlm_daily_usd: Some(20.0),
        ..config(&url)
    };
    let (server, scene) = start(dear.clone()).await;
    let plain = builtin(&server, &scene).await;
    script.next(vec![six_lines(plain.answer.predicted_id.unwrap(), "", true, 1)]);
    let limited = |reasoner, usd| GroundRequest { max_cost_usd: Some(usd), ..by(reasoner) };

    // Nothing may be spent: nobody is asked.
    assert!(
        !server.client.ground(&scene, &limited(ReasonerChoice::Auto, 0.0)).await.unwrap().degraded
    );
    let error = problem(server.client.ground(&scene, &limited(ReasonerChoice::Vlm, 0.0)).await);
    assert_eq!((error.status, error.code.as_str(), script.calls()), (402, "budget_spent", 0));
    // Too little for one call.
    let error = problem(server.client.ground(&scene, &limited(ReasonerChoice::Vlm, 0.5)).await);
    assert_eq!((error.status, error.code.as_str(), script.calls()), (402, "budget_spent", 0));
    assert!(error.detail.contains("this question"), "{}", error.detail);
    let answer = server.client.ground(&scene, &limited(ReasonerChoice::Auto, 0.5)).await.unwrap();
    assert!(answer.degraded && corrections(&answer).contains("budget of this question"));

    // A server that does not count its tokens is not free.
    let uncounted =
        json!({"choices": [{"message": {"content": "Predicted ID: none"}}], "usage": null});
    script.next(vec![Scripted::Json(200, uncounted)]);
    let answer = server.client.ground(&scene, &by(ReasonerChoice::Vlm)).await.unwrap();
    assert!(answer.usage.prompt_tokens > 1000 && answer.usage.cost_usd > 1.0, "{:?}", answer.usage);
    script.next(vec![six_lines(plain.answer.predicted_id.unwrap(), "", true, 1)]);
    script.take();

    // The day's money is spent call by call, also by a server that starts again.
    let mut paid = 0;
    while server.client.ground(&scene, &by(ReasonerChoice::Vlm)).await.is_ok() {
        paid += 1;
        assert!(paid < 20, "the day's budget never ends");
    }
    assert!(paid >= 1 && script.calls() == paid);
    let answer = server.client.ground(&scene, &ask(QUERY)).await.unwrap();
    assert!(
        answer.degraded && corrections(&answer).contains("budget of today"),
        "{}",
        corrections(&answer)
    );
    let data = server.give_back().await;
    let server =
        TestServer::start_on(data, LimitsConfig::default(), dear, ModelsConfig::builtin()).await;
    let error = problem(server.client.ground(&scene, &by(ReasonerChoice::Vlm)).await);
    assert_eq!((error.code.as_str(), script.calls()), ("budget_spent", paid));
    server.stop().await;
}

/// What can not be held to is refused rather than ignored.
#[tokio::test(flavor = "multi_thread")]
async fn budgets_need_prices() {
    let script = Script::default();
    let free = VlmConfig {
        vlm_prompt_usd: 0.0,
        vlm_completion_usd: 0.0,
        ..config(&script.serve(vec![says("Predicted ID: none")]).await)
    };
    for (wrong, told) in [
        (VlmConfig { vlm_daily_usd: Some(1.0), ..free.clone() }, "--vlm-daily-usd needs"),
        (VlmConfig { vlm_prompt_usd: -1.0, ..free.clone() }, "--vlm-prompt-usd: must be 0 or more"),
        (VlmConfig { vlm_model: None, ..free.clone() }, "--vlm-url needs --vlm-model"),
    ] {
        let error = wrong
            .client(uniground_endpoints::chat::ReplayCache::Off)
            .map(|_| ())
            .unwrap_err()
            .to_string();
        assert!(error.contains(told), "{error}");
    }
    let (server, scene) = start(free).await;
    let limited = GroundRequest { max_cost_usd: Some(1.0), ..ask(QUERY) };
    let error = problem(server.client.ground(&scene, &limited).await);
    assert_eq!(
        (error.status, error.errors[0].pointer.as_str(), script.calls()),
        (422, "/max_cost_usd", 0)
    );
    let unasked = GroundRequest { reasoner: ReasonerChoice::Builtin, ..limited };
    assert!(server.client.ground(&scene, &unasked).await.is_ok());
    server.stop().await;
}

/// Attempts that got no answer may be billed all the same, and a server that is killed in mid-call
/// does not forget what was under way.
#[tokio::test(flavor = "multi_thread")]
async fn what_may_be_billed_counts_and_outlives_the_server() {
    let script = Script::default();
    let url = script.serve(vec![fails(503, "overloaded")]).await;
    let dear = VlmConfig {
        vlm_prompt_usd: 1000.0,
        vlm_completion_usd: 5000.0,
        vlm_daily_usd: Some(100.0),
        vlm_attempts: 2,
        ..config(&url)
    };
    let (server, scene) = start(dear.clone()).await;
    let spent = async |server: &TestServer| {
        let mut database = rows(server.data()).await;
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
    assert_eq!(problem(server.client.ground(&scene, &by(ReasonerChoice::Vlm)).await).status, 502);
    let (usd, open) = spent(&server).await;
    assert!(
        usd > 1.0 && open == 0 && script.calls() == 2,
        "two attempts behind an error of the server's own: {usd}"
    );
    // Refused at the door, nothing was bought.
    script.next(vec![fails(401, "who are you")]);
    assert_eq!(problem(server.client.ground(&scene, &by(ReasonerChoice::Vlm)).await).status, 502);
    assert_eq!(spent(&server).await, (usd, 0));

    // A caller that leaves while the model thinks has asked it all the same.
    script.next(vec![Scripted::Stall]);
    time_out_during_a_call(&server, &scene, &script).await;
    while spent(&server).await.1 > 0 {
        tokio::time::sleep(std::time::Duration::from_millis(20)).await;
    }
    assert!(spent(&server).await.0 > usd + 0.5);

    let data = server.give_back().await;
    let mut database = rows(Utf8Path::from_path(data.path()).unwrap()).await;
    // What a server leaves that is killed in the middle of a dear call.
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
        problem(server.client.ground(&scene, &by(ReasonerChoice::Vlm)).await).code,
        "budget_spent"
    );
    assert!(spent(&server).await.0 > 99.0);
    server.stop().await;
}
