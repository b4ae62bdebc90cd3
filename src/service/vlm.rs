//! The configured vision-language model, and what may be spent on it.

use crate::error::Error;
use crate::store::{Store, now};
use std::sync::Arc;
use std::sync::{Mutex, PoisonError};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use uniground_core::models::chat::{Budget, ChatModel};

/// A model and how it is used here.
pub struct Vlm {
    pub model: Arc<dyn ChatModel>,
    settings: VlmSettings,
    /// Questions that wait for the model; more are told to come back.
    places: Arc<Semaphore>,
    today: Mutex<Option<Today>>,
}

/// What may be spent on one day.
#[derive(Clone)]
struct Today {
    /// Its date, UTC.
    day: String,
    budget: Budget,
    /// What is written down already.
    noted_usd: f64,
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
    pub fn new(model: Arc<dyn ChatModel>, settings: VlmSettings) -> Self {
        Self { model, settings, places: Arc::new(Semaphore::new(MAX_WAITING)), today: Mutex::default() }
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

    /// Writes down what was spent today.
    pub(super) async fn note_spending(&self, store: &Store) -> Result<(), Error> {
        let known = self.today.lock().unwrap_or_else(PoisonError::into_inner).clone();
        let Some(Today { day, budget, noted_usd }) = known else { return Ok(()) };
        let spent = budget.spent_usd();
        if spent > noted_usd {
            store.set_spent_on(&day, spent).await?;
            let mut today = self.today.lock().unwrap_or_else(PoisonError::into_inner);
            if let Some(today) = today.as_mut().filter(|today| today.day == day) {
                today.noted_usd = today.noted_usd.max(spent);
            }
        }
        Ok(())
    }

    async fn budget_of_today(&self, store: &Store) -> Result<Budget, Error> {
        let day = now()[..10].to_owned();
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
        *today = Some(Today { day: day.clone(), budget: budget.clone(), noted_usd: spent });
        Ok(budget)
    }
}
