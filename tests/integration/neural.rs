//! Neural models in the service: tiny bundles with random weights through a real server, and an
//! inference server that misbehaves.

use crate::server::{TestServer, ask, command, finished, problem};
use axum::Json;
use axum::extract::{Path, State};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use camino::{Utf8Path, Utf8PathBuf};
use serde_json::{Value, json};
use std::fs;
use std::process::Command;
use std::sync::Arc;
use std::time::Duration;
use uniground::config::{BundlesConfig, LimitsConfig, ModelsConfig, RuntimeConfig, VlmConfig};
use uniground_core::grounding::QueryText;
use uniground_core::models::neural::verify;
use uniground_core::models::neural::{ModelError, Models, Role};
use uniground_core::scene::Embeddings;
use uniground_endpoints::inference::RemoteServer;
use uniground_types::instances::Levels;
use uniground_types::job::Job;
use uniground_types::question::ShortlistRequest;

fn root() -> &'static Utf8Path {
    Utf8Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn sample() -> Vec<u8> {
    fs::read(root().join("examples/living_room.zip")).unwrap()
}

fn bundles() -> BundlesConfig {
    let library = std::env::var("ORT_DYLIB_PATH")
        .map_or_else(|_| root().join(".onnxruntime/libonnxruntime.so"), Utf8PathBuf::from);
    let runtime = RuntimeConfig { onnxruntime_lib: Some(library), ..RuntimeConfig::default() };
    BundlesConfig {
        models: root().join("crates/uniground-models/tests/data"),
        runtime,
        ..BundlesConfig::default()
    }
}

/// A segmenter and an encoder with random weights.
pub fn tiny() -> ModelsConfig {
    ModelsConfig {
        masks: "tiny-segmenter".into(),
        encoder: "tiny-dual-encoder".into(),
        bundles: bundles(),
    }
}

async fn server_with(models: ModelsConfig) -> TestServer {
    TestServer::start_on(
        tempfile::tempdir().unwrap(),
        LimitsConfig::default(),
        VlmConfig::default(),
        models,
    )
    .await
}

/// Few prompts: these masks mean nothing anyway.
fn quick() -> Value {
    json!({"sam_masks": {"points_per_side": 2, "min_predicted_iou": -10.0, "min_stability": 0.0}})
}

async fn reparsed(server: &TestServer, scene: &str, settings: Value) -> Job {
    let job = server.client.parse(scene, &json!({ "settings": settings })).await.unwrap();
    finished(&server.client, &job.id).await
}

#[tokio::test(flavor = "multi_thread")]
async fn models_take_part_from_the_upload_to_the_answer() {
    let server = server_with(tiny()).await;
    let models = server.client.models().await.unwrap().models;
    let roles: Vec<_> = models
        .iter()
        .map(|m| (m.name.as_str(), m.role, m.runs_on.as_str(), m.dimensions))
        .collect();
    assert_eq!(
        roles,
        [
            ("tiny-segmenter", Role::Masks, "cpu", None),
            ("tiny-dual-encoder", Role::Encoder, "cpu", Some(64))
        ]
    );
    assert!(models.iter().all(|m| m.fingerprint.len() == 64));

    let created = server.client.create_scene(None, "application/zip", sample()).await.unwrap();
    let scene = created.scene.id;
    // The upload's own parse may go on meanwhile; the quick one comes after it.
    let job = reparsed(&server, &scene, json!({ "parsing": quick() })).await;
    assert_eq!(job.error, None);
    let view = server.client.scene(&scene).await.unwrap();
    let used = view.models.unwrap();
    let label = |role: Role| {
        models
            .iter()
            .find(|m| m.role == role)
            .map(|m| format!("{}@{}", m.name, &m.fingerprint[..12]))
            .unwrap()
    };
    assert_eq!((used.masks, used.encoder.clone()), (label(Role::Masks), label(Role::Encoder)));

    let request = |query_text, calibrated| ShortlistRequest {
        query_text,
        calibrated,
        ..ShortlistRequest::new("the red sofa")
    };
    let plain = server.client.shortlist(&scene, &request(QueryText::Mean, false)).await.unwrap();
    assert_eq!((plain.candidates.len(), plain.encoder.as_str()), (5, used.encoder.as_str()));
    assert!(plain.candidates.windows(2).all(|pair| pair[0].score >= pair[1].score));
    assert_eq!(
        plain,
        server.client.shortlist(&scene, &request(QueryText::Mean, false)).await.unwrap()
    );
    let target = server.client.shortlist(&scene, &request(QueryText::Target, false)).await.unwrap();
    assert_ne!(target.candidates, plain.candidates, "other words are compared");
    let calibrated =
        server.client.shortlist(&scene, &request(QueryText::Mean, true)).await.unwrap();
    assert_ne!(calibrated.candidates, plain.candidates);
    let long = ShortlistRequest::new("the chair ".repeat(30));
    assert!(server.client.shortlist(&scene, &long).await.unwrap().cut && !plain.cut);

    let answer = server.client.ground(&scene, &ask("the sofa")).await.unwrap();
    assert_eq!((answer.models.encoder, answer.degraded), (used.encoder, false));

    // One row per instance, in a format numpy reads.
    let rows = server.client.bytes(&format!("v1/scenes/{scene}/embeddings.npy")).await.unwrap();
    assert!(rows.starts_with(b"\x93NUMPY"));
    let norms = fs::read(
        server
            .data()
            .join("blobs/parses")
            .join(server.stored("blobs/parses").into_iter().max().unwrap()) // the latest
            .join("embedding_norms.npy"),
    )
    .unwrap();
    let instances = server.client.all_instances(&scene, Levels::All).await.unwrap();
    assert_eq!(
        Embeddings::read(&rows, &norms).map(|e| (e.len(), e.dim())).unwrap(),
        (instances.len(), 64)
    );

    // The same settings again: nothing is computed.
    let again = reparsed(&server, &scene, json!({ "parsing": quick() })).await;
    assert!(again.message.unwrap_or_default().contains("stored parse"));

    // The built-in parts on demand.
    let builtin = json!({"models": {"masks": "builtin", "encoder": "builtin"}});
    reparsed(&server, &scene, builtin).await;
    let used = server.client.scene(&scene).await.unwrap().models.unwrap();
    assert_eq!((used.masks.as_str(), used.encoder.as_str()), ("rgbd-2", "attributes-2"));
    let error = problem(server.client.bytes(&format!("v1/scenes/{scene}/embeddings.npy")).await);
    assert_eq!((error.status, error.code.as_str()), (404, "no_embeddings"));
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_scene_parsed_with_another_encoder_says_so() {
    let server = server_with(ModelsConfig { masks: "rgbd".into(), ..tiny() }).await;
    let scene = server.parsed(sample()).await.id;
    let data = server.give_back().await;
    let plain = TestServer::start_on(
        data,
        LimitsConfig::default(),
        VlmConfig::default(),
        ModelsConfig::builtin(),
    )
    .await;
    let error = problem(plain.client.ground(&scene, &ask("the sofa")).await);
    assert_eq!((error.status, error.code.as_str()), (409, "encoder_changed"));
    assert!(
        error.detail.contains("tiny-dual-encoder@") && error.detail.contains("attributes-2"),
        "{}",
        error.detail
    );
    let mut allowed = ask("the sofa");
    allowed.allow_builtin = true;
    let answer = plain.client.ground(&scene, &allowed).await.unwrap();
    assert!(answer.degraded && answer.models.encoder == "attributes-2");
    assert!(answer.trace.unwrap().corrections[0].contains("parse it again"));
    let listed = plain
        .client
        .shortlist(
            &scene,
            &ShortlistRequest { allow_builtin: true, ..ShortlistRequest::new("the sofa") },
        )
        .await
        .unwrap();
    assert_eq!(listed.encoder, "attributes-2");
    plain.stop().await;
}

#[test]
fn a_server_whose_models_are_wrong_does_not_start() {
    let data = tempfile::tempdir().unwrap();
    let data = Utf8Path::from_path(data.path()).unwrap();
    let library = bundles().runtime.onnxruntime_lib.unwrap();
    let nowhere = ["--onnxruntime-lib", "/nowhere/libonnxruntime.so"];
    let there = ["--onnxruntime-lib", library.as_str()];
    for (flags, expected) in [
        (
            [&nowhere[..], &["--encoder", "tiny-dual-encoder"]].concat(),
            "/nowhere/libonnxruntime.so",
        ),
        (
            [
                &["--onnxruntime-lib", concat!(env!("CARGO_MANIFEST_DIR"), "/Cargo.toml")][..],
                &["--encoder", "tiny-dual-encoder"],
            ]
            .concat(),
            "Cargo.toml",
        ),
        ([&there[..], &["--encoder", "no-such-bundle"]].concat(), "no-such-bundle/model.json"),
        ([&there[..], &["--masks", "tiny-dual-encoder"]].concat(), "promptable-segmenter"),
        (
            [&there[..], &["--encoder", "tiny-dual-encoder", "--provider", "cuda"]].concat(),
            "cuda is not there",
        ),
        (
            vec![
                "--encoder",
                "tiny-dual-encoder",
                "--inference-url",
                "http://127.0.0.1:9",
                "--inference-timeout-s",
                "1",
            ],
            "127.0.0.1:9",
        ),
    ] {
        let mut server = command(data, "127.0.0.1:0");
        let output = server
            .args(&flags)
            .args(["--models", root().join("crates/uniground-models/tests/data").as_str()])
            .output()
            .unwrap();
        let told = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{flags:?}: {told}");
        assert!(told.contains(expected), "{expected}: {told}");
    }
}

/// How an inference server behaves when it is asked to compute.
/// What lies in the folder, and whether it works, from the command line.
#[test]
fn bundles_are_listed_and_verified() {
    let (folder, library) = (
        root().join("crates/uniground-models/tests/data"),
        bundles().runtime.onnxruntime_lib.unwrap(),
    );
    let models = |args: &[&str]| {
        let mut program = Command::new(env!("CARGO_BIN_EXE_uniground"));
        let output =
            program.arg("models").args(args).args(["--models", folder.as_str()]).output().unwrap();
        let told = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
        (output.status.code(), told(&output.stdout), told(&output.stderr))
    };
    let (code, listed, _) = models(&["list"]);
    assert_eq!(code, Some(0));
    let row =
        |name: &str| listed.lines().find(|line| line.contains(name)).unwrap_or_default().to_owned();
    assert!(
        row("tiny-dual-encoder").contains("--encoder")
            && row("tiny-segmenter-sam").contains("--masks"),
        "{listed}"
    );

    let verify = |more: &[&str]| {
        models(&[&["verify", "--onnxruntime-lib", library.as_str()], more].concat())
    };
    let (code, verified, _) = verify(&["--json"]);
    let loaded: Value = serde_json::from_str(&verified).unwrap();
    assert_eq!((code, loaded.as_array().map(Vec::len)), (Some(0), Some(3)), "{verified}");
    let (code, verified, told) = verify(&["tiny-dual-encoder", "no-such-bundle"]);
    assert_eq!(code, Some(1));
    assert!(
        verified.contains("tiny-dual-encoder works as --encoder on cpu, 64 dimensions"),
        "{verified}"
    );
    assert!(
        told.contains("no-such-bundle/model.json") && told.contains("1 of 2 bundles do not work"),
        "{told}"
    );
}

#[derive(Debug, Clone, Copy)]
enum Mood {
    Hangs,
    Garbage,
    Unavailable,
    NotANumber,
    Short,
    /// Right answers, as plain JSON: refuses raw bytes.
    PlainOnly,
    /// Right at first, then gone.
    FailsAfter(usize),
}

#[derive(Clone)]
struct Remote {
    mood: Mood,
    asked: Arc<std::sync::atomic::AtomicUsize>,
}

/// Serves the networks of the tiny dual encoder: the same embedding for everything.
async fn serve(mood: Mood) -> String {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let router = axum::Router::new()
        .route("/v2/models/{name}", get(describe))
        .route("/v2/models/{name}/infer", post(infer))
        .with_state(Remote { mood, asked: Arc::default() });
    tokio::spawn(async move { axum::serve(listener, router).await });
    format!("http://{address}")
}

async fn describe(Path(name): Path<String>) -> Json<Value> {
    let (input, output, shape) = match name.ends_with("-image") {
        true => (vec![("pixel_values", "FP32", json!([-1, 3, 64, 64]))], "image_embeds", [-1, 64]),
        false => (
            vec![
                ("input_ids", "INT64", json!([-1, 16])),
                ("attention_mask", "INT64", json!([-1, 16])),
            ],
            "text_embeds",
            [-1, 64],
        ),
    };
    let inputs: Vec<Value> = input
        .into_iter()
        .map(|(name, datatype, shape)| json!({"name": name, "datatype": datatype, "shape": shape}))
        .collect();
    Json(
        json!({"name": name, "versions": ["1"], "platform": "test", "inputs": inputs, "outputs": [{"name": output, "datatype": "FP32", "shape": shape}]}),
    )
}

async fn infer(
    State(remote): State<Remote>,
    Path(name): Path<String>,
    headers: axum::http::HeaderMap,
    body: axum::body::Bytes,
) -> Response {
    let asked = remote.asked.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
    let header = headers
        .get("Inference-Header-Content-Length")
        .and_then(|v| v.to_str().unwrap().parse::<usize>().ok());
    let request: Value = serde_json::from_slice(&body[..header.unwrap_or(body.len())]).unwrap();
    let count = request["inputs"][0]["shape"][0].as_u64().unwrap() as usize;
    let output = if name.ends_with("-image") { "image_embeds" } else { "text_embeds" };
    let right = |values: usize| {
        let data: Vec<f32> = (0..values).map(|i| (i % 64) as f32 + 1.0).collect();
        Json(json!({"outputs": [{"name": output, "datatype": "FP32", "shape": [count, 64], "data": data}]})).into_response()
    };
    match remote.mood {
        Mood::Hangs => {
            tokio::time::sleep(Duration::from_mins(1)).await;
            right(count * 64)
        }
        Mood::Garbage => "<html>hello</html>".into_response(),
        Mood::Unavailable => {
            (StatusCode::SERVICE_UNAVAILABLE, [("retry-after", "0")], "busy").into_response()
        }
        Mood::NotANumber => {
            let header = json!({"outputs": [{"name": output, "datatype": "FP32", "shape": [count, 64], "parameters": {"binary_data_size": count * 256}}]}).to_string();
            let mut answer = header.clone().into_bytes();
            answer.extend(std::iter::repeat_n(f32::NAN.to_le_bytes(), count * 64).flatten());
            ([("Inference-Header-Content-Length", header.len().to_string())], answer)
                .into_response()
        }
        Mood::Short => right(count * 64 - 1),
        Mood::PlainOnly if header.is_some() => {
            (StatusCode::BAD_REQUEST, "what is this?").into_response()
        }
        Mood::FailsAfter(calls) if asked >= calls => {
            (StatusCode::SERVICE_UNAVAILABLE, [("retry-after", "0")], "gone").into_response()
        }
        Mood::PlainOnly | Mood::FailsAfter(_) => right(count * 64),
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_misbehaving_inference_server_is_told_at_load() {
    for (mood, expected) in [
        (Mood::Hangs, "timed out"),
        (Mood::Garbage, "the answer is none"),
        (Mood::Unavailable, "503 Service Unavailable: busy (4 attempts)"),
        (Mood::NotANumber, "no numbers"),
        (Mood::Short, "values for the shape"),
    ] {
        let address = serve(mood).await;
        let loaded = tokio::task::spawn_blocking(move || {
            let engine = RemoteServer::new(&address, Duration::from_millis(400)).unwrap();
            verify(&engine, &root().join("crates/uniground-models/tests/data/tiny-dual-encoder"))
        });
        let error = loaded.await.unwrap().unwrap_err();
        assert!(error.to_string().contains(expected), "{mood:?}: {error}");
        assert!(
            matches!(error, ModelError::Remote { .. } | ModelError::NotFinite { .. }),
            "{mood:?}: {error}"
        );
    }
    let address = serve(Mood::PlainOnly).await;
    let loaded = tokio::task::spawn_blocking(move || {
        let engine = RemoteServer::new(&address, Duration::from_secs(5)).unwrap();
        Models::default().with_encoder(
            &engine,
            &root().join("crates/uniground-models/tests/data/tiny-dual-encoder"),
        )
    });
    assert_eq!(loaded.await.unwrap().unwrap().loaded[0].dimensions, Some(64));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_model_that_fails_fails_the_parse_unless_the_built_in_parts_may_help() {
    // Loading takes a handful of calls; the server is gone soon after.
    let bundles =
        BundlesConfig { inference_url: Some(serve(Mood::FailsAfter(12)).await), ..bundles() };
    let server = server_with(ModelsConfig {
        masks: "rgbd".into(),
        encoder: "tiny-dual-encoder".into(),
        bundles,
    })
    .await;
    let created = server.client.create_scene(None, "application/zip", sample()).await.unwrap();
    let job = finished(&server.client, &created.job.unwrap().id).await;
    let error = job.error.unwrap();
    assert_eq!(error.code, "model_failed");
    assert!(
        error.detail.contains("tiny-dual-encoder-") && error.detail.contains("503"),
        "{}",
        error.detail
    );

    let job =
        reparsed(&server, &created.scene.id, json!({"models": {"allow_builtin": true}})).await;
    assert_eq!(job.error, None);
    let scene = server.client.scene(&created.scene.id).await.unwrap();
    assert_eq!(scene.models.unwrap().encoder, "attributes-2");
    let warnings = server.client.report(&scene.id).await.unwrap().parse.unwrap().warnings;
    assert!(warnings.iter().any(|w| w.contains("a model failed")), "{warnings:?}");
    // What was made without the model is not taken for what was asked.
    let job =
        reparsed(&server, &created.scene.id, json!({"models": {"allow_builtin": true}})).await;
    assert!(!job.message.unwrap_or_default().contains("stored parse"));
    server.stop().await;
}
