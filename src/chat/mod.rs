//! Vision-language models behind any OpenAI-compatible chat endpoint, and their answers recorded for replay.

mod replay_cache;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use futures::FutureExt;
use futures::future::BoxFuture;
pub use replay_cache::ReplayCache;
use reqwest::Response;
use reqwest::header::RETRY_AFTER;
use serde::Deserialize;
use serde_json::{Value, json};
use sha2::{Digest, Sha256};
use std::time::{Duration, Instant};
use tokio::sync::Semaphore;
use tokio::time::sleep;
use uniground_client::choose_cryptography;
use uniground_core::models::chat::{ChatError, ChatFailure, ChatModel, ChatReply, ChatRequest, Part, Picture, Prices, Tokens};
use uniground_core::models::with_causes;

/// Where a model is asked, and what it costs.
#[derive(Clone)]
pub struct Endpoint {
    /// Like `https://host/v1`; `/chat/completions` is added.
    pub base_url: String,
    pub model: String,
    /// Never logged, never recorded.
    pub api_key: Option<String>,
    pub prices: Prices,
    /// Requests under way at once; more wait their turn.
    pub concurrency: usize,
}

impl std::fmt::Debug for Endpoint {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Endpoint")
            .field("base_url", &self.base_url)
            .field("model", &self.model)
            .finish_non_exhaustive()
    }
}

/// How patiently a model is asked. Defaults are the paper's.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Patience {
    pub timeout: Duration,
    pub attempts: u32,
    /// The wait before the second attempt; it doubles from one to the next.
    pub backoff: Duration,
    /// No wait is longer, whatever the server asks for.
    pub longest_wait: Duration,
}

impl Default for Patience {
    fn default() -> Self {
        Self { timeout: Duration::from_mins(5), attempts: 5, backoff: Duration::from_secs(1), longest_wait: Duration::from_mins(1) }
    }
}

/// A model at an endpoint, and how it is asked.
pub struct ChatClient {
    http: reqwest::Client,
    endpoint: Endpoint,
    patience: Patience,
    replay_cache: ReplayCache,
    turns: Semaphore,
}

#[derive(Deserialize)]
struct Completion {
    choices: Vec<Choice>,
    usage: Option<Usage>,
}

#[derive(Deserialize)]
struct Choice {
    message: Message,
}

#[derive(Deserialize)]
struct Message {
    content: Option<Content>,
    /// Why nothing is said, with some servers.
    refusal: Option<String>,
}

/// Most servers answer with a text, some with a list of parts.
#[derive(Deserialize)]
#[serde(untagged)]
enum Content {
    Text(String),
    Parts(Vec<ContentPart>),
}

#[derive(Deserialize)]
struct ContentPart {
    #[serde(default)]
    text: String,
}

impl Message {
    fn text(self) -> Option<String> {
        let said = self.content.map(|content| match content {
            Content::Text(text) => text,
            Content::Parts(parts) => parts.into_iter().map(|part| part.text).collect(),
        });
        said.filter(|text| !text.is_empty()).or(self.refusal)
    }
}

#[derive(Default, Deserialize)]
struct Usage {
    prompt_tokens: Option<u64>,
    completion_tokens: Option<u64>,
}

impl ChatClient {
    #[must_use]
    pub fn new(endpoint: Endpoint, patience: Patience, replay_cache: ReplayCache) -> Self {
        choose_cryptography();
        let turns = Semaphore::new(endpoint.concurrency.max(1));
        Self { http: reqwest::Client::new(), endpoint, patience, replay_cache, turns }
    }

    async fn ask_live(&self, request: &ChatRequest, mut body: Value) -> Result<ChatReply, ChatFailure> {
        let start = Instant::now();
        let mut attempts = 0;
        loop {
            attempts += 1;
            let (error, wait) = match self.send(&body).await {
                Ok(Completion { choices, usage }) => {
                    let latency_ms = start.elapsed().as_secs_f64() * 1e3;
                    // Nothing said is a reply as well, if one that says nothing.
                    let text = choices.into_iter().next().and_then(|choice| choice.message.text()).unwrap_or_default();
                    let Usage { prompt_tokens, completion_tokens } = usage.unwrap_or_default();
                    // Servers that do not count are not free: it is reckoned.
                    let prompt_tokens = prompt_tokens.unwrap_or_else(|| Tokens::of(request).total());
                    let completion_tokens = completion_tokens.unwrap_or_else(|| Tokens::of_text(&text));
                    return Ok(ChatReply { text, prompt_tokens, completion_tokens, attempts, latency_ms });
                }
                Err(failure) => failure,
            };
            // A server that knows no schemas is asked without one.
            let refuses_schema = matches!(&error, ChatError::Refused { status: 400 | 404 | 422 | 501, .. });
            if refuses_schema && body.get("response_format").is_some() {
                body = self.body(request, false);
                continue;
            }
            let Some(asked_for) = wait.filter(|_| attempts < self.patience.attempts) else {
                return Err(ChatFailure { error, attempts, latency_ms: start.elapsed().as_secs_f64() * 1e3 });
            };
            // Jitter from the clock spreads callers that failed together; nothing that is kept depends on it.
            let jitter = f64::from(start.elapsed().subsec_nanos() % 1000) / 1000.0;
            let backoff = self.patience.backoff.mul_f64(f64::from(1_u32 << (attempts - 1).min(16)) * (1.0 + 0.25 * jitter));
            sleep(asked_for.unwrap_or(backoff).min(self.patience.longest_wait)).await;
        }
    }

    /// One attempt. A failure says whether another may help, and after how long if the server told.
    async fn send(&self, body: &Value) -> Result<Completion, (ChatError, Option<Option<Duration>>)> {
        let url = format!("{}/chat/completions", self.endpoint.base_url.trim_end_matches('/'));
        let mut request = self.http.post(url).timeout(self.patience.timeout).json(body);
        if let Some(key) = &self.endpoint.api_key {
            request = request.bearer_auth(key);
        }
        let transport = |error: reqwest::Error| (ChatError::Transport(with_causes(&error.without_url())), Some(None));
        let _turn = self.turns.acquire().await;
        let response = request.send().await.map_err(transport)?;
        let (status, wait) = (response.status(), retry_after(&response));
        let text = bounded(response)
            .await
            .map_err(transport)?
            .ok_or_else(|| (ChatError::Undecodable(format!("it is longer than {MAX_REPLY_BYTES} bytes")), None))?;
        if !status.is_success() {
            let again = matches!(status.as_u16(), 408 | 409 | 429) || status.is_server_error();
            return Err((
                ChatError::Refused {
                    status: status.as_u16(),
                    reason: status.canonical_reason().unwrap_or("of its own"),
                    detail: detail(&self.without_key(&text)),
                },
                again.then_some(wait),
            ));
        }
        let undecodable = |why: String| (ChatError::Undecodable(why), Some(None));
        let completion: Completion = serde_json::from_str(&text).map_err(|error| undecodable(error.to_string()))?;
        if completion.choices.is_empty() { Err(undecodable("there is no choice".into())) } else { Ok(completion) }
    }

    /// Some servers repeat the key they were shown.
    fn without_key(&self, text: &str) -> String {
        match &self.endpoint.api_key {
            Some(key) if !key.is_empty() => text.replace(key.as_str(), "<key>"),
            _ => text.to_owned(),
        }
    }

    fn body(&self, request: &ChatRequest, with_schema: bool) -> Value {
        let part = |part: &Part| match part {
            Part::Text(text) => json!({"type": "text", "text": text}),
            Part::Picture(Picture { jpeg, .. }) => {
                json!({"type": "image_url", "image_url": {"url": format!("data:image/jpeg;base64,{}", STANDARD.encode(jpeg))}})
            }
        };
        let user = match request.user.as_slice() {
            [Part::Text(text)] => json!(text),
            parts => parts.iter().map(part).collect(),
        };
        let mut body = json!({
            "model": self.endpoint.model,
            "messages": [{"role": "system", "content": request.system}, {"role": "user", "content": user}],
        });
        if let Some((name, schema)) = request.schema.as_ref().filter(|_| with_schema) {
            body["response_format"] = json!({"type": "json_schema", "json_schema": {"name": name, "schema": schema}});
        }
        body
    }
}

impl ChatModel for ChatClient {
    fn name(&self) -> &str {
        &self.endpoint.model
    }

    fn prices(&self) -> Prices {
        self.endpoint.prices
    }

    /// From the replay cache where it has the answer.
    fn ask<'a>(&'a self, request: &'a ChatRequest) -> BoxFuture<'a, Result<ChatReply, ChatFailure>> {
        async move {
            let never_asked = |error| ChatFailure { error, attempts: 0, latency_ms: 0.0 };
            let body = self.body(request, request.schema.is_some());
            if self.replay_cache.is_off() {
                return self.ask_live(request, body).await;
            }
            let key: String = Sha256::digest(body.to_string()).iter().map(|byte| format!("{byte:02x}")).collect();
            if let Some(reply) = self.replay_cache.reply(&key) {
                return Ok(reply);
            }
            if self.replay_cache.is_replay() {
                return Err(never_asked(ChatError::NotRecorded(self.endpoint.model.clone())));
            }
            let reply = self.ask_live(request, body).await?;
            self.replay_cache
                .record_reply(&key, &self.endpoint.model, &reply)
                .map_err(|error| never_asked(error.into()))?;
            Ok(reply)
        }
        .boxed()
    }
}

/// A reply that is longer is none.
const MAX_REPLY_BYTES: usize = 8 << 20;

/// The body as text, `None` when it does not end.
async fn bounded(mut response: Response) -> Result<Option<String>, reqwest::Error> {
    let mut bytes = Vec::new();
    while let Some(chunk) = response.chunk().await? {
        bytes.extend_from_slice(&chunk);
        if bytes.len() > MAX_REPLY_BYTES {
            return Ok(None);
        }
    }
    Ok(Some(String::from_utf8_lossy(&bytes).into_owned()))
}

/// What a server asks to wait, in seconds; dates are not understood.
fn retry_after(response: &Response) -> Option<Duration> {
    response.headers().get(RETRY_AFTER)?.to_str().ok()?.trim().parse().ok().map(Duration::from_secs)
}

/// The reason within an error body, short.
fn detail(body: &str) -> String {
    const MAX_CHARS: usize = 300;
    let parsed: Option<Value> = serde_json::from_str(body).ok();
    let message = parsed
        .as_ref()
        .and_then(|v| v.pointer("/error/message").or_else(|| v.get("message")).or_else(|| v.get("detail")));
    let text = message.and_then(Value::as_str).unwrap_or(body);
    text.chars().take(MAX_CHARS).collect()
}
