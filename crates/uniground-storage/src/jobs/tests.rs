use super::super::{BlobHome, Location, Store};
use super::*;
use camino::Utf8Path;

const KIND: &str = "parse";

async fn store(folder: &tempfile::TempDir) -> Store {
    let path = Utf8Path::from_path(folder.path()).unwrap();
    Store::open(path, &Location::Folder, &BlobHome::Folder).await.unwrap()
}

fn new<'a>(kind: &'a str, key_id: Option<&'a str>) -> NewJob<'a> {
    NewJob { kind, payload: "{}", key_id, done: None }
}

async fn insert_one(jobs: &JobRepository) -> String {
    jobs.insert_job("s", &new(KIND, None)).await.unwrap().id
}

async fn claim(jobs: &JobRepository) -> JobRow {
    jobs.claim_job(KIND).await.unwrap().unwrap()
}

async fn row(jobs: &JobRepository, id: &str) -> JobRow {
    jobs.job(id).await.unwrap().unwrap()
}

/// Changes columns of a job directly in the database.
async fn update_job_row(store: &Store, id: &str, what: &str) {
    let sql = format!("UPDATE jobs SET {what} WHERE id = $1");
    let changed = sqlx::query(sqlx::AssertSqlSafe(sql))
        .bind(id)
        .execute(store.database.writer.pool())
        .await
        .unwrap();
    assert_eq!(changed.rows_affected(), 1, "{what}");
}

/// Returns the time from which a job is due, and its number of interruptions in a row.
async fn read_due(store: &Store, id: &str) -> (Option<Timestamp>, i64) {
    let sql = "SELECT not_before, interruptions FROM jobs WHERE id = $1";
    let (due, interruptions): (Option<String>, i64) =
        sqlx::query_as(sql).bind(id).fetch_one(&store.database.reader).await.unwrap();
    (due.map(|due| due.parse().unwrap()), interruptions)
}

#[track_caller]
fn assert_not_held<T: std::fmt::Debug>(written: Result<T, StoreError>) {
    assert!(matches!(written, Err(StoreError::LeaseLost)), "{written:?}");
}

const RECOVERY: JobRecovery =
    JobRecovery { give_up_after: 5, at_once: 2, wait: Duration::from_secs(100) };

#[tokio::test]
async fn a_new_job_is_stored_and_queued() {
    let folder = tempfile::tempdir().unwrap();
    let jobs = store(&folder).await.jobs;
    let new = NewJob { kind: "parse", payload: "{\"a\":1}", key_id: Some("k"), done: None };
    let before = Timestamp::now();
    let inserted = jobs.insert_job("scene", &new).await.unwrap();
    let created: Timestamp = inserted.created_at.parse().unwrap();
    assert!((before..=Timestamp::now()).contains(&created), "{created}");
    let expected = JobRow {
        id: inserted.id.clone(),
        kind: "parse".into(),
        subject: "scene".into(),
        payload: "{\"a\":1}".into(),
        state: JobState::Queued,
        stage: None,
        progress: 0.0,
        attempts: 0,
        failures: 0,
        furthest: 0.0,
        holder: None,
        message: None,
        error_code: None,
        error: None,
        created_at: inserted.created_at.clone(),
        started_at: None,
        finished_at: None,
    };
    assert_eq!(inserted, expected);
    assert_eq!(jobs.job(&inserted.id).await.unwrap(), Some(expected));
    assert_eq!(jobs.job("nobody's").await.unwrap(), None);
}

#[tokio::test]
async fn a_job_with_a_known_result_is_inserted_as_finished() {
    let folder = tempfile::tempdir().unwrap();
    let store = store(&folder).await;
    let mut tx = store.database.writer.begin().await.unwrap();
    let done =
        insert_done(&mut tx, "j", "scene", &new(KIND, Some("k")), "it was there").await.unwrap();
    tx.commit().await.unwrap();
    assert_eq!((done.state, done.progress, done.attempts), (JobState::Succeeded, 1.0, 0));
    assert_eq!(done.message.as_deref(), Some("it was there"));
    assert_eq!((done.id.as_str(), done.subject.as_str()), ("j", "scene"));
    assert_eq!(
        (&done.started_at, &done.finished_at),
        (&Some(done.created_at.clone()), &Some(done.created_at.clone()))
    );
    assert_eq!(row(&store.jobs, "j").await, done);
    assert_eq!(store.jobs.claim_job(KIND).await.unwrap(), None, "a finished job is not claimed");
}

#[tokio::test]
async fn jobs_are_listed_newest_first_and_filtered() {
    let folder = tempfile::tempdir().unwrap();
    let jobs = store(&folder).await.jobs;
    let mut ids = Vec::new();
    for (kind, subject) in [("parse", "a"), ("naming", "a"), ("parse", "b"), ("parse", "a")] {
        ids.push(jobs.insert_job(subject, &new(kind, None)).await.unwrap().id);
    }
    jobs.cancel_queued_job(&ids[3]).await.unwrap();
    let listed = async |filter: JobFilter, limit, cursor: Option<&str>| {
        let rows = jobs.jobs(&filter, limit, cursor).await.unwrap();
        rows.iter().map(|row| ids.iter().position(|id| *id == row.id).unwrap()).collect::<Vec<_>>()
    };
    let any = JobFilter::default;
    assert_eq!(listed(any(), 9, None).await, [3, 2, 1, 0]);
    assert_eq!(listed(any(), 2, None).await, [3, 2]);
    assert_eq!(listed(any(), 9, Some(&ids[2])).await, [1, 0]);
    let kind = JobFilter { kind: Some("parse".into()), ..any() };
    assert_eq!(listed(kind.clone(), 9, None).await, [3, 2, 0]);
    assert_eq!(listed(kind, 9, Some(&ids[3])).await, [2, 0]);
    let subject = JobFilter { subject: Some("a".into()), ..any() };
    assert_eq!(listed(subject.clone(), 9, None).await, [3, 1, 0]);
    let state = JobFilter { state: Some(JobState::Queued), ..subject };
    assert_eq!(listed(state, 9, None).await, [1, 0]);
}

#[tokio::test]
async fn queued_jobs_are_counted_by_kind_and_by_key() {
    let folder = tempfile::tempdir().unwrap();
    let jobs = store(&folder).await.jobs;
    let mut ids = Vec::new();
    for key_id in [Some("a"), Some("a"), Some("b"), None, Some("a")] {
        ids.push(jobs.insert_job("s", &new(KIND, key_id)).await.unwrap().id);
    }
    jobs.insert_job("s", &new("naming", Some("a"))).await.unwrap();
    let counted = async |kind, key_id| jobs.queued_jobs(kind, key_id).await.unwrap();
    assert_eq!(counted(KIND, Some("a")).await, QueueLengths { all: 5, of_key: 3 });
    assert_eq!(counted(KIND, Some("b")).await, QueueLengths { all: 5, of_key: 1 });
    assert_eq!(counted(KIND, Some("c")).await, QueueLengths { all: 5, of_key: 0 });
    assert_eq!(counted(KIND, None).await, QueueLengths { all: 5, of_key: 1 });
    assert_eq!(counted("naming", None).await, QueueLengths { all: 1, of_key: 0 });
    assert_eq!(counted("batch", None).await, QueueLengths { all: 0, of_key: 0 });
    for (i, id) in ids.iter().enumerate() {
        assert_eq!(jobs.jobs_ahead(KIND, id).await.unwrap(), i as u32);
    }
    assert_eq!(jobs.jobs_ahead("naming", &ids[4]).await.unwrap(), 0);
    // A claimed job is neither queued nor ahead of other jobs.
    claim(&jobs).await;
    assert_eq!(counted(KIND, Some("a")).await, QueueLengths { all: 4, of_key: 2 });
    assert_eq!(jobs.jobs_ahead(KIND, &ids[4]).await.unwrap(), 3);
}

#[tokio::test]
async fn recently_finished_jobs_are_those_that_succeeded_or_failed() {
    let folder = tempfile::tempdir().unwrap();
    let store = store(&folder).await;
    let jobs = &store.jobs;
    let (minutes, hours) = (Duration::from_mins(10), Duration::from_hours(2));
    assert_eq!(jobs.count_recently_finished(KIND, minutes).await.unwrap(), 0);
    for state in [JobState::Succeeded, JobState::Failed, JobState::Cancelled] {
        insert_one(jobs).await;
        jobs.finish_job(&JobLease::from_claimed_row(&claim(jobs).await), state, None, None)
            .await
            .unwrap();
    }
    // A running job, a queued one, and one that failed without running.
    insert_one(jobs).await;
    claim(jobs).await;
    insert_one(jobs).await;
    let never = insert_one(jobs).await;
    jobs.finish_open_job(&never, JobState::Failed, None).await.unwrap();
    assert_eq!(jobs.count_recently_finished(KIND, minutes).await.unwrap(), 2);
    assert_eq!(jobs.count_recently_finished("naming", minutes).await.unwrap(), 0);
    // A job that was created an hour ago.
    let hour_ago = first_id_at(Timestamp::now().checked_sub(Duration::from_hours(1)).unwrap());
    let old = insert_one(jobs).await;
    let done = format!("id = '{hour_ago}', state = 'succeeded', attempts = 1");
    update_job_row(&store, &old, &done).await;
    assert_eq!(jobs.count_recently_finished(KIND, minutes).await.unwrap(), 2);
    assert_eq!(jobs.count_recently_finished(KIND, hours).await.unwrap(), 3);
}

#[tokio::test]
async fn a_job_is_claimed_by_one_worker() {
    let folder = tempfile::tempdir().unwrap();
    let store = store(&folder).await;
    let jobs = &store.jobs;
    assert_eq!(jobs.claim_job(KIND).await.unwrap(), None);
    let (first, second) = (insert_one(jobs).await, insert_one(jobs).await);
    update_job_row(&store, &first, "stage = 'masks', progress = 0.5, attempts = 2").await;
    assert_eq!(jobs.claim_job("naming").await.unwrap(), None, "another kind");
    let before = Timestamp::now();
    let claimed = claim(jobs).await;
    assert_eq!(
        (&claimed.id, claimed.state),
        (&first, JobState::Running),
        "the oldest job is claimed"
    );
    assert_eq!((claimed.attempts, claimed.progress, &claimed.stage), (3, 0.0, &None));
    assert_eq!(claimed.holder.as_deref(), Some(&*store.database.members.id()));
    let started: Timestamp = claimed.started_at.clone().unwrap().parse().unwrap();
    assert!((before..=Timestamp::now()).contains(&started), "{started}");
    assert_eq!(row(jobs, &first).await, claimed);
    assert_eq!(claim(jobs).await.id, second);
    assert_eq!(jobs.claim_job(KIND).await.unwrap(), None, "both jobs are claimed");
    let lease = JobLease::from_claimed_row(&claimed);
    assert_eq!((&lease.job_id, &lease.holder), (&first, &claimed.holder.unwrap()));
}

#[tokio::test]
async fn a_job_is_claimed_once_it_is_due() {
    let folder = tempfile::tempdir().unwrap();
    let store = store(&folder).await;
    let id = insert_one(&store.jobs).await;
    let due_after = async |wait: &str| {
        update_job_row(&store, &id, &format!("state = 'queued', not_before = '{wait}'")).await;
        store.jobs.claim_job(KIND).await.unwrap().is_some()
    };
    assert!(!due_after(&time_after(Duration::from_mins(1))).await);
    assert!(!due_after(&time_after(Duration::from_mins(119))).await);
    let ago = Timestamp::now().checked_sub(Duration::from_mins(1)).unwrap();
    assert!(due_after(&ago.to_string()).await);
    // Delays above two hours are ignored: the clock was set back.
    assert!(due_after(&time_after(Duration::from_mins(121))).await);
}

#[tokio::test]
async fn claims_alternate_between_keys_and_keyless_jobs() {
    let folder = tempfile::tempdir().unwrap();
    let jobs = store(&folder).await.jobs;
    for (subject, key_id) in
        [("a1", Some("a")), ("a2", Some("a")), ("none1", None), ("none2", None), ("b1", Some("b"))]
    {
        jobs.insert_job(subject, &new(KIND, key_id)).await.unwrap();
    }
    let mut claimed_subjects = Vec::new();
    while let Some(job) = jobs.claim_job(KIND).await.unwrap() {
        claimed_subjects.push(job.subject);
    }
    assert_eq!(claimed_subjects, ["a1", "none1", "b1", "a2", "none2"]);
}

#[tokio::test]
async fn a_removed_member_claims_no_jobs() {
    let folder = tempfile::tempdir().unwrap();
    let store = store(&folder).await;
    let id = insert_one(&store.jobs).await;
    sqlx::query("DELETE FROM members").execute(store.database.writer.pool()).await.unwrap();
    assert_eq!(store.jobs.claim_job(KIND).await.unwrap(), None);
    assert_eq!(row(&store.jobs, &id).await.state, JobState::Queued);
    store.jobs.enter_as_new_process().await.unwrap();
    assert_eq!(claim(&store.jobs).await.id, id);
}

#[tokio::test]
async fn saving_progress_returns_cancel_requests() {
    let folder = tempfile::tempdir().unwrap();
    let jobs = store(&folder).await.jobs;
    let id = insert_one(&jobs).await;
    let lease = JobLease::from_claimed_row(&claim(&jobs).await);
    assert!(!jobs.save_job_progress(&lease, "masks", 0.25).await.unwrap());
    let noted = row(&jobs, &id).await;
    assert_eq!((noted.stage.as_deref(), noted.progress), (Some("masks"), 0.25));
    jobs.request_cancel(&id).await.unwrap();
    assert!(jobs.save_job_progress(&lease, "merge", 0.5).await.unwrap());
    let noted = row(&jobs, &id).await;
    assert_eq!((noted.stage.as_deref(), noted.progress), (Some("merge"), 0.5));
}

#[tokio::test]
async fn cancel_requests_are_stored_for_unfinished_jobs_only() {
    let folder = tempfile::tempdir().unwrap();
    let jobs = store(&folder).await.jobs;
    let (running, waiting) = (insert_one(&jobs).await, insert_one(&jobs).await);
    let lease = JobLease::from_claimed_row(&claim(&jobs).await);
    let cancel_requested = async |id: &str| jobs.is_cancel_requested(id).await.unwrap();
    assert_eq!(
        (cancel_requested(&running).await, cancel_requested(&waiting).await),
        (false, false)
    );
    jobs.request_cancel(&running).await.unwrap();
    assert_eq!((cancel_requested(&running).await, cancel_requested(&waiting).await), (true, false));
    jobs.request_cancel(&waiting).await.unwrap();
    assert!(cancel_requested(&waiting).await);
    assert!(!cancel_requested("nobody's").await);
    jobs.finish_job(&lease, JobState::Cancelled, None, None).await.unwrap();
    let over = insert_one(&jobs).await;
    jobs.finish_open_job(&over, JobState::Failed, None).await.unwrap();
    jobs.request_cancel(&over).await.unwrap();
    assert!(!cancel_requested(&over).await);
}

#[tokio::test]
async fn a_job_is_finished_once_by_its_lease_holder() {
    let folder = tempfile::tempdir().unwrap();
    let jobs = store(&folder).await.jobs;
    let id = insert_one(&jobs).await;
    let lease = JobLease::from_claimed_row(&claim(&jobs).await);
    let stranger = JobLease { holder: "somebody else".into(), ..lease.clone() };
    jobs.save_job_progress(&lease, "masks", 0.25).await.unwrap();
    let before = Timestamp::now();
    assert_not_held(jobs.finish_job(&stranger, JobState::Failed, None, None).await);
    assert_eq!(row(&jobs, &id).await.state, JobState::Running);
    jobs.finish_job(&lease, JobState::Succeeded, Some("4 things\0"), None).await.unwrap();
    let done = row(&jobs, &id).await;
    assert_eq!((done.state, done.progress, &done.stage), (JobState::Succeeded, 1.0, &None));
    assert_eq!(done.message.as_deref(), Some("4 things\u{fffd}"), "NUL is replaced");
    assert_eq!((&done.error_code, &done.error), (&None, &None));
    let finished: Timestamp = done.finished_at.clone().unwrap().parse().unwrap();
    assert!((before..=Timestamp::now()).contains(&finished), "{finished}");
    let failed = Some(("internal", "too late"));
    assert_not_held(jobs.finish_job(&lease, JobState::Failed, None, failed).await);
    assert_eq!(row(&jobs, &id).await, done, "the first outcome is kept");
}

#[tokio::test]
async fn a_failed_job_stores_its_error_and_progress() {
    let folder = tempfile::tempdir().unwrap();
    let jobs = store(&folder).await.jobs;
    let id = insert_one(&jobs).await;
    let lease = JobLease::from_claimed_row(&claim(&jobs).await);
    jobs.save_job_progress(&lease, "masks", 0.25).await.unwrap();
    let error = Some(("broken", "a\0b"));
    jobs.finish_job(&lease, JobState::Failed, None, error).await.unwrap();
    let failed = row(&jobs, &id).await;
    assert_eq!((failed.state, failed.progress), (JobState::Failed, 0.25));
    assert_eq!(failed.stage.as_deref(), Some("masks"));
    assert_eq!(failed.error_code.as_deref(), Some("broken"));
    assert_eq!(failed.error.as_deref(), Some("a\u{fffd}b"));
    assert_eq!(failed.message, None);
}

#[tokio::test]
async fn an_open_job_can_be_finished_without_its_lease() {
    let folder = tempfile::tempdir().unwrap();
    let jobs = store(&folder).await.jobs;
    let (running, waiting) = (insert_one(&jobs).await, insert_one(&jobs).await);
    let lease = JobLease::from_claimed_row(&claim(&jobs).await);
    let why = Some(("unknown", "nobody knows it"));
    for id in [&running, &waiting] {
        jobs.finish_open_job(id, JobState::Failed, why).await.unwrap();
        let ended = row(&jobs, id).await;
        assert_eq!((ended.state, ended.error_code.as_deref()), (JobState::Failed, Some("unknown")));
        jobs.cancel_orphan_job(id).await.unwrap();
        assert_eq!(row(&jobs, id).await, ended, "a finished job is not changed");
    }
    assert_not_held(jobs.finish_job(&lease, JobState::Succeeded, None, None).await);
    let orphan = insert_one(&jobs).await;
    jobs.cancel_orphan_job(&orphan).await.unwrap();
    let ended = row(&jobs, &orphan).await;
    assert_eq!((ended.state, &ended.error), (JobState::Cancelled, &None));
    // Finishing an unknown job is no error.
    jobs.finish_open_job("nobody's", JobState::Failed, None).await.unwrap();
}

#[tokio::test]
async fn only_queued_jobs_are_cancelled_at_once() {
    let folder = tempfile::tempdir().unwrap();
    let jobs = store(&folder).await.jobs;
    let (running, waiting) = (insert_one(&jobs).await, insert_one(&jobs).await);
    claim(&jobs).await;
    assert!(!jobs.cancel_queued_job(&running).await.unwrap());
    assert_eq!(row(&jobs, &running).await.state, JobState::Running);
    assert!(jobs.cancel_queued_job(&waiting).await.unwrap());
    let cancelled = row(&jobs, &waiting).await;
    assert_eq!(cancelled.state, JobState::Cancelled);
    assert!(cancelled.finished_at.is_some());
    assert!(!jobs.cancel_queued_job(&waiting).await.unwrap(), "a finished job is not cancelled");
    assert!(!jobs.cancel_queued_job("nobody's").await.unwrap());
}

#[tokio::test]
async fn open_jobs_are_queued_or_running() {
    let folder = tempfile::tempdir().unwrap();
    let store = store(&folder).await;
    let jobs = &store.jobs;
    assert!(jobs.open_jobs().await.unwrap().is_empty());
    let mut ids = Vec::new();
    for (subject, kind) in [("a", "parse"), ("b", "naming"), ("a", "parse"), ("a", "batch")] {
        ids.push(jobs.insert_job(subject, &new(kind, None)).await.unwrap().id);
    }
    claim(jobs).await;
    jobs.cancel_queued_job(&ids[3]).await.unwrap();
    let mut of_a = jobs.open_jobs_of("a").await.unwrap();
    of_a.sort();
    assert_eq!(of_a, [ids[0].clone(), ids[2].clone()]);
    assert!(jobs.open_jobs_of("c").await.unwrap().is_empty());
    let mut open = jobs.open_jobs().await.unwrap();
    open.sort();
    let expected = [(0, "parse"), (1, "naming"), (2, "parse")];
    assert_eq!(open, expected.map(|(i, kind)| (ids[i].clone(), kind.to_owned())));
    // Insert the scene of one job.
    for sql in [
        "INSERT INTO contents (hash, bytes, created_at) VALUES ('h', 1, 'then')",
        "INSERT INTO scenes (id, name, content_hash, created_at, updated_at)
         VALUES ('b', 'room', 'h', 'then', 'then')",
    ] {
        sqlx::query(sql).execute(store.database.writer.pool()).await.unwrap();
    }
    let mut orphans = jobs.jobs_without_scene().await.unwrap();
    orphans.sort();
    assert_eq!(orphans, [0, 2].map(|i: usize| (ids[i].clone(), "a".to_owned())));
}

#[tokio::test]
async fn a_shutdown_requeues_a_job_without_counting_an_attempt() {
    let folder = tempfile::tempdir().unwrap();
    let jobs = store(&folder).await.jobs;
    let id = insert_one(&jobs).await;
    let lease = JobLease::from_claimed_row(&claim(&jobs).await);
    jobs.save_job_progress(&lease, "masks", 0.25).await.unwrap();
    let stranger = JobLease { holder: "somebody else".into(), ..lease.clone() };
    assert_not_held(jobs.requeue_job(&stranger).await);
    jobs.requeue_job(&lease).await.unwrap();
    let waiting = row(&jobs, &id).await;
    assert_eq!((waiting.state, waiting.attempts), (JobState::Queued, 0));
    assert_eq!((&waiting.started_at, &waiting.stage, waiting.progress), (&None, &None, 0.0));
    assert_not_held(jobs.requeue_job(&lease).await);
    assert_eq!(row(&jobs, &id).await.attempts, 0, "the attempt is subtracted once");
    assert_eq!(claim(&jobs).await.attempts, 1, "due immediately");
}

#[tokio::test]
async fn a_transient_failure_requeues_a_job_with_a_delay() {
    let folder = tempfile::tempdir().unwrap();
    let store = store(&folder).await;
    let jobs = &store.jobs;
    let id = insert_one(jobs).await;
    let lease = JobLease::from_claimed_row(&claim(jobs).await);
    jobs.save_job_progress(&lease, "masks", 0.5).await.unwrap();
    let hour = Duration::from_hours(1);
    let stranger = JobLease { holder: "somebody else".into(), ..lease.clone() };
    assert_not_held(jobs.requeue_job_after(&stranger, hour, 2, 0.5).await);
    let before = Timestamp::now();
    jobs.requeue_job_after(&lease, hour, 2, 0.5).await.unwrap();
    let (due_at, _) = read_due(&store, &id).await;
    let latest = Timestamp::now().checked_add(hour).unwrap();
    assert!((before.checked_add(hour).unwrap()..=latest).contains(&due_at.unwrap()));
    let waiting = row(jobs, &id).await;
    assert_eq!((waiting.state, waiting.attempts), (JobState::Queued, 1), "the attempt counts");
    assert_eq!((waiting.failures, waiting.furthest), (2, 0.5));
    assert_eq!((&waiting.started_at, &waiting.stage, waiting.progress), (&None, &None, 0.0));
    assert_eq!(jobs.claim_job(KIND).await.unwrap(), None, "not due yet");
    assert_not_held(jobs.requeue_job_after(&lease, Duration::ZERO, 3, 0.5).await);
    // An attempt with less progress does not lower the furthest progress.
    update_job_row(&store, &id, "not_before = NULL").await;
    let lease = JobLease::from_claimed_row(&claim(jobs).await);
    jobs.requeue_job_after(&lease, Duration::ZERO, 3, 0.25).await.unwrap();
    let waiting = row(jobs, &id).await;
    assert_eq!((waiting.failures, waiting.furthest), (3, 0.5));
    assert_eq!(claim(jobs).await.attempts, 3, "due immediately");
}

#[tokio::test]
async fn a_lease_is_lost_when_another_worker_claims_the_job() {
    let folder = tempfile::tempdir().unwrap();
    let store = store(&folder).await;
    let jobs = &store.jobs;
    insert_one(jobs).await;
    let lease = JobLease::from_claimed_row(&claim(jobs).await);
    let checked = async |lease: &JobLease| {
        let mut tx = store.database.writer.begin().await.unwrap();
        let checked = lease.check(&mut tx).await;
        tx.rollback().await.unwrap();
        checked
    };
    checked(&lease).await.unwrap();
    assert_not_held(checked(&JobLease { job_id: "nobody's".into(), ..lease.clone() }).await);
    assert_not_held(checked(&JobLease { holder: "somebody else".into(), ..lease.clone() }).await);
    jobs.enter_as_new_process().await.unwrap();
    jobs.recover_jobs(KIND, RECOVERY).await.unwrap();
    assert_not_held(checked(&lease).await);
    let again = JobLease::from_claimed_row(&claim(jobs).await);
    assert_not_held(checked(&lease).await);
    checked(&again).await.unwrap();
    jobs.finish_job(&again, JobState::Succeeded, None, None).await.unwrap();
    assert_not_held(checked(&again).await);
}

#[tokio::test]
async fn jobs_of_gone_members_are_requeued() {
    let folder = tempfile::tempdir().unwrap();
    let store = store(&folder).await;
    let jobs = &store.jobs;
    let left = insert_one(jobs).await;
    let other_kind = jobs.insert_job("s", &new("naming", None)).await.unwrap().id;
    let lease = JobLease::from_claimed_row(&claim(jobs).await);
    jobs.claim_job("naming").await.unwrap().unwrap();
    jobs.save_job_progress(&lease, "masks", 0.25).await.unwrap();
    jobs.recover_jobs(KIND, RECOVERY).await.unwrap();
    assert_eq!(row(jobs, &left).await.state, JobState::Running, "its lease holder is alive");
    jobs.enter_as_new_process().await.unwrap();
    let waiting = insert_one(jobs).await;
    jobs.recover_jobs(KIND, RECOVERY).await.unwrap();
    let found = row(jobs, &left).await;
    assert_eq!((found.state, found.attempts), (JobState::Queued, 1));
    assert_eq!((&found.started_at, &found.stage, found.progress), (&None, &None, 0.0));
    assert_eq!(found.furthest, 0.25);
    assert_eq!(read_due(&store, &left).await, (None, 1), "the first retry has no delay");
    assert_eq!(read_due(&store, &waiting).await, (None, 0), "a queued job is not changed");
    assert_eq!(row(jobs, &other_kind).await.state, JobState::Running);
    // Jobs from before membership existed have no holder.
    let lease = JobLease::from_claimed_row(&claim(jobs).await);
    update_job_row(&store, &lease.job_id, "holder = NULL").await;
    jobs.recover_jobs(KIND, RECOVERY).await.unwrap();
    assert_eq!(row(jobs, &lease.job_id).await.state, JobState::Queued);
}

#[tokio::test]
async fn a_cancel_request_is_applied_when_the_member_is_gone() {
    let folder = tempfile::tempdir().unwrap();
    let store = store(&folder).await;
    let jobs = &store.jobs;
    let (stop, go_on) = (insert_one(jobs).await, insert_one(jobs).await);
    claim(jobs).await;
    claim(jobs).await;
    jobs.request_cancel(&stop).await.unwrap();
    jobs.enter_as_new_process().await.unwrap();
    jobs.recover_jobs(KIND, RECOVERY).await.unwrap();
    let stopped = row(jobs, &stop).await;
    assert_eq!(stopped.state, JobState::Cancelled);
    assert!(stopped.finished_at.is_some());
    assert_eq!(row(jobs, &go_on).await.state, JobState::Queued);
}

/// Claims the only job, saves its progress, and simulates the end of its process.
async fn interrupt_job(store: &Store, id: &str, progress: f32, recovery: JobRecovery) {
    let jobs = &store.jobs;
    update_job_row(store, id, "not_before = NULL").await;
    let lease = JobLease::from_claimed_row(&claim(jobs).await);
    jobs.save_job_progress(&lease, "stage", progress).await.unwrap();
    jobs.enter_as_new_process().await.unwrap();
    jobs.recover_jobs(KIND, recovery).await.unwrap();
}

#[tokio::test]
async fn the_delay_doubles_with_each_interruption_until_the_job_fails() {
    let folder = tempfile::tempdir().unwrap();
    let store = store(&folder).await;
    let id = insert_one(&store.jobs).await;
    // No delay at first, then 100 s, 200 s and 400 s. The fifth interruption fails the job.
    for (times, waits_s) in [(1, None), (2, Some(100)), (3, Some(200)), (4, Some(400))] {
        let earliest = Timestamp::now();
        interrupt_job(&store, &id, 0.0, RECOVERY).await;
        let latest = Timestamp::now();
        let (due_at, interruptions) = read_due(&store, &id).await;
        assert_eq!(interruptions, times);
        assert_eq!(due_at.is_some(), waits_s.is_some(), "{times} times");
        if let (Some(due_at), Some(wait_s)) = (due_at, waits_s) {
            let begun = due_at.checked_sub(Duration::from_secs(wait_s)).unwrap();
            assert!((earliest..=latest).contains(&begun), "{times} times: due {due_at}");
        }
        assert_eq!(row(&store.jobs, &id).await.state, JobState::Queued);
    }
    interrupt_job(&store, &id, 0.0, RECOVERY).await;
    let failed = row(&store.jobs, &id).await;
    assert_eq!(
        (failed.state, failed.error_code.as_deref()),
        (JobState::Failed, Some("interrupted"))
    );
    let why = "the server stopped 5 times while this job ran, and it got no further";
    assert_eq!(failed.error.as_deref(), Some(why));
    assert!(failed.finished_at.is_some());
}

#[tokio::test]
async fn the_delay_after_an_interruption_is_at_most_an_hour() {
    let folder = tempfile::tempdir().unwrap();
    let store = store(&folder).await;
    let id = insert_one(&store.jobs).await;
    let recovery = JobRecovery { give_up_after: 9, at_once: 1, wait: Duration::from_mins(50) };
    // 50 minutes, then 100 minutes, which exceeds the limit.
    for minutes in [50, 60, 60] {
        let earliest = Timestamp::now();
        interrupt_job(&store, &id, 0.0, recovery).await;
        let due_at = read_due(&store, &id).await.0.unwrap();
        let begun = due_at.checked_sub(Duration::from_mins(minutes)).unwrap();
        assert!((earliest..=Timestamp::now()).contains(&begun), "{minutes} min: {due_at}");
    }
}

#[tokio::test]
async fn progress_resets_the_interruption_count() {
    let folder = tempfile::tempdir().unwrap();
    let store = store(&folder).await;
    let id = insert_one(&store.jobs).await;
    // Progress, then the number of interruptions and the furthest progress.
    for (progress, times, furthest) in [
        (0.25, 1, 0.25),
        (0.25, 2, 0.25),
        (0.125, 3, 0.25),
        // Less than 0.001 more does not count as further progress.
        (0.250_5, 4, 0.250_5),
        (0.5, 1, 0.5),
        (0.25, 2, 0.5),
    ] {
        interrupt_job(&store, &id, progress, RECOVERY).await;
        let found = (read_due(&store, &id).await.1, row(&store.jobs, &id).await.furthest as f32);
        assert_eq!(found, (times, furthest), "at {progress}");
    }
}

#[test]
fn time_after_adds_the_delay() {
    let before = Timestamp::now();
    let later: Timestamp = time_after(Duration::from_secs(90)).parse().unwrap();
    let begun = later.checked_sub(Duration::from_secs(90)).unwrap();
    assert!((before..=Timestamp::now()).contains(&begun), "{later}");
    let never: Timestamp = time_after(Duration::from_secs(1 << 60)).parse().unwrap();
    assert_eq!(never, Timestamp::MAX);
}
