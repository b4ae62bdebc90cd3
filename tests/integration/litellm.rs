//! A chat server by another vendor: `LiteLLM`'s proxy with mock answers
//! (`tests/litellm/config.yaml`). `make test-models` starts it.

use crate::test_server::{TestServer, ask, expect_problem};
use camino::Utf8PathBuf;
use std::fs;
use uniground::config::{LimitsConfig, VlmConfig};
use uniground_core::grounding::Status;
use uniground_types::question::{EvidenceMode, GroundRequest, ReasonerChoice};

const QUERY: &str = "the mug on the coffee table";

async fn start_server(
    model: &str,
    key: &str,
    json: bool,
) -> (TestServer, String, tempfile::TempDir) {
    let url = std::env::var("LITELLM_URL")
        .unwrap_or_else(|_| panic!("LITELLM_URL is set by make test-models"));
    let folder = tempfile::tempdir().unwrap();
    let file = Utf8PathBuf::from_path_buf(folder.path().join("key")).unwrap();
    fs::write(&file, key).unwrap();
    let vlm = VlmConfig {
        vlm_url: Some(format!("{url}/v1")),
        vlm_model: Some(model.into()),
        vlm_api_key_file: Some(file),
        vlm_prompt_usd: 1.0,
        vlm_attempts: 2,
        vlm_backoff_ms: 10,
        vlm_timeout_s: 60,
        vlm_json: json,
        ..VlmConfig::default()
    };
    let server = TestServer::start_configured(LimitsConfig::default(), vlm).await;
    let scan = fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/examples/living_room.zip")).unwrap();
    let scene = server.upload_and_parse(scan).await.id;
    (server, scene, folder)
}

fn request_requiring_model() -> GroundRequest {
    GroundRequest { reasoner: ReasonerChoice::Vlm, ..ask(QUERY) }
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "needs a LiteLLM proxy: make test-models"]
async fn litellm_accepts_requests_and_its_answers_are_used() {
    for json in [false, true] {
        let (server, scene, _key) = start_server("scripted", "sk-litellm-test", json).await;
        // The request contains six images, half a megabyte in total.
        let answer = server.client.ground(&scene, &request_requiring_model()).await.unwrap();
        assert_eq!(
            (answer.status, answer.usage.vlm_calls, answer.degraded),
            (Status::NoMatch, 1, false)
        );
        assert_eq!(answer.answer.explanation, "the target is not in the scene");
        assert!(
            answer.usage.prompt_tokens > 0 && answer.usage.cost_usd > 0.0,
            "{:?}",
            answer.usage
        );
        let cached =
            GroundRequest { evidence: EvidenceMode::CachedNames, ..request_requiring_model() };
        assert_eq!(server.client.ground(&scene, &cached).await.unwrap().usage.vlm_calls, 2);
        server.stop().await;
    }
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "needs a LiteLLM proxy: make test-models"]
async fn litellm_errors_are_reported_verbatim() {
    for (model, key, attempts, told) in [
        ("scripted", "sk-wrong", 1, "400"),
        ("no-such-model", "sk-litellm-test", 1, "Invalid model name"),
        ("broken", "sk-litellm-test", 2, "mock rate limit error"),
    ] {
        let (server, scene, _key) = start_server(model, key, false).await;
        let error = expect_problem(server.client.ground(&scene, &request_requiring_model()).await);
        assert_eq!((error.status, error.code.as_str()), (502, "vlm_unavailable"));
        assert!(
            error.detail.contains(told)
                && error.detail.contains(&format!("in {attempts} attempts")),
            "{}",
            error.detail
        );
        assert!(
            !error.detail.contains(key)
                && server.client.ground(&scene, &ask(QUERY)).await.unwrap().degraded
        );
        server.stop().await;
    }
}
