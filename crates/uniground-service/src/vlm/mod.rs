//! The configured vision-language model and its spending limits.

mod circuit;
mod metered;

use super::Caller;
use crate::error::Error;
use metered::MeteredModel;
use std::sync::Arc;
use std::time::Instant;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use uniground_grounding::vlm::{PictureLimits, PointForm};
use uniground_models::chat::{Budget, ChatModel, Prices};
use uniground_storage::{SpendingRepository, Store, now};
use uniground_telemetry::metrics::Metrics;

/// A model with its settings.
pub struct Vlm {
    model: MeteredModel,
    spending: SpendingRepository,
    settings: VlmSettings,
    /// Permits to wait for the model. Questions beyond them are rejected.
    places: Arc<Semaphore>,
}

#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct VlmSettings {
    /// The daily spending limit (UTC day), in US dollars.
    pub daily_usd: Option<f64>,
    /// Requests JSON that follows a schema.
    pub json: bool,
    /// How the model gives places in pictures.
    pub points: PointForm,
    /// What the model accepts in one request.
    pub limits: PictureLimits,
    /// When the model names all instances of a scene.
    pub names: WhenNamed,
}

/// When the model names all instances of a scene automatically.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum WhenNamed {
    /// Never. Only on request (`POST /v1/scenes/{id}/names`).
    #[default]
    Off,
    /// Before the first question that the model reviews. That question waits for the names.
    Lazy,
    /// As soon as a scene is parsed.
    Parse,
}

/// The names of budgets in messages.
pub(super) const OF_QUESTION: &str = "this question";
pub(super) const OF_KEY: &str = "this key today";
const OF_EVERYBODY: &str = "today";

/// The maximum number of questions that wait for the model.
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

    /// Returns the model for calls of the server itself, which count as its own spending.
    #[must_use]
    pub fn own_model(&self) -> Arc<dyn ChatModel> {
        Arc::new(self.model.clone())
    }

    /// Records that a probe could not reach the server, so that no question has to find out.
    pub fn record_unreachable(&self) {
        self.model.circuit().record(
            circuit::CallSignal::Unreachable,
            "unreachable",
            Instant::now(),
        );
    }

    pub(super) fn name(&self) -> &str {
        self.model.name()
    }

    pub(super) fn prices(&self) -> Prices {
        self.model.prices()
    }

    /// Returns the model for a caller.
    pub(super) fn model_for(&self, caller: &Caller) -> Arc<dyn ChatModel> {
        Arc::new(self.model.for_caller(caller, false))
    }

    /// Returns the model for a caller who waits, as long as there is time, for a server that cannot
    /// be reached.
    pub(super) fn patient_model_for(&self, caller: &Caller) -> Arc<dyn ChatModel> {
        Arc::new(self.model.for_caller(caller, true))
    }

    /// Returns whether the model answered its last call. Otherwise describes since when it has not.
    pub(super) fn condition(&self) -> Result<(), String> {
        self.model.circuit().condition()
    }

    pub(super) fn names(&self) -> WhenNamed {
        self.settings.names
    }

    /// Returns whether replies are requested as JSON.
    #[must_use]
    pub fn json(&self) -> bool {
        self.settings.json
    }

    /// Returns how the model gives places in pictures.
    #[must_use]
    pub fn points(&self) -> PointForm {
        self.settings.points
    }

    /// Returns what the model accepts in one request.
    #[must_use]
    pub fn picture_limits(&self) -> PictureLimits {
        self.settings.limits
    }

    /// Acquires a permit to wait for the model.
    pub(super) fn acquire_permit(&self) -> Result<OwnedSemaphorePermit, Error> {
        self.places.clone().try_acquire_owned().map_err(|_| Error::Overloaded)
    }

    /// Returns the number of questions that hold a permit to wait.
    pub(super) fn waiting(&self) -> usize {
        MAX_WAITING.saturating_sub(self.places.available_permits())
    }

    /// Returns the daily limit in US dollars.
    pub(super) fn daily_limit_usd(&self) -> Option<f64> {
        self.settings.daily_usd
    }

    /// Returns today's spending in US dollars, without calls in progress.
    pub(super) async fn spent_today_usd(&self) -> Result<f64, Error> {
        Ok(self.spending.spending_on_day(&today()).await?)
    }

    /// Returns the budgets of a single question. The daily budgets of the server and of its keys
    /// are checked with every call, because all processes share them.
    pub(super) fn budgets(of_question: Option<f64>) -> Vec<Budget> {
        of_question.map(|usd| Budget::new(OF_QUESTION, usd)).into_iter().collect()
    }
}

/// Returns today's date, UTC.
pub(super) fn today() -> String {
    now()[..10].to_owned()
}
