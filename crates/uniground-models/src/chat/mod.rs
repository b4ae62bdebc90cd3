//! Chat models: requests, replies and costs (docs/METHOD.md, section 4, "Calls"). This module does
//! not define how a model is reached: the service uses OpenAI-compatible endpoints, and a robot may
//! bring its own model.

mod budget;
mod session;
mod thoughts;
mod tokens;

pub use budget::{Budget, OverBudget};
use futures::future::BoxFuture;
use serde::{Deserialize, Serialize};
use serde_json::Value;
pub use session::{AskError, CallRecord, Session, total_usage};
use std::sync::Arc;
pub use thoughts::after_thoughts;
pub use tokens::Tokens;

/// Estimated tokens of a completion before its size is known.
const EXPECTED_COMPLETION_TOKENS: u64 = 1000;

/// Prices in US dollars per million tokens.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Prices {
    /// Price of the tokens sent, including pictures.
    pub prompt_usd: f64,
    /// Price of the tokens that the model writes.
    pub completion_usd: f64,
}

/// A request to a model. Temperature and token limits are left unset, as in the paper.
#[derive(Debug, Clone, PartialEq)]
pub struct ChatRequest {
    /// System message: the role of the model.
    pub system: String,
    /// User message: text and pictures, in this order.
    pub user: Vec<Part>,
    /// A JSON schema for the answer. Servers that refuse it are asked again without it.
    pub schema: Option<(&'static str, Value)>,
}

/// A part of a user message.
#[derive(Debug, Clone, PartialEq)]
pub enum Part {
    /// Text for the model, sent unchanged.
    Text(String),
    /// A picture at this position in the text.
    Picture(Picture),
}

/// A picture for a model.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    /// Name of the picture: `global`, `candidate-7`.
    pub name: String,
    /// Bytes of the JPEG file, shared by all copies.
    pub jpeg: Arc<[u8]>,
    /// Columns of the JPEG, pixels.
    pub width: u32,
    /// Rows of the JPEG, pixels.
    pub height: u32,
}

/// The reply of a model, with tokens and time used.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ChatReply {
    /// The model's text, unchanged. Empty when the model wrote nothing.
    pub text: String,
    /// Tokens sent, including pictures. Estimated by [`Tokens`] if the server does not count.
    pub prompt_tokens: u64,
    /// Tokens written. Estimated if the server does not count.
    pub completion_tokens: u64,
    /// Number of times the request was sent, at least 1. A recorded reply keeps its number.
    pub attempts: u32,
    /// Earlier attempts without an answer that may be billed: the server may have read the request.
    #[serde(default)]
    pub lost: u32,
    /// Wall-clock time from the first attempt to the reply, including waits.
    pub latency_ms: f64,
}

/// The reason why a model gave no answer.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // Every message describes its variant.
pub enum ChatError {
    #[error("the model server answered {status} {reason}: {detail}")]
    Refused { status: u16, reason: &'static str, detail: String },
    #[error("the model server could not be reached or took too long: {0}")]
    Transport(String),
    #[error("the model server's reply is not a chat completion: {0}")]
    Undecodable(String),
    #[error("the model gave no answer: {0}")]
    NoAnswer(String),
    #[error("the replay cache has no reply of {0} to this request")]
    NotRecorded(String),
    #[error("the replay cache could not be written")]
    ReplayCache(#[from] std::io::Error),
    #[error("the cost of the model call could not be recorded: {0}")]
    NotRecordable(String),
    #[error("the model server is down: next attempt in {again_in_s} s")]
    Down { again_in_s: u64 },
    /// A budget refused the call. It is shared with other spenders, so only the owner of the model
    /// knows what is left.
    #[error(transparent)]
    OverBudget(#[from] OverBudget),
}

/// A failed request, with the attempts that were made.
#[derive(Debug, thiserror::Error)]
#[error("{error}")]
pub struct ChatFailure {
    /// The error of the last attempt.
    #[source]
    pub error: ChatError,
    /// Number of times the request was sent. 0 if it was never sent.
    pub attempts: u32,
    /// Number of these attempts that may be billed: the server may have read the request.
    pub lost: u32,
    /// Wall-clock time of all attempts, including waits.
    pub latency_ms: f64,
}

/// A chat model: a remote endpoint, recorded answers, or a model in this process.
pub trait ChatModel: Send + Sync {
    /// Returns the model's name, which is recorded with answers.
    fn name(&self) -> &str;

    /// Returns the prices of tokens. All are 0 if they are unknown.
    fn prices(&self) -> Prices;

    /// Returns whether the model's server shows a sign of life. Costs nothing. `None` if that
    /// cannot be told.
    fn is_alive(&self) -> BoxFuture<'_, Option<bool>> {
        Box::pin(std::future::ready(None))
    }

    /// Sends a request. Retries and timeouts are up to the implementation.
    ///
    /// # Errors
    /// Returns [`ChatFailure`]. The caller must drop a future that never completes.
    fn ask<'a>(&'a self, request: &'a ChatRequest)
    -> BoxFuture<'a, Result<ChatReply, ChatFailure>>;
}

impl Prices {
    /// Returns whether any price is known to be above 0.
    #[must_use]
    pub fn has_prices(self) -> bool {
        self != Self::default()
    }

    /// Returns the estimated cost of a call before it is made, US dollars.
    #[must_use]
    pub fn estimated_usd(self, request: &ChatRequest) -> f64 {
        self.cost_usd(Tokens::estimate(request).total(), EXPECTED_COMPLETION_TOKENS)
    }

    /// Returns the cost of a call, US dollars. Attempts that may be billed count with the tokens
    /// they sent, so that the cost is not underestimated.
    #[must_use]
    pub fn billed_usd(
        self,
        request: &ChatRequest,
        outcome: &Result<ChatReply, ChatFailure>,
    ) -> f64 {
        let lost = |attempts: u32| {
            f64::from(attempts) * self.cost_usd(Tokens::estimate(request).total(), 0)
        };
        match outcome {
            Ok(reply) => {
                self.cost_usd(reply.prompt_tokens, reply.completion_tokens) + lost(reply.lost)
            }
            Err(failure) => lost(failure.lost),
        }
    }

    /// Returns the cost of tokens, US dollars.
    #[must_use]
    pub fn cost_usd(self, prompt_tokens: u64, completion_tokens: u64) -> f64 {
        (prompt_tokens as f64 * self.prompt_usd + completion_tokens as f64 * self.completion_usd)
            / 1e6
    }
}
