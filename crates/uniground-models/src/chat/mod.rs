//! Chat models: what is asked, what is answered, what it costs (docs/METHOD.md, section 4,
//! "Calls"). How a model is reached is somebody else's business: the service speaks to
//! OpenAI-compatible endpoints, a robot may bring a model of its own.

mod budget;
mod session;
mod tokens;

pub use budget::{Budget, OverBudget};
use futures::future::BoxFuture;
use serde::{Deserialize, Serialize};
use serde_json::Value;
pub use session::{AskError, CallRecord, Session, usage_of};
use std::sync::Arc;
pub use tokens::Tokens;

/// What a completion is thought to take before it is known.
const EXPECTED_COMPLETION_TOKENS: u64 = 1000;

/// US dollars per million tokens.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Prices {
    /// For what is sent, pictures included.
    pub prompt_usd: f64,
    /// For what the model writes.
    pub completion_usd: f64,
}

/// One question to a model. Temperature and token limits are left unset, as in the paper.
#[derive(Debug, Clone, PartialEq)]
pub struct ChatRequest {
    /// System message: who the model is to be.
    pub system: String,
    /// User message: text and pictures, in this order.
    pub user: Vec<Part>,
    /// A JSON schema the answer should follow; servers that refuse it are asked without.
    pub schema: Option<(&'static str, Value)>,
}

/// A piece of a user message.
#[derive(Debug, Clone, PartialEq)]
pub enum Part {
    /// Words for the model, as they are.
    Text(String),
    /// Shown at this place between the words.
    Picture(Picture),
}

/// A picture for a model.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    /// By which it is found again: `global`, `candidate-7`.
    pub name: String,
    /// Bytes of the JPEG file, shared by all copies.
    pub jpeg: Arc<[u8]>,
    /// Columns of the JPEG, pixels.
    pub width: u32,
    /// Rows of the JPEG, pixels.
    pub height: u32,
}

/// What the model said, and what it took.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ChatReply {
    /// What the model wrote, as it came; empty when it said nothing.
    pub text: String,
    /// Tokens sent, pictures included; reckoned by [`Tokens`] where the server does not count.
    pub prompt_tokens: u64,
    /// Tokens written; reckoned where the server does not count.
    pub completion_tokens: u64,
    /// How often the request was sent, at least once; a recorded reply keeps its number.
    pub attempts: u32,
    /// Attempts before it that got no answer but may be billed: the request was read, as far as
    /// anybody knows.
    #[serde(default)]
    pub lost: u32,
    /// Wall-clock time from the first attempt to the reply, waits included.
    pub latency_ms: f64,
}

/// Why a model gave no answer.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // Every message says what it is about.
pub enum ChatError {
    #[error("the model's server said {status} {reason}: {detail}")]
    Refused { status: u16, reason: &'static str, detail: String },
    #[error("the model's server can not be reached, or took too long: {0}")]
    Transport(String),
    #[error("the model's server answered something that is no chat completion: {0}")]
    Undecodable(String),
    #[error("the replay cache has no answer to this question of {0}")]
    NotRecorded(String),
    #[error("the replay cache can not be written")]
    ReplayCache(#[from] std::io::Error),
    #[error("what the call costs can not be written down: {0}")]
    NotRecordable(String),
    #[error("the model's server is down and is not asked: it is tried again in {again_in_s} s")]
    Down { again_in_s: u64 },
    /// By money that others spend from as well, so that only the model's keeper knows what is left.
    #[error(transparent)]
    OverBudget(#[from] OverBudget),
}

/// A question that got no answer, and what was done for it.
#[derive(Debug, thiserror::Error)]
#[error("{error}")]
pub struct ChatFailure {
    /// What the last attempt came to.
    #[source]
    pub error: ChatError,
    /// How often the request was sent; 0 when it never was.
    pub attempts: u32,
    /// Those of them that may be billed: the request was read, as far as anybody knows.
    pub lost: u32,
    /// Wall-clock time of all attempts, waits included.
    pub latency_ms: f64,
}

/// A model that can be asked: an endpoint elsewhere, answers that were recorded, or a model in this
/// process.
pub trait ChatModel: Send + Sync {
    /// Its name, recorded with answers.
    fn name(&self) -> &str;

    /// What its tokens cost; all 0 when that is not known.
    fn prices(&self) -> Prices;

    /// Asks, with whatever patience it has.
    ///
    /// # Errors
    /// [`ChatFailure`]; a future that never completes is for the caller to drop.
    fn ask<'a>(&'a self, request: &'a ChatRequest)
    -> BoxFuture<'a, Result<ChatReply, ChatFailure>>;
}

impl Prices {
    /// Whether anything is known to cost something.
    #[must_use]
    pub fn are_known(self) -> bool {
        self != Self::default()
    }

    /// What a call is thought to cost before it is made, US dollars.
    #[must_use]
    pub fn thought_usd(self, request: &ChatRequest) -> f64 {
        self.cost_usd(Tokens::of(request).total(), EXPECTED_COMPLETION_TOKENS)
    }

    /// What a call has cost, US dollars. Attempts that may be billed count for what they sent:
    /// better than to find out later.
    #[must_use]
    pub fn paid_usd(self, request: &ChatRequest, outcome: &Result<ChatReply, ChatFailure>) -> f64 {
        let lost =
            |attempts: u32| f64::from(attempts) * self.cost_usd(Tokens::of(request).total(), 0);
        match outcome {
            Ok(reply) => {
                self.cost_usd(reply.prompt_tokens, reply.completion_tokens) + lost(reply.lost)
            }
            Err(failure) => lost(failure.lost),
        }
    }

    /// What tokens cost, US dollars.
    #[must_use]
    pub fn cost_usd(self, prompt_tokens: u64, completion_tokens: u64) -> f64 {
        (prompt_tokens as f64 * self.prompt_usd + completion_tokens as f64 * self.completion_usd)
            / 1e6
    }
}
