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
const PROGRESS_SAVE_INTERVAL: Duration = Duration::from_millis(500);
/// Polling interval of a worker that is not notified.
const POLL_INTERVAL: Duration = Duration::from_secs(2);
/// Progress must grow by more than this to count as further progress.
const MIN_PROGRESS_STEP: f64 = 0.001;
/// Upper limit of the delay between attempts.
const MAX_BACKOFF: Duration = Duration::from_hours(1);
/// Interruptions of a job that are retried without delay. A job that is interrupted repeatedly
/// without further progress may be what crashes its server.
const FREE_INTERRUPTIONS: u32 = 3;
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
        self.metrics.jobs.register(K::NAME);
        let _at_work = WorkerGuard::begin(self, K::NAME);
        self.recover::<K>(&shutdown).await;
        let recovering = async {
            while shutdown.run_until_cancelled(time::sleep(POLL_INTERVAL)).await.is_some() {
                self.recover::<K>(&shutdown).await;
            }
        };
        let working =
            join_all((0..at_once.max(1)).map(|_| self.claim_and_run_jobs(&kind, &shutdown)));
        tokio::join!(recovering, working);
    }

    /// Recovers the jobs of processes that are gone. Retries until the store works.
    async fn recover<K: JobKind>(&self, shutdown: &CancellationToken) {
        let recovery = JobRecovery {
            give_up_after: K::RETRY.interrupted,
            at_once: FREE_INTERRUPTIONS,
            wait: WAIT_AFTER_INTERRUPTIONS,
        };
        while let Err(error) = self.repository.recover_jobs(K::NAME, recovery).await {
            tracing::error!(
                kind = K::NAME,
                error = &error as &dyn std::error::Error,
                "interrupted jobs could not be recovered yet; retrying"
            );
            if shutdown.run_until_cancelled(time::sleep(POLL_INTERVAL)).await.is_none() {
                return;
            }
        }
    }

    /// Fails queued jobs of kinds that this server does not know: from a newer server, or from one
    /// with other features.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn fail_unknown_kinds(&self, known: &[&str]) -> Result<(), StoreError> {
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

    async fn claim_and_run_jobs<K: JobKind>(&self, kind: &Arc<K>, shutdown: &CancellationToken) {
        let bell = self.notifier(K::NAME);
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
                        () = time::sleep(POLL_INTERVAL) => {}
                        () = shutdown.cancelled() => {}
                    }
                }
                Err(error) => {
                    tracing::error!(
                        kind = K::NAME,
                        error = &error as &dyn std::error::Error,
                        "job queue could not be read"
                    );
                    time::sleep(POLL_INTERVAL).await;
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
        let lease = JobLease::from_claimed_row(&job);
        let payload = match serde_json::from_str(&payload) {
            Ok(payload) => payload,
            Err(error) => {
                let detail = format!("the stored request of this job cannot be read: {error}");
                tracing::error!(%error, "job payload could not be read");
                self.metrics.jobs.record_finished(K::NAME, JobState::Failed.as_str(), None);
                return self
                    .record_outcome(
                        &lease,
                        &JobOutcome::Failed { code: "internal".into(), detail },
                        shutdown,
                    )
                    .await;
            }
        };
        let running = RunningJob {
            progress: Arc::default(),
            cancel: shutdown.child_token(),
            row: job.into(),
        };
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
                return self.record_outcome(&lease, &JobOutcome::Requeued, shutdown).await;
            }
        }
        let (beating, cancel) = (running.clone(), running.cancel.clone());
        let progress = Progress::new(
            move |stage, progress| beating.update_progress(JobProgress { stage, progress }),
            move || cancel.is_cancelled(),
        );
        // A separate task: a panic ends only this job, not the lane.
        let lost = CancellationToken::new();
        let context = JobContext { lease: lease.clone(), lost: lost.clone(), payload, progress };
        let work = {
            let kind = kind.clone();
            async move { kind.run(context).await }
        };
        let mut work = tokio::spawn(work.in_current_span());
        tracing::info!(attempt = attempts, "job started");
        let start = Instant::now();
        let mut saving = time::interval(PROGRESS_SAVE_INTERVAL);
        saving.set_missed_tick_behavior(time::MissedTickBehavior::Delay);
        let result = loop {
            tokio::select! {
                result = &mut work => break result,
                _ = saving.tick() => {
                    let JobProgress { stage, progress } = running.progress_snapshot();
                    match self.repository.save_job_progress(&lease, stage, progress).await {
                        Ok(false) => {}
                        // Cancellation was requested through another process.
                        Ok(true) => running.cancel.cancel(),
                        Err(StoreError::LeaseLost) => {
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
            Ok(Err(_)) if shutdown.is_cancelled() => JobOutcome::Requeued,
            Ok(Err(JobFailure::Cancelled)) => JobOutcome::Cancelled,
            // The job failed because of its cancellation, so it counts as cancelled.
            Ok(Err(JobFailure::Failed { .. })) if running.cancel.is_cancelled() => {
                JobOutcome::Cancelled
            }
            Ok(Err(JobFailure::Failed { code, detail, cause, transient })) => {
                let progress = running.progress_snapshot().progress;
                // Further progress resets the count of failures.
                let failures = if f64::from(progress) > furthest + MIN_PROGRESS_STEP {
                    1
                } else {
                    failures + 1
                };
                let again = transient.then(|| retry_delay(K::RETRY, failures)).flatten();
                tracing::warn!(
                    code,
                    cause,
                    again_in_s = again.map(|wait| wait.as_secs()),
                    "job failed"
                );
                again.map_or(JobOutcome::Failed { code, detail }, |wait| JobOutcome::RetryLater {
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
        // Count first: a finished job that a caller sees must already be in the metrics.
        self.count_outcome(K::NAME, &end, start.elapsed());
        let ended = self.record_outcome(&lease, &end, shutdown).await;
        self.running().remove(&id);
        ended
    }

    fn count_outcome(&self, kind: &'static str, end: &JobOutcome, took: Duration) {
        let state = match end {
            JobOutcome::Done(_) => JobState::Succeeded,
            JobOutcome::Failed { .. } => JobState::Failed,
            JobOutcome::Cancelled => JobState::Cancelled,
            JobOutcome::RetryLater { .. } => return self.metrics.jobs.record_retry(kind),
            JobOutcome::Requeued => return,
        };
        self.metrics.jobs.record_finished(kind, state.as_str(), Some(took));
    }

    /// Stores the end of a job. Retries until the store accepts it or the server stops. Otherwise
    /// the job would appear to run forever.
    async fn record_outcome(
        &self,
        lease: &JobLease,
        end: &JobOutcome,
        shutdown: &CancellationToken,
    ) -> Result<(), StoreError> {
        loop {
            match self.try_record_outcome(lease, end).await {
                Err(StoreError::LeaseLost) => {
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
                    let _ = shutdown.run_until_cancelled(time::sleep(POLL_INTERVAL)).await;
                }
                recorded => return recorded,
            }
        }
    }

    async fn try_record_outcome(
        &self,
        lease: &JobLease,
        end: &JobOutcome,
    ) -> Result<(), StoreError> {
        match end {
            JobOutcome::Done(message) => {
                tracing::info!(result = message, "job succeeded");
                self.repository.finish_job(lease, JobState::Succeeded, Some(message), None).await
            }
            JobOutcome::Requeued => self.repository.requeue_job(lease).await,
            JobOutcome::RetryLater { wait, failures, progress } => {
                self.repository.requeue_job_after(lease, *wait, *failures, *progress).await
            }
            JobOutcome::Cancelled => {
                tracing::info!("job cancelled");
                self.repository.finish_job(lease, JobState::Cancelled, None, None).await
            }
            JobOutcome::Failed { code, detail } => {
                self.repository
                    .finish_job(lease, JobState::Failed, None, Some((code, detail)))
                    .await
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
        jobs.set_lane_running(kind, true);
        Self { jobs, kind }
    }
}

impl Drop for WorkerGuard<'_> {
    fn drop(&mut self) {
        self.jobs.set_lane_running(self.kind, false);
    }
}

/// How a run of a job ended.
enum JobOutcome {
    Done(String),
    /// The server shuts down: another one continues.
    Requeued,
    /// It failed with a transient error: failures in a row, and its progress.
    RetryLater {
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
fn retry_delay(Retry { transient, backoff, .. }: Retry, failures: u32) -> Option<Duration> {
    (failures < transient)
        .then(|| backoff.saturating_mul(1 << failures.saturating_sub(1).min(16)).min(MAX_BACKOFF))
}

#[cfg(test)]
mod tests;
