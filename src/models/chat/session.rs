//! The calls of one question: counted, paid for, remembered.

use super::purse::Hold;
use super::{ChatClient, ChatFailure, ChatReply, ChatRequest, OverBudget, Purse, Tokens};

/// What a completion is thought to take before it is known.
const EXPECTED_COMPLETION_TOKENS: u64 = 1000;

/// One call: what was asked, and what came of it.
#[derive(Debug, Clone, PartialEq)]
pub struct CallRecord {
    pub purpose: &'static str,
    pub request: ChatRequest,
    /// The reply, or why there is none.
    pub outcome: Result<ChatReply, String>,
    pub attempts: u32,
    pub latency_ms: f64,
    pub cost_usd: f64,
}

#[derive(Debug, thiserror::Error)]
pub enum AskError {
    #[error(transparent)]
    Chat(#[from] ChatFailure),
    #[error(transparent)]
    Budget(#[from] OverBudget),
    #[error("no more than {most} calls are made for one question")]
    CallsUsedUp { most: u32 },
}

/// A call under way and what it is thought to cost: that counts as spent when nobody waits for its end.
struct Sent {
    holds: Vec<Hold>,
    thought: f64,
}

impl Sent {
    fn settle(&mut self, usd: f64) {
        self.holds.drain(..).for_each(|hold| hold.settle(usd));
    }
}

impl Drop for Sent {
    fn drop(&mut self) {
        self.settle(self.thought);
    }
}

/// Asks for one question, from the purses that pay for it.
pub struct Session<'a> {
    client: &'a ChatClient,
    purses: Vec<Purse>,
    most: u32,
    records: Vec<CallRecord>,
}

impl<'a> Session<'a> {
    /// A session of at most `most` calls, each paid from all of `purses`.
    #[must_use]
    pub fn new(client: &'a ChatClient, purses: Vec<Purse>, most: u32) -> Self {
        Self { client, purses, most, records: Vec::new() }
    }

    #[must_use]
    pub fn model(&self) -> &str {
        self.client.model()
    }

    #[must_use]
    pub fn calls_left(&self) -> u32 {
        self.most.saturating_sub(self.records.len() as u32)
    }

    /// Asks once. Whatever comes of it is remembered.
    ///
    /// # Errors
    /// [`AskError`]: no call left, no money left, or the model could not be asked.
    pub async fn ask(&mut self, purpose: &'static str, request: ChatRequest) -> Result<String, AskError> {
        if self.calls_left() == 0 {
            return Err(AskError::CallsUsedUp { most: self.most });
        }
        let thought = self.client.cost_usd(Tokens::of(&request).total(), EXPECTED_COMPLETION_TOKENS);
        let holds = self.purses.iter().map(|purse| purse.hold(thought)).collect::<Result<Vec<_>, _>>()?;
        // Who leaves while the model thinks has asked it all the same.
        let mut sent = Sent { holds, thought };
        let answered = self.client.ask(&request).await;
        let (attempts, latency_ms) = match &answered {
            Ok(reply) => (reply.attempts, reply.latency_ms),
            Err(failure) => (failure.attempts, failure.latency_ms),
        };
        let cost_usd = answered
            .as_ref()
            .map_or(0.0, |reply| self.client.cost_usd(reply.prompt_tokens, reply.completion_tokens));
        sent.settle(cost_usd);
        let outcome = answered.as_ref().map(Clone::clone).map_err(ToString::to_string);
        self.records.push(CallRecord { purpose, request, outcome, attempts, latency_ms, cost_usd });
        Ok(answered?.text)
    }

    /// All calls, in order.
    #[must_use]
    pub fn into_records(self) -> Vec<CallRecord> {
        self.records
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_leaves_in_mid_call_has_paid_what_was_put_aside() {
        let purse = Purse::new("this question", 1.0);
        let sent = |usd| Sent { holds: vec![purse.hold(usd).unwrap()], thought: usd };
        drop(sent(0.25));
        assert!((purse.spent_usd() - 0.25).abs() < 1e-9);
        let mut answered = sent(0.5);
        answered.settle(0.1);
        drop(answered);
        assert!((purse.spent_usd() - 0.35).abs() < 1e-9 && purse.hold(0.6).is_ok());
    }
}
