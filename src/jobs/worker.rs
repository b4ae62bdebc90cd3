//! Takes jobs from the queue, one after the other, and sees them to an end.

use super::Jobs;
use super::queue::{Pulse, Running};
use crate::progress::Progress;
use crate::store::{JobRow, JobState, StoreError};
use futures::future::BoxFuture;
use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;
use tokio::time;
use tokio_util::sync::CancellationToken;

/// What a job is run with.
pub struct JobContext {
    pub id: String,
    pub payload: String,
    /// Progress sink and cancellation in one.
    pub progress: Progress,
}

/// How a job ends badly.
#[derive(Debug)]
pub enum JobFailure {
    /// `code` is stable; `detail` is for the caller.
    Failed {
        code: String,
        detail: String,
    },
    Cancelled,
}

/// Runs one kind of job; the result is a sentence about what came out.
pub type Handler = Arc<dyn Fn(JobContext) -> BoxFuture<'static, Result<String, JobFailure>> + Send + Sync>;

/// How often a running job's row is brought up to date.
const SAVE_EVERY: Duration = Duration::from_millis(500);
/// How long a worker sleeps when nobody wakes it.
const LOOK_EVERY: Duration = Duration::from_secs(2);
/// A job that was running when the server died is tried again; so many times in all.
const MAX_ATTEMPTS: u32 = 3;

impl Jobs {
    /// Works until `shutdown`. A job running then is put back and goes on after the next start.
    ///
    /// # Errors
    /// [`StoreError`] when the queue can not be read at start; later trouble with the database is logged and retried.
    pub async fn work(&self, handlers: &HashMap<&'static str, Handler>, shutdown: CancellationToken) -> Result<(), StoreError> {
        self.store.recover_jobs(MAX_ATTEMPTS).await?;
        while !shutdown.is_cancelled() {
            match self.store.claim_job().await {
                Ok(Some(job)) => {
                    let id = job.id.clone();
                    if let Err(error) = self.run(job, handlers, &shutdown).await {
                        tracing::error!(job = %id, error = &error as &dyn std::error::Error, "a job's end could not be recorded");
                    }
                }
                Ok(None) => {
                    tokio::select! {
                        () = self.wake.notified() => {}
                        () = time::sleep(LOOK_EVERY) => {}
                        () = shutdown.cancelled() => {}
                    }
                }
                Err(error) => {
                    tracing::error!(error = &error as &dyn std::error::Error, "the job queue can not be read");
                    time::sleep(LOOK_EVERY).await;
                }
            }
        }
        Ok(())
    }

    async fn run(&self, job: JobRow, handlers: &HashMap<&'static str, Handler>, shutdown: &CancellationToken) -> Result<(), StoreError> {
        let JobRow { id, kind, payload, .. } = job;
        let Some(handler) = handlers.get(kind.as_str()) else {
            let detail = format!("this server does not know jobs of the kind {kind:?}");
            return self.store.finish_job(&id, JobState::Failed, None, Some(("unknown_job_kind", &detail))).await;
        };
        let running = Running { cancel: shutdown.child_token(), ..Running::default() };
        self.lock().insert(id.clone(), running.clone());
        let beating = running.clone();
        let progress = Progress::new(move |stage, progress| beating.beat(Pulse { stage, progress }), running.cancel.clone());
        // A task of its own: a handler that panics ends its job, not the worker.
        let mut work = tokio::spawn(handler(JobContext { id: id.clone(), payload, progress }));
        let mut saving = time::interval(SAVE_EVERY);
        saving.set_missed_tick_behavior(time::MissedTickBehavior::Delay);
        let result = loop {
            tokio::select! {
                result = &mut work => break result,
                _ = saving.tick() => {
                    let Pulse { stage, progress } = running.pulse();
                    if let Err(error) = self.store.save_job_progress(&id, stage, progress).await {
                        tracing::warn!(job = %id, error = &error as &dyn std::error::Error, "progress not saved");
                    }
                }
            }
        };
        let ended = self.end(&id, result, running.cancel.is_cancelled(), shutdown).await;
        self.lock().remove(&id);
        ended
    }

    async fn end(
        &self,
        id: &str,
        result: Result<Result<String, JobFailure>, tokio::task::JoinError>,
        cancelled: bool,
        shutdown: &CancellationToken,
    ) -> Result<(), StoreError> {
        match result {
            Ok(Ok(message)) => self.store.finish_job(id, JobState::Succeeded, Some(&message), None).await,
            Ok(Err(_)) if shutdown.is_cancelled() => self.store.requeue_job(id).await,
            Ok(Err(JobFailure::Cancelled)) => self.store.finish_job(id, JobState::Cancelled, None, None).await,
            // Asked to stop, it stumbled over what was taken from under it: that is no failure of its own.
            Ok(Err(JobFailure::Failed { .. })) if cancelled => self.store.finish_job(id, JobState::Cancelled, None, None).await,
            Ok(Err(JobFailure::Failed { code, detail })) => {
                tracing::warn!(job = id, code, detail, "job failed");
                self.store.finish_job(id, JobState::Failed, None, Some((&code, &detail))).await
            }
            Err(panic) => {
                tracing::error!(job = id, error = &panic as &dyn std::error::Error, "job panicked");
                let detail = "the job stopped because of an internal error; the server's log has the cause";
                self.store.finish_job(id, JobState::Failed, None, Some(("internal", detail))).await
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::jobs::Job;
    use crate::store::Store;
    use camino::Utf8Path;
    use futures::FutureExt;

    async fn queue(folder: &tempfile::TempDir) -> Jobs {
        Jobs::new(Store::open(Utf8Path::from_path(folder.path()).unwrap()).await.unwrap(), 10)
    }

    fn handlers() -> HashMap<&'static str, Handler> {
        let ok: Handler = Arc::new(|context| async move { Ok(format!("did {}", context.payload)) }.boxed());
        let fails: Handler = Arc::new(|_| async { Err(JobFailure::Failed { code: "broken".into(), detail: "it broke".into() }) }.boxed());
        let panics: Handler = Arc::new(|_| async { panic!("on purpose") }.boxed());
        let waits: Handler = Arc::new(|context| {
            async move {
                loop {
                    time::sleep(Duration::from_millis(5)).await;
                    context.progress.report("waiting", 0.5).map_err(|_| JobFailure::Cancelled)?;
                }
            }
            .boxed()
        });
        HashMap::from([("ok", ok), ("fails", fails), ("panics", panics), ("waits", waits)])
    }

    async fn until(jobs: &Jobs, id: &str, done: impl Fn(&Job) -> bool) -> Job {
        for _ in 0..2000 {
            let job = jobs.get(id).await.unwrap();
            if done(&job) {
                return job;
            }
            time::sleep(Duration::from_millis(5)).await;
        }
        panic!("the job never got there: {:?}", jobs.get(id).await);
    }

    #[tokio::test]
    async fn jobs_succeed_fail_and_panic_each_to_their_end() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = queue(&folder).await;
        let shutdown = CancellationToken::new();
        let worker = tokio::spawn({
            let (jobs, shutdown) = (jobs.clone(), shutdown.clone());
            async move { jobs.work(&handlers(), shutdown).await }
        });
        for (kind, state, code) in [
            ("panics", JobState::Failed, Some("internal")),
            ("fails", JobState::Failed, Some("broken")),
            ("nobody", JobState::Failed, Some("unknown_job_kind")),
            ("ok", JobState::Succeeded, None),
        ] {
            let id = jobs.submit(kind, "s", "x").await.unwrap().id;
            let job = until(&jobs, &id, |j| j.state.is_final()).await;
            assert_eq!((job.state, job.error.map(|e| e.code)), (state, code.map(str::to_owned)), "{kind}");
        }
        shutdown.cancel();
        worker.await.unwrap().unwrap();
    }

    #[tokio::test]
    async fn cancelling_stops_a_job_and_stopping_the_server_puts_it_back() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = queue(&folder).await;
        let shutdown = CancellationToken::new();
        let worker = tokio::spawn({
            let (jobs, shutdown) = (jobs.clone(), shutdown.clone());
            async move { jobs.work(&handlers(), shutdown).await }
        });
        let first = jobs.submit("waits", "s", "").await.unwrap().id;
        let second = jobs.submit("waits", "s", "").await.unwrap().id;
        let third = jobs.submit("waits", "s", "").await.unwrap().id;
        until(&jobs, &first, |j| j.stage.as_deref() == Some("waiting") && j.progress == 0.5).await;
        assert_eq!(jobs.cancel(&third).await.unwrap().state, JobState::Cancelled);
        jobs.cancel(&first).await.unwrap();
        until(&jobs, &first, |j| j.state == JobState::Cancelled).await;
        until(&jobs, &second, |j| j.state == JobState::Running).await;
        shutdown.cancel();
        worker.await.unwrap().unwrap();
        let put_back = jobs.get(&second).await.unwrap();
        assert_eq!((put_back.state, put_back.attempts), (JobState::Queued, 0));
    }

    #[tokio::test]
    async fn a_full_queue_says_so() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = queue(&folder).await;
        for _ in 0..10 {
            jobs.submit("ok", "s", "").await.unwrap();
        }
        assert!(matches!(jobs.submit("ok", "s", "").await, Err(crate::jobs::JobsError::QueueFull { queued: 10 })));
    }
}
