//! The configured vision-language model, and what may be spent on it.

use crate::error::Error;
use crate::metrics::Metrics;
use crate::store::{Store, now};
use futures::FutureExt;
use futures::future::BoxFuture;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tracing::{Instrument, field};
use uniground_core::models::chat::{Budget, ChatError, ChatFailure, ChatModel, ChatReply, ChatRequest, Prices};
use uniground_core::models::with_causes;

/// A model and how it is used here.
pub struct Vlm {
    /// Writes down what each call costs.
    pub model: Arc<dyn ChatModel>,
    settings: VlmSettings,
    /// Questions that wait for the model; more are told to come back.
    places: Arc<Semaphore>,
    today: Mutex<Option<Today>>,
    condition: Arc<Mutex<Condition>>,
}

/// What became of the latest calls.
#[derive(Default)]
struct Condition {
    /// Calls in a row that the model did not answer, by the last one's outcome, and when the first of them was.
    failing: Option<(u32, &'static str, String)>,
}

/// What may be spent on one day.
#[derive(Clone)]
struct Today {
    /// Its date, UTC.
    day: String,
    budget: Budget,
}

#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct VlmSettings {
    /// Most that may be spent in a day (UTC), US dollars.
    pub daily_usd: Option<f64>,
    /// Ask for JSON by a schema.
    pub json: bool,
}

/// Questions that may wait for the model at once.
const MAX_WAITING: usize = 256;

impl Vlm {
    #[must_use]
    pub fn new(model: Arc<dyn ChatModel>, settings: VlmSettings, store: Store, metrics: Arc<Metrics>) -> Self {
        metrics.vlm.knows(&[ANSWERED, REFUSED, UNREACHABLE, UNREADABLE]);
        let condition = Arc::default();
        let model = Arc::new(Metered { model, store, metrics, condition: Arc::clone(&condition) });
        Self { model, settings, places: Arc::new(Semaphore::new(MAX_WAITING)), today: Mutex::default(), condition }
    }

    /// Whether the model answered when it was asked last; else since when it has not, and what happens instead.
    pub(super) fn condition(&self) -> Result<(), String> {
        match &self.condition.lock().unwrap_or_else(PoisonError::into_inner).failing {
            None => Ok(()),
            Some((calls, outcome, since)) => Err(format!("{outcome} since {since} ({calls} calls)")),
        }
    }

    /// Questions that have a place among those who wait.
    pub(super) fn waiting(&self) -> usize {
        MAX_WAITING.saturating_sub(self.places.available_permits())
    }

    /// US dollars.
    pub(super) fn daily_limit_usd(&self) -> Option<f64> {
        self.settings.daily_usd
    }

    /// US dollars, calls under way left out.
    pub(super) async fn spent_today_usd(&self, store: &Store) -> Result<f64, Error> {
        Ok(self.budget_of_today(store).await?.spent_usd())
    }

    pub(super) fn name(&self) -> &str {
        self.model.name()
    }

    pub(super) fn json(&self) -> bool {
        self.settings.json
    }

    /// A place among those who wait.
    pub(super) fn place(&self) -> Result<OwnedSemaphorePermit, Error> {
        self.places.clone().try_acquire_owned().map_err(|_| Error::Overloaded)
    }

    /// What pays for a question: its own budget, where it has one, and the day's.
    pub(super) async fn budgets(&self, store: &Store, of_question: Option<f64>) -> Result<Vec<Budget>, Error> {
        let today = self.budget_of_today(store).await?;
        Ok(of_question.map(|usd| Budget::new("this question", usd)).into_iter().chain([today]).collect())
    }

    async fn budget_of_today(&self, store: &Store) -> Result<Budget, Error> {
        let day = today();
        let of_day = |known: &Option<Today>| known.as_ref().filter(|today| today.day == day).map(|today| today.budget.clone());
        let known = of_day(&self.today.lock().unwrap_or_else(PoisonError::into_inner));
        if let Some(budget) = known {
            return Ok(budget);
        }
        let spent = store.spent_on(&day).await?;
        let mut today = self.today.lock().unwrap_or_else(PoisonError::into_inner);
        // Somebody may have been faster.
        if let Some(budget) = of_day(&today) {
            return Ok(budget);
        }
        let budget = Budget::new("today", self.settings.daily_usd.unwrap_or(f64::INFINITY)).with_spent(spent);
        *today = Some(Today { day, budget: budget.clone() });
        Ok(budget)
    }
}

/// Today's date, UTC.
pub(super) fn today() -> String {
    now()[..10].to_owned()
}

/// What may come of a call.
const ANSWERED: &str = "answered";
const REFUSED: &str = "refused";
const UNREACHABLE: &str = "unreachable";
const UNREADABLE: &str = "unreadable";
/// Whoever asked left before there was an answer.
const ABANDONED: &str = "abandoned";

fn outcome_of(answered: &Result<ChatReply, ChatFailure>) -> &'static str {
    match answered {
        Ok(_) => ANSWERED,
        Err(ChatFailure { error, .. }) => match error {
            ChatError::Refused { .. } => REFUSED,
            ChatError::Transport(_) => UNREACHABLE,
            ChatError::Undecodable(_) => UNREADABLE,
            ChatError::NotRecorded(_) | ChatError::ReplayCache(_) => "not_recorded",
            ChatError::NotRecordable(_) => "not_recordable",
        },
    }
}

/// A model whose calls are written down before they are made: whatever becomes of the server or of who asked, what was spent is known.
/// They are counted, too.
struct Metered {
    model: Arc<dyn ChatModel>,
    store: Store,
    metrics: Arc<Metrics>,
    condition: Arc<Mutex<Condition>>,
}

impl Metered {
    async fn ask_paid(&self, request: &ChatRequest) -> Result<ChatReply, ChatFailure> {
        let prices = self.model.prices();
        if !prices.are_known() {
            return self.model.ask(request).await;
        }
        let thought_usd = prices.thought_usd(request);
        let reserved = self.store.reserve_spending(&today(), thought_usd).await;
        let id = reserved.map_err(|error| {
            let error = ChatError::NotRecordable(with_causes(&error));
            ChatFailure { error, attempts: 0, lost: 0, latency_ms: 0.0 }
        })?;
        // Who leaves while the model thinks has asked it all the same.
        let mut call = Call { store: self.store.clone(), open: Some((id, thought_usd)) };
        let outcome = self.model.ask(request).await;
        call.open = call.open.take().map(|(id, _)| (id, prices.paid_usd(request, &outcome)));
        call.settle().await;
        outcome
    }

    fn count(&self, outcome: &'static str, attempts: u32, start: Instant, usd: f64) {
        self.metrics.vlm.called(outcome, attempts, start.elapsed());
        self.metrics.vlm.paid(usd);
        let mut condition = self.condition.lock().unwrap_or_else(PoisonError::into_inner);
        match outcome {
            ANSWERED => condition.failing = None,
            REFUSED | UNREACHABLE | UNREADABLE => {
                let (calls, _, since) = condition.failing.take().unwrap_or_else(|| (0, outcome, now()));
                condition.failing = Some((calls + 1, outcome, since));
            }
            _ => {}
        }
    }
}

impl ChatModel for Metered {
    fn name(&self) -> &str {
        self.model.name()
    }

    fn prices(&self) -> Prices {
        self.model.prices()
    }

    fn ask<'a>(&'a self, request: &'a ChatRequest) -> BoxFuture<'a, Result<ChatReply, ChatFailure>> {
        async move {
            let span = tracing::info_span!("model_call", model = self.name(), outcome = field::Empty, attempts = field::Empty);
            let mut counted = Counted { metered: self, start: Instant::now(), thought_usd: Some(self.prices().thought_usd(request)) };
            let answered = self.ask_paid(request).instrument(span.clone()).await;
            counted.thought_usd = None;
            let (attempts, usd) = match &answered {
                Ok(reply) => {
                    self.metrics.vlm.counted(reply.prompt_tokens, reply.completion_tokens);
                    (reply.attempts, self.prices().paid_usd(request, &answered))
                }
                Err(failure) => (failure.attempts, self.prices().paid_usd(request, &answered)),
            };
            let outcome = outcome_of(&answered);
            span.record("outcome", outcome).record("attempts", attempts);
            self.count(outcome, attempts, counted.start, usd);
            answered
        }
        .boxed()
    }
}

/// A call that will be counted, also when nobody waits for its end.
struct Counted<'a> {
    metered: &'a Metered,
    start: Instant,
    /// What the call is taken to cost as long as it is under way.
    thought_usd: Option<f64>,
}

impl Drop for Counted<'_> {
    fn drop(&mut self) {
        if let Some(usd) = self.thought_usd {
            self.metered.count(ABANDONED, 1, self.start, usd);
        }
    }
}

/// A call under way.
struct Call {
    store: Store,
    /// Its reservation, and what it is taken to cost.
    open: Option<(String, f64)>,
}

impl Call {
    async fn settle(&mut self) {
        if let Some((id, usd)) = self.open.take() {
            settle(&self.store, &id, usd).await;
        }
    }
}

impl Drop for Call {
    fn drop(&mut self) {
        if let Some((id, usd)) = self.open.take() {
            let store = self.store.clone();
            tokio::spawn(async move { settle(&store, &id, usd).await });
        }
    }
}

/// What can not be settled stays reserved, and counts as spent when the server starts next.
async fn settle(store: &Store, id: &str, usd: f64) {
    if let Err(error) = store.settle_spending(id, usd).await {
        tracing::warn!(
            usd,
            error = &error as &dyn std::error::Error,
            "what a call has cost could not be written down: it stays reserved"
        );
    }
}
