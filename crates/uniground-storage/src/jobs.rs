//! Rows of the job queue.

use super::database::{Database, SqlFilter, replace_nul, to_unsigned};
use super::{StoreError, first_id_at, now};
use jiff::Timestamp;
use sqlx::any::AnyRow;
use sqlx::{AnyConnection, FromRow, Row};
use std::sync::Arc;
use std::time::Duration;
pub use uniground_types::job::JobState;

/// A job as stored in the database.
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
    /// Transient failures in a row without further progress.
    pub failures: u32,
    /// The furthest progress of any earlier attempt.
    pub furthest: f64,
    /// The member that holds the lease, while the job is running.
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
            state: parse_state(row.try_get("state")?)?,
            stage: row.try_get("stage")?,
            progress: row.try_get("progress")?,
            attempts: row.try_get("attempts")?,
            failures: to_unsigned(row.try_get("failures")?)?,
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

fn parse_state(word: String) -> sqlx::Result<JobState> {
    JobState::try_from(word).map_err(|error| sqlx::Error::Decode(error.into()))
}

/// A lease on a running job. Every write of a worker names its lease; once the lease has passed to
/// another worker, the write is refused.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct JobLease {
    pub job_id: String,
    /// The member that claimed the job.
    holder: String,
}

impl JobLease {
    /// Returns the lease of a job that was just claimed.
    #[must_use]
    pub fn from_claimed_row(job: &JobRow) -> Self {
        Self { job_id: job.id.clone(), holder: job.holder.clone().unwrap_or_default() }
    }

    /// Checks within this transaction that the lease is still held.
    pub(super) async fn check(&self, tx: &mut AnyConnection) -> Result<(), StoreError> {
        let sql = "SELECT count(*) FROM jobs WHERE id = $1 AND holder = $2 AND state = 'running'";
        let held: i64 =
            sqlx::query_scalar(sql).bind(&self.job_id).bind(&self.holder).fetch_one(tx).await?;
        if held > 0 { Ok(()) } else { Err(StoreError::LeaseLost) }
    }
}

/// Which jobs to list. An empty field matches every job.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct JobFilter {
    pub kind: Option<String>,
    pub state: Option<JobState>,
    /// The id of the scene or batch that the job works on.
    pub subject: Option<String>,
}

/// Numbers of queued jobs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct QueueLengths {
    pub all: u32,
    /// Queued jobs of one API key, contained in `all`.
    pub of_key: u32,
}

/// A job to be inserted.
pub struct NewJob<'a> {
    pub kind: &'a str,
    pub payload: &'a str,
    /// The API key that requested it.
    pub key_id: Option<&'a str>,
    /// The existing parse that is the job's result, and a message about that.
    pub done: Option<(&'a str, &'a str)>,
}

/// The outcome of a transaction that may have inserted a job.
pub trait InsertedJob {
    /// Returns the job that the transaction inserted.
    fn inserted_job(&self) -> Option<&JobRow>;
}

impl InsertedJob for JobRow {
    fn inserted_job(&self) -> Option<&JobRow> {
        Some(self)
    }
}

impl InsertedJob for Option<JobRow> {
    fn inserted_job(&self) -> Option<&JobRow> {
        self.as_ref()
    }
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

/// Inserts a job whose result exists already.
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

/// How interrupted jobs are retried.
#[derive(Debug, Clone, Copy)]
pub struct JobRecovery {
    /// Interruptions in a row without further progress after which a job fails.
    pub give_up_after: u32,
    /// Number of interruptions that are retried without delay. After that the delay doubles each
    /// time.
    pub at_once: u32,
    /// The first delay.
    pub wait: Duration,
}

/// How often a worker that lost the race for a job tries another one before it waits.
const TRIES_TO_CLAIM: u32 = 8;
/// A longer delay is ignored: the clock was set back since it was stored.
const MAX_DELAY: Duration = Duration::from_hours(2);

/// Repository of background jobs.
#[derive(Clone)]
pub struct JobRepository {
    pub(super) database: Arc<Database>,
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

    /// Returns jobs, newest first; with a `cursor` (an id) only those before it.
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
        let mut which = SqlFilter::new("SELECT * FROM jobs WHERE true");
        which.and_if_some("id <", cursor);
        which.and_if_some("kind =", kind.as_ref());
        which.and_if_some("state =", state.map(JobState::as_str));
        which.and_if_some("subject =", subject.as_ref());
        which.fetch("id DESC", limit, &self.database.reader).await
    }

    /// Counts the queued jobs of a kind.
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
        Ok(QueueLengths { all: to_unsigned(all)?, of_key: to_unsigned(of_key)? })
    }

    /// Counts the jobs of a kind that were queued before this one and still wait.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn jobs_ahead(&self, kind: &str, id: &str) -> Result<u32, StoreError> {
        let sql = "SELECT count(*) FROM jobs WHERE kind = $1 AND state = 'queued' AND id < $2";
        Ok(to_unsigned(
            sqlx::query_scalar(sql).bind(kind).bind(id).fetch_one(&self.database.reader).await?,
        )?)
    }

    /// Counts the jobs of a kind that were created within the last `period` and have finished.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn count_recently_finished(
        &self,
        kind: &str,
        period: Duration,
    ) -> Result<u32, StoreError> {
        let since = Timestamp::now().checked_sub(period).unwrap_or(Timestamp::MIN);
        let sql = "SELECT count(*) FROM jobs WHERE kind = $1 AND state IN ('succeeded', 'failed') AND id >= $2 AND attempts > 0";
        let done = sqlx::query_scalar(sql)
            .bind(kind)
            .bind(first_id_at(since))
            .fetch_one(&self.database.reader);
        Ok(to_unsigned(done.await?)?)
    }

    /// Claims a queued job of a kind that is due. Takes the oldest job of the API key that was
    /// served least recently, so that no key waits behind all jobs of another one. A single UPDATE
    /// claims it, so no two workers get the same job. Also returns `None` if other workers were
    /// faster.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn claim_job(&self, kind: &str) -> Result<Option<JobRow>, StoreError> {
        let due = "SELECT id FROM jobs AS due WHERE kind = $1 AND state = 'queued' AND (not_before IS NULL OR not_before <= $2 OR not_before > $3)
                   ORDER BY CASE WHEN key_id IS NULL THEN (SELECT max(started_at) FROM jobs WHERE kind = $1 AND key_id IS NULL)
                   ELSE (SELECT max(started_at) FROM jobs WHERE kind = $1 AND key_id = due.key_id) END NULLS FIRST, id LIMIT 1";
        let (time, too_late) = (now(), time_after(MAX_DELAY));
        for _ in 0..TRIES_TO_CLAIM {
            // Search with a reader first: polling an empty queue then writes nothing.
            let id = sqlx::query_scalar(due).bind(kind).bind(&time).bind(&too_late);
            let id: Option<String> = id.fetch_optional(&self.database.reader).await?;
            let Some(id) = id else { return Ok(None) };
            // Another worker was faster. There may be a further job.
            if let Some(job) = self.claim_job_by_id(&id, &time).await? {
                return Ok(Some(job));
            }
        }
        Ok(None)
    }

    async fn claim_job_by_id(&self, id: &str, time: &str) -> Result<Option<JobRow>, StoreError> {
        // A process that was removed from the cluster claims nothing: it would lose the job at
        // once.
        let sql = "UPDATE jobs SET state = 'running', attempts = attempts + 1, started_at = $1, stage = NULL, progress = 0, holder = $3
                   WHERE id = $2 AND state = 'queued' AND EXISTS (SELECT 1 FROM members WHERE id = $3) RETURNING *";
        let claim =
            sqlx::query_as(sql).bind(time).bind(id).bind(self.database.members.id().to_string());
        Ok(claim.fetch_optional(self.database.writer.pool()).await?)
    }

    /// Stores the progress of a job. Returns whether cancellation was requested.
    ///
    /// # Errors
    /// [`StoreError::LeaseLost`], [`StoreError::Database`].
    pub async fn save_job_progress(
        &self,
        lease: &JobLease,
        stage: &str,
        progress: f32,
    ) -> Result<bool, StoreError> {
        let sql = "UPDATE jobs SET stage = $1, progress = $2 WHERE id = $3 AND holder = $4 AND state = 'running' RETURNING cancel_requested";
        let save = sqlx::query_scalar(sql)
            .bind(stage)
            .bind(progress)
            .bind(&lease.job_id)
            .bind(&lease.holder);
        let wished: i64 =
            save.fetch_optional(self.database.writer.pool()).await?.ok_or(StoreError::LeaseLost)?;
        Ok(wished != 0)
    }

    /// Finishes a job under its lease. Fails if the job is already finished.
    ///
    /// # Errors
    /// [`StoreError::LeaseLost`], [`StoreError::Database`].
    pub async fn finish_job(
        &self,
        lease: &JobLease,
        state: JobState,
        message: Option<&str>,
        error: Option<(&str, &str)>,
    ) -> Result<(), StoreError> {
        let ended =
            self.finish_job_as(&lease.job_id, Some(&lease.holder), state, message, error).await?;
        if ended { Ok(()) } else { Err(StoreError::LeaseLost) }
    }

    /// Finishes a job that is queued or running, regardless of who holds its lease.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn finish_open_job(
        &self,
        id: &str,
        state: JobState,
        error: Option<(&str, &str)>,
    ) -> Result<(), StoreError> {
        self.finish_job_as(id, None, state, None, error).await?;
        Ok(())
    }

    /// Finishes a job: under this holder's lease, or without a lease in any open state. Returns
    /// whether the job was open.
    async fn finish_job_as(
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
        let (message, detail) = (message.map(replace_nul), detail.map(replace_nul));
        let ended = sqlx::query(sql)
            .bind(state.as_str())
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

    /// Cancels a queued job. Returns `false` when a worker has already claimed it.
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

    /// Returns the ids of the queued and running jobs of a subject.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn open_jobs_of(&self, subject: &str) -> Result<Vec<String>, StoreError> {
        let sql = "SELECT id FROM jobs WHERE subject = $1 AND state IN ('queued', 'running')";
        Ok(sqlx::query_scalar(sql).bind(subject).fetch_all(&self.database.reader).await?)
    }

    /// Returns a running job to the queue because its process shuts down; another worker takes
    /// over. A planned shutdown does not count as an attempt.
    ///
    /// # Errors
    /// [`StoreError::LeaseLost`], [`StoreError::Database`].
    pub async fn requeue_job(&self, lease: &JobLease) -> Result<(), StoreError> {
        let sql = "UPDATE jobs SET state = 'queued', attempts = attempts - 1, started_at = NULL, stage = NULL, progress = 0
                   WHERE id = $1 AND holder = $2 AND state = 'running'";
        let requeued = sqlx::query(sql)
            .bind(&lease.job_id)
            .bind(&lease.holder)
            .execute(self.database.writer.pool())
            .await?;
        if requeued.rows_affected() > 0 { Ok(()) } else { Err(StoreError::LeaseLost) }
    }

    /// Returns a running job to the queue, to be retried after a delay. Stores its failures in a
    /// row and its progress.
    ///
    /// # Errors
    /// [`StoreError::LeaseLost`], [`StoreError::Database`].
    pub async fn requeue_job_after(
        &self,
        lease: &JobLease,
        wait: Duration,
        failures: u32,
        progress: f32,
    ) -> Result<(), StoreError> {
        let sql = "UPDATE jobs SET state = 'queued', not_before = $1, failures = $2, furthest = CASE WHEN furthest < $3 THEN $3 ELSE furthest END,
                   started_at = NULL, stage = NULL, progress = 0 WHERE id = $4 AND holder = $5 AND state = 'running'";
        let requeued = sqlx::query(sql)
            .bind(time_after(wait))
            .bind(i64::from(failures))
            .bind(progress)
            .bind(&lease.job_id)
            .bind(&lease.holder)
            .execute(self.database.writer.pool())
            .await?;
        if requeued.rows_affected() > 0 { Ok(()) } else { Err(StoreError::LeaseLost) }
    }

    /// Requests the cancellation of a job.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn request_cancel(&self, id: &str) -> Result<(), StoreError> {
        let sql =
            "UPDATE jobs SET cancel_requested = 1 WHERE id = $1 AND state IN ('queued', 'running')";
        sqlx::query(sql).bind(id).execute(self.database.writer.pool()).await?;
        Ok(())
    }

    /// Returns whether cancellation of a job was requested.
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

    /// Returns id and kind of every queued or running job.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn open_jobs(&self) -> Result<Vec<(String, String)>, StoreError> {
        let sql = "SELECT id, kind FROM jobs WHERE state IN ('queued', 'running')";
        Ok(sqlx::query_as(sql).fetch_all(&self.database.reader).await?)
    }

    /// Returns id and subject of every queued or running job whose scene is deleted.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn jobs_without_scene(&self) -> Result<Vec<(String, String)>, StoreError> {
        let sql = "SELECT id, subject FROM jobs WHERE state IN ('queued', 'running') AND NOT EXISTS (SELECT 1 FROM scenes WHERE id = subject)";
        Ok(sqlx::query_as(sql).fetch_all(&self.database.reader).await?)
    }

    /// Cancels a job whose scene is deleted.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn cancel_orphan_job(&self, id: &str) -> Result<(), StoreError> {
        self.finish_open_job(id, JobState::Cancelled, None).await
    }

    /// Recovers the running jobs of a kind whose process is gone. Jobs with a cancellation request
    /// are cancelled, the others return to the queue. Further
    /// progress resets a job's count of interruptions. A job without further progress waits longer
    /// each time and finally fails: it may be what crashes its process.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn recover_jobs(&self, kind: &str, recovery: JobRecovery) -> Result<(), StoreError> {
        const LEFT: &str = "kind = $1 AND state = 'running' AND (holder IS NULL OR holder NOT IN (SELECT id FROM members))";
        // Search with a reader first: if no process is gone, nothing is written.
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
            let due = time_after(
                wait.saturating_mul(1 << (interruptions - at_once).min(16)).min(MAX_DELAY / 2),
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

/// Returns the current time plus a delay, in the format of the database.
pub(super) fn time_after(wait: Duration) -> String {
    let wait = jiff::SignedDuration::try_from(wait).unwrap_or_default();
    Timestamp::now().checked_add(wait).unwrap_or(Timestamp::MAX).to_string()
}

#[cfg(test)]
mod tests;
