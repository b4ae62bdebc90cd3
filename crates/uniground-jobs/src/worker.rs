//! A lane: the workers of one kind. They claim jobs from the queue and run each to an end.

use super::queue::{JobProgress, RunningJob};
use super::{JobContext, JobFailure, JobKind, Jobs, Retry};
use futures::future::join_all;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::time;
use tokio_util::sync::CancellationToken;
use tracing::Instrument;
use uniground_geometry::progress::Progress;
use uniground_storage::{JobLease, JobRecovery, JobRow, JobState, StoreError};

/// How often the row of a running job is updated.
const SAVE_EVERY: Duration = Duration::from_millis(500);
/// Polling interval of a worker that is not notified.
const LOOK_EVERY: Duration = Duration::from_secs(2);
/// Progress must grow by more than this to count as further progress.
const FURTHER: f64 = 0.001;
/// Upper limit of the delay between attempts.
const LONGEST_BACKOFF: Duration = Duration::from_hours(1);
/// Interruptions of a job that are retried without delay. A job that is interrupted repeatedly
/// without further progress may be what crashes its server.
const TAKEN_UP_AT_ONCE: u32 = 3;
/// The delay after further interruptions. It doubles from one to the next.
const WAIT_AFTER_INTERRUPTIONS: Duration = Duration::from_secs(30);

impl Jobs {
    /// Runs the jobs of one kind, `at_once` at a time, until `shutdown`. Jobs that are running then
    /// return to the queue, and continue after the next start or in another process. Jobs of
    /// processes that are gone are recovered. Kinds do not wait for each other. Errors of the
    /// database are logged and retried.
    pub async fn run_lane<K: JobKind>(
        &self,
        kind: Arc<K>,
        at_once: usize,
        shutdown: CancellationToken,
    ) {
        self.metrics.jobs.knows(K::NAME);
        let _at_work = WorkerGuard::begin(self, K::NAME);
        self.recover::<K>(&shutdown).await;
        let recovering = async {
            while shutdown.run_until_cancelled(time::sleep(LOOK_EVERY)).await.is_some() {
                self.recover::<K>(&shutdown).await;
            }
        };
        let working = join_all((0..at_once.max(1)).map(|_| self.work(&kind, &shutdown)));
        tokio::join!(recovering, working);
    }

    /// Recovers the jobs of processes that are gone. Retries until the store works.
    async fn recover<K: JobKind>(&self, shutdown: &CancellationToken) {
        let recovery = JobRecovery {
            give_up_after: K::RETRY.interrupted,
            at_once: TAKEN_UP_AT_ONCE,
            wait: WAIT_AFTER_INTERRUPTIONS,
        };
        while let Err(error) = self.repository.recover_jobs(K::NAME, recovery).await {
            tracing::error!(
                kind = K::NAME,
                error = &error as &dyn std::error::Error,
                "interrupted jobs could not be recovered yet; retrying"
            );
            if shutdown.run_until_cancelled(time::sleep(LOOK_EVERY)).await.is_none() {
                return;
            }
        }
    }

    /// Fails queued jobs of kinds that this server does not know: from a newer server, or from one
    /// with other features.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn refuse_unknown_kinds(&self, known: &[&str]) -> Result<(), StoreError> {
        for (id, kind) in self.repository.open_jobs().await? {
            if !known.contains(&kind.as_str()) {
                let detail = format!("this server does not know jobs of the kind {kind:?}");
                self.repository
                    .finish_open_job(&id, JobState::Failed, Some(("unknown_job_kind", &detail)))
                    .await?;
            }
        }
        Ok(())
    }

    async fn work<K: JobKind>(&self, kind: &Arc<K>, shutdown: &CancellationToken) {
        let bell = self.bell(K::NAME);
        while !shutdown.is_cancelled() {
            match self.repository.claim_job(K::NAME).await {
                Ok(Some(job)) => {
                    let span = tracing::info_span!(
                        "job",
                        id = job.id,
                        kind = K::NAME,
                        subject = job.subject
                    );
                    let run = async {
                        if let Err(error) = self.run(kind, job, shutdown).await {
                            tracing::error!(
                                error = &error as &dyn std::error::Error,
                                "job result could not be recorded"
                            );
                        }
                    };
                    run.instrument(span).await;
                }
                Ok(None) => {
                    tokio::select! {
                        () = bell.notified() => {}
                        () = time::sleep(LOOK_EVERY) => {}
                        () = shutdown.cancelled() => {}
                    }
                }
                Err(error) => {
                    tracing::error!(
                        kind = K::NAME,
                        error = &error as &dyn std::error::Error,
                        "job queue could not be read"
                    );
                    time::sleep(LOOK_EVERY).await;
                }
            }
        }
    }

    async fn run<K: JobKind>(
        &self,
        kind: &Arc<K>,
        job: JobRow,
        shutdown: &CancellationToken,
    ) -> Result<(), StoreError> {
        let JobRow { id, payload, attempts, failures, furthest, .. } = job.clone();
        let hold = JobLease::of(&job);
        let payload = match serde_json::from_str(&payload) {
            Ok(payload) => payload,
            Err(error) => {
                let detail = format!("what this job was asked to do can not be read: {error}");
                tracing::error!(%error, "job payload could not be read");
                self.metrics.jobs.finished(K::NAME, JobState::Failed.as_str(), None);
                return self
                    .record(
                        &hold,
                        &JobOutcome::Failed { code: "internal".into(), detail },
                        shutdown,
                    )
                    .await;
            }
        };
        let running =
            RunningJob { pulse: Arc::default(), cancel: shutdown.child_token(), row: job.into() };
        self.running().insert(id.clone(), running.clone());
        // From here on a cancellation request reaches the token. An earlier one is in the row.
        match self.repository.is_cancel_requested(&id).await {
            Ok(false) => {}
            Ok(true) => running.cancel.cancel(),
            // Return the job to the queue unchanged, as soon as the store works.
            Err(error) => {
                tracing::error!(
                    error = &error as &dyn std::error::Error,
                    "job could not be started yet; retrying"
                );
                self.running().remove(&id);
                return self.record(&hold, &JobOutcome::PutBack, shutdown).await;
            }
        }
        let (beating, cancel) = (running.clone(), running.cancel.clone());
        let progress = Progress::new(
            move |stage, progress| beating.beat(JobProgress { stage, progress }),
            move || cancel.is_cancelled(),
        );
        // In a task of its own: a job that panics ends itself, not the lane.
        let lost = CancellationToken::new();
        let context = JobContext { hold: hold.clone(), lost: lost.clone(), payload, progress };
        let work = {
            let kind = kind.clone();
            async move { kind.run(context).await }
        };
        let mut work = tokio::spawn(work.in_current_span());
        tracing::info!(attempt = attempts, "job started");
        let start = Instant::now();
        let mut saving = time::interval(SAVE_EVERY);
        saving.set_missed_tick_behavior(time::MissedTickBehavior::Delay);
        let result = loop {
            tokio::select! {
                result = &mut work => break result,
                _ = saving.tick() => {
                    let JobProgress { stage, progress } = running.pulse();
                    match self.repository.save_job_progress(&hold, stage, progress).await {
                        Ok(false) => {}
                        // Cancellation was requested through another process.
                        Ok(true) => running.cancel.cancel(),
                        Err(StoreError::NotHeld) => {
                            lost.cancel();
                            running.cancel.cancel();
                        }
                        Err(error) => tracing::warn!(error = &error as &dyn std::error::Error, "job progress could not be saved"),
                    }
                }
            }
        };
        let end = match result {
            Ok(Ok(message)) => JobOutcome::Done(message),
            Ok(Err(_)) if shutdown.is_cancelled() => JobOutcome::PutBack,
            Ok(Err(JobFailure::Cancelled)) => JobOutcome::Cancelled,
            // The job failed because of its cancellation, so it counts as cancelled.
            Ok(Err(JobFailure::Failed { .. })) if running.cancel.is_cancelled() => {
                JobOutcome::Cancelled
            }
            Ok(Err(JobFailure::Failed { code, detail, cause, transient })) => {
                let progress = running.pulse().progress;
                // Further progress resets the count of failures.
                let failures =
                    if f64::from(progress) > furthest + FURTHER { 1 } else { failures + 1 };
                let again = transient.then(|| next_try(K::RETRY, failures)).flatten();
                tracing::warn!(
                    code,
                    cause,
                    again_in_s = again.map(|wait| wait.as_secs()),
                    "job failed"
                );
                again.map_or(JobOutcome::Failed { code, detail }, |wait| JobOutcome::Again {
                    wait,
                    failures,
                    progress,
                })
            }
            Err(panic) => {
                tracing::error!(error = &panic as &dyn std::error::Error, "job panicked");
                let detail =
                    "the job stopped because of an internal error; the server's log has the cause";
                JobOutcome::Failed { code: "internal".into(), detail: detail.into() }
            }
        };
        // Count first: whoever sees the finished job must find it in the metrics.
        self.count(K::NAME, &end, start.elapsed());
        let ended = self.record(&hold, &end, shutdown).await;
        self.running().remove(&id);
        ended
    }

    fn count(&self, kind: &'static str, end: &JobOutcome, took: Duration) {
        let state = match end {
            JobOutcome::Done(_) => JobState::Succeeded,
            JobOutcome::Failed { .. } => JobState::Failed,
            JobOutcome::Cancelled => JobState::Cancelled,
            JobOutcome::Again { .. } => return self.metrics.jobs.retried(kind),
            JobOutcome::PutBack => return,
        };
        self.metrics.jobs.finished(kind, state.as_str(), Some(took));
    }

    /// Stores the end of a job. Retries until the store accepts it or the server stops. Otherwise
    /// the job would appear to run forever.
    async fn record(
        &self,
        hold: &JobLease,
        end: &JobOutcome,
        shutdown: &CancellationToken,
    ) -> Result<(), StoreError> {
        loop {
            match self.try_to_record(hold, end).await {
                Err(StoreError::NotHeld) => {
                    tracing::warn!(
                        "lease lost: another worker has this job, its result here is discarded"
                    );
                    return Ok(());
                }
                Err(error) if !shutdown.is_cancelled() => {
                    tracing::error!(
                        error = &error as &dyn std::error::Error,
                        "job result could not be recorded yet; retrying"
                    );
                    let _ = shutdown.run_until_cancelled(time::sleep(LOOK_EVERY)).await;
                }
                notify_worker => return notify_worker,
            }
        }
    }

    async fn try_to_record(&self, hold: &JobLease, end: &JobOutcome) -> Result<(), StoreError> {
        match end {
            JobOutcome::Done(message) => {
                tracing::info!(result = message, "job succeeded");
                self.repository.finish_job(hold, JobState::Succeeded, Some(message), None).await
            }
            JobOutcome::PutBack => self.repository.requeue_job(hold).await,
            JobOutcome::Again { wait, failures, progress } => {
                self.repository.requeue_job_after(hold, *wait, *failures, *progress).await
            }
            JobOutcome::Cancelled => {
                tracing::info!("job cancelled");
                self.repository.finish_job(hold, JobState::Cancelled, None, None).await
            }
            JobOutcome::Failed { code, detail } => {
                self.repository.finish_job(hold, JobState::Failed, None, Some((code, detail))).await
            }
        }
    }
}

/// Marks a lane as running, and as stopped on drop, however it ends.
struct WorkerGuard<'a> {
    jobs: &'a Jobs,
    kind: &'static str,
}

impl<'a> WorkerGuard<'a> {
    fn begin(jobs: &'a Jobs, kind: &'static str) -> Self {
        jobs.note_lane(kind, true);
        Self { jobs, kind }
    }
}

impl Drop for WorkerGuard<'_> {
    fn drop(&mut self) {
        self.jobs.note_lane(self.kind, false);
    }
}

/// How a run of a job ended.
enum JobOutcome {
    Done(String),
    /// The server shuts down: another one continues.
    PutBack,
    /// It failed with a transient error: failures in a row, and its progress.
    Again {
        wait: Duration,
        failures: u32,
        progress: f32,
    },
    Cancelled,
    Failed {
        code: String,
        detail: String,
    },
}

/// Returns the delay before the next attempt after this many failures, or `None` if there is none.
fn next_try(Retry { transient, backoff, .. }: Retry, failures: u32) -> Option<Duration> {
    (failures < transient).then(|| {
        backoff.saturating_mul(1 << failures.saturating_sub(1).min(16)).min(LONGEST_BACKOFF)
    })
}

#[cfg(test)]
mod tests;
