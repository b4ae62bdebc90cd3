//! Records calls of the model before they are made, and counts them when they end.

use super::circuit::{CallSignal, CircuitBreaker, LOOK_INTERVAL};
use super::{OF_EVERYBODY, OF_KEY, today};
use crate::Caller;
use crate::keys::KnownKey;
use futures::FutureExt;
use futures::future::BoxFuture;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::time::sleep;
use tracing::{Instrument, field};
use uniground_models::chat::{
    ChatError, ChatFailure, ChatModel, ChatReply, ChatRequest, OverBudget, Prices,
};
use uniground_models::with_causes;
use uniground_storage::{
    BudgetExceeded, BudgetOwner, IdGenerator, SpendRequest, SpendingRepository, Store, StoreError,
};
use uniground_telemetry::metrics::Metrics;

/// The outcomes of a call.
const ANSWERED: &str = "answered";
const REFUSED: &str = "refused";
const UNREACHABLE: &str = "unreachable";
const UNREADABLE: &str = "unreadable";
/// The server was considered down.
const NOT_ASKED: &str = "not_asked";
/// The caller left before the answer.
const ABANDONED: &str = "abandoned";

/// How long a call waits for an unavailable database, and the interval between attempts.
const DATABASE_RETRY_TIMEOUT: Duration = Duration::from_secs(30);
const RETRY_INTERVAL: Duration = Duration::from_secs(1);

fn outcome_name(answered: &Result<ChatReply, ChatFailure>) -> &'static str {
    match answered {
        Ok(_) => ANSWERED,
        Err(ChatFailure { error, .. }) => match error {
            ChatError::Refused { .. } => REFUSED,
            ChatError::Transport(_) => UNREACHABLE,
            ChatError::Undecodable(_) | ChatError::NoAnswer(_) => UNREADABLE,
            ChatError::NotRecorded(_) | ChatError::ReplayCache(_) => "not_recorded",
            ChatError::NotRecordable(_) => "not_recordable",
            ChatError::Down { .. } | ChatError::OverBudget(_) => NOT_ASKED,
        },
    }
}

/// Returns what a call reveals about the model's server. Returns `None` if it never reached it.
fn call_signal(answered: &Result<ChatReply, ChatFailure>) -> Option<CallSignal> {
    match answered {
        Ok(_) => Some(CallSignal::Up),
        Err(ChatFailure { error, .. }) => match error {
            ChatError::Transport(_) => Some(CallSignal::Unreachable),
            ChatError::Refused { status: 429 | 500..=599, .. } => Some(CallSignal::Failing),
            ChatError::Refused { .. } | ChatError::Undecodable(_) | ChatError::NoAnswer(_) => {
                Some(CallSignal::Unclear)
            }
            ChatError::NotRecorded(_)
            | ChatError::ReplayCache(_)
            | ChatError::NotRecordable(_)
            | ChatError::Down { .. }
            | ChatError::OverBudget(_) => None,
        },
    }
}

/// A model whose calls are recorded before they are made. The spending is known even if this server
/// is killed or the caller leaves. Calls are also counted in metrics.
#[derive(Clone)]
pub struct MeteredModel {
    model: Arc<dyn ChatModel>,
    spending: SpendingRepository,
    ids: IdGenerator,
    metrics: Arc<Metrics>,
    circuit: Arc<CircuitBreaker>,
    /// Held while one call looks for the server. The others wait for what it finds.
    looking: Arc<tokio::sync::Mutex<()>>,
    /// The daily spending limit (UTC day), in US dollars.
    daily_usd: Option<f64>,
    /// The key of the caller.
    key: Option<Arc<KnownKey>>,
    /// Whether a call waits for a server that cannot be reached. Its caller has a limit of time.
    waits: bool,
}

impl MeteredModel {
    pub fn new(
        model: Arc<dyn ChatModel>,
        daily_usd: Option<f64>,
        store: &Store,
        metrics: Arc<Metrics>,
    ) -> Self {
        metrics.vlm.register(&[ANSWERED, REFUSED, UNREACHABLE, UNREADABLE, NOT_ASKED]);
        let (spending, ids) = (store.spending.clone(), store.ids.clone());
        let (circuit, looking) = (Arc::default(), Arc::default());
        Self { model, spending, ids, metrics, circuit, looking, daily_usd, key: None, waits: false }
    }

    /// Returns the same model for a caller, to whom the cost of calls is charged too.
    pub fn for_caller(&self, caller: &Caller, waits: bool) -> Self {
        Self { key: caller.key.clone(), waits, ..self.clone() }
    }

    /// Returns the circuit breaker of the model's server.
    pub fn circuit(&self) -> &Arc<CircuitBreaker> {
        &self.circuit
    }

    async fn ask_paid(&self, request: &ChatRequest) -> Result<ChatReply, ChatFailure> {
        let prices = self.model.prices();
        let key_daily_usd = self.key.as_ref().and_then(|key| key.row.daily_usd);
        if !prices.has_prices() && self.daily_usd.is_none() && key_daily_usd.is_none() {
            return self.model.ask(request).await;
        }
        let thought_usd = prices.estimated_usd(request);
        // A caller that leaves before the call is made pays nothing, even if the money is already
        // reserved. A caller that leaves while the model computes pays for the call.
        let mut call =
            OpenCall { spending: self.spending.clone(), open: Some((self.ids.new_id(), 0.0)) };
        let id = call.open.as_ref().map_or("", |(id, _)| id);
        let (day, key_id) = (today(), self.key.as_ref().map(|key| &*key.row.id));
        let wish = SpendRequest {
            day: &day,
            usd: thought_usd,
            key_id,
            daily_usd: self.daily_usd,
            key_daily_usd,
        };
        let never_asked = |error| ChatFailure { error, attempts: 0, lost: 0, latency_ms: 0.0 };
        let reserved = self.reserve(id, &wish).await;
        let reserved =
            reserved.map_err(|error| never_asked(ChatError::NotRecordable(with_causes(&error))))?;
        if let Err(BudgetExceeded { whose, limit_usd, left_usd }) = reserved {
            let of = if whose == BudgetOwner::Key { OF_KEY } else { OF_EVERYBODY };
            call.open = None;
            return Err(never_asked(
                OverBudget { of, limit_usd, left_usd, wanted_usd: thought_usd }.into(),
            ));
        }
        call.open = call.open.take().map(|(id, _)| (id, thought_usd));
        let outcome = self.model.ask(request).await;
        call.open = call.open.take().map(|(id, _)| (id, prices.billed_usd(request, &outcome)));
        call.settle_reservation().await;
        outcome
    }

    /// Reserves the cost of a call. Retries while the database is busy, because earlier calls of
    /// the same question may already be paid.
    async fn reserve(
        &self,
        id: &str,
        wish: &SpendRequest<'_>,
    ) -> Result<Result<(), BudgetExceeded>, StoreError> {
        let start = Instant::now();
        loop {
            match self.spending.reserve_spending(id, wish).await {
                Err(error) if error.is_busy() && start.elapsed() < DATABASE_RETRY_TIMEOUT => {
                    sleep(RETRY_INTERVAL).await;
                }
                reserved => return reserved,
            }
        }
    }

    /// Admits a call, after a look for a server that could not be reached.
    ///
    /// # Errors
    /// The time to wait.
    async fn admit(&self) -> Result<(), Duration> {
        loop {
            self.look().await;
            match self.circuit.admit(Instant::now()) {
                Err(_) if self.waits && self.circuit.is_unreachable() => sleep(LOOK_INTERVAL).await,
                admitted => return admitted,
            }
        }
    }

    async fn look(&self) {
        if !self.circuit.wants_look(Instant::now()) {
            return;
        }
        let _alone = self.looking.lock().await;
        // Another call may have looked meanwhile.
        if self.circuit.wants_look(Instant::now())
            && let Some(is_alive) = self.model.is_alive().await
        {
            self.circuit.record_look(is_alive, Instant::now());
        }
    }

    fn count(&self, outcome: &'static str, attempts: u32, start: Instant, usd: f64) {
        self.metrics.vlm.record_call(outcome, attempts, start.elapsed());
        self.metrics.vlm.record_spending(usd);
    }
}

impl ChatModel for MeteredModel {
    fn name(&self) -> &str {
        self.model.name()
    }

    fn prices(&self) -> Prices {
        self.model.prices()
    }

    fn ask<'a>(
        &'a self,
        request: &'a ChatRequest,
    ) -> BoxFuture<'a, Result<ChatReply, ChatFailure>> {
        async move {
            if let Err(wait) = self.admit().await {
                self.metrics.vlm.record_call(NOT_ASKED, 0, Duration::ZERO);
                let error = ChatError::Down { again_in_s: wait.as_secs().max(1) };
                return Err(ChatFailure { error, attempts: 0, lost: 0, latency_ms: 0.0 });
            }
            let span = tracing::info_span!(
                "model_call",
                model = self.name(),
                outcome = field::Empty,
                attempts = field::Empty
            );
            let mut counted = CallCounter {
                metered: self,
                start: Instant::now(),
                thought_usd: Some(self.prices().estimated_usd(request)),
            };
            let answered = self.ask_paid(request).instrument(span.clone()).await;
            counted.thought_usd = None;
            if let Err(ChatFailure { error: ChatError::OverBudget(_), .. }) = &answered {
                self.circuit.release_probe();
                return answered;
            }
            let (attempts, usd) = match &answered {
                Ok(reply) => {
                    self.metrics.vlm.record_tokens(reply.prompt_tokens, reply.completion_tokens);
                    (reply.attempts, self.prices().billed_usd(request, &answered))
                }
                Err(failure) => (failure.attempts, self.prices().billed_usd(request, &answered)),
            };
            let outcome = outcome_name(&answered);
            span.record("outcome", outcome).record("attempts", attempts);
            self.count(outcome, attempts, counted.start, usd);
            match call_signal(&answered) {
                Some(sign) => self.circuit.record(sign, outcome, Instant::now()),
                None => self.circuit.release_probe(),
            }
            answered
        }
        .boxed()
    }
}

/// Counts a call, even if its caller leaves before the end.
struct CallCounter<'a> {
    metered: &'a MeteredModel,
    start: Instant,
    /// The estimated cost of the call while it is in progress.
    thought_usd: Option<f64>,
}

impl Drop for CallCounter<'_> {
    fn drop(&mut self) {
        if let Some(usd) = self.thought_usd {
            self.metered.count(ABANDONED, 1, self.start, usd);
            self.metered.circuit.release_probe();
        }
    }
}

/// A call in progress.
struct OpenCall {
    spending: SpendingRepository,
    /// The reservation, with the expected cost.
    open: Option<(String, f64)>,
}

impl OpenCall {
    async fn settle_reservation(&mut self) {
        if let Some((id, usd)) = self.open.take() {
            settle_reservation(&self.spending, &id, usd).await;
        }
    }
}

impl Drop for OpenCall {
    fn drop(&mut self) {
        if let Some((id, usd)) = self.open.take() {
            let spending = self.spending.clone();
            tokio::spawn(async move { settle_reservation(&spending, &id, usd).await });
        }
    }
}

/// Settles a reservation. If that fails, the money stays reserved and counts as spent after the
/// next start of the server.
async fn settle_reservation(spending: &SpendingRepository, id: &str, usd: f64) {
    if let Err(error) = spending.settle_spending(id, usd).await {
        tracing::warn!(
            usd,
            error = &error as &dyn std::error::Error,
            "cost of a model call could not be recorded; it stays reserved"
        );
    }
}
