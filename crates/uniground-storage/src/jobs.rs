//! The durable side of the job queue.

use super::database::{Database, SqlFilter, number, without_nul};
use super::{StoreError, first_id_at, now};
use jiff::Timestamp;
use sqlx::any::AnyRow;
use sqlx::{AnyConnection, FromRow, Row};
use std::time::Duration;
pub use uniground_types::job::JobState;

/// A job as stored.
#[derive(Debug, Clone, PartialEq)]
pub struct JobRow {
    pub id: String,
    pub kind: String,
    pub subject: String,
    pub payload: String,
    pub state: JobState,
    pub stage: Option<String>,
    pub progress: f64,
    pub attempts: i64,
    /// In a row, in ways that may pass, without getting further.
    pub failures: u32,
    /// How far an earlier attempt got.
    pub furthest: f64,
    /// The member at work on it, while it is running.
    pub holder: Option<String>,
    pub message: Option<String>,
    pub error_code: Option<String>,
    pub error: Option<String>,
    pub created_at: String,
    pub started_at: Option<String>,
    pub finished_at: Option<String>,
}

impl FromRow<'_, AnyRow> for JobRow {
    fn from_row(row: &AnyRow) -> sqlx::Result<Self> {
        Ok(Self {
            id: row.try_get("id")?,
            kind: row.try_get("kind")?,
            subject: row.try_get("subject")?,
            payload: row.try_get("payload")?,
            state: state(row.try_get("state")?)?,
            stage: row.try_get("stage")?,
            progress: row.try_get("progress")?,
            attempts: row.try_get("attempts")?,
            failures: number(row.try_get("failures")?)?,
            furthest: row.try_get("furthest")?,
            holder: row.try_get("holder")?,
            message: row.try_get("message")?,
            error_code: row.try_get("error_code")?,
            error: row.try_get("error")?,
            created_at: row.try_get("created_at")?,
            started_at: row.try_get("started_at")?,
            finished_at: row.try_get("finished_at")?,
        })
    }
}

fn state(word: String) -> sqlx::Result<JobState> {
    JobState::try_from(word).map_err(|error| sqlx::Error::Decode(error.into()))
}

/// A running job in somebody's hands. Whatever is written down of it says so: once it was given to
/// somebody else, nothing is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct JobLease {
    pub job_id: String,
    /// The member that took it.
    holder: String,
}

impl JobLease {
    /// That of a job that was just taken.
    #[must_use]
    pub fn of(job: &JobRow) -> Self {
        Self { job_id: job.id.clone(), holder: job.holder.clone().unwrap_or_default() }
    }

    /// Whether the job is still in these hands, as far as this transaction goes.
    pub(super) async fn check(&self, tx: &mut AnyConnection) -> Result<(), StoreError> {
        let sql = "SELECT count(*) FROM jobs WHERE id = $1 AND holder = $2 AND state = 'running'";
        let held: i64 =
            sqlx::query_scalar(sql).bind(&self.job_id).bind(&self.holder).fetch_one(tx).await?;
        if held > 0 { Ok(()) } else { Err(StoreError::NotHeld) }
    }
}

/// Which jobs are wanted; what is not said is any.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct JobFilter {
    pub kind: Option<String>,
    pub state: Option<JobState>,
    /// What it works on: a scene, or a batch.
    pub subject: Option<String>,
}

/// Jobs that wait.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct QueueLengths {
    pub all: u32,
    /// Of these, one key's.
    pub of_key: u32,
}

/// A job about to be recorded.
pub struct NewJob<'a> {
    pub kind: &'a str,
    pub payload: &'a str,
    /// Who asked for it.
    pub key_id: Option<&'a str>,
    /// The parse that was there already, and a sentence about that.
    pub done: Option<(&'a str, &'a str)>,
}

pub(super) async fn insert(
    connection: &mut AnyConnection,
    id: &str,
    subject: &str,
    NewJob { kind, payload, key_id, done: _ }: &NewJob<'_>,
) -> Result<JobRow, StoreError> {
    let sql = "INSERT INTO jobs (id, kind, subject, payload, state, key_id, created_at) VALUES ($1, $2, $3, $4, 'queued', $5, $6) RETURNING *";
    let row = sqlx::query_as(sql)
        .bind(id)
        .bind(kind)
        .bind(subject)
        .bind(payload)
        .bind(key_id)
        .bind(now());
    Ok(row.fetch_one(connection).await?)
}

/// Records a job whose result was there already.
pub(super) async fn insert_done(
    connection: &mut AnyConnection,
    id: &str,
    subject: &str,
    NewJob { kind, payload, key_id, done: _ }: &NewJob<'_>,
    message: &str,
) -> Result<JobRow, StoreError> {
    let sql = "INSERT INTO jobs (id, kind, subject, payload, state, progress, message, key_id, created_at, started_at, finished_at)
               VALUES ($1, $2, $3, $4, 'succeeded', 1.0, $5, $6, $7, $7, $7) RETURNING *";
    let row = sqlx::query_as(sql)
        .bind(id)
        .bind(kind)
        .bind(subject)
        .bind(payload)
        .bind(message)
        .bind(key_id)
        .bind(now());
    Ok(row.fetch_one(connection).await?)
}

/// How jobs that were interrupted are taken up again.
#[derive(Debug, Clone, Copy)]
pub struct JobRecovery {
    /// Interruptions in a row, without getting further than before, after which a job fails.
    pub give_up_after: u32,
    /// As many are taken up at once; from then on it waits, twice as long each time.
    pub at_once: u32,
    /// The first wait.
    pub wait: Duration,
}

/// How often a worker that was overtaken looks for another job before it waits.
const TRIES_TO_CLAIM: u32 = 8;
/// A wait beyond this is none: the clock was set back since it was written down.
const LONGEST_WAIT: Duration = Duration::from_hours(2);

/// Rows of background jobs.
#[derive(Clone)]
pub struct JobRepository {
    pub(super) database: Database,
}

impl JobRepository {
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn insert_job(&self, subject: &str, new: &NewJob<'_>) -> Result<JobRow, StoreError> {
        let mut tx = self.database.writer.begin().await?;
        let row = insert(&mut tx, &self.database.new_id(), subject, new).await?;
        tx.commit().await?;
        Ok(row)
    }

    /// # Errors
    /// [`StoreError::Database`].
    pub async fn job(&self, id: &str) -> Result<Option<JobRow>, StoreError> {
        Ok(sqlx::query_as("SELECT * FROM jobs WHERE id = $1")
            .bind(id)
            .fetch_optional(&self.database.reader)
            .await?)
    }

    /// Jobs newest first, those before `cursor` (an id) only.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn jobs(
        &self,
        filter: &JobFilter,
        limit: u32,
        cursor: Option<&str>,
    ) -> Result<Vec<JobRow>, StoreError> {
        let JobFilter { kind, state, subject } = filter;
        let mut which = SqlFilter::behind("SELECT * FROM jobs WHERE true");
        which.and("id <", cursor);
        which.and("kind =", kind.as_ref());
        which.and("state =", state.map(JobState::word));
        which.and("subject =", subject.as_ref());
        which.first("id DESC", limit, &self.database.reader).await
    }

    /// Jobs of a kind that wait.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn queued_jobs(
        &self,
        kind: &str,
        key_id: Option<&str>,
    ) -> Result<QueueLengths, StoreError> {
        let sql = "SELECT count(*), coalesce(sum(CASE WHEN key_id IS NOT DISTINCT FROM $2 THEN 1 ELSE 0 END), 0) FROM jobs
                   WHERE kind = $1 AND state = 'queued'";
        let (all, of_key): (i64, i64) =
            sqlx::query_as(sql).bind(kind).bind(key_id).fetch_one(&self.database.reader).await?;
        Ok(QueueLengths { all: number(all)?, of_key: number(of_key)? })
    }

    /// Jobs of a kind that wait and were asked for before another.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn jobs_ahead(&self, kind: &str, id: &str) -> Result<u32, StoreError> {
        let sql = "SELECT count(*) FROM jobs WHERE kind = $1 AND state = 'queued' AND id < $2";
        Ok(number(
            sqlx::query_scalar(sql).bind(kind).bind(id).fetch_one(&self.database.reader).await?,
        )?)
    }

    /// How many jobs of a kind were done lately: those asked for within `lately` that have come to
    /// their end since then.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn done_lately(&self, kind: &str, lately: Duration) -> Result<u32, StoreError> {
        let since = Timestamp::now().checked_sub(lately).unwrap_or(Timestamp::MIN);
        let sql = "SELECT count(*) FROM jobs WHERE kind = $1 AND state IN ('succeeded', 'failed') AND id >= $2 AND attempts > 0";
        let done = sqlx::query_scalar(sql)
            .bind(kind)
            .bind(first_id_at(since))
            .fetch_one(&self.database.reader);
        Ok(number(done.await?)?)
    }

    /// Takes a queued job of a kind that is due: of the key whose last turn is longest ago, so that
    /// nobody waits behind all jobs of one other; of that key the oldest. One UPDATE, so no two
    /// workers get the same. `None` also when somebody was faster.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn claim_job(&self, kind: &str) -> Result<Option<JobRow>, StoreError> {
        let due = "SELECT id FROM jobs AS due WHERE kind = $1 AND state = 'queued' AND (not_before IS NULL OR not_before <= $2 OR not_before > $3)
                   ORDER BY CASE WHEN key_id IS NULL THEN (SELECT max(started_at) FROM jobs WHERE kind = $1 AND key_id IS NULL)
                   ELSE (SELECT max(started_at) FROM jobs WHERE kind = $1 AND key_id = due.key_id) END NULLS FIRST, id LIMIT 1";
        let (time, too_late) = (now(), after(LONGEST_WAIT));
        for _ in 0..TRIES_TO_CLAIM {
            // Looked for among the readers first: a queue that is empty writes nothing.
            let id = sqlx::query_scalar(due).bind(kind).bind(&time).bind(&too_late);
            let id: Option<String> = id.fetch_optional(&self.database.reader).await?;
            let Some(id) = id else { return Ok(None) };
            // Where somebody was faster there may be another.
            if let Some(job) = self.take_job(&id, &time).await? {
                return Ok(Some(job));
            }
        }
        Ok(None)
    }

    async fn take_job(&self, id: &str, time: &str) -> Result<Option<JobRow>, StoreError> {
        // Who is no member any more takes nothing: it would be taken from him at once.
        let sql = "UPDATE jobs SET state = 'running', attempts = attempts + 1, started_at = $1, stage = NULL, progress = 0, holder = $3
                   WHERE id = $2 AND state = 'queued' AND EXISTS (SELECT 1 FROM members WHERE id = $3) RETURNING *";
        let claim =
            sqlx::query_as(sql).bind(time).bind(id).bind(self.database.members.id().to_string());
        Ok(claim.fetch_optional(self.database.writer.pool()).await?)
    }

    /// Notes how far a job is; whether somebody wants it to stop.
    ///
    /// # Errors
    /// [`StoreError::NotHeld`], [`StoreError::Database`].
    pub async fn save_job_progress(
        &self,
        hold: &JobLease,
        stage: &str,
        progress: f32,
    ) -> Result<bool, StoreError> {
        let sql = "UPDATE jobs SET stage = $1, progress = $2 WHERE id = $3 AND holder = $4 AND state = 'running' RETURNING cancel_requested";
        let save = sqlx::query_scalar(sql)
            .bind(stage)
            .bind(progress)
            .bind(&hold.job_id)
            .bind(&hold.holder);
        let wished: i64 =
            save.fetch_optional(self.database.writer.pool()).await?.ok_or(StoreError::NotHeld)?;
        Ok(wished != 0)
    }

    /// Ends a job that somebody has had in hands; what ended it first stays.
    ///
    /// # Errors
    /// [`StoreError::NotHeld`], [`StoreError::Database`].
    pub async fn finish_job(
        &self,
        hold: &JobLease,
        state: JobState,
        message: Option<&str>,
        error: Option<(&str, &str)>,
    ) -> Result<(), StoreError> {
        let ended = self.end_job(&hold.job_id, Some(&hold.holder), state, message, error).await?;
        if ended { Ok(()) } else { Err(StoreError::NotHeld) }
    }

    /// Ends a job that is not over yet, whoever has it in hands.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn finish_open_job(
        &self,
        id: &str,
        state: JobState,
        error: Option<(&str, &str)>,
    ) -> Result<(), StoreError> {
        self.end_job(id, None, state, None, error).await?;
        Ok(())
    }

    /// Ends a job, in somebody's hands or in anybody's; whether it was there to end.
    async fn end_job(
        &self,
        id: &str,
        holder: Option<&str>,
        state: JobState,
        message: Option<&str>,
        error: Option<(&str, &str)>,
    ) -> Result<bool, StoreError> {
        let sql = "UPDATE jobs SET state = $1, message = $2, error_code = $3, error = $4, finished_at = $5,
                   progress = CASE WHEN $1 = 'succeeded' THEN 1.0 ELSE progress END,
                   stage = CASE WHEN $1 = 'succeeded' THEN NULL ELSE stage END
                   WHERE id = $6 AND (state = 'running' AND holder = $7 OR $7 IS NULL AND state IN ('queued', 'running'))";
        let (code, detail) = error.unzip();
        let (message, detail) = (message.map(without_nul), detail.map(without_nul));
        let ended = sqlx::query(sql)
            .bind(state.word())
            .bind(message.as_deref())
            .bind(code)
            .bind(detail.as_deref())
            .bind(now())
            .bind(id)
            .bind(holder)
            .execute(self.database.writer.pool())
            .await?;
        Ok(ended.rows_affected() > 0)
    }

    /// Cancels a job that no worker has taken; `false` when one has.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn cancel_queued_job(&self, id: &str) -> Result<bool, StoreError> {
        let sql = "UPDATE jobs SET state = 'cancelled', finished_at = $1 WHERE id = $2 AND state = 'queued'";
        Ok(sqlx::query(sql)
            .bind(now())
            .bind(id)
            .execute(self.database.writer.pool())
            .await?
            .rows_affected()
            > 0)
    }

    /// Jobs on a subject that are not over.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn open_jobs_of(&self, subject: &str) -> Result<Vec<String>, StoreError> {
        let sql = "SELECT id FROM jobs WHERE subject = $1 AND state IN ('queued', 'running')";
        Ok(sqlx::query_scalar(sql).bind(subject).fetch_all(&self.database.reader).await?)
    }

    /// Puts a running job back: its process stops, another goes on. A planned stop does not count
    /// as an attempt.
    ///
    /// # Errors
    /// [`StoreError::NotHeld`], [`StoreError::Database`].
    pub async fn requeue_job(&self, hold: &JobLease) -> Result<(), StoreError> {
        let sql = "UPDATE jobs SET state = 'queued', attempts = attempts - 1, started_at = NULL, stage = NULL, progress = 0
                   WHERE id = $1 AND holder = $2 AND state = 'running'";
        let put_back = sqlx::query(sql)
            .bind(&hold.job_id)
            .bind(&hold.holder)
            .execute(self.database.writer.pool())
            .await?;
        if put_back.rows_affected() > 0 { Ok(()) } else { Err(StoreError::NotHeld) }
    }

    /// Puts a running job back, to be tried again after a wait: it has failed so often in a row,
    /// and got so far.
    ///
    /// # Errors
    /// [`StoreError::NotHeld`], [`StoreError::Database`].
    pub async fn requeue_job_after(
        &self,
        hold: &JobLease,
        wait: Duration,
        failures: u32,
        progress: f32,
    ) -> Result<(), StoreError> {
        let sql = "UPDATE jobs SET state = 'queued', not_before = $1, failures = $2, furthest = CASE WHEN furthest < $3 THEN $3 ELSE furthest END,
                   started_at = NULL, stage = NULL, progress = 0 WHERE id = $4 AND holder = $5 AND state = 'running'";
        let put_back = sqlx::query(sql)
            .bind(after(wait))
            .bind(i64::from(failures))
            .bind(progress)
            .bind(&hold.job_id)
            .bind(&hold.holder)
            .execute(self.database.writer.pool())
            .await?;
        if put_back.rows_affected() > 0 { Ok(()) } else { Err(StoreError::NotHeld) }
    }

    /// Notes that a running job should stop.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn request_cancel(&self, id: &str) -> Result<(), StoreError> {
        let sql =
            "UPDATE jobs SET cancel_requested = 1 WHERE id = $1 AND state IN ('queued', 'running')";
        sqlx::query(sql).bind(id).execute(self.database.writer.pool()).await?;
        Ok(())
    }

    /// Whether somebody wants a job to stop.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn is_cancel_requested(&self, id: &str) -> Result<bool, StoreError> {
        let wished: Option<i64> =
            sqlx::query_scalar("SELECT cancel_requested FROM jobs WHERE id = $1")
                .bind(id)
                .fetch_optional(&self.database.reader)
                .await?;
        Ok(wished.is_some_and(|wished| wished != 0))
    }

    /// Jobs that are not over: id and kind.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn open_jobs(&self) -> Result<Vec<(String, String)>, StoreError> {
        let sql = "SELECT id, kind FROM jobs WHERE state IN ('queued', 'running')";
        Ok(sqlx::query_as(sql).fetch_all(&self.database.reader).await?)
    }

    /// Jobs that are not over though their scene is gone: id and subject.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn jobs_without_scene(&self) -> Result<Vec<(String, String)>, StoreError> {
        let sql = "SELECT id, subject FROM jobs WHERE state IN ('queued', 'running') AND NOT EXISTS (SELECT 1 FROM scenes WHERE id = subject)";
        Ok(sqlx::query_as(sql).fetch_all(&self.database.reader).await?)
    }

    /// Ends a job whose scene is gone.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn end_orphan(&self, id: &str) -> Result<(), StoreError> {
        self.finish_open_job(id, JobState::Cancelled, None).await
    }

    /// Jobs of a kind that were left running by members that are gone end as they were asked to, or
    /// go back to their queue. One that got further than ever before starts to count anew; one
    /// that did not waits longer each time, and fails in the end: it may be what stops
    /// its process.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn recover_jobs(&self, kind: &str, recovery: JobRecovery) -> Result<(), StoreError> {
        const LEFT: &str = "kind = $1 AND state = 'running' AND (holder IS NULL OR holder NOT IN (SELECT id FROM members))";
        // Looked for among the readers first: where nobody is gone, nothing is written.
        let left = format!("SELECT count(*) FROM jobs WHERE {LEFT}");
        let left: i64 = sqlx::query_scalar(sqlx::AssertSqlSafe(left))
            .bind(kind)
            .fetch_one(&self.database.reader)
            .await?;
        if left == 0 {
            return Ok(());
        }
        let JobRecovery { give_up_after, at_once, wait } = recovery;
        let mut tx = self.database.writer.begin().await?;
        let stop = format!(
            "UPDATE jobs SET state = 'cancelled', finished_at = $2 WHERE {LEFT} AND cancel_requested = 1"
        );
        sqlx::query(sqlx::AssertSqlSafe(stop)).bind(kind).bind(now()).execute(&mut *tx).await?;
        let count = format!(
            "UPDATE jobs SET interruptions = CASE WHEN progress > furthest + 0.001 THEN 1 ELSE interruptions + 1 END,
             furthest = CASE WHEN furthest < progress THEN progress ELSE furthest END WHERE {LEFT}"
        );
        sqlx::query(sqlx::AssertSqlSafe(count)).bind(kind).execute(&mut *tx).await?;
        let give_up = format!(
            "UPDATE jobs SET state = 'failed', error_code = 'interrupted', finished_at = $2,
             error = 'the server stopped ' || interruptions || ' times while this job ran, and it got no further'
             WHERE {LEFT} AND interruptions >= $3"
        );
        sqlx::query(sqlx::AssertSqlSafe(give_up))
            .bind(kind)
            .bind(now())
            .bind(i64::from(give_up_after))
            .execute(&mut *tx)
            .await?;
        for interruptions in at_once..give_up_after {
            let due = after(
                wait.saturating_mul(1 << (interruptions - at_once).min(16)).min(LONGEST_WAIT / 2),
            );
            let sql =
                format!("UPDATE jobs SET not_before = $2 WHERE {LEFT} AND interruptions = $3");
            let put_off = sqlx::query(sqlx::AssertSqlSafe(sql))
                .bind(kind)
                .bind(due)
                .bind(i64::from(interruptions));
            put_off.execute(&mut *tx).await?;
        }
        let requeue = format!(
            "UPDATE jobs SET state = 'queued', started_at = NULL, stage = NULL, progress = 0 WHERE {LEFT}"
        );
        sqlx::query(sqlx::AssertSqlSafe(requeue)).bind(kind).execute(&mut *tx).await?;
        tx.commit().await
    }
}

/// The time after a wait, as stored.
pub(super) fn after(wait: Duration) -> String {
    let wait = jiff::SignedDuration::try_from(wait).unwrap_or_default();
    Timestamp::now().checked_add(wait).unwrap_or(Timestamp::MAX).to_string()
}
