//! The configured vision-language model, and what may be spent on it.

use crate::error::Error;
use crate::models::chat::{ChatClient, Purse};
use crate::store::{Store, now};
use std::sync::{Mutex, PoisonError};
use tokio::sync::{Semaphore, SemaphorePermit};

/// A model and how it is used here.
pub struct Vlm {
    pub client: std::sync::Arc<ChatClient>,
    settings: VlmSettings,
    /// Questions that wait for the model; more are told to come back.
    places: Semaphore,
    /// The day's purse, by its date.
    today: Mutex<Option<(String, Purse)>>,
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
    pub fn new(client: ChatClient, settings: VlmSettings) -> Self {
        Self { client: client.into(), settings, places: Semaphore::new(MAX_WAITING), today: Mutex::default() }
    }

    pub(super) fn json(&self) -> bool {
        self.settings.json
    }

    /// A place among those who wait.
    pub(super) fn place(&self) -> Result<SemaphorePermit<'_>, Error> {
        self.places.try_acquire().map_err(|_| Error::Overloaded)
    }

    /// What pays for a question: its own purse, where it has one, and the day's.
    pub(super) async fn purses(&self, store: &Store, of_question: Option<f64>) -> Result<Vec<Purse>, Error> {
        let today = self.purse_of_today(store).await?;
        Ok(of_question.map(|usd| Purse::new("this question", usd)).into_iter().chain([today]).collect())
    }

    /// Writes down what was spent today.
    pub(super) async fn note_spending(&self, store: &Store) -> Result<(), Error> {
        let known = self.today.lock().unwrap_or_else(PoisonError::into_inner).clone();
        match known {
            Some((day, purse)) if purse.spent_usd() > 0.0 => Ok(store.set_spent_on(&day, purse.spent_usd()).await?),
            _ => Ok(()),
        }
    }

    async fn purse_of_today(&self, store: &Store) -> Result<Purse, Error> {
        let day = now()[..10].to_owned();
        let of_day = |known: &Option<(String, Purse)>| known.as_ref().filter(|(date, _)| *date == day).map(|(_, purse)| purse.clone());
        let known = of_day(&self.today.lock().unwrap_or_else(PoisonError::into_inner));
        if let Some(purse) = known {
            return Ok(purse);
        }
        let spent = store.spent_on(&day).await?;
        let mut today = self.today.lock().unwrap_or_else(PoisonError::into_inner);
        // Somebody may have been faster.
        if let Some(purse) = of_day(&today) {
            return Ok(purse);
        }
        let purse = Purse::new("today", self.settings.daily_usd.unwrap_or(f64::INFINITY)).with_spent(spent);
        *today = Some((day.clone(), purse.clone()));
        Ok(purse)
    }
}
