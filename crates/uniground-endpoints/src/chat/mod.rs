//! Client for vision-language models behind any OpenAI-compatible chat endpoint, with recording and
//! replay.

mod completion;
mod limits;
mod replay_cache;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use completion::{EndpointReply, NoReply};
use futures::FutureExt;
use futures::future::BoxFuture;
pub use replay_cache::ReplayCache;
use reqwest::header::RETRY_AFTER;
use reqwest::redirect;
use reqwest::{Response, StatusCode, Url};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};
use std::time::{Duration, Instant};
use tokio::sync::Semaphore;
use tokio::time::sleep;
use uniground_client::{http_client, install_crypto_provider};
use uniground_models::chat::{
    ChatError, ChatFailure, ChatModel, ChatReply, ChatRequest, Part, Picture, Prices, Tokens,
};
use uniground_models::with_causes;
use uniground_telemetry::trace_context;

/// A chat endpoint, its model and its prices.
#[derive(Clone)]
pub struct Endpoint {
    /// Like `https://host/v1`; `/chat/completions` is added unless it is there. A query such as
    /// `?api-version=1` is kept.
    pub base_url: String,
    pub model: String,
    /// Never logged, never recorded.
    pub api_key: Option<String>,
    pub prices: Prices,
    /// Maximum number of concurrent requests; further ones wait.
    pub concurrency: usize,
}

impl Endpoint {
    /// Returns the address of a route such as `models`.
    fn address(&self, route: &str) -> String {
        let Ok(mut url) = Url::parse(&self.base_url) else {
            return format!("{}/{route}", self.base_url.trim_end_matches('/'));
        };
        let base = url.path().trim_end_matches('/');
        let base = base.strip_suffix("/chat/completions").unwrap_or(base);
        let path = format!("{base}/{route}");
        url.set_path(&path);
        url.into()
    }
}

impl std::fmt::Debug for Endpoint {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Endpoint")
            .field("base_url", &self.base_url)
            .field("model", &self.model)
            .finish_non_exhaustive()
    }
}

/// Timeout and retries of requests. The defaults are the paper's.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RetryPolicy {
    pub timeout: Duration,
    pub attempts: u32,
    /// The delay before the second attempt. It doubles from one attempt to the next.
    pub backoff: Duration,
    /// Upper limit of a delay. If a server asks for a longer one, the request is not retried.
    pub longest_wait: Duration,
}

impl Default for RetryPolicy {
    fn default() -> Self {
        Self {
            timeout: Duration::from_mins(5),
            attempts: 5,
            backoff: Duration::from_secs(1),
            longest_wait: Duration::from_secs(20),
        }
    }
}

/// Client of one model at an endpoint.
pub struct ChatClient {
    http: reqwest::Client,
    endpoint: Endpoint,
    patience: RetryPolicy,
    replay_cache: ReplayCache,
    permits: Semaphore,
}

/// A failed attempt.
struct Attempt {
    error: ChatError,
    /// Whether a retry may succeed.
    again: bool,
    /// The delay that the server asked for, if any.
    wait: Option<Duration>,
    /// The model may have processed it, so it may be billed.
    may_be_billed: bool,
}

impl Attempt {
    fn from_unreadable(why: String, again: bool) -> Self {
        Self { error: ChatError::Undecodable(why), again, wait: None, may_be_billed: true }
    }
}

const MAX_REDIRECTS: usize = 3;
/// Timeout of the reachability check.
const CHECK_TIMEOUT: Duration = Duration::from_secs(5);
/// Servers count tokens differently, above all for pictures. A count that differs from the estimate
/// by more than this factor is implausible.
const MAX_PROMPT_FACTOR: u64 = 20;
/// The same factor for replies. It is large: models bill the tokens of their hidden reasoning too.
const MAX_COMPLETION_FACTOR: u64 = 1000;
/// Tokens around even the shortest question.
const PROMPT_OVERHEAD_TOKENS: u64 = 1000;

/// Returns a server's token count if it is plausible, and the estimate otherwise. Servers that
/// report no count are billed by the estimate.
fn plausible_token_count(counted: Option<u64>, reckoned: u64, most_times: u64) -> u64 {
    let least = reckoned / most_times;
    let most = reckoned.max(PROMPT_OVERHEAD_TOKENS).saturating_mul(most_times);
    match counted {
        Some(counted) if counted > 0 && (least..=most).contains(&counted) => counted,
        Some(counted) => {
            tracing::warn!(
                counted,
                reckoned,
                "model server reported an impossible token count; using the estimate"
            );
            reckoned
        }
        None => reckoned,
    }
}

impl ChatClient {
    /// # Errors
    /// The HTTP client cannot be created, e.g. if the system's certificates cannot be read.
    pub fn new(
        endpoint: Endpoint,
        patience: RetryPolicy,
        replay_cache: ReplayCache,
    ) -> Result<Self, reqwest::Error> {
        install_crypto_provider();
        let permits = Semaphore::new(endpoint.concurrency.max(1));
        // Prompts and pictures must go to the configured origin only.
        let redirect = redirect::Policy::custom(|attempt| {
            let same_place = attempt
                .previous()
                .first()
                .is_some_and(|first| first.origin() == attempt.url().origin());
            if same_place && attempt.previous().len() < MAX_REDIRECTS {
                attempt.follow()
            } else {
                attempt.stop()
            }
        });
        let http = http_client(&endpoint.base_url).redirect(redirect).build()?;
        Ok(Self { http, endpoint, patience, replay_cache, permits })
    }

    /// Checks that the endpoint's server is reachable. Any response counts; the check costs
    /// nothing.
    ///
    /// # Errors
    /// Why it cannot be reached.
    pub async fn check_reachable(&self) -> Result<(), reqwest::Error> {
        let request = self.http.get(self.endpoint.address("models")).timeout(CHECK_TIMEOUT);
        let request =
            self.endpoint.api_key.iter().fold(request, reqwest::RequestBuilder::bearer_auth);
        request.send().await.map(drop).map_err(reqwest::Error::without_url)
    }

    async fn ask_live(
        &self,
        request: &ChatRequest,
        mut body: Value,
    ) -> Result<ChatReply, ChatFailure> {
        let start = Instant::now();
        let (mut attempts, mut lost) = (0, 0);
        loop {
            attempts += 1;
            let Attempt { error, again, wait, may_be_billed } = match self.send(&body).await {
                Ok(EndpointReply { text, prompt_tokens, completion_tokens }) => {
                    let latency_ms = start.elapsed().as_secs_f64() * 1e3;
                    let prompt_tokens = plausible_token_count(
                        prompt_tokens,
                        Tokens::estimate(request).total(),
                        MAX_PROMPT_FACTOR,
                    );
                    let completion_tokens = plausible_token_count(
                        completion_tokens,
                        Tokens::estimate_text(&text),
                        MAX_COMPLETION_FACTOR,
                    );
                    return Ok(ChatReply {
                        text,
                        prompt_tokens,
                        completion_tokens,
                        attempts,
                        lost,
                        latency_ms,
                    });
                }
                Err(attempt) => attempt,
            };
            lost += u32::from(may_be_billed);
            // Some endpoints only stream. Their replies are read as a whole.
            if demands_stream(&error) && body.get("stream").is_none() {
                body["stream"] = json!(true);
                body["stream_options"] = json!({"include_usage": true});
                continue;
            }
            // If a server does not support schemas, retry without one.
            let refuses_schema =
                matches!(&error, ChatError::Refused { status: 400 | 404 | 422 | 501, .. });
            if refuses_schema && body.get("response_format").is_some() {
                body = self.body(request, false);
                continue;
            }
            // If the server asks for a longer delay, give up.
            let too_long = wait.is_some_and(|wait| wait > self.patience.longest_wait);
            if !again || too_long || attempts >= self.patience.attempts {
                return Err(ChatFailure {
                    error,
                    attempts,
                    lost,
                    latency_ms: start.elapsed().as_secs_f64() * 1e3,
                });
            }
            // Jitter from the clock spreads callers that failed together. No stored result depends
            // on it.
            let jitter = f64::from(start.elapsed().subsec_nanos() % 1000) / 1000.0;
            let backoff = self
                .patience
                .backoff
                .mul_f64(f64::from(1_u32 << (attempts - 1).min(16)) * (1.0 + 0.25 * jitter));
            sleep(wait.unwrap_or(backoff).min(self.patience.longest_wait)).await;
        }
    }

    async fn send(&self, body: &Value) -> Result<EndpointReply, Attempt> {
        let mut request = self
            .http
            .post(self.endpoint.address("chat/completions"))
            .headers(trace_context::propagation_headers())
            .timeout(self.patience.timeout)
            .json(body);
        if let Some(key) = &self.endpoint.api_key {
            request = request.bearer_auth(key);
        }
        // A failed connection has sent nothing, so it cannot be billed.
        let transport = |error: reqwest::Error| {
            let may_be_billed = !error.is_connect() && !error.is_builder();
            Attempt {
                error: ChatError::Transport(with_causes(&error.without_url())),
                again: true,
                wait: None,
                may_be_billed,
            }
        };
        let _permit = self.permits.acquire().await;
        let response = request.send().await.map_err(transport)?;
        let (status, wait) = (response.status(), retry_after(&response));
        let text = read_limited(response).await.map_err(transport)?.ok_or_else(|| {
            Attempt::from_unreadable(format!("it is longer than {MAX_REPLY_BYTES} bytes"), false)
        })?;
        if !status.is_success() {
            let error = ChatError::Refused {
                status: status.as_u16(),
                reason: status.canonical_reason().unwrap_or("(nonstandard status)"),
                detail: detail(&self.redact_key(&text)),
            };
            // The model may have run before a server error, so it may be billed.
            return Err(Attempt {
                error,
                again: is_transient(status),
                wait,
                may_be_billed: status.is_server_error() || status.as_u16() == 408,
            });
        }
        completion::read(&text).map_err(|NoReply { error, again }| Attempt {
            error: self.redact_keys_of(error),
            again,
            wait: None,
            may_be_billed: true,
        })
    }

    fn redact_keys_of(&self, error: ChatError) -> ChatError {
        match error {
            ChatError::Refused { status, reason, detail } => {
                ChatError::Refused { status, reason, detail: self.redact_key(&detail) }
            }
            ChatError::NoAnswer(why) => ChatError::NoAnswer(self.redact_key(&why)),
            ChatError::Undecodable(why) => ChatError::Undecodable(self.redact_key(&why)),
            other => other,
        }
    }

    /// Removes the API key: some servers repeat it in error messages.
    fn redact_key(&self, text: &str) -> String {
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
            body["response_format"] =
                json!({"type": "json_schema", "json_schema": {"name": name, "schema": schema}});
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

    fn is_alive(&self) -> BoxFuture<'_, Option<bool>> {
        async move {
            match self.replay_cache.is_replay() {
                true => None,
                false => Some(self.check_reachable().await.is_ok()),
            }
        }
        .boxed()
    }

    /// Asks the model, or returns the recorded reply.
    fn ask<'a>(
        &'a self,
        request: &'a ChatRequest,
    ) -> BoxFuture<'a, Result<ChatReply, ChatFailure>> {
        async move {
            let never_asked = |error| ChatFailure { error, attempts: 0, lost: 0, latency_ms: 0.0 };
            let body = self.body(request, request.schema.is_some());
            if self.replay_cache.is_off() {
                return self.ask_live(request, body).await;
            }
            let key: String =
                Sha256::digest(body.to_string()).iter().map(|byte| format!("{byte:02x}")).collect();
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

/// Returns whether an endpoint refused a request because it did not ask for a stream.
fn demands_stream(error: &ChatError) -> bool {
    let ChatError::Refused { status: 400 | 422, detail, .. } = error else { return false };
    let detail = detail.to_ascii_lowercase();
    let says = |words: &[&str]| words.iter().any(|word| detail.contains(word));
    detail.contains("stream") && says(&["must", "only", "require", "non-stream", "true"])
}

/// Longer replies are rejected.
const MAX_REPLY_BYTES: usize = 8 << 20;

/// Returns the body as text, or `None` if it is too long.
async fn read_limited(mut response: Response) -> Result<Option<String>, reqwest::Error> {
    let mut bytes = Vec::new();
    while let Some(chunk) = response.chunk().await? {
        bytes.extend_from_slice(&chunk);
        if bytes.len() > MAX_REPLY_BYTES {
            return Ok(None);
        }
    }
    Ok(Some(String::from_utf8_lossy(&bytes).into_owned()))
}

/// Returns the delay that a server asks for in seconds. Dates are not supported.
fn retry_after(response: &Response) -> Option<Duration> {
    response.headers().get(RETRY_AFTER)?.to_str().ok()?.trim().parse().ok().map(Duration::from_secs)
}

/// Returns whether a request that got this status may succeed later.
fn is_transient(status: StatusCode) -> bool {
    matches!(status.as_u16(), 408 | 409 | 429) || status.is_server_error()
}

/// Returns the message within an error body, shortened.
fn detail(body: &str) -> String {
    const MAX_CHARS: usize = 300;
    let parsed: Option<Value> = serde_json::from_str(body).ok();
    let message = parsed.as_ref().and_then(|v| {
        v.pointer("/error/message").or_else(|| v.get("message")).or_else(|| v.get("detail"))
    });
    let text = message.and_then(Value::as_str).unwrap_or(body);
    text.chars().take(MAX_CHARS).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn routes_are_joined_to_addresses_with_a_query_or_a_route() {
        for (base_url, expected) in [
            ("http://host/v1", "http://host/v1/chat/completions"),
            ("http://host/v1/", "http://host/v1/chat/completions"),
            ("http://host/v1/chat/completions", "http://host/v1/chat/completions"),
            ("https://host/x?api-version=1", "https://host/x/chat/completions?api-version=1"),
            ("http://host", "http://host/chat/completions"),
        ] {
            let endpoint = Endpoint {
                base_url: base_url.into(),
                model: "m".into(),
                api_key: None,
                prices: Prices::default(),
                concurrency: 1,
            };
            assert_eq!(endpoint.address("chat/completions"), expected);
        }
    }
}
