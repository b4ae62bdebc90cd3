//! Rows that are kept for a time only: which may go, and their removal, a few at a time.
//!
//! What may go is looked up among the readers; only the removal itself takes the writing
//! connection, and asks again whether it may.

use super::database::Database;
use super::{BatchRepository, StoreError, first_id_at};
use jiff::{Timestamp, ToSpan};
use sqlx::AssertSqlSafe;

/// Kinds of rows that go after a time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RetentionKind {
    Answers,
    /// Those that are over, with their items.
    Batches,
    /// Those that are over, unless a scene or a batch refers to them.
    Jobs,
    IdempotencyKeys,
    /// Those of questions.
    QuestionKeys,
    /// What was done, and with whose key.
    Audit,
    /// Those neither a scene nor an answer refers to, counted from when that was
    /// [seen](Store::mark_superseded_parses).
    SupersededParses,
    /// Those in parts, whatever came of them.
    Uploads,
}

/// Everything before it has been kept long enough.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Cutoff {
    time: String,
    /// The first id that could have been given then.
    id: String,
}

/// A row that may go.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ExpiredRow {
    pub id: String,
    /// Of what it says, roughly.
    pub bytes: u64,
}

impl Cutoff {
    /// So many days before `now`.
    #[must_use]
    pub fn days_ago(days: u32, now: Timestamp) -> Self {
        let time = now.checked_sub((i64::from(days) * 24).hours()).unwrap_or(Timestamp::MIN);
        Self { time: time.to_string(), id: first_id_at(time) }
    }
}

impl RetentionKind {
    /// Table, key, bytes and condition; `?1` is a time, `?2` the first id of that time.
    const fn sql(self) -> (&'static str, &'static str, &'static str, &'static str) {
        match self {
            // An item of a batch has its answer's id long before it is asked, where the batch was paused.
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

/// Rows that have expired.
#[derive(Clone)]
pub struct RetentionRepository {
    pub(super) database: Database,
    pub(super) batches: BatchRepository,
}

impl RetentionRepository {
    /// Rows that may go, in order of their keys, those after `after` only.
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

    /// Removes some of the rows that were due, those that still are; their ids.
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
        let among = self.database.engine.values_of("$3");
        let sql =
            format!("DELETE FROM {table} WHERE {condition} AND {key} IN {among} RETURNING {key}");
        let removed =
            sqlx::query_scalar(AssertSqlSafe(sql)).bind(&before.time).bind(&before.id).bind(ids);
        Ok(removed.fetch_all(self.database.writer.pool()).await?)
    }

    /// A batch may have a million items. It is hidden first, as one that is still coming in:
    /// whatever happens then, nobody meets half of it.
    async fn remove_batches(
        &self,
        before: &Cutoff,
        ids: &str,
        condition: &str,
    ) -> Result<Vec<String>, StoreError> {
        let among = self.database.engine.values_of("$3");
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

    /// Notes which parses nothing refers to any more, since `now`, and which are referred to again.
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

    /// Contents that a parse works on, or is about to.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn contents_in_work(&self) -> Result<Vec<String>, StoreError> {
        let sql = "SELECT DISTINCT content_hash FROM scenes
                   WHERE id IN (SELECT subject FROM jobs WHERE state IN ('queued', 'running'))";
        Ok(sqlx::query_scalar(sql).fetch_all(&self.database.reader).await?)
    }

    /// Bytes that removed rows have left in the database.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn unused_bytes(&self) -> Result<u64, StoreError> {
        let Some(sql) = self.database.engine.unused_bytes() else { return Ok(0) };
        let bytes: i64 = sqlx::query_scalar(sql).fetch_one(&self.database.reader).await?;
        Ok(u64::try_from(bytes).unwrap_or(0))
    }

    /// Gives the room of removed rows back to the disk. Nobody else may use the database meanwhile.
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
