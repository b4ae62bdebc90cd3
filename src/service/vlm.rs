//! The configured vision-language model, and what may be spent on it.

use super::Caller;
use crate::error::Error;
use crate::store::{Store, now};
use futures::FutureExt;
use futures::future::BoxFuture;
use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use uniground_core::models::chat::{Budget, ChatError, ChatFailure, ChatModel, ChatReply, ChatRequest, Prices};
use uniground_core::models::with_causes;

/// A model and how it is used here.
pub struct Vlm {
    /// Asked through [`model_for`](Self::model_for) only: what a call costs is written down.
    model: Arc<dyn ChatModel>,
    store: Store,
    settings: VlmSettings,
    /// Questions that wait for the model; more are told to come back.
    places: Arc<Semaphore>,
    /// By key; of no key: everybody together.
    today: Mutex<HashMap<String, Today>>,
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
    pub fn new(model: Arc<dyn ChatModel>, settings: VlmSettings, store: Store) -> Self {
        Self { model, store, settings, places: Arc::new(Semaphore::new(MAX_WAITING)), today: Mutex::default() }
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

    pub(super) fn prices(&self) -> Prices {
        self.model.prices()
    }

    /// The model, asked for somebody: what it costs is written down, for them too.
    pub(super) fn model_for(&self, caller: &Caller) -> Arc<dyn ChatModel> {
        let key_id = caller.key_id().map(str::to_owned);
        Arc::new(Metered { model: self.model.clone(), store: self.store.clone(), key_id })
    }

    /// What pays for a question: its own budget, where it has one, that of who asks, and the day's.
    pub(super) async fn budgets(&self, caller: &Caller, of_question: Option<f64>) -> Result<Vec<Budget>, Error> {
        let mut budgets: Vec<Budget> = of_question.map(|usd| Budget::new("this question", usd)).into_iter().collect();
        if let Some(key) = &caller.key
            && let Some(usd) = key.row.daily_usd
        {
            budgets.push(self.budget_of_today(Some(&key.row.id), "this key today", usd).await?);
        }
        budgets.push(self.budget_of_today(None, "today", self.settings.daily_usd.unwrap_or(f64::INFINITY)).await?);
        Ok(budgets)
    }

    async fn budget_of_today(&self, key_id: Option<&str>, of: &'static str, usd: f64) -> Result<Budget, Error> {
        let (day, who) = (today(), key_id.unwrap_or_default());
        if let Some(budget) = self.known_budget(who, &day) {
            return Ok(budget);
        }
        let spent = match key_id {
            Some(key_id) => self.store.spent_by_key(key_id, &day).await?,
            None => self.store.spent_on(&day).await?,
        };
        let budget = Budget::new(of, usd).with_spent(spent);
        let mut budgets = self.today.lock().unwrap_or_else(PoisonError::into_inner);
        budgets.retain(|_, of| of.day == day);
        // Somebody may have been faster.
        Ok(budgets.entry(who.to_owned()).or_insert(Today { day, budget }).budget.clone())
    }

    fn known_budget(&self, who: &str, day: &str) -> Option<Budget> {
        let budgets = self.today.lock().unwrap_or_else(PoisonError::into_inner);
        budgets.get(who).filter(|of| of.day == day).map(|of| of.budget.clone())
    }
}

/// Today's date, UTC.
fn today() -> String {
    now()[..10].to_owned()
}

/// A model whose calls are written down before they are made: whatever becomes of the server or of who asked, what was spent is known.
struct Metered {
    model: Arc<dyn ChatModel>,
    store: Store,
    /// Whose call it is.
    key_id: Option<String>,
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
            let prices = self.model.prices();
            if !prices.are_known() {
                return self.model.ask(request).await;
            }
            let thought_usd = prices.thought_usd(request);
            let reserved = self.store.reserve_spending(&today(), thought_usd, self.key_id.as_deref()).await;
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
        .boxed()
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
