//! A lane: takes the jobs of one kind from their queue and sees each to an end.

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

/// How often a running job's row is brought up to date.
const SAVE_EVERY: Duration = Duration::from_millis(500);
/// How long a worker sleeps when nobody wakes it.
const LOOK_EVERY: Duration = Duration::from_secs(2);
/// Progress by more than this is getting further.
const FURTHER: f64 = 0.001;
/// No wait before another try is longer.
const LONGEST_BACKOFF: Duration = Duration::from_hours(1);
/// A job that is interrupted again and again without getting further may be what brings its server
/// down: it is taken up at once so often,
const TAKEN_UP_AT_ONCE: u32 = 3;
/// and then waits, this long first.
const WAIT_AFTER_INTERRUPTIONS: Duration = Duration::from_secs(30);

impl Jobs {
    /// Works on the jobs of one kind until `shutdown`, so many at once. Jobs running then are put
    /// back and go on after the next start, or elsewhere; those that processes which are gone
    /// had in hands are taken up. No kind waits for another. Trouble with the database is
    /// logged, and tried again.
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

    /// Takes up what processes that are gone had in hands, as soon as the store lets it.
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

    /// Fails what waits but is of no kind this server knows: jobs of a newer server, or of one with
    /// other parts.
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
                self.metrics.jobs.finished(K::NAME, JobState::Failed.word(), None);
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
        // From here on a wish to stop finds the token; what was wished before stands in the row.
        match self.repository.is_cancel_requested(&id).await {
            Ok(false) => {}
            Ok(true) => running.cancel.cancel(),
            // It goes back as it came, as soon as the store takes it.
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
        // A task of its own: a job that panics ends itself, not the lane.
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
                        // Wished elsewhere.
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
            // Asked to stop, it stumbled over what was taken from under it: that is no failure of
            // its own.
            Ok(Err(JobFailure::Failed { .. })) if running.cancel.is_cancelled() => {
                JobOutcome::Cancelled
            }
            Ok(Err(JobFailure::Failed { code, detail, cause, transient })) => {
                let progress = running.pulse().progress;
                // One that got further starts to count anew.
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
        // Whoever sees the job's end sees it counted.
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
        self.metrics.jobs.finished(kind, state.word(), Some(took));
    }

    /// Writes down a job's end: until the store takes it, or the server stops. A job whose end
    /// nobody knows would run for ever.
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

/// A lane at work; however it ends, whoever asks learns of it.
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

/// What becomes of a job.
enum JobOutcome {
    Done(String),
    /// The server stops: the next one goes on.
    PutBack,
    /// It failed in a way that may pass, so often in a row, and got so far.
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

/// The wait before another try, after so many failures; `None` when there is none.
fn next_try(Retry { transient, backoff, .. }: Retry, failures: u32) -> Option<Duration> {
    (failures < transient).then(|| {
        backoff.saturating_mul(1 << failures.saturating_sub(1).min(16)).min(LONGEST_BACKOFF)
    })
}

#[cfg(test)]
mod tests;
