//! Submitting, watching and cancelling jobs.

use super::watchers::JobWatchers;
use super::{Job, JobKind, JobList, JobRequest, to_job};
use jiff::Timestamp;
use std::collections::{BTreeMap, HashMap};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio::sync::Notify;
use tokio_util::sync::CancellationToken;
use uniground_storage::{
    InsertedJob, JobFilter, JobRepository, JobRow, JobState, QueueLengths, StoreError, split_page,
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

/// Period over which the throughput of a queue is measured.
const THROUGHPUT_WINDOW: Duration = Duration::from_mins(10);
/// Shortest retry delay for callers that find a queue full, seconds.
const MIN_RETRY_AFTER_S: u32 = 2;
/// Longest retry delay, seconds.
const MAX_RETRY_AFTER_S: u32 = 120;

/// The progress of a running job.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct JobProgress {
    pub stage: &'static str,
    pub progress: f32,
}

/// A job that a worker of this process runs.
#[derive(Clone)]
pub(super) struct RunningJob {
    pub progress: Arc<Mutex<JobProgress>>,
    pub cancel: CancellationToken,
    /// The row at the time the worker claimed it.
    pub row: Arc<JobRow>,
}

impl RunningJob {
    pub fn progress_snapshot(&self) -> JobProgress {
        *self.progress.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub fn update_progress(&self, progress: JobProgress) {
        *self.progress.lock().unwrap_or_else(PoisonError::into_inner) = progress;
    }
}

/// The queues of all kinds. Cheap to clone.
#[derive(Clone)]
pub struct Jobs {
    pub(super) repository: JobRepository,
    /// By kind: notified when a job was queued.
    bells: Arc<Mutex<HashMap<&'static str, Arc<Notify>>>>,
    running: Arc<Mutex<HashMap<String, RunningJob>>>,
    pub(super) followed: JobWatchers,
    /// By kind: whether its lane is running.
    lanes: Arc<Mutex<BTreeMap<&'static str, bool>>>,
    pub(super) metrics: Arc<Metrics>,
    max_queued: u32,
}

impl Jobs {
    /// Creates the queues. At most `max_queued` jobs of each kind may wait.
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

    /// Sets the metrics that count jobs.
    #[must_use]
    pub fn with_metrics(self, metrics: Arc<Metrics>) -> Self {
        Self { metrics, ..self }
    }

    /// Returns the metrics that count jobs.
    #[must_use]
    pub fn metrics(&self) -> &Arc<Metrics> {
        &self.metrics
    }

    /// Returns the kinds with a lane in this process, and whether the lane is running.
    #[must_use]
    pub fn lane_states(&self) -> BTreeMap<&'static str, bool> {
        self.lanes.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Records whether a lane is running.
    pub(super) fn set_lane_running(&self, kind: &'static str, up: bool) {
        self.lanes.lock().unwrap_or_else(PoisonError::into_inner).insert(kind, up);
        self.metrics.jobs.set_lane_running(kind, up);
    }

    /// Queues a job on a subject, the id of what it works on. `key_id` is the API key that
    /// requested it.
    ///
    /// # Errors
    /// [`JobsError::QueueFull`] when too many jobs of its kind are queued.
    pub async fn submit<K: JobKind>(
        &self,
        subject: &str,
        payload: &K::Payload,
        key_id: Option<&str>,
    ) -> Result<Job, JobsError> {
        let job = JobRequest::<K>::new(payload, key_id)?;
        let row = self.enqueue(&job, self.repository.insert_job(subject, &job.row())).await?;
        Ok(self.to_job(row))
    }

    /// Queues a job in the transaction `insert`, which stores [`JobRequest::row`] together with
    /// what the job works on. Wakes a worker after the commit. `insert` does not run if the queue
    /// is full.
    ///
    /// # Errors
    /// [`JobsError::QueueFull`] when too many jobs of its kind are queued, and those of `insert`.
    pub async fn enqueue<K: JobKind, T: InsertedJob>(
        &self,
        job: &JobRequest<K>,
        insert: impl Future<Output = Result<T, StoreError>>,
    ) -> Result<T, JobsError> {
        if job.is_limited {
            self.check_queue_capacity::<K>(job.row().key_id).await?;
        }
        let outcome = insert.await?;
        match outcome.inserted_job().map(|row| row.state) {
            Some(JobState::Queued) => self.notifier(K::NAME).notify_one(),
            Some(state) if state.is_final() => {
                self.metrics.jobs.record_finished(K::NAME, state.as_str(), None);
            }
            _ => {}
        }
        Ok(outcome)
    }

    /// Checks that another job of this kind may be queued for an API key. The last tenth of the
    /// queue is reserved for keys with few queued jobs, so a key with many jobs cannot block the
    /// others.
    ///
    /// # Errors
    /// [`JobsError::QueueFull`], with the estimated time until the next job finishes.
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
        let done = self.repository.count_recently_finished(K::NAME, THROUGHPUT_WINDOW).await?;
        let again_in_s =
            u32::try_from(THROUGHPUT_WINDOW.as_secs()).unwrap_or(u32::MAX) / done.max(1);
        Err(JobsError::QueueFull {
            queued,
            again_in_s: again_in_s.clamp(MIN_RETRY_AFTER_S, MAX_RETRY_AFTER_S),
        })
    }

    /// Requests cancellation of every job on a subject.
    ///
    /// # Errors
    /// [`JobsError::Store`].
    pub async fn cancel_all_of(&self, subject: &str) -> Result<(), JobsError> {
        for id in self.repository.open_jobs_of(subject).await? {
            self.cancel(&id).await?;
        }
        Ok(())
    }

    /// Returns the current state of a job.
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
        Ok(Job { ahead, ..self.to_job(row) })
    }

    /// Returns jobs, newest first; with a `cursor` (an id) only those before it.
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
            split_page(self.repository.jobs(filter, limit + 1, cursor).await?, limit, |row| {
                &row.id
            });
        Ok(JobList { jobs: rows.into_iter().map(|row| self.to_job(row)).collect(), next_cursor })
    }

    /// Converts a row to its API form. A job that runs in this process has its progress from
    /// memory, which is newer than the row.
    #[must_use]
    pub fn to_job(&self, mut row: JobRow) -> Job {
        if row.state == JobState::Running
            && let Some(running) = self.running().get(&row.id)
        {
            let JobProgress { stage, progress } = running.progress_snapshot();
            row.progress = f64::from(progress);
            row.stage = (!stage.is_empty()).then(|| stage.to_owned());
        }
        to_job(row, Timestamp::now())
    }

    /// Cancels a job. Queued jobs stop at once, running ones at their next check; finished ones
    /// stay as they are. The request is stored first, so that a worker that has claimed the job but
    /// not started it finds it, and so does the next server.
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
        if was_queued
            && let Some(kind) = self.lane_states().into_keys().find(|kind| *kind == job.kind)
        {
            self.metrics.jobs.record_finished(kind, job.state.as_str(), None);
        }
        Ok(job)
    }

    /// Wakes the lane of a kind, or all lanes, after another process has queued a job.
    pub fn wake_lanes(&self, kind: Option<&str>) {
        let bells = self.bells.lock().unwrap_or_else(PoisonError::into_inner);
        bells
            .iter()
            .filter(|(of, _)| kind.is_none_or(|kind| kind == **of))
            .for_each(|(_, bell)| bell.notify_one());
    }

    /// Returns the notifier for queued jobs of this kind.
    pub(super) fn notifier(&self, kind: &'static str) -> Arc<Notify> {
        self.bells.lock().unwrap_or_else(PoisonError::into_inner).entry(kind).or_default().clone()
    }

    pub(super) fn running(&self) -> MutexGuard<'_, HashMap<String, RunningJob>> {
        // The map is consistent between any two statements, so a panic elsewhere cannot corrupt it.
        self.running.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{JobContext, JobFailure, Retry};
    use camino::Utf8Path;
    use futures::FutureExt;
    use uniground_storage::{BlobHome, JobLease, Location, Store};

    const RETRY: Retry = Retry { interrupted: 1, transient: 1, backoff: Duration::ZERO };

    /// A job kind that no worker runs in these tests.
    struct Parsing;
    struct Naming;

    impl JobKind for Parsing {
        const NAME: &'static str = "parsing";
        const CONCURRENCY: usize = 1;
        const RETRY: Retry = RETRY;
        type Payload = Vec<u32>;

        async fn run(&self, _: JobContext<Vec<u32>>) -> Result<String, JobFailure> {
            Err(JobFailure::Cancelled)
        }
    }

    impl JobKind for Naming {
        const NAME: &'static str = "naming";
        const CONCURRENCY: usize = 1;
        const RETRY: Retry = RETRY;
        type Payload = ();

        async fn run(&self, _: JobContext<()>) -> Result<String, JobFailure> {
            Err(JobFailure::Cancelled)
        }
    }

    async fn jobs(folder: &tempfile::TempDir, max_queued: u32) -> Jobs {
        let path = Utf8Path::from_path(folder.path()).unwrap();
        let store = Store::open(path, &Location::Folder, &BlobHome::Folder).await.unwrap();
        Jobs::new(store.jobs, max_queued)
    }

    /// Queues `count` jobs without checking the capacity.
    async fn fill(jobs: &Jobs, count: u32, key_id: Option<&str>) {
        let job = JobRequest::<Parsing>::new(&vec![], key_id).unwrap();
        for _ in 0..count {
            jobs.repository.insert_job("s", &job.row()).await.unwrap();
        }
    }

    async fn submit(jobs: &Jobs, subject: &str) -> String {
        jobs.submit::<Parsing>(subject, &vec![], None).await.unwrap().id
    }

    /// Claims the next job, as a worker does.
    async fn claim_next(jobs: &Jobs) -> (JobLease, RunningJob) {
        let row = jobs.repository.claim_job(Parsing::NAME).await.unwrap().unwrap();
        let lease = JobLease::from_claimed_row(&row);
        let running = RunningJob {
            progress: Arc::default(),
            cancel: CancellationToken::new(),
            row: row.into(),
        };
        jobs.running().insert(lease.job_id.clone(), running.clone());
        (lease, running)
    }

    /// Returns whether the lane of this kind was notified since the last call.
    fn was_notified(jobs: &Jobs, kind: &'static str) -> bool {
        jobs.notifier(kind).notified().now_or_never().is_some()
    }

    async fn has_queue_capacity(jobs: &Jobs, key_id: Option<&str>) -> bool {
        match jobs.check_queue_capacity::<Parsing>(key_id).await {
            Ok(()) => true,
            Err(JobsError::QueueFull { .. }) => false,
            Err(error) => panic!("{error}"),
        }
    }

    #[tokio::test]
    async fn submitting_a_job_queues_it_and_notifies_its_lane() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = jobs(&folder, 10).await;
        assert!(!was_notified(&jobs, Parsing::NAME));
        let job = jobs.submit::<Parsing>("scene", &vec![7, 9], Some("k")).await.unwrap();
        assert_eq!((job.kind.as_str(), job.subject.as_str()), ("parsing", "scene"));
        assert_eq!((job.state, job.attempts, job.progress), (JobState::Queued, 0, 0.0));
        assert!(was_notified(&jobs, Parsing::NAME));
        assert!(!was_notified(&jobs, Parsing::NAME), "one notification per job");
        assert!(!was_notified(&jobs, Naming::NAME));
        let row = jobs.repository.job(&job.id).await.unwrap().unwrap();
        assert_eq!(row.payload, "[7,9]");
        let queued = jobs.repository.queued_jobs(Parsing::NAME, Some("k")).await.unwrap();
        assert_eq!(queued, QueueLengths { all: 1, of_key: 1 });
    }

    #[tokio::test]
    async fn callers_without_a_key_can_fill_the_whole_queue() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = jobs(&folder, 20).await;
        fill(&jobs, 19, Some("many")).await;
        assert!(has_queue_capacity(&jobs, None).await);
        submit(&jobs, "s").await;
        let full = jobs.submit::<Parsing>("s", &vec![], None).await;
        assert!(
            matches!(full, Err(JobsError::QueueFull { queued: 20, again_in_s: 120 })),
            "{full:?}"
        );
        assert_eq!(jobs.list(&JobFilter::default(), 99, None).await.unwrap().jobs.len(), 20);
        // Each kind has its own queue.
        jobs.submit::<Naming>("s", &(), None).await.unwrap();
        // Claiming a job frees its place in the queue.
        claim_next(&jobs).await;
        assert!(has_queue_capacity(&jobs, None).await);
    }

    #[tokio::test]
    async fn the_last_tenth_of_the_queue_is_reserved_for_keys_with_few_jobs() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = jobs(&folder, 20).await;
        // A tenth of 20 is 2: keys with 2 or more jobs can use 18 places.
        fill(&jobs, 2, Some("two")).await;
        fill(&jobs, 1, Some("one")).await;
        fill(&jobs, 14, Some("many")).await;
        let keys = [Some("many"), Some("two"), Some("one"), Some("none"), None];
        let room = async || {
            let mut room = Vec::new();
            for key_id in keys {
                room.push(has_queue_capacity(&jobs, key_id).await);
            }
            room
        };
        assert_eq!(room().await, [true; 5], "17 queued");
        fill(&jobs, 1, None).await;
        assert_eq!(room().await, [false, false, true, true, true], "18 queued");
        fill(&jobs, 1, None).await;
        assert_eq!(room().await, [false, false, true, true, true], "19 queued");
        fill(&jobs, 1, None).await;
        assert_eq!(room().await, [false; 5], "20 queued");
    }

    #[tokio::test]
    async fn queues_with_fewer_than_ten_places_reserve_none() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = jobs(&folder, 9).await;
        fill(&jobs, 8, Some("many")).await;
        assert!(has_queue_capacity(&jobs, Some("many")).await);
        fill(&jobs, 1, Some("many")).await;
        assert!(!has_queue_capacity(&jobs, Some("many")).await);
    }

    #[tokio::test]
    async fn retry_after_of_a_full_queue_follows_its_throughput() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = jobs(&folder, 0).await;
        let again = async || match jobs.check_queue_capacity::<Parsing>(None).await {
            Err(JobsError::QueueFull { queued: 0, again_in_s }) => again_in_s,
            other => panic!("{other:?}"),
        };
        // Finished in the last 600 s: none, then 8 (600 / 8 = 75 s), then 12 (600 / 12 = 50 s).
        assert_eq!(again().await, 120, "the longest retry delay");
        for (more, again_in_s) in [(8, 75), (4, 50)] {
            for _ in 0..more {
                fill(&jobs, 1, None).await;
                let (lease, _) = claim_next(&jobs).await;
                let done = jobs.repository.finish_job(&lease, JobState::Succeeded, None, None);
                done.await.unwrap();
            }
            assert_eq!(again().await, again_in_s);
        }
    }

    #[tokio::test]
    async fn enqueue_notifies_workers_only_after_the_insert() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = jobs(&folder, 10).await;
        let job = JobRequest::<Parsing>::new(&vec![1], Some("k")).unwrap();
        let row = jobs
            .enqueue(&job, async {
                let row = jobs.repository.insert_job("s", &job.row()).await;
                assert!(!was_notified(&jobs, Parsing::NAME), "notified before the insert finished");
                row
            })
            .await
            .unwrap();
        assert!(was_notified(&jobs, Parsing::NAME));
        assert_eq!((row.payload.as_str(), row.state), ("[1]", JobState::Queued));
        let none = jobs.enqueue(&job, async { Ok(None::<JobRow>) }).await.unwrap();
        assert!(none.is_none() && !was_notified(&jobs, Parsing::NAME), "nothing was inserted");
    }

    #[tokio::test]
    async fn enqueue_inserts_into_a_full_queue_only_jobs_without_limit() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = jobs(&folder, 0).await;
        let job = JobRequest::<Parsing>::new(&vec![], None).unwrap();
        let new = job.row();
        let insert = || jobs.repository.insert_job("s", &new);
        let full = jobs.enqueue(&job, insert()).await;
        assert!(matches!(full, Err(JobsError::QueueFull { queued: 0, .. })), "{full:?}");
        assert!(jobs.list(&JobFilter::default(), 9, None).await.unwrap().jobs.is_empty());
        jobs.enqueue(&job.clone().without_limit(), insert()).await.unwrap();
        jobs.enqueue(&job.clone().with_result("p".into(), "stored"), insert()).await.unwrap();
        assert_eq!(jobs.list(&JobFilter::default(), 9, None).await.unwrap().jobs.len(), 2);
    }

    #[tokio::test]
    async fn enqueue_counts_finished_jobs_without_notifying_workers() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = jobs(&folder, 10).await;
        fill(&jobs, 1, None).await;
        let (lease, _) = claim_next(&jobs).await;
        let job = JobRequest::<Parsing>::new(&vec![], None).unwrap();
        let row = async || Ok(jobs.repository.job(&lease.job_id).await.unwrap().unwrap());
        jobs.enqueue(&job, row()).await.unwrap();
        let metrics = jobs.metrics().text();
        assert!(!metrics.contains("kind=\"parsing\""), "a running job is not counted: {metrics}");
        jobs.repository.finish_job(&lease, JobState::Succeeded, Some("done"), None).await.unwrap();
        let job = jobs.to_job(jobs.enqueue(&job, row()).await.unwrap());
        assert_eq!((job.state, job.message.as_deref()), (JobState::Succeeded, Some("done")));
        let metrics = jobs.metrics().text();
        let counted = "uniground_jobs_finished_total{kind=\"parsing\",state=\"succeeded\"} 1";
        assert!(metrics.contains(counted), "{metrics}");
        assert!(!was_notified(&jobs, Parsing::NAME), "a worker was notified of a finished job");
    }

    #[tokio::test]
    async fn with_metrics_replaces_the_metrics() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = jobs(&folder, 10).await;
        let metrics = Arc::new(Metrics::default());
        assert!(!Arc::ptr_eq(jobs.metrics(), &metrics));
        let jobs = jobs.with_metrics(metrics.clone());
        assert!(Arc::ptr_eq(jobs.metrics(), &metrics));
        assert_eq!(jobs.max_queued, 10);
    }

    #[tokio::test]
    async fn a_queued_job_reports_how_many_are_ahead() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = jobs(&folder, 10).await;
        let mut ids = Vec::new();
        for _ in 0..3 {
            ids.push(submit(&jobs, "s").await);
        }
        claim_next(&jobs).await;
        let mut ahead = Vec::new();
        for id in &ids {
            let job = jobs.get(id).await.unwrap();
            assert_eq!(job.id, *id);
            ahead.push((job.state, job.ahead));
        }
        let (queued, running) = (JobState::Queued, JobState::Running);
        assert_eq!(ahead, [(running, None), (queued, Some(0)), (queued, Some(1))]);
        let error = jobs.get("nobody's").await.unwrap_err();
        assert!(matches!(&error, JobsError::NotFound { id } if id == "nobody's"), "{error:?}");
    }

    #[tokio::test]
    async fn jobs_are_listed_page_by_page() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = jobs(&folder, 10).await;
        let mut ids = Vec::new();
        for subject in ["a", "b", "a"] {
            ids.push(submit(&jobs, subject).await);
        }
        let listed = async |filter: &JobFilter, limit, cursor: Option<&str>| {
            let JobList { jobs, next_cursor } = jobs.list(filter, limit, cursor).await.unwrap();
            let place = |id: &String| ids.iter().position(|known| known == id).unwrap();
            let listed: Vec<usize> = jobs.iter().map(|job| place(&job.id)).collect();
            (listed, next_cursor.map(|id| place(&id)))
        };
        let any = JobFilter::default();
        assert_eq!(listed(&any, 2, None).await, (vec![2, 1], Some(1)));
        assert_eq!(listed(&any, 2, Some(&ids[1])).await, (vec![0], None));
        assert_eq!(listed(&any, 3, None).await, (vec![2, 1, 0], None), "all on one page");
        let of_a = JobFilter { subject: Some("a".into()), ..any };
        assert_eq!(listed(&of_a, 1, None).await, (vec![2], Some(2)));
    }

    #[tokio::test]
    async fn a_running_job_reports_live_progress() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = jobs(&folder, 10).await;
        let id = submit(&jobs, "s").await;
        let (lease, running) = claim_next(&jobs).await;
        jobs.repository.save_job_progress(&lease, "masks", 0.25).await.unwrap();
        running.update_progress(JobProgress { stage: "merge", progress: 0.5 });
        assert_eq!(running.progress_snapshot(), JobProgress { stage: "merge", progress: 0.5 });
        let job_state = async || {
            let job = jobs.get(&id).await.unwrap();
            (job.state, job.stage, job.progress)
        };
        assert_eq!(job_state().await, (JobState::Running, Some("merge".into()), 0.5));
        let listed = jobs.list(&JobFilter::default(), 1, None).await.unwrap().jobs;
        assert_eq!((listed[0].stage.as_deref(), listed[0].progress), (Some("merge"), 0.5));
        running.update_progress(JobProgress { stage: "", progress: 0.75 });
        assert_eq!(
            job_state().await,
            (JobState::Running, None, 0.75),
            "an empty stage is reported as none"
        );
        // A finished job is reported from its row, even while it is still in the running list.
        jobs.repository.finish_job(&lease, JobState::Failed, None, None).await.unwrap();
        assert_eq!(job_state().await, (JobState::Failed, Some("masks".into()), 0.25));
        // A job that runs in another process is reported from its row.
        let elsewhere = submit(&jobs, "s").await;
        let (lease, _) = claim_next(&jobs).await;
        jobs.running().remove(&elsewhere);
        jobs.repository.save_job_progress(&lease, "masks", 0.125).await.unwrap();
        let job = jobs.get(&elsewhere).await.unwrap();
        assert_eq!((job.stage.as_deref(), job.progress), (Some("masks"), 0.125));
    }

    #[tokio::test]
    async fn cancelling_a_queued_job_finishes_and_counts_it_at_once() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = jobs(&folder, 10).await;
        let id = submit(&jobs, "s").await;
        // Without a lane in this process, the cancellation is not counted.
        assert_eq!(jobs.cancel(&id).await.unwrap().state, JobState::Cancelled);
        assert!(!jobs.metrics().text().contains("state=\"cancelled\""));
        jobs.set_lane_running(Naming::NAME, true);
        jobs.set_lane_running(Parsing::NAME, true);
        let id = submit(&jobs, "s").await;
        assert_eq!(jobs.cancel(&id).await.unwrap().state, JobState::Cancelled);
        // Cancelling it again changes nothing and is not counted.
        assert_eq!(jobs.cancel(&id).await.unwrap().state, JobState::Cancelled);
        let exported = jobs.metrics().text();
        let counted = "uniground_jobs_finished_total{kind=\"parsing\",state=\"cancelled\"} 1";
        assert!(exported.contains(counted), "{exported}");
        assert!(!exported.contains("{kind=\"naming\",state=\"cancelled\"}"), "{exported}");
        assert!(matches!(jobs.cancel("nobody's").await, Err(JobsError::NotFound { .. })));
    }

    #[tokio::test]
    async fn cancelling_a_running_job_signals_it_and_stores_the_request() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = jobs(&folder, 10).await;
        jobs.set_lane_running(Parsing::NAME, true);
        let (id, other) = (submit(&jobs, "s").await, submit(&jobs, "s").await);
        let ((lease, running), (_, other_job)) = (claim_next(&jobs).await, claim_next(&jobs).await);
        assert_eq!(
            jobs.cancel(&id).await.unwrap().state,
            JobState::Running,
            "it runs until its next check"
        );
        assert!(running.cancel.is_cancelled() && !other_job.cancel.is_cancelled());
        assert!(jobs.repository.is_cancel_requested(&id).await.unwrap());
        assert!(!jobs.repository.is_cancel_requested(&other).await.unwrap());
        assert!(
            !jobs.metrics().text().contains("state=\"cancelled\""),
            "the worker counts it when it stops"
        );
        // A finished job keeps its state.
        jobs.repository.finish_job(&lease, JobState::Succeeded, None, None).await.unwrap();
        assert_eq!(jobs.cancel(&id).await.unwrap().state, JobState::Succeeded);
    }

    #[tokio::test]
    async fn cancelling_a_subject_affects_only_its_jobs() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = jobs(&folder, 10).await;
        let mut ids = Vec::new();
        for subject in ["a", "b", "a"] {
            ids.push(submit(&jobs, subject).await);
        }
        let (_, running) = claim_next(&jobs).await;
        jobs.cancel_all_of("a").await.unwrap();
        let mut states = Vec::new();
        for id in &ids {
            states.push(jobs.get(id).await.unwrap().state);
        }
        assert_eq!(states, [JobState::Running, JobState::Queued, JobState::Cancelled]);
        assert!(running.cancel.is_cancelled());
        jobs.cancel_all_of("nothing").await.unwrap();
    }

    #[tokio::test]
    async fn wake_lanes_notifies_one_kind_or_all() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = jobs(&folder, 10).await;
        let notified_lanes = |kind| {
            // Creates the notifiers of both lanes.
            let _bells = [jobs.notifier(Parsing::NAME), jobs.notifier(Naming::NAME)];
            jobs.wake_lanes(kind);
            [was_notified(&jobs, Parsing::NAME), was_notified(&jobs, Naming::NAME)]
        };
        assert_eq!(notified_lanes(Some("parsing")), [true, false]);
        assert_eq!(notified_lanes(Some("naming")), [false, true]);
        assert_eq!(notified_lanes(Some("batch")), [false, false]);
        assert_eq!(notified_lanes(None), [true, true]);
    }

    #[tokio::test]
    async fn lane_states_report_running_lanes_by_kind() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = jobs(&folder, 10).await;
        assert!(jobs.lane_states().is_empty());
        jobs.set_lane_running(Parsing::NAME, true);
        jobs.set_lane_running(Naming::NAME, false);
        assert_eq!(jobs.lane_states(), BTreeMap::from([("naming", false), ("parsing", true)]));
        let exported = jobs.metrics().text();
        assert!(exported.contains("uniground_lane_up{kind=\"parsing\"} 1"), "{exported}");
        assert!(exported.contains("uniground_lane_up{kind=\"naming\"} 0"), "{exported}");
        jobs.set_lane_running(Parsing::NAME, false);
        assert!(!jobs.lane_states()["parsing"]);
    }
}
