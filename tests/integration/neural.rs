//! Neural models in the service: tiny bundles with random weights through a real server, and a
//! misbehaving inference server.

use crate::test_server::{
    TestServer, ask, assert_contains, expect_problem, serve_command, wait_for_job,
};
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

fn repository_root() -> &'static Utf8Path {
    Utf8Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn sample_scan() -> Vec<u8> {
    fs::read(repository_root().join("examples/living_room.zip")).unwrap()
}

fn bundles_config() -> BundlesConfig {
    let library = std::env::var("ORT_DYLIB_PATH").map_or_else(
        |_| repository_root().join(".onnxruntime/libonnxruntime.so"),
        Utf8PathBuf::from,
    );
    let runtime = RuntimeConfig { onnxruntime_lib: Some(library), ..RuntimeConfig::default() };
    BundlesConfig {
        models: repository_root().join("crates/uniground-models/tests/data"),
        runtime,
        ..BundlesConfig::default()
    }
}

/// Returns a segmenter and an encoder with random weights.
pub fn tiny_models() -> ModelsConfig {
    ModelsConfig {
        masks: "tiny-segmenter".into(),
        encoder: "tiny-dual-encoder".into(),
        bundles: bundles_config(),
    }
}

async fn start_server(models: ModelsConfig) -> TestServer {
    TestServer::start_on(
        tempfile::tempdir().unwrap(),
        LimitsConfig::default(),
        VlmConfig::default(),
        models,
    )
    .await
}

/// Uses few prompts, because random masks mean nothing.
pub fn fast_settings() -> Value {
    json!({"sam_masks": {"points_per_side": 2, "min_predicted_iou": -10.0, "min_stability": 0.0}})
}

async fn reparse(server: &TestServer, scene: &str, settings: Value) -> Job {
    let job = server.client.parse(scene, &json!({ "settings": settings })).await.unwrap();
    wait_for_job(&server.client, &job.id).await
}

#[tokio::test(flavor = "multi_thread")]
async fn models_are_used_from_upload_to_answer() {
    let server = start_server(tiny_models()).await;
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

    let created = server.client.create_scene(None, "application/zip", sample_scan()).await.unwrap();
    let scene = created.scene.id;
    // The upload's own parse may still be running; this faster one comes after it.
    let job = reparse(&server, &scene, json!({ "parsing": fast_settings() })).await;
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
    assert!(
        plain.candidates.windows(2).all(|pair| pair[0].score >= pair[1].score),
        "{:?}",
        plain.candidates
    );
    assert_eq!(
        plain,
        server.client.shortlist(&scene, &request(QueryText::Mean, false)).await.unwrap()
    );
    let target = server.client.shortlist(&scene, &request(QueryText::Target, false)).await.unwrap();
    assert_ne!(
        target.candidates, plain.candidates,
        "target and query texts give the same candidates"
    );
    let calibrated =
        server.client.shortlist(&scene, &request(QueryText::Mean, true)).await.unwrap();
    assert_ne!(calibrated.candidates, plain.candidates);
    let long = ShortlistRequest::new("the chair ".repeat(30));
    assert!(server.client.shortlist(&scene, &long).await.unwrap().cut && !plain.cut);

    let answer = server.client.ground(&scene, &ask("the sofa")).await.unwrap();
    assert_eq!((answer.models.encoder, answer.degraded), (used.encoder, false));

    // One row per instance, in NumPy's format.
    let rows = server.client.bytes(&format!("v1/scenes/{scene}/embeddings.npy")).await.unwrap();
    assert!(rows.starts_with(b"\x93NUMPY"));
    let latest = server.list_folder("blobs/parses").into_iter().max().unwrap();
    let parse = server.data().join("blobs/parses").join(latest);
    let norms = fs::read(parse.join("embedding_norms.npy")).unwrap();
    let shared = fs::read(parse.join("embedding_shared.npy")).unwrap();
    let instances = server.client.all_instances(&scene, Levels::All).await.unwrap();
    assert_eq!(
        Embeddings::read(&rows, &norms, Some(&shared)).map(|e| (e.len(), e.dim())).unwrap(),
        (instances.len(), 64)
    );

    // The same settings again: nothing is computed.
    let again = reparse(&server, &scene, json!({ "parsing": fast_settings() })).await;
    assert_contains(again.message.unwrap_or_default(), "stored parse");

    // Built-in models on request.
    let builtin = json!({"models": {"masks": "builtin", "encoder": "builtin"}});
    reparse(&server, &scene, builtin).await;
    let used = server.client.scene(&scene).await.unwrap().models.unwrap();
    assert_eq!((used.masks.as_str(), used.encoder.as_str()), ("rgbd-2", "attributes-2"));
    let error =
        expect_problem(server.client.bytes(&format!("v1/scenes/{scene}/embeddings.npy")).await);
    assert_eq!((error.status, error.code.as_str()), (404, "no_embeddings"));
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_scene_parsed_with_another_encoder_degrades_the_answer() {
    let server = start_server(ModelsConfig { masks: "rgbd".into(), ..tiny_models() }).await;
    let scene = server.upload_and_parse(sample_scan()).await.id;
    let data = server.stop_and_keep_data().await;
    let plain = TestServer::start_on(
        data,
        LimitsConfig::default(),
        VlmConfig::default(),
        ModelsConfig::builtin(),
    )
    .await;
    let error = expect_problem(plain.client.ground(&scene, &ask("the sofa")).await);
    assert_eq!((error.status, error.code.as_str()), (409, "encoder_changed"));
    assert!(
        error.detail.contains("tiny-dual-encoder@") && error.detail.contains("attributes-2"),
        "{}",
        error.detail
    );
    let mut allowed = ask("the sofa");
    allowed.allow_builtin = true;
    let answer = plain.client.ground(&scene, &allowed).await.unwrap();
    assert!(answer.degraded && answer.models.encoder == "attributes-2", "{answer:?}");
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
fn a_server_with_invalid_models_does_not_start() {
    let data = tempfile::tempdir().unwrap();
    let data = Utf8Path::from_path(data.path()).unwrap();
    let library = bundles_config().runtime.onnxruntime_lib.unwrap();
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
        ([&there[..], &["--masks", "tiny-dual-encoder"]].concat(), "is for --encoder"),
        (
            [&there[..], &["--encoder", "tiny-dual-encoder", "--provider", "cuda"]].concat(),
            "cuda is not available",
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
        let mut server = serve_command(data, "127.0.0.1:0");
        let output = server
            .args(&flags)
            .args([
                "--models",
                repository_root().join("crates/uniground-models/tests/data").as_str(),
            ])
            .output()
            .unwrap();
        let told = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{flags:?}: {told}");
        assert!(told.contains(expected), "{expected}: {told}");
    }
}

#[test]
fn bundles_are_listed_and_verified() {
    let (folder, library) = (
        repository_root().join("crates/uniground-models/tests/data"),
        bundles_config().runtime.onnxruntime_lib.unwrap(),
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
enum Misbehavior {
    Hangs,
    Garbage,
    Unavailable,
    NotANumber,
    Short,
    /// Correct results as plain JSON; raw bytes are refused.
    PlainOnly,
    /// Correct results at first, then the connection closes.
    FailsAfter(usize),
}

#[derive(Clone)]
struct InferenceServer {
    misbehavior: Misbehavior,
    asked: Arc<std::sync::atomic::AtomicUsize>,
}

/// Serves the networks of the tiny dual encoder, with the same embedding for every input.
async fn serve_inference(misbehavior: Misbehavior) -> String {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let router = axum::Router::new()
        .route("/v2/models/{name}", get(describe))
        .route("/v2/models/{name}/infer", post(infer))
        .with_state(InferenceServer { misbehavior, asked: Arc::default() });
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
    State(remote): State<InferenceServer>,
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
    match remote.misbehavior {
        Misbehavior::Hangs => {
            tokio::time::sleep(Duration::from_mins(1)).await;
            right(count * 64)
        }
        Misbehavior::Garbage => "<html>hello</html>".into_response(),
        Misbehavior::Unavailable => {
            (StatusCode::SERVICE_UNAVAILABLE, [("retry-after", "0")], "busy").into_response()
        }
        Misbehavior::NotANumber => {
            let header = json!({"outputs": [{"name": output, "datatype": "FP32", "shape": [count, 64], "parameters": {"binary_data_size": count * 256}}]}).to_string();
            let mut answer = header.clone().into_bytes();
            answer.extend(std::iter::repeat_n(f32::NAN.to_le_bytes(), count * 64).flatten());
            ([("Inference-Header-Content-Length", header.len().to_string())], answer)
                .into_response()
        }
        Misbehavior::Short => right(count * 64 - 1),
        Misbehavior::PlainOnly if header.is_some() => {
            (StatusCode::BAD_REQUEST, "what is this?").into_response()
        }
        Misbehavior::FailsAfter(calls) if asked >= calls => {
            (StatusCode::SERVICE_UNAVAILABLE, [("retry-after", "0")], "gone").into_response()
        }
        Misbehavior::PlainOnly | Misbehavior::FailsAfter(_) => right(count * 64),
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_misbehaving_inference_server_is_reported_at_load() {
    for (misbehavior, expected) in [
        (Misbehavior::Hangs, "timed out"),
        (Misbehavior::Garbage, "the response is invalid"),
        (Misbehavior::Unavailable, "503 Service Unavailable: busy (4 attempts)"),
        (Misbehavior::NotANumber, "NaN or infinite values"),
        (Misbehavior::Short, "values for the shape"),
    ] {
        let address = serve_inference(misbehavior).await;
        let loaded = tokio::task::spawn_blocking(move || {
            let engine = RemoteServer::new(&address, Duration::from_millis(400)).unwrap();
            verify(
                &engine,
                &repository_root().join("crates/uniground-models/tests/data/tiny-dual-encoder"),
            )
        });
        let error = loaded.await.unwrap().unwrap_err();
        assert!(error.to_string().contains(expected), "{misbehavior:?}: {error}");
        assert!(
            matches!(error, ModelError::Remote { .. } | ModelError::NotFinite { .. }),
            "{misbehavior:?}: {error}"
        );
    }
    let address = serve_inference(Misbehavior::PlainOnly).await;
    let loaded = tokio::task::spawn_blocking(move || {
        let engine = RemoteServer::new(&address, Duration::from_secs(5)).unwrap();
        Models::default().with_encoder(
            &engine,
            &repository_root().join("crates/uniground-models/tests/data/tiny-dual-encoder"),
        )
    });
    assert_eq!(loaded.await.unwrap().unwrap().loaded[0].dimensions, Some(64));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_failing_model_fails_the_parse_unless_fallback_is_allowed() {
    // Loading takes a few calls; soon after that the server is gone.
    let bundles = BundlesConfig {
        inference_url: Some(serve_inference(Misbehavior::FailsAfter(12)).await),
        ..bundles_config()
    };
    let server = start_server(ModelsConfig {
        masks: "rgbd".into(),
        encoder: "tiny-dual-encoder".into(),
        bundles,
    })
    .await;
    let created = server.client.create_scene(None, "application/zip", sample_scan()).await.unwrap();
    let job = wait_for_job(&server.client, &created.job.unwrap().id).await;
    let error = job.error.unwrap();
    assert_eq!(error.code, "model_failed");
    assert!(
        error.detail.contains("tiny-dual-encoder-") && error.detail.contains("503"),
        "{}",
        error.detail
    );

    let job = reparse(&server, &created.scene.id, json!({"models": {"allow_builtin": true}})).await;
    assert_eq!(job.error, None);
    let scene = server.client.scene(&created.scene.id).await.unwrap();
    assert_eq!(scene.models.unwrap().encoder, "attributes-2");
    let warnings = server.client.report(&scene.id).await.unwrap().parse.unwrap().warnings;
    assert!(warnings.iter().any(|w| w.contains("a model failed")), "{warnings:?}");
    // A parse made without the model is not reused for a request that names it.
    let job = reparse(&server, &created.scene.id, json!({"models": {"allow_builtin": true}})).await;
    assert!(!job.message.unwrap_or_default().contains("stored parse"));
    server.stop().await;
}
