//! Webhook deliveries for finished jobs.

use super::database::{Database, to_unsigned};
use super::jobs::time_after;
use super::{StoreError, now};
use std::sync::Arc;
use std::time::Duration;

/// Repository of webhook deliveries that are due.
#[derive(Clone)]
pub struct WebhookRepository {
    pub(super) database: Arc<Database>,
}

impl WebhookRepository {
    /// Returns deliveries that are due, first those that were never attempted: id of the job, and
    /// number of attempts.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn due_deliveries(&self, limit: u32) -> Result<Vec<(String, u32)>, StoreError> {
        let sql = "SELECT job_id, attempts FROM announcements WHERE not_before IS NULL OR not_before <= $1
                   ORDER BY coalesce(not_before, ''), job_id LIMIT $2";
        let due: Vec<(String, i64)> = sqlx::query_as(sql)
            .bind(now())
            .bind(i64::from(limit))
            .fetch_all(&self.database.reader)
            .await?;
        Ok(due
            .into_iter()
            .map(|(id, attempts)| Ok((id, to_unsigned(attempts)?)))
            .collect::<sqlx::Result<_>>()?)
    }

    /// Postpones a delivery that failed.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn postpone_delivery(&self, job_id: &str, wait: Duration) -> Result<(), StoreError> {
        let sql =
            "UPDATE announcements SET attempts = attempts + 1, not_before = $1 WHERE job_id = $2";
        sqlx::query(sql)
            .bind(time_after(wait))
            .bind(job_id)
            .execute(self.database.writer.pool())
            .await?;
        Ok(())
    }

    /// Deletes a delivery that succeeded or was given up.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn delete_delivery(&self, job_id: &str) -> Result<(), StoreError> {
        sqlx::query("DELETE FROM announcements WHERE job_id = $1")
            .bind(job_id)
            .execute(self.database.writer.pool())
            .await?;
        Ok(())
    }

    /// Enables deliveries: from now on every finished job gets a delivery, in the same transaction
    /// as its end. A job that is created as finished gets none: its caller has the result.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn enable_deliveries(&self) -> Result<(), StoreError> {
        for &sql in self.database.engine.create_job_end_trigger() {
            sqlx::query(sql).execute(self.database.writer.pool()).await?;
        }
        Ok(())
    }

    /// Disables deliveries, and deletes those that wait.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn disable_deliveries(&self) -> Result<(), StoreError> {
        for sql in [self.database.engine.drop_job_end_trigger(), "DELETE FROM announcements"] {
            sqlx::query(sql).execute(self.database.writer.pool()).await?;
        }
        Ok(())
    }
}
