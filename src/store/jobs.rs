//! The durable side of the job queue.

use super::database::{Conditions, number, without_nul};
use super::{Store, StoreError, now};
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

/// Which jobs are wanted; what is not said is any.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct JobFilter {
    pub kind: Option<String>,
    pub state: Option<JobState>,
    /// What it works on: a scene, or a batch.
    pub subject: Option<String>,
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
    let sql =
        "INSERT INTO jobs (id, kind, subject, payload, state, key_id, created_at) VALUES ($1, $2, $3, $4, 'queued', $5, $6) RETURNING *";
    let row = sqlx::query_as(sql).bind(id).bind(kind).bind(subject).bind(payload).bind(key_id).bind(now());
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
pub struct Recovery {
    /// Interruptions in a row, without getting further than before, after which a job fails.
    pub give_up_after: u32,
    /// As many are taken up at once; from then on it waits, twice as long each time.
    pub at_once: u32,
    /// The first wait.
    pub wait: Duration,
}

/// A wait beyond this is none: the clock was set back since it was written down.
const LONGEST_WAIT: Duration = Duration::from_hours(2);

impl Store {
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn insert_job(&self, subject: &str, new: &NewJob<'_>) -> Result<JobRow, StoreError> {
        let mut tx = self.writer.begin().await?;
        let row = insert(&mut tx, &self.new_id(), subject, new).await?;
        tx.commit().await?;
        Ok(row)
    }

    /// # Errors
    /// [`StoreError::Database`].
    pub async fn job(&self, id: &str) -> Result<Option<JobRow>, StoreError> {
        Ok(sqlx::query_as("SELECT * FROM jobs WHERE id = $1").bind(id).fetch_optional(&self.reader).await?)
    }

    /// Jobs newest first, those before `cursor` (an id) only.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn jobs(&self, filter: &JobFilter, limit: u32, cursor: Option<&str>) -> Result<Vec<JobRow>, StoreError> {
        let JobFilter { kind, state, subject } = filter;
        let mut which = Conditions::behind("SELECT * FROM jobs WHERE true");
        which.and("id <", cursor);
        which.and("kind =", kind.as_ref());
        which.and("state =", state.map(JobState::word));
        which.and("subject =", subject.as_ref());
        which.first("id DESC", limit, &self.reader).await
    }

    /// # Errors
    /// [`StoreError::Database`].
    pub async fn queued_jobs(&self, kind: &str) -> Result<u32, StoreError> {
        let queued = sqlx::query_scalar("SELECT count(*) FROM jobs WHERE kind = $1 AND state = 'queued'").bind(kind);
        Ok(number(queued.fetch_one(&self.reader).await?)?)
    }

    /// Takes a queued job of a kind that is due: of the key whose last turn is longest ago, so that nobody waits behind all jobs of one
    /// other; of that key the oldest. One UPDATE, so no two workers get the same. `None` also when somebody was faster.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn claim_job(&self, kind: &str) -> Result<Option<JobRow>, StoreError> {
        let due = "SELECT id FROM jobs AS due WHERE kind = $1 AND state = 'queued' AND (not_before IS NULL OR not_before <= $2 OR not_before > $3)
                   ORDER BY (SELECT max(started_at) FROM jobs WHERE kind = $1 AND (key_id = due.key_id OR (key_id IS NULL AND due.key_id IS NULL)))
                   NULLS FIRST, id LIMIT 1";
        let (time, too_late) = (now(), after(LONGEST_WAIT));
        // Looked for among the readers first: a queue that is empty writes nothing.
        let id: Option<String> = sqlx::query_scalar(due).bind(kind).bind(&time).bind(too_late).fetch_optional(&self.reader).await?;
        let Some(id) = id else { return Ok(None) };
        let sql = "UPDATE jobs SET state = 'running', attempts = attempts + 1, started_at = $1, stage = NULL, progress = 0
                   WHERE id = $2 AND state = 'queued' RETURNING *";
        Ok(sqlx::query_as(sql).bind(time).bind(id).fetch_optional(self.writer.pool()).await?)
    }

    /// # Errors
    /// [`StoreError::Database`].
    pub async fn save_job_progress(&self, id: &str, stage: &str, progress: f32) -> Result<(), StoreError> {
        let sql = "UPDATE jobs SET stage = $1, progress = $2 WHERE id = $3 AND state = 'running'";
        sqlx::query(sql).bind(stage).bind(progress).bind(id).execute(self.writer.pool()).await?;
        Ok(())
    }

    /// Ends a job that is not over yet; what ended it first stays.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn finish_job(
        &self,
        id: &str,
        state: JobState,
        message: Option<&str>,
        error: Option<(&str, &str)>,
    ) -> Result<(), StoreError> {
        let sql = "UPDATE jobs SET state = $1, message = $2, error_code = $3, error = $4, finished_at = $5,
                   progress = CASE WHEN $1 = 'succeeded' THEN 1.0 ELSE progress END,
                   stage = CASE WHEN $1 = 'succeeded' THEN NULL ELSE stage END
                   WHERE id = $6 AND state IN ('queued', 'running')";
        let (code, detail) = error.unzip();
        let (message, detail) = (message.map(without_nul), detail.map(without_nul));
        sqlx::query(sql)
            .bind(state.word())
            .bind(message.as_deref())
            .bind(code)
            .bind(detail.as_deref())
            .bind(now())
            .bind(id)
            .execute(self.writer.pool())
            .await?;
        Ok(())
    }

    /// Cancels a job that no worker has taken; `false` when one has.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn cancel_queued_job(&self, id: &str) -> Result<bool, StoreError> {
        let sql = "UPDATE jobs SET state = 'cancelled', finished_at = $1 WHERE id = $2 AND state = 'queued'";
        Ok(sqlx::query(sql).bind(now()).bind(id).execute(self.writer.pool()).await?.rows_affected() > 0)
    }

    /// Jobs on a subject that are not over.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn open_jobs_of(&self, subject: &str) -> Result<Vec<String>, StoreError> {
        let sql = "SELECT id FROM jobs WHERE subject = $1 AND state IN ('queued', 'running')";
        Ok(sqlx::query_scalar(sql).bind(subject).fetch_all(&self.reader).await?)
    }

    /// Puts a running job back: the server stops, the next one goes on. A planned stop does not count as an attempt.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn requeue_job(&self, id: &str) -> Result<(), StoreError> {
        let sql = "UPDATE jobs SET state = 'queued', attempts = attempts - 1, started_at = NULL, stage = NULL, progress = 0
                   WHERE id = $1 AND state = 'running'";
        sqlx::query(sql).bind(id).execute(self.writer.pool()).await?;
        Ok(())
    }

    /// Puts a running job back, to be tried again after a wait: it has failed so often in a row, and got so far.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn requeue_job_after(&self, id: &str, wait: Duration, failures: u32, progress: f32) -> Result<(), StoreError> {
        let sql = "UPDATE jobs SET state = 'queued', not_before = $1, failures = $2, furthest = CASE WHEN furthest < $3 THEN $3 ELSE furthest END,
                   started_at = NULL, stage = NULL, progress = 0 WHERE id = $4 AND state = 'running'";
        sqlx::query(sql)
            .bind(after(wait))
            .bind(i64::from(failures))
            .bind(progress)
            .bind(id)
            .execute(self.writer.pool())
            .await?;
        Ok(())
    }

    /// Notes that a running job should stop.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn request_cancel(&self, id: &str) -> Result<(), StoreError> {
        let sql = "UPDATE jobs SET cancel_requested = 1 WHERE id = $1 AND state = 'running'";
        sqlx::query(sql).bind(id).execute(self.writer.pool()).await?;
        Ok(())
    }

    /// Whether somebody wants a job to stop.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn is_cancel_requested(&self, id: &str) -> Result<bool, StoreError> {
        let wished: Option<i64> = sqlx::query_scalar("SELECT cancel_requested FROM jobs WHERE id = $1")
            .bind(id)
            .fetch_optional(&self.reader)
            .await?;
        Ok(wished.is_some_and(|wished| wished != 0))
    }

    /// Jobs that are not over: id and kind.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn open_jobs(&self) -> Result<Vec<(String, String)>, StoreError> {
        let sql = "SELECT id, kind FROM jobs WHERE state IN ('queued', 'running')";
        Ok(sqlx::query_as(sql).fetch_all(&self.reader).await?)
    }

    /// Jobs that are not over though their scene is gone: id and subject.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn jobs_without_scene(&self) -> Result<Vec<(String, String)>, StoreError> {
        let sql =
            "SELECT id, subject FROM jobs WHERE state IN ('queued', 'running') AND NOT EXISTS (SELECT 1 FROM scenes WHERE id = subject)";
        Ok(sqlx::query_as(sql).fetch_all(&self.reader).await?)
    }

    /// Ends a job whose scene is gone.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn end_orphan(&self, id: &str) -> Result<(), StoreError> {
        self.finish_job(id, JobState::Cancelled, None, None).await
    }

    /// At start: jobs of a kind that a server left running end as they were asked to, or go back to their queue. One that got further than
    /// ever before starts to count anew; one that did not waits longer each time, and fails in the end: it may be what stops the server.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn recover_jobs(&self, kind: &str, recovery: Recovery) -> Result<(), StoreError> {
        let Recovery { give_up_after, at_once, wait } = recovery;
        let mut tx = self.writer.begin().await?;
        let stop = "UPDATE jobs SET state = 'cancelled', finished_at = $1 WHERE kind = $2 AND state = 'running' AND cancel_requested = 1";
        sqlx::query(stop).bind(now()).bind(kind).execute(&mut *tx).await?;
        let count = "UPDATE jobs SET interruptions = CASE WHEN progress > furthest + 0.001 THEN 1 ELSE interruptions + 1 END,
                     furthest = CASE WHEN furthest < progress THEN progress ELSE furthest END WHERE kind = $1 AND state = 'running'";
        sqlx::query(count).bind(kind).execute(&mut *tx).await?;
        let give_up = "UPDATE jobs SET state = 'failed', error_code = 'interrupted', finished_at = $1,
                       error = 'the server stopped ' || interruptions || ' times while this job ran, and it got no further'
                       WHERE kind = $2 AND state = 'running' AND interruptions >= $3";
        sqlx::query(give_up).bind(now()).bind(kind).bind(i64::from(give_up_after)).execute(&mut *tx).await?;
        for interruptions in at_once..give_up_after {
            let due = after(wait.saturating_mul(1 << (interruptions - at_once).min(16)).min(LONGEST_WAIT / 2));
            let sql = "UPDATE jobs SET not_before = $1 WHERE kind = $2 AND state = 'running' AND interruptions = $3";
            sqlx::query(sql).bind(due).bind(kind).bind(i64::from(interruptions)).execute(&mut *tx).await?;
        }
        sqlx::query(
            "UPDATE jobs SET state = 'queued', started_at = NULL, stage = NULL, progress = 0 WHERE kind = $1 AND state = 'running'",
        )
        .bind(kind)
        .execute(&mut *tx)
        .await?;
        tx.commit().await
    }
}

/// The time after a wait, as stored.
pub(super) fn after(wait: Duration) -> String {
    let wait = jiff::SignedDuration::try_from(wait).unwrap_or_default();
    Timestamp::now().checked_add(wait).unwrap_or(Timestamp::MAX).to_string()
}
