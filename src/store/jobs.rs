//! The durable side of the job queue.

use super::{Store, StoreError, now};
use jiff::Timestamp;
use sqlx::sqlite::SqliteRow;
use sqlx::{FromRow, Row};
use std::time::Duration;
pub use uniground_types::job::JobState;
use uuid::Uuid;

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
    pub message: Option<String>,
    pub error_code: Option<String>,
    pub error: Option<String>,
    pub created_at: String,
    pub started_at: Option<String>,
    pub finished_at: Option<String>,
}

impl FromRow<'_, SqliteRow> for JobRow {
    fn from_row(row: &SqliteRow) -> sqlx::Result<Self> {
        Ok(Self {
            id: row.try_get("id")?,
            kind: row.try_get("kind")?,
            subject: row.try_get("subject")?,
            payload: row.try_get("payload")?,
            state: state(row.try_get("state")?)?,
            stage: row.try_get("stage")?,
            progress: row.try_get("progress")?,
            attempts: row.try_get("attempts")?,
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

impl Store {
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn insert_job(&self, kind: &str, subject: &str, payload: &str) -> Result<JobRow, StoreError> {
        let sql = "INSERT INTO jobs (id, kind, subject, payload, state, created_at) VALUES (?, ?, ?, ?, 'queued', ?) RETURNING *";
        Ok(sqlx::query_as(sql)
            .bind(Uuid::now_v7().to_string())
            .bind(kind)
            .bind(subject)
            .bind(payload)
            .bind(now())
            .fetch_one(&self.writer)
            .await?)
    }

    /// Records a job whose result was there already.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn insert_done_job(&self, kind: &str, subject: &str, payload: &str, message: &str) -> Result<JobRow, StoreError> {
        let sql = "INSERT INTO jobs (id, kind, subject, payload, state, progress, message, created_at, started_at, finished_at)
                   VALUES (?1, ?2, ?3, ?4, 'succeeded', 1.0, ?5, ?6, ?6, ?6) RETURNING *";
        let id = Uuid::now_v7().to_string();
        Ok(sqlx::query_as(sql)
            .bind(id)
            .bind(kind)
            .bind(subject)
            .bind(payload)
            .bind(message)
            .bind(now())
            .fetch_one(&self.writer)
            .await?)
    }

    /// # Errors
    /// [`StoreError::Database`].
    pub async fn job(&self, id: &str) -> Result<Option<JobRow>, StoreError> {
        Ok(sqlx::query_as("SELECT * FROM jobs WHERE id = ?").bind(id).fetch_optional(&self.reader).await?)
    }

    /// # Errors
    /// [`StoreError::Database`].
    pub async fn queued_jobs(&self, kind: &str) -> Result<u32, StoreError> {
        Ok(sqlx::query_scalar("SELECT count(*) FROM jobs WHERE kind = ? AND state = 'queued'")
            .bind(kind)
            .fetch_one(&self.reader)
            .await?)
    }

    /// Takes the oldest queued job of a kind that is due; one UPDATE, so no two workers get the same.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn claim_job(&self, kind: &str) -> Result<Option<JobRow>, StoreError> {
        let sql = "UPDATE jobs SET state = 'running', attempts = attempts + 1, started_at = ?1, stage = NULL, progress = 0
                   WHERE id = (SELECT id FROM jobs WHERE kind = ?2 AND state = 'queued' AND (not_before IS NULL OR not_before <= ?1)
                               ORDER BY id LIMIT 1) RETURNING *";
        Ok(sqlx::query_as(sql).bind(now()).bind(kind).fetch_optional(&self.writer).await?)
    }

    /// # Errors
    /// [`StoreError::Database`].
    pub async fn save_job_progress(&self, id: &str, stage: &str, progress: f32) -> Result<(), StoreError> {
        let sql = "UPDATE jobs SET stage = ?, progress = ? WHERE id = ? AND state = 'running'";
        sqlx::query(sql).bind(stage).bind(progress).bind(id).execute(&self.writer).await?;
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
        let sql = "UPDATE jobs SET state = ?1, message = ?2, error_code = ?3, error = ?4, finished_at = ?5,
                   progress = CASE WHEN ?1 = 'succeeded' THEN 1.0 ELSE progress END,
                   stage = CASE WHEN ?1 = 'succeeded' THEN NULL ELSE stage END
                   WHERE id = ?6 AND state IN ('queued', 'running')";
        let (code, detail) = error.unzip();
        sqlx::query(sql)
            .bind(state.word())
            .bind(message)
            .bind(code)
            .bind(detail)
            .bind(now())
            .bind(id)
            .execute(&self.writer)
            .await?;
        Ok(())
    }

    /// Cancels a job that no worker has taken; `false` when one has.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn cancel_queued_job(&self, id: &str) -> Result<bool, StoreError> {
        let sql = "UPDATE jobs SET state = 'cancelled', finished_at = ? WHERE id = ? AND state = 'queued'";
        Ok(sqlx::query(sql).bind(now()).bind(id).execute(&self.writer).await?.rows_affected() > 0)
    }

    /// Jobs on a subject that are not over.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn open_jobs_of(&self, subject: &str) -> Result<Vec<String>, StoreError> {
        let sql = "SELECT id FROM jobs WHERE subject = ? AND state IN ('queued', 'running')";
        Ok(sqlx::query_scalar(sql).bind(subject).fetch_all(&self.reader).await?)
    }

    /// Puts a running job back: the server stops, the next one goes on. A planned stop does not count as an attempt.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn requeue_job(&self, id: &str) -> Result<(), StoreError> {
        let sql = "UPDATE jobs SET state = 'queued', attempts = attempts - 1, started_at = NULL, stage = NULL, progress = 0
                   WHERE id = ? AND state = 'running'";
        sqlx::query(sql).bind(id).execute(&self.writer).await?;
        Ok(())
    }

    /// Puts a running job back, to be tried again after a wait.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn requeue_job_after(&self, id: &str, wait: Duration) -> Result<(), StoreError> {
        let due = Timestamp::now()
            .checked_add(jiff::SignedDuration::try_from(wait).unwrap_or_default())
            .unwrap_or(Timestamp::MAX);
        let sql = "UPDATE jobs SET state = 'queued', not_before = ?, started_at = NULL, stage = NULL, progress = 0
                   WHERE id = ? AND state = 'running'";
        sqlx::query(sql).bind(due.to_string()).bind(id).execute(&self.writer).await?;
        Ok(())
    }

    /// Notes that a running job should stop.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn request_cancel(&self, id: &str) -> Result<(), StoreError> {
        let sql = "UPDATE jobs SET cancel_requested = 1 WHERE id = ? AND state = 'running'";
        sqlx::query(sql).bind(id).execute(&self.writer).await?;
        Ok(())
    }

    /// Whether somebody wants a job to stop.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn is_cancel_requested(&self, id: &str) -> Result<bool, StoreError> {
        let wished: Option<bool> = sqlx::query_scalar("SELECT cancel_requested FROM jobs WHERE id = ?")
            .bind(id)
            .fetch_optional(&self.reader)
            .await?;
        Ok(wished.unwrap_or(false))
    }

    /// Jobs that are not over: id and kind.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn open_jobs(&self) -> Result<Vec<(String, String)>, StoreError> {
        let sql = "SELECT id, kind FROM jobs WHERE state IN ('queued', 'running')";
        Ok(sqlx::query_as(sql).fetch_all(&self.reader).await?)
    }

    /// At start: jobs of a kind that a crashed server left running end as they were asked to, fail once they have brought it down too
    /// often, or go back to their queue.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn recover_jobs(&self, kind: &str, max_attempts: u32) -> Result<(), StoreError> {
        let stop = "UPDATE jobs SET state = 'cancelled', finished_at = ? WHERE kind = ? AND state = 'running' AND cancel_requested";
        sqlx::query(stop).bind(now()).bind(kind).execute(&self.writer).await?;
        let give_up = "UPDATE jobs SET state = 'failed', error_code = 'interrupted', finished_at = ?,
                       error = 'the server stopped ' || attempts || ' times while this job ran'
                       WHERE kind = ? AND state = 'running' AND attempts >= ?";
        sqlx::query(give_up).bind(now()).bind(kind).bind(max_attempts).execute(&self.writer).await?;
        sqlx::query("UPDATE jobs SET state = 'queued', started_at = NULL, stage = NULL, progress = 0 WHERE kind = ? AND state = 'running'")
            .bind(kind)
            .execute(&self.writer)
            .await?;
        Ok(())
    }
}
