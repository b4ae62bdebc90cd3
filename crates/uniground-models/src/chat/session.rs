//! The calls of one question: counted, paid for, remembered.

use super::budget::Reservation;
use super::{Budget, ChatError, ChatFailure, ChatModel, ChatReply, ChatRequest, OverBudget};
use uniground_types::answer::Usage;

/// One call: what was asked, and what came of it.
#[derive(Debug, Clone, PartialEq)]
pub struct CallRecord {
    /// What the call was for: `parse`, `naming`, `spatial`, or what was wrong with the answer
    /// before, like `out_of_set`.
    pub purpose: &'static str,
    /// What was asked, pictures included.
    pub request: ChatRequest,
    /// The reply, or why there is none.
    pub outcome: Result<ChatReply, String>,
    /// How often the request was sent; 0 when it never was.
    pub attempts: u32,
    /// Wall-clock time of all attempts, waits included.
    pub latency_ms: f64,
    /// At the model's prices, US dollars; attempts that may be billed count.
    pub cost_usd: f64,
}

/// Why a call was not made, or got no answer.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // Every message says what it is about.
pub enum AskError {
    #[error(transparent)]
    Chat(#[from] ChatFailure),
    #[error(transparent)]
    Budget(#[from] OverBudget),
    #[error("no more than {most} calls are made for one question")]
    CallsUsedUp { most: u32 },
}

/// A call under way and what it is thought to cost: that counts as spent when nobody waits for its
/// end.
struct Sent {
    reservations: Vec<Reservation>,
    thought: f64,
}

impl Sent {
    fn settle(&mut self, usd: f64) {
        self.reservations.drain(..).for_each(|reservation| reservation.settle(usd));
    }
}

impl Drop for Sent {
    fn drop(&mut self) {
        self.settle(self.thought);
    }
}

/// Asks for one question, from the budgets that pay for it.
pub struct Session<'a> {
    model: &'a dyn ChatModel,
    budgets: Vec<Budget>,
    most: u32,
    records: Vec<CallRecord>,
}

impl<'a> Session<'a> {
    /// A session of at most `most` calls, each paid from all of `budgets`.
    #[must_use]
    pub fn new(model: &'a dyn ChatModel, budgets: Vec<Budget>, most: u32) -> Self {
        Self { model, budgets, most, records: Vec::new() }
    }

    /// Name of the model that is asked, as recorded with answers.
    #[must_use]
    pub fn model_name(&self) -> &str {
        self.model.name()
    }

    /// How many more calls may be made. A failed call counts, one refused by a budget does not.
    #[must_use]
    pub fn calls_left(&self) -> u32 {
        self.most.saturating_sub(self.records.len() as u32)
    }

    /// Lets one more call be made than was agreed.
    pub fn allow_one_more(&mut self) {
        self.most += 1;
    }

    /// Asks once. Whatever comes of it is remembered.
    ///
    /// # Errors
    /// [`AskError`]: no call left, no money left, or the model could not be asked.
    pub async fn ask(
        &mut self,
        purpose: &'static str,
        request: ChatRequest,
    ) -> Result<String, AskError> {
        if self.calls_left() == 0 {
            return Err(AskError::CallsUsedUp { most: self.most });
        }
        let thought = self.model.prices().thought_usd(&request);
        let reservations = self
            .budgets
            .iter()
            .map(|budget| budget.reserve(thought))
            .collect::<Result<Vec<_>, _>>()?;
        // Who leaves while the model thinks has asked it all the same.
        let mut sent = Sent { reservations, thought };
        let answered = match self.model.ask(&request).await {
            // As if one of ours had refused it: nothing was asked.
            Err(ChatFailure { error: ChatError::OverBudget(over), .. }) => {
                sent.settle(0.0);
                return Err(over.into());
            }
            answered => answered,
        };
        let (attempts, latency_ms) = match &answered {
            Ok(reply) => (reply.attempts, reply.latency_ms),
            Err(failure) => (failure.attempts, failure.latency_ms),
        };
        let cost_usd = self.model.prices().paid_usd(&request, &answered);
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

/// Sums up the tokens and the cost of calls. A call without a reply costs nothing that is known.
#[must_use]
pub fn usage_of(calls: &[CallRecord]) -> Usage {
    let replies = || calls.iter().filter_map(|call| call.outcome.as_ref().ok());
    Usage {
        vlm_calls: replies().count() as u32,
        prompt_tokens: replies().map(|reply| reply.prompt_tokens).sum(),
        completion_tokens: replies().map(|reply| reply.completion_tokens).sum(),
        // An empty sum of floats is -0.
        cost_usd: calls.iter().fold(0.0, |sum, call| sum + call.cost_usd),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_leaves_in_mid_call_has_paid_what_was_put_aside() {
        let budget = Budget::new("this question", 1.0);
        let sent = |usd| Sent { reservations: vec![budget.reserve(usd).unwrap()], thought: usd };
        drop(sent(0.25));
        assert!((budget.spent_usd() - 0.25).abs() < 1e-9);
        let mut answered = sent(0.5);
        answered.settle(0.1);
        drop(answered);
        assert!((budget.spent_usd() - 0.35).abs() < 1e-9 && budget.reserve(0.6).is_ok());
    }
}
