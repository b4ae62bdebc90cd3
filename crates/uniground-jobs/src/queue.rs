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

/// Period over which the throughput of a queue is measured.
const LATELY: Duration = Duration::from_mins(10);
/// Shortest retry delay for callers that find a queue full, seconds.
const SOONEST_S: u32 = 2;
/// Longest retry delay, seconds.
const LATEST_S: u32 = 120;

/// The progress of a running job.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct JobProgress {
    pub stage: &'static str,
    pub progress: f32,
}

/// A job that a worker of this process runs.
#[derive(Clone)]
pub(super) struct RunningJob {
    pub pulse: Arc<Mutex<JobProgress>>,
    pub cancel: CancellationToken,
    /// The row at the time the worker claimed it.
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
    pub fn counted_by(self, metrics: Arc<Metrics>) -> Self {
        Self { metrics, ..self }
    }

    /// Returns the metrics that count jobs.
    #[must_use]
    pub fn metrics(&self) -> &Arc<Metrics> {
        &self.metrics
    }

    /// Returns the kinds with a lane in this process, and whether the lane is running.
    #[must_use]
    pub fn lanes(&self) -> BTreeMap<&'static str, bool> {
        self.lanes.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Records whether a lane is running.
    pub(super) fn note_lane(&self, kind: &'static str, up: bool) {
        self.lanes.lock().unwrap_or_else(PoisonError::into_inner).insert(kind, up);
        self.metrics.jobs.lane(kind, up);
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
        self.check_queue_capacity::<K>(key_id).await?;
        let payload = serde_json::to_string(payload).map_err(StoreError::from)?;
        let row = self
            .repository
            .insert_job(subject, &NewJob { kind: K::NAME, payload: &payload, key_id, done: None })
            .await?;
        Ok(self.notify_worker::<K>(row))
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
        let done = self.repository.done_lately(K::NAME, LATELY).await?;
        let again_in_s = u32::try_from(LATELY.as_secs()).unwrap_or(u32::MAX) / done.max(1);
        Err(JobsError::QueueFull { queued, again_in_s: again_in_s.clamp(SOONEST_S, LATEST_S) })
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

    /// Converts an inserted job to its API form, and wakes its lane if it is queued.
    #[allow(clippy::must_use_candidate)] // It also wakes the lane.
    pub fn notify_worker<K: JobKind>(&self, row: JobRow) -> Job {
        match row.state {
            JobState::Queued => self.bell(K::NAME).notify_one(),
            state if state.is_final() => self.metrics.jobs.finished(K::NAME, state.as_str(), None),
            _ => {}
        }
        job_of(row, Timestamp::now())
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
        Ok(Job { ahead, ..self.as_it_stands(row) })
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
            page(self.repository.jobs(filter, limit + 1, cursor).await?, limit, |row| &row.id);
        Ok(JobList {
            jobs: rows.into_iter().map(|row| self.as_it_stands(row)).collect(),
            next_cursor,
        })
    }

    /// Merges in the progress from memory, which is newer than the row.
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
        if was_queued && let Some(kind) = self.lanes().into_keys().find(|kind| *kind == job.kind) {
            self.metrics.jobs.finished(kind, job.state.as_str(), None);
        }
        Ok(job)
    }

    /// Wakes the lane of a kind, or all lanes, after another process has queued a job.
    pub fn ring(&self, kind: Option<&str>) {
        let bells = self.bells.lock().unwrap_or_else(PoisonError::into_inner);
        bells
            .iter()
            .filter(|(of, _)| kind.is_none_or(|kind| kind == **of))
            .for_each(|(_, bell)| bell.notify_one());
    }

    /// Returns the notifier for queued jobs of this kind.
    pub(super) fn bell(&self, kind: &'static str) -> Arc<Notify> {
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

    /// Jobs that are only queued here.
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

    /// Queues so many, whether there is room or not.
    async fn fill(jobs: &Jobs, count: u32, key_id: Option<&str>) {
        let new = NewJob { kind: Parsing::NAME, payload: "[]", key_id, done: None };
        for _ in 0..count {
            jobs.repository.insert_job("s", &new).await.unwrap();
        }
    }

    async fn submit(jobs: &Jobs, subject: &str) -> String {
        jobs.submit::<Parsing>(subject, &vec![], None).await.unwrap().id
    }

    /// Takes the next job, as a worker does.
    async fn take(jobs: &Jobs) -> (JobLease, RunningJob) {
        let row = jobs.repository.claim_job(Parsing::NAME).await.unwrap().unwrap();
        let hold = JobLease::of(&row);
        let running =
            RunningJob { pulse: Arc::default(), cancel: CancellationToken::new(), row: row.into() };
        jobs.running().insert(hold.job_id.clone(), running.clone());
        (hold, running)
    }

    /// Whether a bell was rung since it was last looked at.
    fn rang(jobs: &Jobs, kind: &'static str) -> bool {
        jobs.bell(kind).notified().now_or_never().is_some()
    }

    async fn has_room(jobs: &Jobs, key_id: Option<&str>) -> bool {
        match jobs.check_queue_capacity::<Parsing>(key_id).await {
            Ok(()) => true,
            Err(JobsError::QueueFull { .. }) => false,
            Err(error) => panic!("{error}"),
        }
    }

    #[tokio::test]
    async fn a_submitted_job_waits_and_its_lane_is_told() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = jobs(&folder, 10).await;
        assert!(!rang(&jobs, Parsing::NAME));
        let job = jobs.submit::<Parsing>("scene", &vec![7, 9], Some("k")).await.unwrap();
        assert_eq!((job.kind.as_str(), job.subject.as_str()), ("parsing", "scene"));
        assert_eq!((job.state, job.attempts, job.progress), (JobState::Queued, 0, 0.0));
        assert!(rang(&jobs, Parsing::NAME));
        assert!(!rang(&jobs, Parsing::NAME), "once for each job");
        assert!(!rang(&jobs, Naming::NAME));
        let row = jobs.repository.job(&job.id).await.unwrap().unwrap();
        assert_eq!(row.payload, "[7,9]");
        let queued = jobs.repository.queued_jobs(Parsing::NAME, Some("k")).await.unwrap();
        assert_eq!(queued, QueueLengths { all: 1, of_key: 1 });
    }

    #[tokio::test]
    async fn a_queue_has_room_up_to_its_last_place_for_those_without_a_key() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = jobs(&folder, 20).await;
        fill(&jobs, 19, Some("many")).await;
        assert!(has_room(&jobs, None).await);
        submit(&jobs, "s").await;
        let full = jobs.submit::<Parsing>("s", &vec![], None).await;
        assert!(
            matches!(full, Err(JobsError::QueueFull { queued: 20, again_in_s: 120 })),
            "{full:?}"
        );
        assert_eq!(jobs.list(&JobFilter::default(), 99, None).await.unwrap().jobs.len(), 20);
        // Every kind has a queue of its own.
        jobs.submit::<Naming>("s", &(), None).await.unwrap();
        // A place is free once somebody has taken a job.
        take(&jobs).await;
        assert!(has_room(&jobs, None).await);
    }

    #[tokio::test]
    async fn the_last_tenth_of_a_queue_is_for_keys_that_have_few_in_it() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = jobs(&folder, 20).await;
        // A tenth of 20 is 2: who has 2 or more finds 18 places.
        fill(&jobs, 2, Some("two")).await;
        fill(&jobs, 1, Some("one")).await;
        fill(&jobs, 14, Some("many")).await;
        let keys = [Some("many"), Some("two"), Some("one"), Some("none"), None];
        let room = async || {
            let mut room = Vec::new();
            for key_id in keys {
                room.push(has_room(&jobs, key_id).await);
            }
            room
        };
        assert_eq!(room().await, [true; 5], "17 wait");
        fill(&jobs, 1, None).await;
        assert_eq!(room().await, [false, false, true, true, true], "18 wait");
        fill(&jobs, 1, None).await;
        assert_eq!(room().await, [false, false, true, true, true], "19 wait");
        fill(&jobs, 1, None).await;
        assert_eq!(room().await, [false; 5], "20 wait");
    }

    #[tokio::test]
    async fn a_queue_of_fewer_than_ten_places_keeps_none_free() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = jobs(&folder, 9).await;
        fill(&jobs, 8, Some("many")).await;
        assert!(has_room(&jobs, Some("many")).await);
        fill(&jobs, 1, Some("many")).await;
        assert!(!has_room(&jobs, Some("many")).await);
    }

    #[tokio::test]
    async fn who_finds_a_queue_full_is_told_when_by_how_fast_jobs_were_done() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = jobs(&folder, 0).await;
        let again = async || match jobs.check_queue_capacity::<Parsing>(None).await {
            Err(JobsError::QueueFull { queued: 0, again_in_s }) => again_in_s,
            other => panic!("{other:?}"),
        };
        // Done in the last ten minutes, 600 s: none, then 600 / 8 = 75 s, then 600 / 12 = 50 s.
        assert_eq!(again().await, 120, "at the latest");
        for (more, again_in_s) in [(8, 75), (4, 50)] {
            for _ in 0..more {
                fill(&jobs, 1, None).await;
                let (hold, _) = take(&jobs).await;
                let done = jobs.repository.finish_job(&hold, JobState::Succeeded, None, None);
                done.await.unwrap();
            }
            assert_eq!(again().await, again_in_s);
        }
    }

    #[tokio::test]
    async fn a_recorded_job_is_counted_if_it_is_over_and_rings_if_it_waits() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = jobs(&folder, 10).await;
        fill(&jobs, 1, None).await;
        let (hold, _) = take(&jobs).await;
        let row = async || jobs.repository.job(&hold.job_id).await.unwrap().unwrap();
        assert_eq!(jobs.notify_worker::<Parsing>(row().await).state, JobState::Running);
        let told = jobs.metrics().text();
        assert!(!told.contains("kind=\"parsing\""), "one that runs counts nowhere: {told}");
        jobs.repository.finish_job(&hold, JobState::Succeeded, Some("done"), None).await.unwrap();
        let job = jobs.notify_worker::<Parsing>(row().await);
        assert_eq!((job.state, job.message.as_deref()), (JobState::Succeeded, Some("done")));
        let told = jobs.metrics().text();
        let counted = "uniground_jobs_finished_total{kind=\"parsing\",state=\"succeeded\"} 1";
        assert!(told.contains(counted), "{told}");
        assert!(!rang(&jobs, Parsing::NAME), "neither waits");
    }

    #[tokio::test]
    async fn jobs_are_counted_where_it_was_said() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = jobs(&folder, 10).await;
        let metrics = Arc::new(Metrics::default());
        assert!(!Arc::ptr_eq(jobs.metrics(), &metrics));
        let jobs = jobs.counted_by(metrics.clone());
        assert!(Arc::ptr_eq(jobs.metrics(), &metrics));
        assert_eq!(jobs.max_queued, 10);
    }

    #[tokio::test]
    async fn a_job_that_waits_is_told_with_how_many_are_ahead() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = jobs(&folder, 10).await;
        let mut ids = Vec::new();
        for _ in 0..3 {
            ids.push(submit(&jobs, "s").await);
        }
        take(&jobs).await;
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
    async fn a_running_job_stands_where_its_worker_says() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = jobs(&folder, 10).await;
        let id = submit(&jobs, "s").await;
        let (hold, running) = take(&jobs).await;
        jobs.repository.save_job_progress(&hold, "masks", 0.25).await.unwrap();
        running.beat(JobProgress { stage: "merge", progress: 0.5 });
        assert_eq!(running.pulse(), JobProgress { stage: "merge", progress: 0.5 });
        let stands = async || {
            let job = jobs.get(&id).await.unwrap();
            (job.state, job.stage, job.progress)
        };
        assert_eq!(stands().await, (JobState::Running, Some("merge".into()), 0.5));
        let listed = jobs.list(&JobFilter::default(), 1, None).await.unwrap().jobs;
        assert_eq!((listed[0].stage.as_deref(), listed[0].progress), (Some("merge"), 0.5));
        running.beat(JobProgress { stage: "", progress: 0.75 });
        assert_eq!(stands().await, (JobState::Running, None, 0.75), "no stage has a name yet");
        // One that is over stands as it was written down, though its worker is still there.
        jobs.repository.finish_job(&hold, JobState::Failed, None, None).await.unwrap();
        assert_eq!(stands().await, (JobState::Failed, Some("masks".into()), 0.25));
        // Of one that runs elsewhere only its row is known.
        let elsewhere = submit(&jobs, "s").await;
        let (hold, _) = take(&jobs).await;
        jobs.running().remove(&elsewhere);
        jobs.repository.save_job_progress(&hold, "masks", 0.125).await.unwrap();
        let job = jobs.get(&elsewhere).await.unwrap();
        assert_eq!((job.stage.as_deref(), job.progress), (Some("masks"), 0.125));
    }

    #[tokio::test]
    async fn a_job_that_waits_is_cancelled_and_counted_at_once() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = jobs(&folder, 10).await;
        let id = submit(&jobs, "s").await;
        // Without a lane here nobody counts.
        assert_eq!(jobs.cancel(&id).await.unwrap().state, JobState::Cancelled);
        assert!(!jobs.metrics().text().contains("state=\"cancelled\""));
        jobs.note_lane(Naming::NAME, true);
        jobs.note_lane(Parsing::NAME, true);
        let id = submit(&jobs, "s").await;
        assert_eq!(jobs.cancel(&id).await.unwrap().state, JobState::Cancelled);
        // Again: it stays, and is not counted twice.
        assert_eq!(jobs.cancel(&id).await.unwrap().state, JobState::Cancelled);
        let told = jobs.metrics().text();
        let counted = "uniground_jobs_finished_total{kind=\"parsing\",state=\"cancelled\"} 1";
        assert!(told.contains(counted), "{told}");
        assert!(!told.contains("{kind=\"naming\",state=\"cancelled\"}"), "{told}");
        assert!(matches!(jobs.cancel("nobody's").await, Err(JobsError::NotFound { .. })));
    }

    #[tokio::test]
    async fn a_running_job_is_asked_to_stop_and_the_wish_is_written_down() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = jobs(&folder, 10).await;
        jobs.note_lane(Parsing::NAME, true);
        let (id, other) = (submit(&jobs, "s").await, submit(&jobs, "s").await);
        let ((hold, running), (_, beside)) = (take(&jobs).await, take(&jobs).await);
        assert_eq!(jobs.cancel(&id).await.unwrap().state, JobState::Running, "until its next look");
        assert!(running.cancel.is_cancelled() && !beside.cancel.is_cancelled());
        assert!(jobs.repository.is_cancel_requested(&id).await.unwrap());
        assert!(!jobs.repository.is_cancel_requested(&other).await.unwrap());
        assert!(!jobs.metrics().text().contains("state=\"cancelled\""), "its worker counts it");
        // One that is over stays as it is.
        jobs.repository.finish_job(&hold, JobState::Succeeded, None, None).await.unwrap();
        assert_eq!(jobs.cancel(&id).await.unwrap().state, JobState::Succeeded);
    }

    #[tokio::test]
    async fn all_jobs_on_a_subject_are_asked_to_stop_and_no_others() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = jobs(&folder, 10).await;
        let mut ids = Vec::new();
        for subject in ["a", "b", "a"] {
            ids.push(submit(&jobs, subject).await);
        }
        let (_, running) = take(&jobs).await;
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
    async fn a_bell_rings_for_its_kind_or_for_all() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = jobs(&folder, 10).await;
        let rung = |kind| {
            // Who listens has a bell.
            let _bells = [jobs.bell(Parsing::NAME), jobs.bell(Naming::NAME)];
            jobs.ring(kind);
            [rang(&jobs, Parsing::NAME), rang(&jobs, Naming::NAME)]
        };
        assert_eq!(rung(Some("parsing")), [true, false]);
        assert_eq!(rung(Some("naming")), [false, true]);
        assert_eq!(rung(Some("batch")), [false, false]);
        assert_eq!(rung(None), [true, true]);
    }

    #[tokio::test]
    async fn lanes_are_told_by_kind_with_whether_they_are_at_work() {
        let folder = tempfile::tempdir().unwrap();
        let jobs = jobs(&folder, 10).await;
        assert!(jobs.lanes().is_empty());
        jobs.note_lane(Parsing::NAME, true);
        jobs.note_lane(Naming::NAME, false);
        assert_eq!(jobs.lanes(), BTreeMap::from([("naming", false), ("parsing", true)]));
        let told = jobs.metrics().text();
        assert!(told.contains("uniground_lane_up{kind=\"parsing\"} 1"), "{told}");
        assert!(told.contains("uniground_lane_up{kind=\"naming\"} 0"), "{told}");
        jobs.note_lane(Parsing::NAME, false);
        assert!(!jobs.lanes()["parsing"]);
    }
}
