//! Submitting, watching and cancelling jobs.

use super::watchers::JobWatchers;
use super::{Job, JobKind, JobList, job_of};
use jiff::Timestamp;
use std::collections::{BTreeMap, HashMap};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio::sync::Notify;
use tokio_util::sync::CancellationToken;
use uniground_storage::{
    JobFilter, JobRepository, JobRow, JobState, NewJob, QueueLengths, StoreError, page,
};
use uniground_telemetry::metrics::Metrics;

#[derive(Debug, thiserror::Error)]
pub enum JobsError {
    #[error("there is no job {id}")]
    NotFound { id: String },
    #[error("the queue is full ({queued} jobs are waiting): try again in about {again_in_s} s")]
    QueueFull { queued: u32, again_in_s: u32 },
    #[error(transparent)]
    Store(#[from] StoreError),
}

/// How jobs went is told by those of so long.
const LATELY: Duration = Duration::from_mins(10);
/// Nobody who finds a queue full is told to come again sooner than that, seconds,
const SOONEST_S: u32 = 2;
/// or later.
const LATEST_S: u32 = 120;

/// Where a running job stands.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct JobProgress {
    pub stage: &'static str,
    pub progress: f32,
}

/// A job in a worker's hands.
#[derive(Clone)]
pub(super) struct RunningJob {
    pub pulse: Arc<Mutex<JobProgress>>,
    pub cancel: CancellationToken,
    /// As it was when the worker took it.
    pub row: Arc<JobRow>,
}

impl RunningJob {
    pub fn pulse(&self) -> JobProgress {
        *self.pulse.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub fn beat(&self, pulse: JobProgress) {
        *self.pulse.lock().unwrap_or_else(PoisonError::into_inner) = pulse;
    }
}

/// The queues of all kinds. Cheap to clone.
#[derive(Clone)]
pub struct Jobs {
    pub(super) repository: JobRepository,
    /// By kind: told when a job was queued.
    bells: Arc<Mutex<HashMap<&'static str, Arc<Notify>>>>,
    running: Arc<Mutex<HashMap<String, RunningJob>>>,
    pub(super) followed: JobWatchers,
    /// By kind: whether its lane is at work.
    lanes: Arc<Mutex<BTreeMap<&'static str, bool>>>,
    pub(super) metrics: Arc<Metrics>,
    max_queued: u32,
}

impl Jobs {
    /// At most `max_queued` jobs of a kind wait.
    #[must_use]
    pub fn new(repository: JobRepository, max_queued: u32) -> Self {
        Self {
            repository,
            bells: Arc::default(),
            running: Arc::default(),
            followed: JobWatchers::default(),
            lanes: Arc::default(),
            metrics: Arc::default(),
            max_queued,
        }
    }

    /// The same, counted here.
    #[must_use]
    pub fn counted_by(self, metrics: Arc<Metrics>) -> Self {
        Self { metrics, ..self }
    }

    /// Where jobs are counted.
    #[must_use]
    pub fn metrics(&self) -> &Arc<Metrics> {
        &self.metrics
    }

    /// The kinds that have a lane, and whether it is still at work.
    #[must_use]
    pub fn lanes(&self) -> BTreeMap<&'static str, bool> {
        self.lanes.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Notes whether a lane is at work.
    pub(super) fn note_lane(&self, kind: &'static str, up: bool) {
        self.lanes.lock().unwrap_or_else(PoisonError::into_inner).insert(kind, up);
        self.metrics.jobs.lane(kind, up);
    }

    /// Queues a job on a subject: the id of what it works on; `key_id` is who asked for it.
    ///
    /// # Errors
    /// [`JobsError::QueueFull`] when too many of its kind wait already.
    pub async fn submit<K: JobKind>(
        &self,
        subject: &str,
        payload: &K::Payload,
        key_id: Option<&str>,
    ) -> Result<Job, JobsError> {
        self.check_queue_capacity::<K>(key_id).await?;
        let payload = serde_json::to_string(payload).map_err(StoreError::from)?;
        let row = self
            .repository
            .insert_job(subject, &NewJob { kind: K::NAME, payload: &payload, key_id, done: None })
            .await?;
        Ok(self.notify_worker::<K>(row))
    }

    /// Whether another job of this kind may be queued for somebody. Of keys, those that have few in
    /// the queue find the last tenth of all places free: who brings many keeps out nobody.
    ///
    /// # Errors
    /// [`JobsError::QueueFull`], with the time until one more is done, by how it went lately.
    pub async fn check_queue_capacity<K: JobKind>(
        &self,
        key_id: Option<&str>,
    ) -> Result<(), JobsError> {
        let QueueLengths { all: queued, of_key } =
            self.repository.queued_jobs(K::NAME, key_id).await?;
        let tenth = self.max_queued / 10;
        let kept_free = if key_id.is_some() && of_key >= tenth { tenth } else { 0 };
        if queued < self.max_queued - kept_free {
            return Ok(());
        }
        let done = self.repository.done_lately(K::NAME, LATELY).await?;
        let again_in_s = u32::try_from(LATELY.as_secs()).unwrap_or(u32::MAX) / done.max(1);
        Err(JobsError::QueueFull { queued, again_in_s: again_in_s.clamp(SOONEST_S, LATEST_S) })
    }

    /// Asks every job on a subject to stop.
    ///
    /// # Errors
    /// [`JobsError::Store`].
    pub async fn cancel_all_of(&self, subject: &str) -> Result<(), JobsError> {
        for id in self.repository.open_jobs_of(subject).await? {
            self.cancel(&id).await?;
        }
        Ok(())
    }

    /// A job that somebody recorded, as callers see it; its lane is told if it waits.
    #[allow(clippy::must_use_candidate)] // Its lane is told.
    pub fn notify_worker<K: JobKind>(&self, row: JobRow) -> Job {
        match row.state {
            JobState::Queued => self.bell(K::NAME).notify_one(),
            state if state.is_final() => self.metrics.jobs.finished(K::NAME, state.word(), None),
            _ => {}
        }
        job_of(row, Timestamp::now())
    }

    /// A job as it stands now.
    ///
    /// # Errors
    /// [`JobsError::NotFound`].
    pub async fn get(&self, id: &str) -> Result<Job, JobsError> {
        let row =
            self.repository.job(id).await?.ok_or_else(|| JobsError::NotFound { id: id.into() })?;
        let ahead = match row.state {
            JobState::Queued => Some(self.repository.jobs_ahead(&row.kind, id).await?),
            _ => None,
        };
        Ok(Job { ahead, ..self.as_it_stands(row) })
    }

    /// Jobs as they stand, newest first, those before `cursor` (an id) only.
    ///
    /// # Errors
    /// [`JobsError::Store`].
    pub async fn list(
        &self,
        filter: &JobFilter,
        limit: u32,
        cursor: Option<&str>,
    ) -> Result<JobList, JobsError> {
        let (rows, next_cursor) =
            page(self.repository.jobs(filter, limit + 1, cursor).await?, limit, |row| &row.id);
        Ok(JobList {
            jobs: rows.into_iter().map(|row| self.as_it_stands(row)).collect(),
            next_cursor,
        })
    }

    /// The row lags behind: a running job's own word is newer.
    pub(super) fn as_it_stands(&self, mut row: JobRow) -> Job {
        if row.state == JobState::Running
            && let Some(running) = self.running().get(&row.id)
        {
            let JobProgress { stage, progress } = running.pulse();
            row.progress = f64::from(progress);
            row.stage = (!stage.is_empty()).then(|| stage.to_owned());
        }
        job_of(row, Timestamp::now())
    }

    /// Asks a job to stop. Queued jobs stop at once, running ones at their next check; finished
    /// ones stay as they are. A wish is written down first: a worker that has claimed the job
    /// but not begun finds it there, and so does the next server.
    ///
    /// # Errors
    /// [`JobsError::NotFound`].
    pub async fn cancel(&self, id: &str) -> Result<Job, JobsError> {
        let was_queued = self.repository.cancel_queued_job(id).await?;
        if !was_queued {
            self.repository.request_cancel(id).await?;
            if let Some(running) = self.running().get(id) {
                running.cancel.cancel();
            }
        }
        let job = self.get(id).await?;
        if was_queued && let Some(kind) = self.lanes().into_keys().find(|kind| *kind == job.kind) {
            self.metrics.jobs.finished(kind, job.state.word(), None);
        }
        Ok(job)
    }

    /// Another process has queued a job of a kind, or of any where nobody knows: lanes that wait
    /// for it look.
    pub fn ring(&self, kind: Option<&str>) {
        let bells = self.bells.lock().unwrap_or_else(PoisonError::into_inner);
        bells
            .iter()
            .filter(|(of, _)| kind.is_none_or(|kind| kind == **of))
            .for_each(|(_, bell)| bell.notify_one());
    }

    /// Rings when a job of this kind was queued.
    pub(super) fn bell(&self, kind: &'static str) -> Arc<Notify> {
        self.bells.lock().unwrap_or_else(PoisonError::into_inner).entry(kind).or_default().clone()
    }

    pub(super) fn running(&self) -> MutexGuard<'_, HashMap<String, RunningJob>> {
        // The map is whole between any two statements: a panic elsewhere does not spoil it.
        self.running.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
