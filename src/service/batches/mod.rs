//! Lists of questions: submitted whole, asked in the background, their results read while they are made.

mod job;
mod results;
mod submission;

pub use job::BatchJob;
pub use results::Results;
pub use submission::{Body, Submission};

use super::Service;
use crate::error::Error;
use crate::jobs::JobsError;
use crate::store::BatchRow;
use jiff::Timestamp;
use job::Payload;
use uniground_types::batch::{Batch, BatchList, BatchState};
use uniground_types::job::Job;

/// Questions of a batch asked at once, where it does not say.
const CONCURRENCY: u32 = 4;
/// More would only wait for each other.
const MAX_CONCURRENCY: u32 = 64;
/// Items a batch may have.
const MAX_ITEMS: u32 = 1_000_000;
const MAX_LABEL_CHARS: usize = 200;
/// Below this share done, the time left is a guess.
const MIN_DONE_FOR_ETA: f32 = 0.01;

/// Why a batch is paused that nobody paused.
mod reason {
    /// What it may cost is spent.
    pub const BUDGET_SPENT: &str = "budget_spent";
    /// The key it was submitted with is refused by now.
    pub const KEY_REFUSED: &str = "key_refused";
    /// Its job was cancelled, failed, or ended just before it was resumed.
    pub const JOB_ENDED: &str = "job_ended";
}

impl Service {
    /// # Errors
    /// [`Error::BatchNotFound`].
    pub async fn batch(&self, id: &str) -> Result<Batch, Error> {
        let row = self.batch_row(id).await?;
        self.present_batch(row).await
    }

    /// Batches, newest first.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn batches(&self, limit: u32, cursor: Option<&str>) -> Result<BatchList, Error> {
        let mut rows = self.store.batches(limit + 1, cursor).await?;
        let more = rows.len() > limit as usize;
        rows.truncate(limit as usize);
        let next_cursor = rows.last().filter(|_| more).map(|row| row.id.clone());
        let mut batches = Vec::with_capacity(rows.len());
        for row in rows {
            batches.push(self.present_batch(row).await?);
        }
        Ok(BatchList { batches, next_cursor })
    }

    /// Stops asking until somebody resumes it. Questions under way are answered.
    ///
    /// # Errors
    /// [`Error::BatchNotFound`], [`Error::BatchOver`].
    pub async fn pause_batch(&self, id: &str) -> Result<Batch, Error> {
        self.move_batch(id, &["running", "paused"], "paused").await
    }

    /// Stops asking for good. What is answered stays.
    ///
    /// # Errors
    /// As [`pause_batch`](Self::pause_batch); cancelling twice is none.
    pub async fn cancel_batch(&self, id: &str) -> Result<Batch, Error> {
        self.move_batch(id, &["running", "paused", "cancelled"], "cancelled").await
    }

    /// Goes on with a batch that is paused. A batch that goes on already just does.
    ///
    /// # Errors
    /// As [`pause_batch`](Self::pause_batch); a full queue.
    pub async fn resume_batch(&self, id: &str) -> Result<Batch, Error> {
        let row = self.batch_row(id).await?;
        let working = match &row.job_id {
            Some(job) => !self.jobs.get(job).await?.state.is_final(),
            None => false,
        };
        let resumed = self.move_batch(id, &["running", "paused"], "running").await?;
        if working {
            return Ok(resumed);
        }
        let job = self
            .jobs
            .submit::<BatchJob>(id, &Payload { batch_id: id.to_owned() }, row.key_id.as_deref())
            .await?;
        self.store.set_batch_job(id, &job.id).await?;
        self.batch(id).await
    }

    async fn move_batch(&self, id: &str, from: &[&str], to: &str) -> Result<Batch, Error> {
        let row = self.batch_row(id).await?;
        if !self.store.move_batch(id, from, to, None).await? {
            return Err(Error::BatchOver { id: id.into(), state: row.state });
        }
        self.batch(id).await
    }

    async fn batch_row(&self, id: &str) -> Result<BatchRow, Error> {
        self.store.batch(id).await?.ok_or_else(|| Error::BatchNotFound { id: id.into() })
    }

    /// Where a batch stands, why, and its job.
    async fn batch_state(&self, row: &BatchRow) -> Result<(BatchState, Option<String>, Option<Job>), Error> {
        let job = match &row.job_id {
            Some(id) => match self.jobs.get(id).await {
                Ok(job) => Some(job),
                Err(JobsError::NotFound { .. }) => None,
                Err(error) => return Err(error.into()),
            },
            None => None,
        };
        // However it ended: nobody asks any more.
        let ended = job.as_ref().is_some_and(|job| job.state.is_final());
        let (state, reason) = match row.state.as_str() {
            "running" if ended => (BatchState::Paused, Some(reason::JOB_ENDED.to_owned())),
            "running" => (BatchState::Running, None),
            "paused" => (BatchState::Paused, row.reason.clone()),
            "cancelled" => (BatchState::Cancelled, None),
            _ => (BatchState::Succeeded, None),
        };
        Ok((state, reason, job))
    }

    async fn present_batch(&self, row: BatchRow) -> Result<Batch, Error> {
        let (by_status, cost_usd) = self.store.batch_figures(&row.id).await?;
        let (state, reason, job) = self.batch_state(&row).await?;
        let done = by_status.values().sum();
        let eta_s = job.filter(|_| state == BatchState::Running).and_then(|job| time_left(&job, done, row.items));
        let BatchRow { id, label, items, job_id, created_at, finished_at, .. } = row;
        Ok(Batch { id, label, state, reason, items, done, by_status, cost_usd, eta_s, job_id, created_at, finished_at })
    }
}

/// Seconds left, if the rest goes as what this job has done: its progress is over what was open when it began.
fn time_left(job: &Job, done: u32, items: u32) -> Option<f32> {
    let started: Timestamp = job.started_at.as_ref()?.parse().ok()?;
    let elapsed = Timestamp::now().duration_since(started).as_secs_f32();
    (done < items && job.progress >= MIN_DONE_FOR_ETA).then(|| elapsed * (1.0 - job.progress) / job.progress)
}
