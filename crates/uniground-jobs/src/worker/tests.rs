use super::*;
use crate::{Job, JobsError};
use camino::Utf8Path;
use std::sync::atomic::{AtomicU32, Ordering};
use uniground_storage::{BlobHome, Location, NewJob, Store};

async fn queue(folder: &tempfile::TempDir) -> Jobs {
    Jobs::new(
        Store::open(
            Utf8Path::from_path(folder.path()).unwrap(),
            &Location::Folder,
            &BlobHome::Folder,
        )
        .await
        .unwrap()
        .jobs,
        10,
    )
}

/// A job kind that does what its payload says.
#[derive(Default)]
struct ScriptedJob {
    tries: AtomicU32,
}

fn failed(transient: bool) -> JobFailure {
    JobFailure::Failed {
        code: "broken".into(),
        detail: "it broke".into(),
        cause: "it broke: on purpose".into(),
        transient,
    }
}

impl JobKind for ScriptedJob {
    const NAME: &'static str = "obedient";
    const CONCURRENCY: usize = 1;
    const RETRY: Retry = Retry { interrupted: 3, transient: 3, backoff: Duration::from_millis(1) };
    type Payload = String;

    async fn run(&self, job: JobContext<String>) -> Result<String, JobFailure> {
        match job.payload.as_str() {
            "fail" => Err(failed(false)),
            "fail twice" if self.tries.fetch_add(1, Ordering::Relaxed) < 2 => Err(failed(true)),
            "panic" => panic!("on purpose"),
            "wait" => loop {
                time::sleep(Duration::from_millis(5)).await;
                job.progress.report("waiting", 0.5).map_err(|_| JobFailure::Cancelled)?;
            },
            word => Ok(format!("did {word}")),
        }
    }
}

/// A job kind that waits forever, in another lane.
struct Slow;

impl JobKind for Slow {
    const NAME: &'static str = "slow";
    const CONCURRENCY: usize = 2;
    const RETRY: Retry = Retry { interrupted: 1, transient: 1, backoff: Duration::ZERO };
    type Payload = ();

    async fn run(&self, job: JobContext<()>) -> Result<String, JobFailure> {
        loop {
            time::sleep(Duration::from_millis(5)).await;
            job.progress.report("waiting", 0.1).map_err(|_| JobFailure::Cancelled)?;
        }
    }
}

const RECOVERY: JobRecovery =
    JobRecovery { give_up_after: 4, at_once: 2, wait: Duration::from_hours(1) };

fn written<'a>(kind: &'a str, payload: &'a str) -> NewJob<'a> {
    NewJob { kind, payload, key_id: None, done: None }
}

async fn submit(jobs: &Jobs, what: &str) -> String {
    jobs.submit::<ScriptedJob>("s", &what.to_owned(), None).await.unwrap().id
}

fn lane<K: JobKind>(
    jobs: &Jobs,
    kind: K,
    shutdown: &CancellationToken,
) -> tokio::task::JoinHandle<()> {
    let (jobs, shutdown) = (jobs.clone(), shutdown.clone());
    tokio::spawn(async move { jobs.run_lane(Arc::new(kind), K::CONCURRENCY, shutdown).await })
}

async fn until(jobs: &Jobs, id: &str, done: impl Fn(&Job) -> bool) -> Job {
    for _ in 0..2000 {
        let job = jobs.get(id).await.unwrap();
        if done(&job) {
            return job;
        }
        time::sleep(Duration::from_millis(5)).await;
    }
    panic!("the job did not reach the expected state: {:?}", jobs.get(id).await);
}

#[tokio::test]
async fn jobs_finish_after_success_failure_or_panic() {
    let folder = tempfile::tempdir().unwrap();
    let (jobs, shutdown) = (queue(&folder).await, CancellationToken::new());
    let stranger = jobs.repository.insert_job("s", &written("stranger", "{}")).await.unwrap().id;
    jobs.fail_unknown_kinds(&[ScriptedJob::NAME]).await.unwrap();
    assert_eq!(jobs.get(&stranger).await.unwrap().error.unwrap().code, "unknown_job_kind");
    let unreadable =
        jobs.repository.insert_job("s", &written(ScriptedJob::NAME, "{")).await.unwrap().id;
    let worker = lane(&jobs, ScriptedJob::default(), &shutdown);
    assert_eq!(
        until(&jobs, &unreadable, |j| j.state.is_final()).await.error.unwrap().code,
        "internal"
    );
    for (what, state, code) in [
        ("panic", JobState::Failed, Some("internal")),
        ("fail", JobState::Failed, Some("broken")),
        ("this", JobState::Succeeded, None),
        ("fail twice", JobState::Succeeded, None),
    ] {
        let id = submit(&jobs, what).await;
        let job = until(&jobs, &id, |j| j.state.is_final()).await;
        assert_eq!(
            (job.state, job.error.map(|e| e.code)),
            (state, code.map(str::to_owned)),
            "{what}"
        );
        assert_eq!(job.attempts, if what == "fail twice" { 3 } else { 1 }, "{what}");
    }
    shutdown.cancel();
    worker.await.unwrap();
}

#[tokio::test]
async fn cancellation_stops_a_job_and_shutdown_requeues_it() {
    let folder = tempfile::tempdir().unwrap();
    let (jobs, shutdown) = (queue(&folder).await, CancellationToken::new());
    let worker = lane(&jobs, ScriptedJob::default(), &shutdown);
    let (first, second, third) =
        (submit(&jobs, "wait").await, submit(&jobs, "wait").await, submit(&jobs, "wait").await);
    until(&jobs, &first, |j| j.stage.as_deref() == Some("waiting") && j.progress == 0.5).await;
    assert_eq!(jobs.cancel(&third).await.unwrap().state, JobState::Cancelled);
    jobs.cancel(&first).await.unwrap();
    until(&jobs, &first, |j| j.state == JobState::Cancelled).await;
    until(&jobs, &second, |j| j.state == JobState::Running).await;
    shutdown.cancel();
    worker.await.unwrap();
    let put_back = jobs.get(&second).await.unwrap();
    assert_eq!((put_back.state, put_back.attempts), (JobState::Queued, 0));
}

#[tokio::test]
async fn a_cancel_request_between_claim_and_start_is_not_lost() {
    let folder = tempfile::tempdir().unwrap();
    let (jobs, shutdown) = (queue(&folder).await, CancellationToken::new());
    let id = submit(&jobs, "wait").await;
    let claimed = jobs.repository.claim_job(ScriptedJob::NAME).await.unwrap().unwrap();
    assert_eq!(jobs.cancel(&id).await.unwrap().state, JobState::Running, "claimed but not started");
    jobs.run(&Arc::new(ScriptedJob::default()), claimed, &shutdown).await.unwrap();
    assert_eq!(jobs.get(&id).await.unwrap().state, JobState::Cancelled);
}

#[tokio::test]
async fn a_cancel_request_survives_a_restart() {
    let folder = tempfile::tempdir().unwrap();
    let jobs = queue(&folder).await;
    let id = submit(&jobs, "wait").await;
    jobs.repository.claim_job(ScriptedJob::NAME).await.unwrap().unwrap();
    jobs.cancel(&id).await.unwrap();
    // The server crashes here; the next one recovers its queue.
    jobs.repository.enter_as_new_process().await.unwrap();
    jobs.repository.recover_jobs(ScriptedJob::NAME, RECOVERY).await.unwrap();
    assert_eq!(jobs.get(&id).await.unwrap().state, JobState::Cancelled);
}

/// After the lease has passed to another worker, writes of the previous holder are refused.
#[tokio::test]
async fn only_the_lease_holder_can_write() {
    let folder = tempfile::tempdir().unwrap();
    let jobs = queue(&folder).await;
    let id = submit(&jobs, "this").await;
    let first = JobLease::from_claimed_row(
        &jobs.repository.claim_job(ScriptedJob::NAME).await.unwrap().unwrap(),
    );
    jobs.repository.recover_jobs(ScriptedJob::NAME, RECOVERY).await.unwrap();
    assert_eq!(jobs.get(&id).await.unwrap().state, JobState::Running, "its lease holder is alive");
    jobs.repository.enter_as_new_process().await.unwrap();
    jobs.repository.recover_jobs(ScriptedJob::NAME, RECOVERY).await.unwrap();
    assert_eq!(jobs.get(&id).await.unwrap().state, JobState::Queued);
    let not_held = |written: Result<(), StoreError>| {
        assert!(matches!(written, Err(StoreError::LeaseLost)), "{written:?}");
    };
    not_held(jobs.repository.save_job_progress(&first, "stage", 0.5).await.map(drop));
    not_held(
        jobs.repository.finish_job(&first, JobState::Succeeded, Some("done twice"), None).await,
    );
    not_held(jobs.repository.requeue_job(&first).await);
    not_held(jobs.repository.requeue_job_after(&first, Duration::ZERO, 1, 0.5).await);
    let job = jobs.get(&id).await.unwrap();
    assert_eq!((job.state, job.message), (JobState::Queued, None));
}

/// A job that makes progress between interruptions is requeued without delay.
#[tokio::test]
async fn interruptions_delay_a_job_only_without_progress() {
    let folder = tempfile::tempdir().unwrap();
    let jobs = queue(&folder).await;
    let id = submit(&jobs, "this").await;
    let interrupted = async |progress| {
        let job = jobs.repository.claim_job(ScriptedJob::NAME).await.unwrap().unwrap();
        jobs.repository
            .save_job_progress(&JobLease::from_claimed_row(&job), "stage", progress)
            .await
            .unwrap();
        jobs.repository.enter_as_new_process().await.unwrap();
        jobs.repository.recover_jobs(ScriptedJob::NAME, RECOVERY).await.unwrap();
        jobs.get(&id).await.unwrap().state
    };
    for step in 1_u8..30 {
        assert_eq!(interrupted(f32::from(step) / 100.0).await, JobState::Queued);
    }
    // Without further progress, the job is delayed.
    assert_eq!(interrupted(0.1).await, JobState::Queued);
    assert_eq!(jobs.repository.claim_job(ScriptedJob::NAME).await.unwrap(), None, "not due yet");
}

#[tokio::test]
async fn a_job_that_keeps_crashing_its_server_fails() {
    let folder = tempfile::tempdir().unwrap();
    let jobs = queue(&folder).await;
    let id = submit(&jobs, "this").await;
    let recovery = JobRecovery { wait: Duration::ZERO, ..RECOVERY };
    for _ in 0..4 {
        assert_eq!(jobs.get(&id).await.unwrap().state, JobState::Queued);
        jobs.repository.claim_job(ScriptedJob::NAME).await.unwrap().unwrap();
        jobs.repository.enter_as_new_process().await.unwrap();
        jobs.repository.recover_jobs(ScriptedJob::NAME, recovery).await.unwrap();
    }
    assert_eq!(jobs.get(&id).await.unwrap().error.unwrap().code, "interrupted");
}

#[tokio::test]
async fn job_kinds_do_not_block_each_other() {
    let folder = tempfile::tempdir().unwrap();
    let (jobs, shutdown) = (queue(&folder).await, CancellationToken::new());
    let workers = [lane(&jobs, Slow, &shutdown), lane(&jobs, ScriptedJob::default(), &shutdown)];
    let mut slow = Vec::new();
    for _ in 0..3 {
        slow.push(jobs.submit::<Slow>("s", &(), None).await.unwrap().id);
    }
    until(&jobs, &slow[1], |j| j.state == JobState::Running).await;
    let quick = submit(&jobs, "this").await;
    until(&jobs, &quick, |j| j.state == JobState::Succeeded).await;
    assert_eq!(
        jobs.get(&slow[2]).await.unwrap().state,
        JobState::Queued,
        "at most two run concurrently"
    );
    shutdown.cancel();
    for worker in workers {
        worker.await.unwrap();
    }
}

/// A key with ten jobs does not block a key with one.
#[tokio::test]
async fn jobs_of_keys_run_round_robin() {
    let folder = tempfile::tempdir().unwrap();
    let jobs = queue(&folder).await;
    for (key, what) in [("a", "a1"), ("a", "a2"), ("a", "a3"), ("b", "b1"), ("b", "b2")] {
        jobs.submit::<ScriptedJob>("s", &what.to_owned(), Some(key)).await.unwrap();
    }
    let mut order = Vec::new();
    while let Some(job) = jobs.repository.claim_job(ScriptedJob::NAME).await.unwrap() {
        order.push(job.payload.trim_matches('"').to_owned());
    }
    assert_eq!(order, ["a1", "b1", "a2", "b2", "a3"]);
}

#[tokio::test]
async fn a_full_queue_rejects_jobs() {
    let folder = tempfile::tempdir().unwrap();
    let jobs = queue(&folder).await;
    for _ in 0..10 {
        submit(&jobs, "this").await;
    }
    assert!(matches!(
        jobs.submit::<ScriptedJob>("s", &String::new(), None).await,
        Err(JobsError::QueueFull { queued: 10, .. })
    ));
    jobs.submit::<Slow>("s", &(), None).await.unwrap();
}

/// A key that fills the queue leaves a place for a key without jobs. The last job in the queue
/// reports how many are ahead of it.
#[tokio::test]
async fn one_key_cannot_fill_the_queue() {
    let folder = tempfile::tempdir().unwrap();
    let jobs = queue(&folder).await;
    let ask = async |key| jobs.submit::<ScriptedJob>("s", &String::new(), Some(key)).await;
    for _ in 0..9 {
        ask("many").await.unwrap();
    }
    assert!(matches!(ask("many").await, Err(JobsError::QueueFull { queued: 9, again_in_s: 120 })));
    let last = ask("few").await.unwrap().id;
    assert_eq!(jobs.get(&last).await.unwrap().ahead, Some(9));
    assert!(matches!(ask("few").await, Err(JobsError::QueueFull { queued: 10, .. })));
}

/// Aborts the task of one lane, which ends it like a panic.
#[tokio::test]
async fn a_stopped_lane_is_reported_by_kind() {
    let folder = tempfile::tempdir().unwrap();
    let (jobs, shutdown) = (queue(&folder).await, CancellationToken::new());
    let workers = [lane(&jobs, Slow, &shutdown), lane(&jobs, ScriptedJob::default(), &shutdown)];
    let id = submit(&jobs, "this").await;
    until(&jobs, &id, |j| j.state == JobState::Succeeded).await;
    assert!(jobs.lane_states().into_iter().all(|(_, up)| up) && jobs.lane_states().len() == 2);
    workers[0].abort();
    while jobs.lane_states()["slow"] {
        time::sleep(Duration::from_millis(5)).await;
    }
    assert!(jobs.lane_states()["obedient"]);
    let exported = jobs.metrics().text();
    assert!(
        exported.contains("uniground_lane_up{kind=\"slow\"} 0")
            && exported.contains("uniground_lane_up{kind=\"obedient\"} 1"),
        "{exported}"
    );
    assert!(
        exported.contains("uniground_jobs_finished_total{kind=\"obedient\",state=\"succeeded\"} 1"),
        "{exported}"
    );
}
