//! Checks the limits of self-hosted model servers once at start, to avoid silently wrong answers:
//! vLLM refuses more pictures than it was configured for, and Ollama silently truncates input that
//! exceeds its context.

use super::ChatClient;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use image::RgbImage;
use serde::Deserialize;
use serde_json::{Value, json};
use std::time::Duration;
use uniground_render::encode_jpeg;

/// Tokens of a question with five candidates, for models with one token per 28 x 28 pixels: a
/// render, seven collages, two photographs, the text, and a reply.
const QUESTION_TOKENS: u64 = 10_000;
/// A render, collages of five candidates and two anchors, and two photographs.
const QUESTION_PICTURES: usize = 10;
/// Timeout of one check.
const CHECK_TIMEOUT: Duration = Duration::from_secs(20);

#[derive(Deserialize)]
struct ModelListing {
    data: Vec<ListedModel>,
}

#[derive(Deserialize)]
struct ListedModel {
    id: String,
    #[serde(default)]
    owned_by: String,
    /// In tokens; reported by vLLM and similar servers.
    max_model_len: Option<u64>,
}

impl ChatClient {
    /// Returns what the endpoint's server will refuse or truncate of a question, with advice. Empty
    /// if no problem is known. Requests only the list of models from hosted servers.
    ///
    /// `max_images` is the configured maximum number of pictures in a request.
    pub async fn describe_limits(&self, max_images: Option<u32>) -> Vec<String> {
        let Some(listed) =
            self.fetch_json::<ModelListing>(self.http.get(self.endpoint.address("models"))).await
        else {
            return Vec::new();
        };
        let model = &self.endpoint.model;
        let Some(found) = listed.data.into_iter().find(|listed| listed.id == *model) else {
            return Vec::new();
        };
        let too_short = |tokens: u64, what_to_do: &str| {
            (tokens < QUESTION_TOKENS).then(|| {
                format!("{model} accepts at most {tokens} tokens here, but a question needs about {QUESTION_TOKENS}, more with more candidates: {what_to_do}")
            })
        };
        let by_length = found
            .max_model_len
            .and_then(|tokens| too_short(tokens, "start its server with a larger --max-model-len"));
        let more = match found.owned_by.as_str() {
            "vllm" => self.picture_limit_advice(max_images).await,
            // This is how Ollama identifies itself.
            "library" => match self.ollama_context_length().await {
                Some(tokens) => too_short(
                    tokens,
                    "Ollama silently truncates the rest; set OLLAMA_CONTEXT_LENGTH=16384, or num_ctx in a Modelfile",
                ),
                None => Some(format!(
                    "Ollama silently truncates prompts to its context length, by default 4096 tokens on GPUs under 24 GB, but a \
                     question needs about {QUESTION_TOKENS}: set OLLAMA_CONTEXT_LENGTH=16384"
                )),
            },
            _ => None,
        };
        by_length.into_iter().chain(more).collect()
    }

    /// Checks whether a vLLM server refuses a question's number of pictures, by a request with tiny
    /// pictures and one token of reply.
    async fn picture_limit_advice(&self, max_images: Option<u32>) -> Option<String> {
        let count =
            max_images.map_or(QUESTION_PICTURES, |most| QUESTION_PICTURES.min(most as usize));
        let picture = format!(
            "data:image/jpeg;base64,{}",
            STANDARD.encode(encode_jpeg(&RgbImage::new(56, 56)))
        );
        let pictures =
            (0..count).map(|_| json!({"type": "image_url", "image_url": {"url": picture}}));
        let content: Vec<Value> = pictures.chain([json!({"type": "text", "text": "?"})]).collect();
        let body = json!({"model": self.endpoint.model, "max_tokens": 1, "messages": [{"role": "user", "content": content}]});
        let response = self
            .authorized(self.http.post(self.endpoint.address("chat/completions")).json(&body))
            .send()
            .await
            .ok()?;
        if !response.status().is_client_error() {
            return None;
        }
        let message = super::read_limited(response).await.ok().flatten().unwrap_or_default();
        Some(format!(
            "{} refuses {count} pictures in one prompt, but a question needs them ({}): start vLLM with \
             --limit-mm-per-prompt '{{\"image\": 25}}' (older versions: image=25), or set --vlm-max-images to what it accepts",
            self.endpoint.model,
            super::detail(&self.redact_key(&message))
        ))
    }

    /// Returns the context length that Ollama gives the model, tokens; `None` if it does not report
    /// it.
    async fn ollama_context_length(&self) -> Option<u64> {
        #[derive(Deserialize)]
        struct ModelDetails {
            #[serde(default)]
            parameters: String,
        }
        #[derive(Deserialize)]
        struct RunningModels {
            models: Vec<RunningModel>,
        }
        #[derive(Deserialize)]
        struct RunningModel {
            name: String,
            context_length: Option<u64>,
        }
        let models = self.endpoint.address("models");
        let base = models.split('?').next().unwrap_or_default().trim_end_matches("/models");
        let root = base.strip_suffix("/v1").unwrap_or(base);
        let model = &self.endpoint.model;
        let shown: Option<ModelDetails> = self
            .fetch_json(self.http.post(format!("{root}/api/show")).json(&json!({"model": model})))
            .await;
        let set = shown.and_then(|shown| {
            let line = shown
                .parameters
                .lines()
                .find_map(|line| line.trim().strip_prefix("num_ctx").map(str::to_owned))?;
            line.trim().parse().ok()
        });
        if set.is_some() {
            return set;
        }
        let running: RunningModels =
            self.fetch_json(self.http.get(format!("{root}/api/ps"))).await?;
        running.models.into_iter().find(|running| running.name == *model)?.context_length
    }

    fn authorized(&self, request: reqwest::RequestBuilder) -> reqwest::RequestBuilder {
        self.endpoint
            .api_key
            .iter()
            .fold(request.timeout(CHECK_TIMEOUT), reqwest::RequestBuilder::bearer_auth)
    }

    /// Sends a request and parses the response. Returns `None` if it cannot be parsed.
    async fn fetch_json<T: serde::de::DeserializeOwned>(
        &self,
        request: reqwest::RequestBuilder,
    ) -> Option<T> {
        let response = self
            .authorized(request)
            .send()
            .await
            .ok()
            .filter(|response| response.status().is_success())?;
        serde_json::from_str(&super::read_limited(response).await.ok()??).ok()
    }
}

#[cfg(test)]
mod tests {
    use crate::chat::{ChatClient, Endpoint, ReplayCache, RetryPolicy};
    use axum::routing::{get, post};
    use axum::{Json, Router, http::StatusCode};
    use serde_json::{Value, json};
    use uniground_models::chat::Prices;

    /// Runs the check against a server with these responses.
    async fn check_limits(
        models: Value,
        completion: (StatusCode, Value),
        show: Value,
        ps: Value,
    ) -> Vec<String> {
        let router = Router::new()
            .route("/v1/models", get(move || async move { Json(models) }))
            .route(
                "/v1/chat/completions",
                post(move || async move { (completion.0, Json(completion.1)) }),
            )
            .route("/api/show", post(move || async move { Json(show) }))
            .route("/api/ps", get(move || async move { Json(ps) }));
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let base_url = format!("http://{}/v1", listener.local_addr().unwrap());
        tokio::spawn(async move { axum::serve(listener, router).await });
        let endpoint = Endpoint {
            base_url,
            model: "qwen".into(),
            api_key: None,
            prices: Prices::default(),
            concurrency: 1,
        };
        ChatClient::new(endpoint, RetryPolicy::default(), ReplayCache::Off)
            .unwrap()
            .describe_limits(None)
            .await
    }

    fn models(owner: &str, max_model_len: Option<u64>) -> Value {
        json!({"object": "list", "data": [{"id": "other"}, {"id": "qwen", "owned_by": owner, "max_model_len": max_model_len}]})
    }

    #[tokio::test]
    async fn endpoint_limits_are_reported_with_advice() {
        let fine = || (StatusCode::OK, json!({"choices": []}));
        let refused = || {
            (
                StatusCode::BAD_REQUEST,
                json!({"error": {"message": "At most 1 image(s) may be provided in one prompt."}}),
            )
        };
        let nothing = || json!({});
        assert_eq!(
            check_limits(models("vllm", Some(32_768)), fine(), nothing(), nothing()).await,
            Vec::<String>::new()
        );
        let warnings =
            check_limits(models("vllm", Some(4096)), refused(), nothing(), nothing()).await;
        assert!(
            warnings.len() == 2
                && warnings[0].contains("--max-model-len")
                && warnings[0].contains("4096"),
            "{warnings:?}"
        );
        assert!(
            warnings[1].contains("At most 1 image(s)")
                && warnings[1].contains("--limit-mm-per-prompt")
                && warnings[1].contains("--vlm-max-images"),
            "{warnings:?}"
        );

        let set = json!({"parameters": "stop \"x\"\nnum_ctx                        8192"});
        let warnings = check_limits(models("library", None), fine(), set, nothing()).await;
        assert!(
            warnings.len() == 1
                && warnings[0].contains("8192")
                && warnings[0].contains("OLLAMA_CONTEXT_LENGTH"),
            "{warnings:?}"
        );
        let running = json!({"models": [{"name": "qwen", "context_length": 32_768}]});
        assert_eq!(
            check_limits(models("library", None), fine(), nothing(), running).await,
            Vec::<String>::new()
        );
        let warnings =
            check_limits(models("library", None), fine(), nothing(), json!({"models": []})).await;
        assert!(warnings.len() == 1 && warnings[0].contains("by default 4096"), "{warnings:?}");

        // Hosted servers get only a request for their list of models.
        assert_eq!(
            check_limits(models("openai", None), refused(), nothing(), nothing()).await,
            Vec::<String>::new()
        );
    }
}
