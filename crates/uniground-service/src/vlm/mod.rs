//! The configured vision-language model, and what may be spent on it.

mod circuit;
mod metered;

use super::Caller;
use crate::error::Error;
use metered::MeteredModel;
use std::sync::Arc;
use std::time::Instant;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use uniground_models::chat::{Budget, ChatModel, Prices};
use uniground_storage::{SpendingRepository, Store, now};
use uniground_telemetry::metrics::Metrics;

/// A model and how it is used here.
pub struct Vlm {
    model: MeteredModel,
    spending: SpendingRepository,
    settings: VlmSettings,
    /// Questions that wait for the model; more are told to come back.
    places: Arc<Semaphore>,
}

#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct VlmSettings {
    /// Most that may be spent in a day (UTC), US dollars.
    pub daily_usd: Option<f64>,
    /// Ask for JSON by a schema.
    pub json: bool,
    /// When it names everything in a scene.
    pub names: WhenNamed,
}

/// When the model names everything in a scene, unasked.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum WhenNamed {
    /// Never: only where somebody asks for it (`POST /v1/scenes/{id}/names`)
    #[default]
    Off,
    /// Before the first question that the model reviews; that question waits for it
    Lazy,
    /// As soon as a scene is parsed
    Parse,
}

/// Whose budgets there are, in messages.
pub(super) const OF_QUESTION: &str = "this question";
pub(super) const OF_KEY: &str = "this key today";
const OF_EVERYBODY: &str = "today";

/// Questions that may wait for the model at once.
const MAX_WAITING: usize = 256;

impl Vlm {
    #[must_use]
    pub fn new(
        model: Arc<dyn ChatModel>,
        settings: VlmSettings,
        store: &Store,
        metrics: Arc<Metrics>,
    ) -> Self {
        let model = MeteredModel::new(model, settings.daily_usd, store, metrics);
        let spending = store.spending.clone();
        Self { model, spending, settings, places: Arc::new(Semaphore::new(MAX_WAITING)) }
    }

    /// Its server was looked at and can not be reached: nobody has to find out.
    pub fn found_gone(&self) {
        self.model.circuit().note(circuit::CallSignal::Gone, "unreachable", Instant::now());
    }

    pub(super) fn name(&self) -> &str {
        self.model.name()
    }

    pub(super) fn prices(&self) -> Prices {
        self.model.prices()
    }

    /// The model, asked for somebody.
    pub(super) fn model_for(&self, caller: &Caller) -> Arc<dyn ChatModel> {
        Arc::new(self.model.of(caller))
    }

    /// Whether the model answered when it was asked last; else since when it has not.
    pub(super) fn condition(&self) -> Result<(), String> {
        self.model.circuit().condition()
    }

    pub(super) fn names(&self) -> WhenNamed {
        self.settings.names
    }

    pub(super) fn json(&self) -> bool {
        self.settings.json
    }

    /// A place among those who wait.
    pub(super) fn place(&self) -> Result<OwnedSemaphorePermit, Error> {
        self.places.clone().try_acquire_owned().map_err(|_| Error::Overloaded)
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
    pub(super) async fn spent_today_usd(&self) -> Result<f64, Error> {
        Ok(self.spending.spent_on(&today()).await?)
    }

    /// What pays for a question of its own. The day's money, everybody's and a key's, is looked at
    /// with every call: all processes share it.
    pub(super) fn budgets(of_question: Option<f64>) -> Vec<Budget> {
        of_question.map(|usd| Budget::new(OF_QUESTION, usd)).into_iter().collect()
    }
}

/// Today's date, UTC.
pub(super) fn today() -> String {
    now()[..10].to_owned()
}
