//! A chat model parses the questions. A scripted OpenAI-compatible server on loopback plays the
//! model.

use crate::scripted_model::{Script, Scripted, fails, says};
use crate::test_server::{TestServer, ask, assert_contains};
use crate::vlm::six_field_reply;
use camino::{Utf8Path, Utf8PathBuf};
use serde_json::{Value, json};
use std::fs;
use std::process::{Command, Output};
use std::time::Duration;
use uniground::config::{LimitsConfig, VlmConfig};
use uniground_client::ClientError;
use uniground_core::models::chat::{ChatError, ChatModel, ChatRequest, Part, Prices};
use uniground_endpoints::chat::{ChatClient, Endpoint, ReplayCache, RetryPolicy};
use uniground_types::question::{GroundRequest, ParserChoice, ReasonerChoice};

fn fast_retries() -> RetryPolicy {
    RetryPolicy {
        backoff: Duration::from_millis(1),
        longest_wait: Duration::from_millis(5),
        ..RetryPolicy::default()
    }
}

fn chat_client(base_url: String, replay_cache: ReplayCache) -> ChatClient {
    let prices = Prices { prompt_usd: 2.0, completion_usd: 8.0 };
    ChatClient::new(
        Endpoint {
            base_url,
            model: "scripted".into(),
            api_key: Some("sk-secret-key".into()),
            prices,
            concurrency: 4,
        },
        fast_retries(),
        replay_cache,
    )
    .unwrap()
}

fn chat_request(text: &str) -> ChatRequest {
    ChatRequest {
        system: "s".into(),
        user: vec![Part::Text(text.into())],
        schema: Some(("answer", json!({"type": "object"}))),
    }
}

/// An endpoint that only streams is asked for a stream, once.
#[tokio::test]
async fn endpoints_that_only_stream_are_asked_for_a_stream() {
    let script = Script::default();
    let parts = "data: {\"choices\":[{\"delta\":{\"content\":\"fi\"}}]}\n\ndata: {\"choices\":[{\"delta\":{\"content\":\"ne\"}}]}\n\ndata: [DONE]\n\n";
    let refused = fails(400, "This model only supports streaming: stream must be true");
    let url = script.serve(vec![refused.clone(), Scripted::Text(parts.into())]).await;
    let reply = chat_client(url, ReplayCache::Off).ask(&chat_request("a")).await.unwrap();
    let asked = script.take();
    assert_eq!((reply.text.as_str(), asked.len()), ("fine", 2));
    assert!(asked[0].get("stream").is_none() && asked[1]["stream"] == true, "{asked:?}");
    let url = script.serve(vec![refused]).await;
    chat_client(url, ReplayCache::Off).ask(&chat_request("a")).await.unwrap_err();
    assert!(script.calls() < 6, "{}", script.calls());
}

#[tokio::test]
async fn transient_errors_are_retried_and_others_are_reported() {
    let busy = || fails(429, "slow down");
    let script = Script::default();
    let url = script.serve(vec![busy(), fails(503, ""), says("fine")]).await;
    let reply = chat_client(url, ReplayCache::Off).ask(&chat_request("a")).await.unwrap();
    assert_eq!((reply.text.as_str(), reply.attempts, reply.prompt_tokens), ("fine", 3, 700));
    assert_eq!(script.asked.lock().unwrap()[0].0.as_deref(), Some("Bearer sk-secret-key"));

    // At most five attempts are made.
    let script = Script::default();
    let url = script.serve(vec![busy()]).await;
    let error = chat_client(url, ReplayCache::Off).ask(&chat_request("a")).await.unwrap_err();
    assert!(
        matches!(&error.error, ChatError::Refused { status, detail, .. } if *status == 429 && detail == "slow down"),
        "{error:?}"
    );
    assert_eq!(script.calls(), 5);

    // A wrong key fails at once, and the message does not contain it.
    let script = Script::default();
    let url = script.serve(vec![fails(401, "bad key: sk-secret-key")]).await;
    let error = chat_client(url, ReplayCache::Off).ask(&chat_request("a")).await.unwrap_err();
    assert!(
        !format!("{error:?} {error}").contains("sk-secret") && script.calls() == 1,
        "{error:?}"
    );
    assert!(error.to_string().contains("bad key: <key>"), "{error}");
}

/// Prompts and images are sent only to the configured host.
#[tokio::test]
async fn a_redirect_to_another_host_is_not_followed() {
    let (script, elsewhere) = (Script::default(), Script::default());
    let other = elsewhere.serve(vec![says("fine")]).await;
    let url = script.serve(vec![Scripted::Redirect(format!("{other}/chat/completions"))]).await;
    let error =
        chat_client(url.clone(), ReplayCache::Off).ask(&chat_request("a")).await.unwrap_err();
    assert!(matches!(&error.error, ChatError::Refused { status: 308, .. }), "{error:?}");
    assert_eq!((script.calls(), elsewhere.calls()), (1, 0));
    // A redirect within the same host is followed.
    script.next(vec![Scripted::Redirect(format!("{url}/chat/completions")), says("fine")]);
    assert_eq!(
        chat_client(url, ReplayCache::Off).ask(&chat_request("a")).await.unwrap().text,
        "fine"
    );
}

#[tokio::test]
async fn implausible_token_counts_are_ignored() {
    let script = Script::default();
    let counted = |prompt: u64, completion: u64| {
        let usage = json!({"prompt_tokens": prompt, "completion_tokens": completion});
        Scripted::Json(200, json!({"choices": [{"message": {"content": "fine"}}], "usage": usage}))
    };
    let url = script
        .serve(vec![counted(0, 0), counted(1_000_000_000_000_000, 1_000_000_000_000_000)])
        .await;
    let client = chat_client(url, ReplayCache::Off);
    for _ in 0..2 {
        let reply = client.ask(&chat_request("a")).await.unwrap();
        assert!(
            (1..1000).contains(&reply.prompt_tokens)
                && (1..1000).contains(&reply.completion_tokens),
            "{reply:?}"
        );
    }
}

#[tokio::test]
async fn a_retry_after_of_a_day_is_not_waited_for() {
    let script = Script::default();
    let url = script.serve(vec![Scripted::After(429, "86400")]).await;
    let failure = chat_client(url, ReplayCache::Off).ask(&chat_request("a")).await.unwrap_err();
    assert_eq!((failure.attempts, failure.lost), (1, 0));
}

#[tokio::test]
async fn a_server_without_schema_support_is_called_without_a_schema() {
    let script = Script::default();
    let url = script.serve(vec![fails(400, "unknown field response_format"), says("{}")]).await;
    chat_client(url, ReplayCache::Off).ask(&chat_request("a")).await.unwrap();
    let asked = script.asked.lock().unwrap();
    assert!(
        asked[0].1.get("response_format").is_some() && asked[1].1.get("response_format").is_none()
    );
}

fn mug_parse_reply() -> Scripted {
    let relation = json!([{"kind": "on", "words": "on", "anchors": [{"noun": "coffee table"}]}]);
    says(&json!({"target": {"noun": "mug", "relations": relation}}).to_string())
}

#[tokio::test]
async fn the_model_parses_questions_and_the_grammar_is_the_fallback() {
    let script = Script::default();
    let url =
        script.serve(vec![mug_parse_reply(), says("I would rather not."), fails(400, "no")]).await;
    let vlm = VlmConfig {
        vlm_url: Some(url),
        vlm_model: Some("scripted".into()),
        vlm_prompt_usd: 2.0,
        vlm_completion_usd: 8.0,
        ..VlmConfig::default()
    };
    let server = TestServer::start_configured(LimitsConfig::default(), vlm).await;
    let scene = server
        .upload_and_parse(
            fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/examples/living_room.zip")).unwrap(),
        )
        .await;
    let with_model = |query: &str| GroundRequest {
        parser: ParserChoice::Vlm,
        reasoner: ReasonerChoice::Builtin,
        ..ask(query)
    };

    // The grammar cannot parse these words; the model can.
    let answer = server
        .client
        .ground(&scene.id, &with_model("der Becher auf dem Couchtisch"))
        .await
        .unwrap();
    let builtin =
        GroundRequest { reasoner: ReasonerChoice::Builtin, ..ask("the mug on the coffee table") };
    let plain = server.client.ground(&scene.id, &builtin).await.unwrap();
    assert_eq!(
        (answer.answer.predicted_id, &answer.parsed_query.target),
        (plain.answer.predicted_id, &"mug".to_owned())
    );
    assert_eq!(
        (answer.usage.vlm_calls, answer.usage.prompt_tokens, answer.usage.completion_tokens),
        (1, 700, 40)
    );
    assert!(
        (answer.usage.cost_usd - (700.0 * 2.0 + 40.0 * 8.0) / 1e6).abs() < 1e-12,
        "{:?}",
        answer.usage
    );
    assert_eq!(answer.trace.as_ref().unwrap().calls[0].purpose, "parse");
    assert!(
        answer.models.parser.starts_with("scripted") && plain.models.parser.starts_with("builtin"),
        "{:?} {:?}",
        answer.models,
        plain.models
    );
    assert_eq!((plain.usage.vlm_calls, plain.usage.cost_usd), (0, 0.0));

    // After a refusal or an error the grammar parses the question, and the trace gives the reason.
    // Paid tokens are counted.
    for (calls, expected) in [(1, "no JSON object"), (0, "400 Bad Request: no")] {
        let answer = server
            .client
            .ground(&scene.id, &with_model("the mug on the coffee table"))
            .await
            .unwrap();
        assert_eq!(answer.answer.predicted_id, plain.answer.predicted_id);
        assert_eq!(answer.usage.vlm_calls, calls);
        let corrections = answer.trace.unwrap().corrections;
        assert!(corrections.len() == 1 && corrections[0].contains(expected), "{corrections:?}");
    }
    // With a budget of zero the model is not called.
    let before = script.calls();
    let unpaid =
        GroundRequest { max_cost_usd: Some(0.0), ..with_model("the mug on the coffee table") };
    assert_eq!(server.client.ground(&scene.id, &unpaid).await.unwrap().usage.vlm_calls, 0);
    assert_eq!(script.calls(), before);
    server.stop().await;

    let server = TestServer::start().await;
    let scene = server
        .upload_and_parse(
            fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/examples/living_room.zip")).unwrap(),
        )
        .await;
    match server.client.ground(&scene.id, &with_model("the mug")).await {
        Err(ClientError::Problem(problem)) => {
            assert_eq!((problem.code.as_str(), problem.status), ("vlm_not_configured", 409));
        }
        other => panic!("{other:?}"),
    }
    server.stop().await;
}

/// In automatic mode the grammar parses; the model parses only where the grammar is unsure and a
/// model also decides.
#[tokio::test]
async fn the_model_parses_questions_that_the_grammar_is_unsure_about() {
    let script = Script::default();
    let url = script.serve(vec![mug_parse_reply()]).await;
    let vlm = VlmConfig {
        vlm_url: Some(url),
        vlm_model: Some("scripted".into()),
        vlm_prompt_usd: 2.0,
        vlm_completion_usd: 8.0,
        ..VlmConfig::default()
    };
    let server = TestServer::start_configured(LimitsConfig::default(), vlm).await;
    let scene = server
        .upload_and_parse(
            fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/examples/living_room.zip")).unwrap(),
        )
        .await;
    let asked = async |request: GroundRequest| {
        let before = script.calls();
        let answer = server.client.ground(&scene.id, &request).await.unwrap();
        (answer, script.calls() - before)
    };
    let builtin = |query: &str| GroundRequest { reasoner: ReasonerChoice::Builtin, ..ask(query) };
    let (plain, calls) = asked(builtin("the mug on the coffee table")).await;
    assert_eq!(calls, 0);
    let mug = plain.answer.predicted_id.unwrap();
    let decides = || six_field_reply(mug, "", true, 1);

    // The grammar understands every word: the model decides but does not parse.
    script.next(vec![decides()]);
    let (answer, calls) = asked(ask("the mug on the coffee table")).await;
    assert!(calls == 1 && answer.models.parser.starts_with("builtin"), "{:?}", answer.models);

    // The grammar does not know this language: the model parses first.
    let doubtful = "der Becher auf dem Couchtisch";
    script.next(vec![mug_parse_reply(), decides()]);
    let (answer, calls) = asked(ask(doubtful)).await;
    let purposes: Vec<String> =
        answer.trace.as_ref().unwrap().calls.iter().map(|call| call.purpose.clone()).collect();
    assert!(calls == 2 && purposes == ["parse", "spatial"], "{purposes:?}");
    assert!(
        answer.models.parser.starts_with("scripted") && answer.parsed_query.target == "mug",
        "{:?}",
        answer.parsed_query
    );
    assert_eq!((answer.answer.predicted_id, answer.degraded), (Some(mug), false));

    // The model's parse is useless: the grammar's parse is used, and only the reason is reported.
    let mumbled = "the mug that frobnicates";
    script.next(vec![says("I would rather not."), decides()]);
    let (answer, calls) = asked(ask(mumbled)).await;
    let corrections = answer.trace.unwrap().corrections;
    assert!(
        calls == 2 && !answer.degraded && answer.models.parser.starts_with("builtin"),
        "{corrections:?}"
    );
    assert!(corrections.len() == 1 && corrections[0].contains("frobnicates"), "{corrections:?}");

    // The model does not parse if the request excludes a deciding model, any spending, or model
    // parsing.
    let unpaid = GroundRequest { max_cost_usd: Some(0.0), ..ask(doubtful) };
    for request in [builtin(doubtful), unpaid] {
        let (answer, calls) = asked(request).await;
        assert_eq!((calls, answer.usage.vlm_calls, answer.degraded), (0, 0, false));
    }
    script.next(vec![decides()]);
    let (answer, calls) =
        asked(GroundRequest { parser: ParserChoice::Builtin, ..ask(mumbled) }).await;
    assert!(calls == 1 && answer.models.parser.starts_with("builtin"), "{:?}", answer.models);
    server.stop().await;
}

fn run_eval(out: &Utf8Path, args: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_uniground"));
    let examples = concat!(env!("CARGO_MANIFEST_DIR"), "/examples");
    command
        .args([
            "eval",
            examples,
            "--out",
            out.as_str(),
            "--matrix",
            "source=oracle;parser=builtin,vlm",
        ])
        .args(args)
        .output()
        .unwrap()
}

#[test]
fn a_recorded_evaluation_is_replayed_without_calls() {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let script = Script::default();
    let url = runtime.block_on(script.serve(vec![mug_parse_reply()]));
    let temporary = tempfile::tempdir().unwrap();
    let root = Utf8PathBuf::from_path_buf(temporary.path().to_owned()).unwrap();
    let record = root.join("answers.jsonl");
    let model = ["--vlm-url", &url, "--vlm-model", "scripted", "--vlm-prompt-usd", "2"];
    let recorded =
        run_eval(&root.join("a"), &[&model[..], &["--record", record.as_str()]].concat());
    assert!(recorded.status.success(), "{}", String::from_utf8_lossy(&recorded.stderr));
    let calls = script.calls();
    assert_eq!(calls, 19, "each expression of one cell is one call");
    assert!(!fs::read_to_string(&record).unwrap().contains("127.0.0.1"));

    // A second recording does not pay again for recorded calls.
    run_eval(&root.join("b"), &[&model[..], &["--record", record.as_str()]].concat());
    assert_eq!(script.calls(), calls);
    // A replay needs no model and no address and gives the same figures.
    let replayed =
        run_eval(&root.join("c"), &["--replay", record.as_str(), "--vlm-prompt-usd", "2"]);
    assert!(replayed.status.success(), "{}", String::from_utf8_lossy(&replayed.stderr));
    assert_eq!(script.calls(), calls);
    let figures = |folder: &str| {
        let report: Value =
            serde_json::from_slice(&fs::read(root.join(folder).join("report.json")).unwrap())
                .unwrap();
        let mut figures = report["cells"][1]["figures"].clone();
        figures.as_object_mut().unwrap().remove("latency_ms");
        figures
    };
    assert_eq!(figures("a"), figures("c"));
    assert!(
        figures("c")["vlm_calls"] == 1.0 && figures("c")["cost_usd"].as_f64().unwrap() > 0.0,
        "{}",
        figures("c")
    );
    // A question that is not in the record fails with an error and is not answered by the grammar.
    fs::write(
        &record,
        fs::read_to_string(&record)
            .unwrap()
            .lines()
            .take(1)
            .map(|l| format!("{l}\n"))
            .collect::<String>(),
    )
    .unwrap();
    let partly = run_eval(&root.join("d"), &["--replay", record.as_str()]);
    assert!(partly.status.success(), "{}", String::from_utf8_lossy(&partly.stderr));
    assert_eq!(figures("d")["failed"], 18, "{}", figures("d"));
    let told = String::from_utf8_lossy(&partly.stderr).into_owned();
    assert!(
        told.contains("18 of 19 questions failed")
            && told.contains("the replay cache has no reply"),
        "{told}"
    );
    // An invalid record is reported with its line number.
    fs::write(&record, "{}\n{}\n").unwrap();
    let broken = run_eval(&root.join("e"), &["--replay", record.as_str()]);
    assert_contains(
        String::from_utf8_lossy(&broken.stderr),
        "answers.jsonl:1: not a recorded reply",
    );
}
