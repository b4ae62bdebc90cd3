//! Batches: lists of questions that are submitted together and answered in the background. Results
//! can be read while the batch runs.

mod items;
mod job;
mod results;
mod submission;

pub use job::BatchJob;
pub use job::BatchRunner;
pub use results::ResultRequest;
pub use submission::{BatchBody, Submission};

use crate::Capacity;
use crate::error::Error;
use job::Payload;
use std::sync::Arc;
use uniground_jobs::{JobRequest, Jobs, JobsError};
use uniground_storage::{BatchRepository, BatchRow, ResumeOutcome, split_page};
use uniground_types::batch::{Batch, BatchList, BatchState};

/// Concurrent questions of a batch that does not specify a number.
const CONCURRENCY: u32 = 4;
/// The maximum number of concurrent questions. More would only wait for each other.
const MAX_CONCURRENCY: u32 = 64;
/// The maximum number of items in a batch.
const MAX_ITEMS: u32 = 1_000_000;
const MAX_LABEL_CHARS: usize = 200;

/// Reasons for which the server pauses a batch.
mod reason {
    /// The budget of the batch is exhausted.
    pub const BUDGET_SPENT: &str = "budget_spent";
    /// The key that submitted the batch has been revoked or has expired.
    pub const KEY_REFUSED: &str = "key_refused";
    /// Its job was cancelled, failed, or ended just before it was resumed.
    pub const JOB_ENDED: &str = "job_ended";
}

/// Lists, pauses, resumes and cancels batches.
#[derive(Clone)]
pub struct BatchService {
    pub(crate) batch_repository: BatchRepository,
    pub(crate) jobs: Jobs,
    pub(crate) capacity: Arc<Capacity>,
}

impl BatchService {
    /// # Errors
    /// [`Error::BatchNotFound`].
    pub async fn batch(&self, id: &str) -> Result<Batch, Error> {
        let row = self.batch_row(id).await?;
        self.present_batch(row).await
    }

    /// Lists batches, newest first.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn batches(&self, limit: u32, cursor: Option<&str>) -> Result<BatchList, Error> {
        let (rows, next_cursor) =
            split_page(self.batch_repository.batches(limit + 1, cursor).await?, limit, |row| {
                &row.id
            });
        let mut batches = Vec::with_capacity(rows.len());
        for row in rows {
            batches.push(self.present_batch(row).await?);
        }
        Ok(BatchList { batches, next_cursor })
    }

    /// Pauses a batch until it is resumed. Questions in progress are answered.
    ///
    /// # Errors
    /// [`Error::BatchNotFound`], [`Error::BatchOver`].
    pub async fn pause_batch(&self, id: &str) -> Result<Batch, Error> {
        self.change_batch_state(id, &["running", "paused"], "paused").await
    }

    /// Cancels a batch for good. Existing answers stay.
    ///
    /// # Errors
    /// Those of [`pause_batch`](Self::pause_batch). Cancelling a batch twice is not an error.
    pub async fn cancel_batch(&self, id: &str) -> Result<Batch, Error> {
        self.change_batch_state(id, &["running", "paused", "cancelled"], "cancelled").await
    }

    /// Resumes a paused batch. A running batch is left as it is.
    ///
    /// # Errors
    /// Those of [`pause_batch`](Self::pause_batch); a full queue.
    pub async fn resume_batch(&self, id: &str) -> Result<Batch, Error> {
        let row = self.batch_row(id).await?;
        let payload = Payload { batch_id: id.to_owned() };
        let job = JobRequest::<BatchJob>::new(&payload, row.key_id.as_deref())?;
        let new_job = job.row();
        let resume = self.batch_repository.resume_batch(id, &new_job);
        match self.jobs.enqueue(&job, resume).await? {
            ResumeOutcome::Resumed(_) | ResumeOutcome::AlreadyRunning => {}
            ResumeOutcome::Finished => {
                return Err(Error::BatchOver { id: id.into(), state: row.state });
            }
        }
        self.batch(id).await
    }

    async fn change_batch_state(&self, id: &str, from: &[&str], to: &str) -> Result<Batch, Error> {
        let row = self.batch_row(id).await?;
        if !self.batch_repository.change_batch_state(id, from, to, None).await? {
            return Err(Error::BatchOver { id: id.into(), state: row.state });
        }
        self.batch(id).await
    }

    async fn batch_row(&self, id: &str) -> Result<BatchRow, Error> {
        self.batch_repository.batch(id).await?.ok_or_else(|| Error::BatchNotFound { id: id.into() })
    }

    /// Returns the state of a batch, the reason for it, and the estimated remaining time in
    /// seconds.
    async fn batch_state(
        &self,
        row: &BatchRow,
    ) -> Result<(BatchState, Option<String>, Option<f32>), Error> {
        let (is_over, eta_s) = match &row.job_id {
            Some(id) => match self.jobs.get(id).await {
                Ok(job) => (job.state.is_final(), job.eta_s),
                Err(JobsError::NotFound { .. }) => (true, None),
                Err(error) => return Err(error.into()),
            },
            None => (false, None),
        };
        let (mut state, mut reason) = (row.state.clone(), row.reason.clone());
        if state == "running" && is_over {
            // A job that succeeds updates its batch before it ends. The batch may have been read
            // before that, so it is read again.
            let now = self.batch_row(&row.id).await?;
            (state, reason) = (now.state, now.reason);
            if state == "running" && now.job_id == row.job_id {
                // The job has ended, for whatever reason, so no more questions are asked.
                (state, reason) = ("paused".into(), Some(reason::JOB_ENDED.to_owned()));
            }
        }
        Ok(match state.as_str() {
            "running" => (BatchState::Running, None, eta_s),
            "paused" => (BatchState::Paused, reason, None),
            "cancelled" => (BatchState::Cancelled, None, None),
            _ => (BatchState::Succeeded, None, None),
        })
    }

    async fn present_batch(&self, row: BatchRow) -> Result<Batch, Error> {
        let (state, reason, eta_s) = self.batch_state(&row).await?;
        let (by_status, cost_usd) = self.batch_repository.summarize_batch_items(&row.id).await?;
        let done = by_status.values().sum();
        let BatchRow { id, label, items, job_id, created_at, finished_at, .. } = row;
        Ok(Batch {
            id,
            label,
            state,
            reason,
            items,
            done,
            by_status,
            cost_usd,
            eta_s,
            job_id,
            created_at,
            finished_at,
        })
    }
}
