//! The model calls of one question: counted, paid from budgets, and recorded.

use super::budget::Reservation;
use super::{Budget, ChatError, ChatFailure, ChatModel, ChatReply, ChatRequest, OverBudget};
use uniground_types::answer::Usage;

/// A call with its request and result.
#[derive(Debug, Clone, PartialEq)]
pub struct CallRecord {
    /// Purpose of the call: `parse`, `naming`, `spatial`, or the error of the previous answer, like
    /// `out_of_set`.
    pub purpose: &'static str,
    /// The request, including pictures.
    pub request: ChatRequest,
    /// The reply, or the reason why there is none.
    pub outcome: Result<ChatReply, String>,
    /// Number of times the request was sent. 0 if it was never sent.
    pub attempts: u32,
    /// Wall-clock time of all attempts, including waits.
    pub latency_ms: f64,
    /// Cost at the model's prices, US dollars. Includes attempts that may be billed.
    pub cost_usd: f64,
}

/// The reason why a call was not made or got no answer.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // Every message describes its variant.
pub enum AskError {
    #[error(transparent)]
    Chat(#[from] ChatFailure),
    #[error(transparent)]
    Budget(#[from] OverBudget),
    #[error("the limit of {most} model calls per question is reached")]
    CallsUsedUp { most: u32 },
}

/// A call in progress with its estimated cost. The estimate counts as spent if the future is
/// dropped before the call ends.
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

/// Makes the calls of one question and pays them from its budgets.
pub struct Session<'a> {
    model: &'a dyn ChatModel,
    budgets: Vec<Budget>,
    most: u32,
    records: Vec<CallRecord>,
}

impl<'a> Session<'a> {
    /// Creates a session of at most `most` calls. Each is paid from all of `budgets`.
    #[must_use]
    pub fn new(model: &'a dyn ChatModel, budgets: Vec<Budget>, most: u32) -> Self {
        Self { model, budgets, most, records: Vec::new() }
    }

    /// Returns the model's name, as recorded with answers.
    #[must_use]
    pub fn model_name(&self) -> &str {
        self.model.name()
    }

    /// Returns how many more calls may be made. A failed call counts, a call refused by a budget
    /// does not.
    #[must_use]
    pub fn calls_left(&self) -> u32 {
        self.most.saturating_sub(self.records.len() as u32)
    }

    /// Returns the number of calls so far, failed ones included.
    #[must_use]
    pub fn calls_made(&self) -> u32 {
        self.records.len() as u32
    }

    /// Raises the limit on calls by one.
    pub fn allow_one_more(&mut self) {
        self.most += 1;
    }

    /// Sends one request and records the result.
    ///
    /// # Errors
    /// Returns [`AskError`]: no call left, no money left, or the model could not be reached.
    pub async fn ask(
        &mut self,
        purpose: &'static str,
        request: ChatRequest,
    ) -> Result<String, AskError> {
        if self.calls_left() == 0 {
            return Err(AskError::CallsUsedUp { most: self.most });
        }
        let thought = self.model.prices().estimated_usd(&request);
        let reservations = self
            .budgets
            .iter()
            .map(|budget| budget.reserve(thought))
            .collect::<Result<Vec<_>, _>>()?;
        // If the caller drops this future during the call, the request has still been sent.
        let mut sent = Sent { reservations, thought };
        let answered = match self.model.ask(&request).await {
            // The same as a refusal by one of the session's own budgets: nothing was sent.
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
        let cost_usd = self.model.prices().billed_usd(&request, &answered);
        sent.settle(cost_usd);
        let outcome = answered.as_ref().map(Clone::clone).map_err(ToString::to_string);
        self.records.push(CallRecord { purpose, request, outcome, attempts, latency_ms, cost_usd });
        Ok(answered?.text)
    }

    /// Returns all calls, in order.
    #[must_use]
    pub fn into_records(self) -> Vec<CallRecord> {
        self.records
    }
}

/// Returns the total tokens and cost of calls. A call without a reply adds no known cost.
#[must_use]
pub fn total_usage(calls: &[CallRecord]) -> Usage {
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
    fn dropped_call_counts_its_estimate_as_spent() {
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
