//! Retention: finds expired rows and removes them, a few at a time.
//!
//! Expired rows are found with readers. Only the removal uses the write connection, and it checks
//! again whether a row may be removed.

use super::database::Database;
use super::{BatchRepository, StoreError, first_id_at};
use jiff::{Timestamp, ToSpan};
use sqlx::AssertSqlSafe;
use std::sync::Arc;

/// Kinds of rows with a retention time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RetentionKind {
    Answers,
    /// Finished batches, with their items.
    Batches,
    /// Finished jobs that no scene or batch refers to.
    Jobs,
    IdempotencyKeys,
    /// Idempotency keys of questions.
    QuestionKeys,
    /// The audit log.
    Audit,
    /// Parses that neither a scene nor an answer refers to, counted from when that was
    /// [seen](RetentionRepository::mark_superseded_parses).
    SupersededParses,
    /// Resumable uploads, finished or not.
    Uploads,
}

/// Rows from before this time have expired.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Cutoff {
    time: String,
    /// The first id that could have been assigned at this time.
    id: String,
}

/// A row that may be removed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ExpiredRow {
    pub id: String,
    /// Approximate size of its content.
    pub bytes: u64,
}

impl Cutoff {
    /// Returns the time so many days before `now`.
    #[must_use]
    pub fn days_ago(days: u32, now: Timestamp) -> Self {
        let time = now.checked_sub((i64::from(days) * 24).hours()).unwrap_or(Timestamp::MIN);
        Self { time: time.to_string(), id: first_id_at(time) }
    }
}

impl RetentionKind {
    /// Table, key, bytes and condition. `$1` is a time, `$2` the first id of that time.
    const fn sql(self) -> (&'static str, &'static str, &'static str, &'static str) {
        match self {
            // An item of a batch gets its answer's id long before it is answered, e.g. while the
            // batch is paused.
            Self::Answers => ("answers", "id", "octet_length(body)", "id < $2 AND created_at < $1"),
            Self::Batches => (
                "batches",
                "id",
                "coalesce(octet_length(defaults), 0)
                 + (SELECT CAST(coalesce(sum(octet_length(request)), 0) AS bigint) FROM batch_items WHERE batch_id = batches.id)",
                "id < $2 AND state IN ('succeeded', 'cancelled') AND finished_at < $1",
            ),
            Self::Jobs => (
                "jobs",
                "id",
                "octet_length(payload)",
                "id < $2 AND state IN ('succeeded', 'failed', 'cancelled') AND finished_at < $1
                 AND id NOT IN (SELECT job_id FROM scenes WHERE job_id IS NOT NULL)
                 AND id NOT IN (SELECT job_id FROM batches WHERE job_id IS NOT NULL)",
            ),
            Self::IdempotencyKeys => ("idempotency_keys", "key", "octet_length(key)", "created_at < $1 AND $2 IS NOT NULL"),
            Self::QuestionKeys => ("question_keys", "key", "octet_length(key)", "created_at < $1 AND $2 IS NOT NULL"),
            Self::Audit => ("audit", "id", "octet_length(path)", "id < $2 AND at < $1"),
            // Their bytes are in files.
            Self::Uploads => ("uploads", "id", "0", "id < $2 AND updated_at < $1"),
            Self::SupersededParses => (
                "parses",
                "id",
                "(SELECT CAST(coalesce(sum(octet_length(body)), 0) AS bigint) FROM instances WHERE parse_id = parses.id)",
                "superseded_at < $1 AND $2 IS NOT NULL
                 AND NOT EXISTS (SELECT 1 FROM scenes WHERE scenes.parse_id = parses.id)
                 AND NOT EXISTS (SELECT 1 FROM answers WHERE parse_id = parses.id)",
            ),
        }
    }
}

/// Repository of expired rows.
#[derive(Clone)]
pub struct RetentionRepository {
    pub(super) database: Arc<Database>,
    pub(super) batches: BatchRepository,
}

impl RetentionRepository {
    /// Returns rows that may be removed, ordered by key, starting after `after`.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn due(
        &self,
        aged: RetentionKind,
        before: &Cutoff,
        after: &str,
        limit: u32,
    ) -> Result<Vec<ExpiredRow>, StoreError> {
        let (table, key, bytes, condition) = aged.sql();
        let sql = format!(
            "SELECT {key} AS id, {bytes} AS bytes FROM {table} WHERE {condition} AND {key} > $3 ORDER BY {key} LIMIT $4"
        );
        let due = sqlx::query_as(AssertSqlSafe(sql))
            .bind(&before.time)
            .bind(&before.id)
            .bind(after)
            .bind(i64::from(limit));
        let due: Vec<(String, i64)> = due.fetch_all(&self.database.reader).await?;
        Ok(due
            .into_iter()
            .map(|(id, bytes)| ExpiredRow { id, bytes: u64::try_from(bytes).unwrap_or(0) })
            .collect())
    }

    /// Removes rows found earlier that may still be removed. Returns their ids.
    ///
    /// # Errors
    /// [`StoreError`].
    pub async fn remove_due(
        &self,
        aged: RetentionKind,
        before: &Cutoff,
        ids: &[&str],
    ) -> Result<Vec<String>, StoreError> {
        let (table, key, _, condition) = aged.sql();
        let ids = serde_json::to_string(ids)?;
        if aged == RetentionKind::Batches {
            return self.remove_batches(before, &ids, condition).await;
        }
        let among = self.database.engine.json_texts("$3");
        let sql =
            format!("DELETE FROM {table} WHERE {condition} AND {key} IN {among} RETURNING {key}");
        let removed =
            sqlx::query_scalar(AssertSqlSafe(sql)).bind(&before.time).bind(&before.id).bind(ids);
        Ok(removed.fetch_all(self.database.writer.pool()).await?)
    }

    /// Removes batches, which may have a million items each. A batch is first hidden like one that
    /// is still being received, so no reader ever sees a part of it.
    async fn remove_batches(
        &self,
        before: &Cutoff,
        ids: &str,
        condition: &str,
    ) -> Result<Vec<String>, StoreError> {
        let among = self.database.engine.json_texts("$3");
        let hide = format!(
            "UPDATE batches SET state = 'receiving', key = NULL
             WHERE {condition} AND id IN {among} RETURNING id"
        );
        let hidden: Vec<String> = sqlx::query_scalar(AssertSqlSafe(hide))
            .bind(&before.time)
            .bind(&before.id)
            .bind(ids)
            .fetch_all(self.database.writer.pool())
            .await?;
        for id in &hidden {
            self.batches.delete_batch(id).await?;
        }
        Ok(hidden)
    }

    /// Stores since when parses are unreferenced (`now`), and clears that for parses referred to
    /// again.
    ///
    /// # Errors
    /// [`StoreError`].
    pub async fn mark_superseded_parses(&self, now: Timestamp) -> Result<(), StoreError> {
        let is_used = "(EXISTS (SELECT 1 FROM scenes WHERE scenes.parse_id = parses.id)
                        OR EXISTS (SELECT 1 FROM answers WHERE parse_id = parses.id))";
        for sql in [
            format!(
                "UPDATE parses SET superseded_at = $1 WHERE superseded_at IS NULL AND NOT {is_used}"
            ),
            format!(
                "UPDATE parses SET superseded_at = NULL WHERE superseded_at IS NOT NULL AND {is_used} AND $1 IS NOT NULL"
            ),
        ] {
            sqlx::query(AssertSqlSafe(sql))
                .bind(now.to_string())
                .execute(self.database.writer.pool())
                .await?;
        }
        Ok(())
    }

    /// Returns contents that a parse job works on or waits for.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn contents_in_work(&self) -> Result<Vec<String>, StoreError> {
        let sql = "SELECT DISTINCT content_hash FROM scenes
                   WHERE id IN (SELECT subject FROM jobs WHERE state IN ('queued', 'running'))";
        Ok(sqlx::query_scalar(sql).fetch_all(&self.database.reader).await?)
    }

    /// Returns the bytes in the database that removed rows left unused.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn unused_bytes(&self) -> Result<u64, StoreError> {
        let Some(sql) = self.database.engine.unused_bytes() else { return Ok(0) };
        let bytes: i64 = sqlx::query_scalar(sql).fetch_one(&self.database.reader).await?;
        Ok(u64::try_from(bytes).unwrap_or(0))
    }

    /// Returns the space of removed rows to the disk. Needs exclusive access to the database.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn compact(&self) -> Result<(), StoreError> {
        for &sql in self.database.engine.compact() {
            sqlx::query(sql).execute(self.database.writer.pool()).await?;
        }
        Ok(())
    }
}
