//! A vision-language model decides. A scripted OpenAI-compatible server on loopback plays it, with
//! correct and incorrect replies.

use crate::scripted_model::{Script, Scripted, fails, says};
use crate::test_server::{TestServer, ask, expect_problem, wait_for_job};
use serde_json::{Value, json};
use std::fs;
use std::time::Duration;
use uniground::config::{LimitsConfig, RetentionConfig, VlmConfig};
use uniground_core::grounding::Status;
use uniground_types::answer::Answer;
use uniground_types::job::JobState;
use uniground_types::question::{Ablation, GroundRequest, PromptVersion, ReasonerChoice};
use uniground_types::transcript::PromptPart;

mod budgets;
mod disconnects;
mod failures;
mod naming;
mod photographs;
mod retries;
mod unlisted;

const QUERY: &str = "the mug on the coffee table";

fn sample_scan() -> Vec<u8> {
    fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/examples/living_room.zip")).unwrap()
}

/// Returns the configuration of a model with short timeouts.
pub fn vlm_config(url: &str) -> VlmConfig {
    VlmConfig {
        vlm_url: Some(url.to_owned()),
        vlm_model: Some("scripted".into()),
        vlm_prompt_usd: 2.0,
        vlm_completion_usd: 8.0,
        vlm_timeout_s: 2,
        vlm_backoff_ms: 1,
        ..VlmConfig::default()
    }
}

async fn start_server(vlm: VlmConfig) -> (TestServer, String) {
    let server = TestServer::start_configured(LimitsConfig::default(), vlm).await;
    let scene = server.upload_and_parse(sample_scan()).await.id;
    (server, scene)
}

fn request_by(reasoner: ReasonerChoice) -> GroundRequest {
    GroundRequest { reasoner, ..ask(QUERY) }
}

/// Returns the answer of the built-in reasoner.
async fn builtin_answer(server: &TestServer, scene: &str) -> Answer {
    server.client.ground(scene, &request_by(ReasonerChoice::Builtin)).await.unwrap()
}

pub fn six_field_reply(
    id: impl std::fmt::Display,
    names: &str,
    matches: bool,
    anchor: u32,
) -> Scripted {
    says(&format!(
        "Predicted ID: {id}\nExplanation: it is red and on the table\nCandidate Names: {names}\nTarget name matches?: {matches}\n\
         Anchor ID: {anchor}\nRelation used: on the coffee table"
    ))
}

/// Returns all texts of a request's user message.
fn user_text(body: &Value) -> String {
    let parts = body["messages"][1]["content"].as_array().unwrap();
    parts.iter().filter_map(|part| part["text"].as_str()).collect()
}

fn count_images(body: &Value) -> usize {
    let parts = body["messages"][1]["content"].as_array().unwrap();
    let pictures: Vec<&str> =
        parts.iter().filter_map(|part| part["image_url"]["url"].as_str()).collect();
    assert!(pictures.iter().all(|url| url.starts_with("data:image/jpeg;base64,/9j/")));
    pictures.len()
}

fn call_purposes(answer: &Answer) -> Vec<String> {
    answer.trace.as_ref().unwrap().calls.iter().map(|call| call.purpose.clone()).collect()
}

fn corrections(answer: &Answer) -> String {
    answer.trace.as_ref().unwrap().corrections.join("\n")
}

#[tokio::test(flavor = "multi_thread")]
async fn the_model_decides_and_its_evidence_is_stored() {
    let script = Script::default();
    let (server, scene) = start_server(vlm_config(&script.serve(vec![says("-")]).await)).await;
    let plain = builtin_answer(&server, &scene).await;
    assert_eq!((plain.models.reasoner.as_str(), script.calls()), ("builtin-3", 0));
    let ids: Vec<u32> = plain.candidates.as_ref().unwrap().iter().map(|c| c.id.0).collect();
    // Not the built-in reasoner's choice.
    let (chosen, anchor) = (ids[1], plain.answer.anchor_id.unwrap().0);
    script.next(vec![six_field_reply(
        chosen,
        &format!("{chosen} -> small red mug, 4711 -> ghost"),
        true,
        anchor,
    )]);

    let answer = server.client.ground(&scene, &ask(QUERY)).await.unwrap();
    assert_eq!(
        (answer.status, answer.answer.predicted_id.map(|id| id.0)),
        (Status::Grounded, Some(chosen))
    );
    assert_eq!(answer.aabb, Some(answer.candidates.as_ref().unwrap()[1].aabb));
    assert!(answer.oriented_box.is_some() && answer.confidence > 0.6, "{answer:?}");
    assert_eq!(answer.answer.candidate_names[&chosen], "small red mug");
    assert!(!answer.answer.candidate_names.contains_key(&4711));
    assert_eq!(answer.answer.relation_used.as_deref(), Some("on the coffee table"));
    assert_eq!(
        (answer.answer.anchor_id.map(|id| id.0), answer.answer.target_name_matches),
        (Some(anchor), Some(true))
    );
    assert_eq!((answer.models.reasoner.as_str(), answer.degraded), ("scripted (prompt 10)", false));
    assert_eq!((answer.usage.vlm_calls, answer.usage.prompt_tokens), (1, 700));
    assert!((answer.usage.cost_usd - (700.0 * 2.0 + 40.0 * 8.0) / 1e6).abs() < 1e-12);
    assert_eq!(call_purposes(&answer), ["spatial"]);
    assert!(
        answer.timings_ms.evidence > 0.0
            && answer.timings_ms.total
                >= answer.timings_ms.evidence + answer.timings_ms.reason - 1.0
    );

    // The request contains a render, a collage for each candidate and the anchor, then the text. It
    // sets neither temperature nor length.
    let sent = script.take().remove(0);
    let candidates = answer.candidates.as_ref().unwrap();
    let beside = usize::from(candidates.iter().all(|c| c.id.0 != anchor));
    assert_eq!(count_images(&sent), 1 + candidates.len() + beside);
    assert!(
        sent.get("temperature").is_none()
            && sent.get("max_tokens").is_none()
            && sent.get("stream").is_none()
    );
    assert!(user_text(&sent).ends_with(&format!("Query: \"{QUERY}\"")));

    // The stored evidence equals what was sent.
    let prompt = server.client.answer_prompt(&answer.id).await.unwrap();
    assert_eq!((prompt.model.as_str(), prompt.calls.len()), ("scripted", 1));
    let texts: String = prompt.calls[0]
        .user
        .iter()
        .filter_map(|p| if let PromptPart::Text { text } = p { Some(text.as_str()) } else { None })
        .collect();
    assert_eq!(texts, user_text(&sent));
    let shown: Vec<&str> = prompt.calls[0]
        .user
        .iter()
        .filter_map(
            |p| if let PromptPart::Picture { href } = p { Some(href.as_str()) } else { None },
        )
        .collect();
    assert_eq!(shown.len(), count_images(&sent));
    for (href, part) in shown.iter().zip(sent["messages"][1]["content"].as_array().unwrap()) {
        use base64::Engine;
        let bytes = server.client.bytes(href).await.unwrap();
        let url = format!(
            "data:image/jpeg;base64,{}",
            base64::engine::general_purpose::STANDARD.encode(&bytes)
        );
        assert_eq!(part["image_url"]["url"].as_str(), Some(url.as_str()), "{href}");
        image::load_from_memory(&bytes).unwrap();
    }
    assert_eq!(answer.evidence.as_ref().unwrap().len(), shown.len());
    let reply = server.client.answer_reply(&answer.id).await.unwrap();
    assert!(reply.calls[0].text.as_ref().unwrap().starts_with(&format!("Predicted ID: {chosen}")));
    assert_eq!(server.client.answer(&answer.id).await.unwrap().answer, answer.answer);

    // An answer of the built-in reasoner has an image and no prompt.
    server.client.bytes(&format!("v1/answers/{}/evidence/global.jpg", plain.id)).await.unwrap();
    let error = expect_problem(server.client.answer_prompt(&plain.id).await);
    assert_eq!((error.status, error.code.as_str()), (404, "no_transcript"));
    for name in ["candidate-4711.jpg", "prompt.json", "..%2Fprompt.jpg", "global.png"] {
        let error = expect_problem(
            server.client.bytes(&format!("v1/answers/{}/evidence/{name}", answer.id)).await,
        );
        assert_eq!(
            (error.status, error.code.as_str()),
            (404, "answer_picture_not_found"),
            "{name}"
        );
    }
    // Deleting the scene deletes the evidence.
    assert_eq!(server.list_folder("blobs/answers"), std::slice::from_ref(&answer.id));
    server.client.delete_scene(&scene).await.unwrap();
    assert!(
        server.list_folder("blobs/answers").is_empty(),
        "{:?}",
        server.list_folder("blobs/answers")
    );
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn inconsistent_replies_are_asked_again() {
    let script = Script::default();
    let (server, scene) = start_server(vlm_config(&script.serve(vec![says("-")]).await)).await;
    let plain = builtin_answer(&server, &scene).await;
    let ids: Vec<u32> = plain.candidates.as_ref().unwrap().iter().map(|c| c.id.0).collect();
    let (first, second) = (ids[0], ids[1]);
    let named = format!("{first} -> red mug, {second} -> white wall panel");
    let good = || six_field_reply(first, &named, true, 1);
    let grounded = async |answers: Vec<Scripted>| {
        script.take();
        script.next(answers);
        server.client.ground(&scene, &ask(QUERY)).await.unwrap()
    };

    // An id that is not a candidate: the model is asked again with the same images and told what
    // was wrong.
    let answer = grounded(vec![six_field_reply(4711, &named, true, 1), good()]).await;
    assert_eq!(
        (call_purposes(&answer), answer.answer.predicted_id.map(|id| id.0)),
        (vec!["spatial".into(), "out_of_set".into()], Some(first))
    );
    let sent = script.take();
    assert!(
        user_text(&sent[1]).contains("ID 4711, which is no candidate")
            && count_images(&sent[1]) == count_images(&sent[0])
    );
    assert!(
        corrections(&answer).contains("4711")
            && !answer.degraded
            && answer.usage.prompt_tokens == 1400
    );

    // An unreadable reply; two ids; an empty reply.
    for (text, why) in [
        ("I would say the mug.", "no \"Predicted ID\""),
        ("Predicted ID: 3 or 5", "both 3 and 5"),
        ("", "no \"Predicted ID\""),
    ] {
        let answer = grounded(vec![says(text), good()]).await;
        assert_eq!(call_purposes(&answer), ["spatial", "unreadable"], "{text}");
        assert!(corrections(&answer).contains(why), "{}", corrections(&answer));
    }

    // A name that contradicts the choice: the model is asked again with the render and the images
    // of the chosen candidate.
    let answer = grounded(vec![six_field_reply(second, &named, true, 1), good()]).await;
    assert_eq!(
        (call_purposes(&answer), answer.answer.predicted_id.map(|id| id.0)),
        (vec!["spatial".into(), "inconsistent".into()], Some(first))
    );
    let sent = script.take();
    assert!(
        user_text(&sent[1]).contains("it is named \"white wall panel\"")
            && count_images(&sent[1]) == 2,
        "{}",
        user_text(&sent[1])
    );
    // The model repeats its choice: that is its answer.
    let answer = grounded(vec![six_field_reply(second, &named, true, 1)]).await;
    assert_eq!(
        (call_purposes(&answer).len(), answer.answer.predicted_id.map(|id| id.0)),
        (2, Some(second))
    );
    assert!(answer.confidence < 0.7 && !answer.degraded, "{answer:?}");

    // Three replies with ids outside of the candidates: the built-in answer, marked as degraded; or
    // the only candidate with a matching name.
    let answer = grounded(vec![six_field_reply(4711, "", true, 1)]).await;
    assert_eq!((call_purposes(&answer).len(), script.calls(), answer.degraded), (3, 3, true));
    assert_eq!((&answer.answer, answer.models.reasoner.as_str()), (&plain.answer, "builtin-3"));
    assert!(
        corrections(&answer).contains("the model never chose a candidate"),
        "{}",
        corrections(&answer)
    );
    let answer = grounded(vec![six_field_reply(
        4711,
        &format!("{second} -> red mug, {first} -> wall"),
        true,
        1,
    )])
    .await;
    assert_eq!((answer.answer.predicted_id.map(|id| id.0), answer.degraded), (Some(second), true));
    assert!(
        answer.answer.explanation.contains("is the only candidate with a fitting name"),
        "{}",
        answer.answer.explanation
    );

    // Nothing matches: no box.
    let answer = grounded(vec![six_field_reply("none", &named, false, 1)]).await;
    assert_eq!(
        (answer.status, answer.aabb, call_purposes(&answer).len()),
        (Status::NoMatch, None, 1)
    );

    // The second call fails: the first answer is used.
    let answer =
        grounded(vec![six_field_reply(second, &named, true, 1), fails(401, "the key has expired")])
            .await;
    assert_eq!((answer.answer.predicted_id.map(|id| id.0), answer.degraded), (Some(second), false));
    assert!(
        corrections(&answer).contains("asking again failed")
            && answer.trace.unwrap().calls[1].error.as_ref().unwrap().contains("expired")
    );

    // Content as a list of parts; a reply of a megabyte.
    let parts = json!({"choices": [{"message": {"content": [{"type": "text", "text": "Predicted ID: "}, {"type": "text", "text": first.to_string()}]}}]});
    assert_eq!(
        grounded(vec![Scripted::Json(200, parts)]).await.answer.predicted_id.map(|id| id.0),
        Some(first)
    );
    let noise = "lorem ipsum ".repeat(90_000);
    let answer = grounded(vec![says(&format!(
        "{noise}\nPredicted ID: {first}\nExplanation: {noise}\nAnchor ID: 1\nRelation used: on"
    ))])
    .await;
    assert_eq!(answer.answer.predicted_id.map(|id| id.0), Some(first));
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn ablations_omit_what_they_name() {
    let script = Script::default();
    let (server, scene) = start_server(vlm_config(&script.serve(vec![says("-")]).await)).await;
    let plain = builtin_answer(&server, &scene).await;
    let count = plain.candidates.as_ref().unwrap().len().max(5);
    script.next(vec![six_field_reply(plain.answer.predicted_id.unwrap(), "", true, 1)]);
    for (ablation, pictures, says_first) in [
        (Ablation::Full, 1 + count, "Image 1 is a global render"),
        (Ablation::NoGlobal, count, "Images 1 to"),
        (Ablation::NoCandidate, 1, "Image 1 is a global render"),
        (Ablation::SimplePrompt, 1 + count, "Query: "),
        (Ablation::RawRender, 1, "Query: "),
        (Ablation::NoLoop, 1 + count, "Image 1 is a global render"),
    ] {
        script.take();
        let prompt = PromptVersion::Paper;
        server
            .client
            .ground(&scene, &GroundRequest { ablation, prompt, ..ask(QUERY) })
            .await
            .unwrap();
        let sent = script.take().remove(0);
        assert_eq!(count_images(&sent), pictures, "{ablation:?}");
        assert!(user_text(&sent).starts_with(says_first), "{ablation:?}: {}", user_text(&sent));
    }
    // Without a response format, prose is accepted.
    let id = plain.answer.predicted_id.unwrap();
    script.next(vec![says(&format!(
        "The object ID that best matches the query is **ID {id}**. It is on the table."
    ))]);
    let request = GroundRequest { ablation: Ablation::SimplePrompt, ..ask(QUERY) };
    let answer = server.client.ground(&scene, &request).await.unwrap();
    assert_eq!((answer.answer.predicted_id, call_purposes(&answer).len()), (Some(id), 1));
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_disconnected_caller_or_cancelled_job_stops_the_call() {
    let script = Script::default();
    let url = script.serve(vec![Scripted::Stall]).await;
    let (server, scene) = start_server(VlmConfig { vlm_timeout_s: 300, ..vlm_config(&url) }).await;
    let client = reqwest::Client::new();
    let request = client
        .post(format!("{}/v1/scenes/{scene}/ground", server.url()))
        .json(&request_by(ReasonerChoice::Vlm));
    let called = async {
        while script.calls() == 0 {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    tokio::select! {
        _ = request.send() => panic!("the model stalls, so there must be no answer"),
        called = tokio::time::timeout(Duration::from_mins(1), called) => called.unwrap(),
    }
    // The dropped request closed its connection, and the service closed the model's.
    tokio::time::timeout(Duration::from_secs(5), script.left.cancelled()).await.unwrap();
    // Cancelling a naming job does the same.
    let job = server.client.name_instances(&scene).await.unwrap();
    while script.calls() < 2 {
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    server.client.cancel_job(&job.id).await.unwrap();
    assert_eq!(wait_for_job(&server.client, &job.id).await.state, JobState::Cancelled);
    // A timeout of the question itself.
    disconnects::time_out_during_a_call(&server, &scene, &script).await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn evidence_is_not_stored_when_disabled() {
    let script = Script::default();
    let vlm = vlm_config(&script.serve(vec![says("Predicted ID: none\nExplanation: x")]).await);
    let limits = LimitsConfig {
        retention: RetentionConfig { keep_evidence_days: 0, ..RetentionConfig::default() },
        ..LimitsConfig::default()
    };
    let server = TestServer::start_configured(limits, vlm).await;
    let scene = server.upload_and_parse(sample_scan()).await.id;
    let answer = server.client.ground(&scene, &ask(QUERY)).await.unwrap();
    assert!(
        server.list_folder("blobs/answers").is_empty(),
        "{:?}",
        server.list_folder("blobs/answers")
    );
    assert_eq!(expect_problem(server.client.answer_reply(&answer.id).await).code, "no_transcript");
    assert!(
        server.client.bytes(&answer.evidence.unwrap()[0]).await.is_ok(),
        "a render is always available"
    );
    server.stop().await;
}

/// No stored file contains an API key.
#[tokio::test(flavor = "multi_thread")]
async fn model_api_keys_are_never_stored() {
    let script = Script::default();
    let folder = tempfile::tempdir().unwrap();
    let file = camino::Utf8PathBuf::from_path_buf(folder.path().join("key")).unwrap();
    fs::write(&file, "sk-very-secret\n").unwrap();
    let vlm = VlmConfig {
        vlm_api_key_file: Some(file),
        ..vlm_config(&script.serve(vec![fails(500, "no"), says("22")]).await)
    };
    let (server, scene) = start_server(vlm).await;
    server.client.ground(&scene, &ask(QUERY)).await.unwrap();
    assert_eq!(script.asked.lock().unwrap()[0].0.as_deref(), Some("Bearer sk-very-secret"));
    let data = server.stop_and_keep_data().await;
    let mut folders = vec![camino::Utf8PathBuf::from_path_buf(data.path().to_owned()).unwrap()];
    let mut looked_at = 0;
    while let Some(folder) = folders.pop() {
        for entry in folder.read_dir_utf8().unwrap().map(Result::unwrap) {
            if entry.file_type().unwrap().is_dir() {
                folders.push(entry.path().to_owned());
            } else {
                let bytes = fs::read(entry.path()).unwrap();
                assert!(!bytes.windows(14).any(|w| w == b"sk-very-secret"), "{}", entry.path());
                looked_at += 1;
            }
        }
    }
    assert!(looked_at > 20, "only {looked_at} files were checked");
}

fn run_eval(out: &camino::Utf8Path, args: &[&str]) -> (std::process::Output, Value) {
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_uniground"));
    let examples = concat!(env!("CARGO_MANIFEST_DIR"), "/examples");
    let output =
        command.args(["eval", examples, "--out", out.as_str()]).args(args).output().unwrap();
    let report = fs::read(out.join("report.json"))
        .ok()
        .and_then(|bytes| serde_json::from_slice(&bytes).ok());
    (output, report.unwrap_or_default())
}

/// Evaluates a model, with photographs and with names, within a budget and then from the recorded
/// replies.
#[test]
fn a_model_is_evaluated_and_its_replies_are_recorded() {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let script = Script::default();
    let url = runtime.block_on(script.serve(vec![six_field_reply(7, "7 -> thing", true, 1)]));
    let temporary = tempfile::tempdir().unwrap();
    let root = camino::Utf8PathBuf::from_path_buf(temporary.path().to_owned()).unwrap();
    let record = root.join("answers.jsonl");
    let matrix = "source=oracle;reasoner=builtin,vlm;evidence=full,cached_names";
    let model = [
        "--vlm-url",
        &url,
        "--vlm-model",
        "scripted",
        "--vlm-prompt-usd",
        "2",
        "--vlm-completion-usd",
        "8",
    ];
    let (output, recorded) = run_eval(
        &root.join("a"),
        &[&model[..], &["--matrix", matrix, "--record", record.as_str()]].concat(),
    );
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let cells = recorded["cells"].as_array().unwrap().clone();
    let calls = |cell: &Value| cell["figures"]["vlm_calls"].as_f64().unwrap();
    assert_eq!((cells.len(), calls(&cells[0])), (4, 0.0));
    assert!(
        calls(&cells[2]) >= 1.0 && cells[2]["figures"]["cost_usd"].as_f64().unwrap() > 0.0,
        "{}",
        cells[2]["figures"]
    );
    assert_eq!(cells[2]["models"]["reasoner"], "scripted (prompt 10)");
    assert!(
        script.take().iter().any(|body| count_images(body) >= 6),
        "annotated instances must have photographs"
    );

    let (output, replayed) = run_eval(
        &root.join("b"),
        &[
            "--matrix",
            matrix,
            "--replay",
            record.as_str(),
            "--vlm-prompt-usd",
            "2",
            "--vlm-completion-usd",
            "8",
        ],
    );
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert_eq!(script.calls(), 0);
    for (before, after) in cells.iter().zip(replayed["cells"].as_array().unwrap()) {
        for figure in ["complete", "vlm_calls", "cost_usd", "prompt_tokens"] {
            assert_eq!(before["figures"][figure], after["figures"][figure], "{figure}");
        }
    }
    // Each run has its own budget: questions beyond it fail with an error.
    let (output, _) = run_eval(
        &root.join("c"),
        &[&model[..], &["--matrix", "source=oracle;reasoner=vlm", "--max-usd", "0.03"]].concat(),
    );
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(
        told.contains("questions failed") && told.contains("the budget of this run is spent"),
        "{told}"
    );
    assert!(script.calls() >= 1 && script.calls() < 19, "{} calls", script.calls());
}
