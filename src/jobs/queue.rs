//! Submitting, watching and cancelling jobs.

use super::Job;
use crate::store::{JobState, Store, StoreError};
use jiff::Timestamp;
use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tokio::sync::Notify;
use tokio_util::sync::CancellationToken;

#[derive(Debug, thiserror::Error)]
pub enum JobsError {
    #[error("there is no job {id}")]
    NotFound { id: String },
    #[error("{queued} jobs are waiting already; try again later")]
    QueueFull { queued: u32 },
    #[error(transparent)]
    Store(#[from] StoreError),
}

/// Where a running job stands.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Pulse {
    pub stage: &'static str,
    pub progress: f32,
}

/// A job in a worker's hands.
#[derive(Clone, Default)]
pub(super) struct Running {
    pub pulse: Arc<Mutex<Pulse>>,
    pub cancel: CancellationToken,
}

impl Running {
    pub fn pulse(&self) -> Pulse {
        *self.pulse.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub fn beat(&self, pulse: Pulse) {
        *self.pulse.lock().unwrap_or_else(PoisonError::into_inner) = pulse;
    }
}

/// The queue. Cheap to clone.
#[derive(Clone)]
pub struct Jobs {
    pub(super) store: Store,
    pub(super) wake: Arc<Notify>,
    running: Arc<Mutex<HashMap<String, Running>>>,
    max_queued: u32,
}

impl Jobs {
    #[must_use]
    pub fn new(store: Store, max_queued: u32) -> Self {
        Self { store, wake: Arc::default(), running: Arc::default(), max_queued }
    }

    /// Queues a job.
    ///
    /// # Errors
    /// [`JobsError::QueueFull`] when too many wait already.
    pub async fn submit(&self, kind: &str, subject: &str, payload: &str) -> Result<Job, JobsError> {
        self.check_room().await?;
        let row = self.store.insert_job(kind, subject, payload).await?;
        self.wake.notify_one();
        Ok(Job::from_row(row, Timestamp::now()))
    }

    /// Whether another job may be queued.
    ///
    /// # Errors
    /// [`JobsError::QueueFull`].
    pub async fn check_room(&self) -> Result<(), JobsError> {
        let queued = self.store.queued_jobs().await?;
        if queued >= self.max_queued { Err(JobsError::QueueFull { queued }) } else { Ok(()) }
    }

    /// Asks every job on a subject to stop.
    ///
    /// # Errors
    /// [`JobsError::Store`].
    pub async fn cancel_all_of(&self, subject: &str) -> Result<(), JobsError> {
        for id in self.store.open_jobs_of(subject).await? {
            self.cancel(&id).await?;
        }
        Ok(())
    }

    /// Records a job whose result was there already.
    ///
    /// # Errors
    /// [`JobsError::Store`].
    pub async fn submit_done(&self, kind: &str, subject: &str, payload: &str, message: &str) -> Result<Job, JobsError> {
        let row = self.store.insert_done_job(kind, subject, payload, message).await?;
        Ok(Job::from_row(row, Timestamp::now()))
    }

    /// A job as it stands now.
    ///
    /// # Errors
    /// [`JobsError::NotFound`].
    pub async fn get(&self, id: &str) -> Result<Job, JobsError> {
        let mut row = self.store.job(id).await?.ok_or_else(|| JobsError::NotFound { id: id.into() })?;
        // The row lags behind: a running job's own word is newer.
        if row.state == JobState::Running
            && let Some(running) = self.lock().get(id)
        {
            let Pulse { stage, progress } = running.pulse();
            row.progress = f64::from(progress);
            row.stage = (!stage.is_empty()).then(|| stage.to_owned());
        }
        Ok(Job::from_row(row, Timestamp::now()))
    }

    /// Asks a job to stop. Queued jobs stop at once, running ones at their next check; finished ones stay as they are.
    ///
    /// # Errors
    /// [`JobsError::NotFound`].
    pub async fn cancel(&self, id: &str) -> Result<Job, JobsError> {
        if !self.store.cancel_queued_job(id).await?
            && let Some(running) = self.lock().get(id)
        {
            running.cancel.cancel();
        }
        self.get(id).await
    }

    pub(super) fn lock(&self) -> MutexGuard<'_, HashMap<String, Running>> {
        // The map is whole between any two statements: a panic elsewhere does not spoil it.
        self.running.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
