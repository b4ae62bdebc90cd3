//! Ends of jobs that somebody wants to be told of.

use super::database::{Database, number};
use super::jobs::after;
use super::{StoreError, now};
use std::time::Duration;

/// Webhook deliveries that are due.
#[derive(Clone)]
pub struct WebhookRepository {
    pub(super) database: Database,
}

impl WebhookRepository {
    /// Ends that are due to be told, those that were never tried first: id of the job, and how
    /// often it was tried.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn due_announcements(&self, limit: u32) -> Result<Vec<(String, u32)>, StoreError> {
        let sql = "SELECT job_id, attempts FROM announcements WHERE not_before IS NULL OR not_before <= $1
                   ORDER BY coalesce(not_before, ''), job_id LIMIT $2";
        let due: Vec<(String, i64)> = sqlx::query_as(sql)
            .bind(now())
            .bind(i64::from(limit))
            .fetch_all(&self.database.reader)
            .await?;
        Ok(due
            .into_iter()
            .map(|(id, attempts)| Ok((id, number(attempts)?)))
            .collect::<sqlx::Result<_>>()?)
    }

    /// Puts an announcement off that was not taken.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn put_off_announcement(
        &self,
        job_id: &str,
        wait: Duration,
    ) -> Result<(), StoreError> {
        let sql =
            "UPDATE announcements SET attempts = attempts + 1, not_before = $1 WHERE job_id = $2";
        sqlx::query(sql)
            .bind(after(wait))
            .bind(job_id)
            .execute(self.database.writer.pool())
            .await?;
        Ok(())
    }

    /// Forgets an announcement: it was taken, or nobody ever will.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn forget_announcement(&self, job_id: &str) -> Result<(), StoreError> {
        sqlx::query("DELETE FROM announcements WHERE job_id = $1")
            .bind(job_id)
            .execute(self.database.writer.pool())
            .await?;
        Ok(())
    }

    /// Notes every end of a job from now on, as one with the end itself, whatever brings it about.
    /// A job that was done when it was made is none: who asked for it knows.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn note_announcements(&self) -> Result<(), StoreError> {
        for &sql in self.database.engine.note_ends() {
            sqlx::query(sql).execute(self.database.writer.pool()).await?;
        }
        Ok(())
    }

    /// Notes none, and forgets what was noted: nobody wants to be told.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn note_no_announcements(&self) -> Result<(), StoreError> {
        for sql in [self.database.engine.note_no_ends(), "DELETE FROM announcements"] {
            sqlx::query(sql).execute(self.database.writer.pool()).await?;
        }
        Ok(())
    }
}
