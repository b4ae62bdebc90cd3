//! Batches and their items.

use super::database::{Database, replace_nul, to_unsigned};
use super::{InsertedJob, JobLease, JobRow, NewJob, Reserve, StoreError, now};
use sqlx::any::AnyRow;
use sqlx::{AssertSqlSafe, FromRow, Row};
use std::collections::BTreeMap;
use std::sync::Arc;

/// A batch as stored.
#[derive(Debug, Clone, PartialEq)]
pub struct BatchRow {
    pub id: String,
    pub label: Option<String>,
    pub state: String,
    pub reason: Option<String>,
    pub items: u32,
    pub concurrency: Option<u32>,
    pub max_cost_usd: Option<f64>,
    pub job_id: Option<String>,
    pub request: Option<String>,
    /// The API key that submitted it.
    pub key_id: Option<String>,
    pub created_at: String,
    pub finished_at: Option<String>,
}

impl FromRow<'_, AnyRow> for BatchRow {
    fn from_row(row: &AnyRow) -> sqlx::Result<Self> {
        Ok(Self {
            id: row.try_get("id")?,
            label: row.try_get("label")?,
            state: row.try_get("state")?,
            reason: row.try_get("reason")?,
            items: to_unsigned(row.try_get("items")?)?,
            concurrency: row
                .try_get::<Option<i64>, _>("concurrency")?
                .map(to_unsigned)
                .transpose()?,
            max_cost_usd: row.try_get("max_cost_usd")?,
            job_id: row.try_get("job_id")?,
            request: row.try_get("request")?,
            key_id: row.try_get("key_id")?,
            created_at: row.try_get("created_at")?,
            finished_at: row.try_get("finished_at")?,
        })
    }
}

/// A batch to be received.
pub struct NewBatch<'a> {
    pub label: Option<&'a str>,
    pub concurrency: Option<u32>,
    pub max_cost_usd: Option<f64>,
    pub key_id: Option<&'a str>,
}

/// A batch whose items have all been received.
pub struct ReceivedBatch<'a> {
    pub id: &'a str,
    pub items: u32,
    /// Fields that its items share, as JSON.
    pub defaults: &'a str,
    /// SHA-256 of the submitted request.
    pub request: &'a str,
    /// The idempotency key it was submitted under.
    pub key: Option<&'a str>,
}

/// An item to be inserted.
pub struct NewItem {
    pub scene_id: String,
    /// The item's own fields of the question as JSON.
    pub request: String,
}

/// An item that has not been answered yet.
#[derive(Debug, Clone)]
pub struct OpenItem {
    pub item: u32,
    pub scene_id: String,
    pub request: String,
    pub answer_id: String,
}

/// The result of an item.
#[derive(Debug, Clone)]
pub struct ClosedItem {
    pub item: u32,
    /// The answer's status, or `failed`.
    pub status: String,
    pub cost_usd: f64,
    /// Code and detail.
    pub error: Option<(String, String)>,
}

/// An item with its answer, if it has one.
#[derive(Debug, Clone)]
pub struct ItemRow {
    pub item: u32,
    pub scene_id: String,
    pub request: String,
    pub answer_id: String,
    /// `None` while it waits.
    pub status: Option<String>,
    pub error: Option<(String, String)>,
    /// The answer's JSON.
    pub answer: Option<String>,
}

/// The result of resuming a batch.
pub enum ResumeOutcome {
    /// A new job.
    Resumed(Box<JobRow>),
    /// Its job was still queued or running.
    AlreadyRunning,
    /// It has finished or was cancelled.
    Finished,
}

impl InsertedJob for ResumeOutcome {
    fn inserted_job(&self) -> Option<&JobRow> {
        match self {
            Self::Resumed(job) => Some(job),
            Self::AlreadyRunning | Self::Finished => None,
        }
    }
}

/// The result of submitting a batch.
pub enum SubmitOutcome {
    New(JobRow),
    /// The batch that was submitted earlier under the same idempotency key.
    AlreadyExists(BatchRow),
    KeyReused,
}

impl InsertedJob for SubmitOutcome {
    fn inserted_job(&self) -> Option<&JobRow> {
        match self {
            Self::New(job) => Some(job),
            Self::AlreadyExists(_) | Self::KeyReused => None,
        }
    }
}

/// Columns of a [`BatchRow`]. Defaults are read only where they are used: they are up to 64 kB.
const COLUMNS: &str = "id, label, state, reason, items, concurrency, max_cost_usd, job_id, request, key_id, created_at, finished_at";

/// Items of a batch deleted in one transaction.
const ITEMS_TOGETHER: u32 = 1000;

fn select(condition: &str) -> AssertSqlSafe<String> {
    AssertSqlSafe(format!("SELECT {COLUMNS} FROM batches WHERE {condition}"))
}

/// Repository of batches of questions and their items.
#[derive(Clone)]
pub struct BatchRepository {
    pub(super) database: Arc<Database>,
    pub(super) reserve: Reserve,
}

impl BatchRepository {
    /// Inserts an empty batch; its items follow. It is invisible to callers until it is
    /// [submitted](Self::submit_batch).
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn insert_batch(&self, new: NewBatch<'_>) -> Result<String, StoreError> {
        let id = self.database.new_id();
        let sql = "INSERT INTO batches (id, label, state, concurrency, max_cost_usd, key_id, created_at, receiver)
                   VALUES ($1, $2, 'receiving', $3, $4, $5, $6, $7)";
        // Not a persistent prepared statement: sqlx infers a smaller type for a NULL than for a
        // number.
        sqlx::query(sql)
            .persistent(false)
            .bind(&id)
            .bind(new.label)
            .bind(new.concurrency.map(i64::from))
            .bind(new.max_cost_usd)
            .bind(new.key_id)
            .bind(now())
            .bind(&*self.database.members.id())
            .execute(self.database.writer.pool())
            .await?;
        Ok(id)
    }

    /// Adds items to a batch that is being received, starting at position `first`. Callers pass few
    /// items at once, to hold the write lock only briefly.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn insert_batch_items(
        &self,
        batch_id: &str,
        first: u32,
        items: &[NewItem],
    ) -> Result<(), StoreError> {
        let sql = "INSERT INTO batch_items (batch_id, item, scene_id, request, answer_id) VALUES ($1, $2, $3, $4, $5)";
        let mut tx = self.database.writer.begin().await?;
        for (item, NewItem { scene_id, request }) in (first..).zip(items) {
            sqlx::query(sql)
                .bind(batch_id)
                .bind(i64::from(item))
                .bind(&*replace_nul(scene_id))
                .bind(request)
                .bind(self.database.new_id())
                .execute(&mut *tx)
                .await?;
        }
        tx.commit().await
    }

    /// Submits a batch whose items have all been received, with its key and its job in one
    /// transaction.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn submit_batch(
        &self,
        received: &ReceivedBatch<'_>,
        job: &NewJob<'_>,
    ) -> Result<SubmitOutcome, StoreError> {
        let ReceivedBatch { id, items, defaults, request, key } = *received;
        let mut tx = self.database.writer.begin().await?;
        if let Some(key) = key {
            let before: Option<BatchRow> =
                sqlx::query_as(select("key = $1")).bind(key).fetch_optional(&mut *tx).await?;
            if let Some(before) = before {
                tx.rollback().await?;
                let same = before.request.as_deref() == Some(request);
                return Ok(if same {
                    SubmitOutcome::AlreadyExists(before)
                } else {
                    SubmitOutcome::KeyReused
                });
            }
        }
        let job = super::jobs::insert(&mut tx, &self.database.new_id(), id, job).await?;
        let sql = "UPDATE batches SET state = 'running', items = $1, request = $2, key = $3, job_id = $4, defaults = $5 WHERE id = $6";
        sqlx::query(sql)
            .bind(i64::from(items))
            .bind(request)
            .bind(key)
            .bind(&job.id)
            .bind(defaults)
            .bind(id)
            .execute(&mut *tx)
            .await?;
        tx.commit().await?;
        Ok(SubmitOutcome::New(job))
    }

    /// Returns the batch that was submitted under an idempotency key.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn batch_of_idempotency_key(
        &self,
        key: &str,
    ) -> Result<Option<BatchRow>, StoreError> {
        Ok(sqlx::query_as(select("key = $1"))
            .bind(key)
            .fetch_optional(&self.database.reader)
            .await?)
    }

    /// Returns the fields that the items of a batch share, as JSON. Returns `None` where its items
    /// store complete questions.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn batch_defaults(&self, id: &str) -> Result<Option<String>, StoreError> {
        let defaults: Option<Option<String>> =
            sqlx::query_scalar("SELECT defaults FROM batches WHERE id = $1")
                .bind(id)
                .fetch_optional(&self.database.reader)
                .await?;
        Ok(defaults.flatten())
    }

    /// Deletes a batch with its items, a thousand items at a time. Its answers stay.
    ///
    /// # Errors
    /// [`StoreError::Database`]; items that were deleted before stay deleted.
    pub async fn delete_batch(&self, id: &str) -> Result<(), StoreError> {
        let some = "DELETE FROM batch_items WHERE batch_id = $1
                    AND item IN (SELECT item FROM batch_items WHERE batch_id = $1 LIMIT $2)";
        let delete = || {
            sqlx::query(some)
                .bind(id)
                .bind(i64::from(ITEMS_TOGETHER))
                .execute(self.database.writer.pool())
        };
        while delete().await?.rows_affected() > 0 {}
        sqlx::query("DELETE FROM batches WHERE id = $1")
            .bind(id)
            .execute(self.database.writer.pool())
            .await?;
        Ok(())
    }

    /// Deletes a rejected batch completely. On a full disk it uses the space of the reserve.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn discard_batch(&self, id: &str) -> Result<(), StoreError> {
        match self.delete_batch(id).await {
            Err(error) if error.is_full() && self.reserve.release_reserve() => {
                self.delete_batch(id).await?;
            }
            deleted => deleted?,
        }
        if let Err(error) = self.database.truncate_log().await {
            tracing::debug!(
                error = &error as &dyn std::error::Error,
                "write-ahead log could not be truncated; it keeps its size"
            );
        }
        self.reserve.restore_reserve().await;
        Ok(())
    }

    /// Deletes batches whose process ended before they were submitted.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub(super) async fn delete_unsubmitted_batches(&self) -> Result<(), StoreError> {
        let sql = "SELECT id FROM batches WHERE state = 'receiving' AND (receiver IS NULL OR receiver NOT IN (SELECT id FROM members))";
        let left: Vec<String> =
            sqlx::query_scalar(sql).fetch_all(self.database.writer.pool()).await?;
        for id in &left {
            self.delete_batch(id).await?;
        }
        Ok(())
    }

    /// # Errors
    /// [`StoreError::Database`].
    pub async fn batch(&self, id: &str) -> Result<Option<BatchRow>, StoreError> {
        let which = select("id = $1 AND state != 'receiving'");
        Ok(sqlx::query_as(which).bind(id).fetch_optional(&self.database.reader).await?)
    }

    /// Returns batches, newest first; with a `cursor` (an id) only those before it.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn batches(
        &self,
        limit: u32,
        cursor: Option<&str>,
    ) -> Result<Vec<BatchRow>, StoreError> {
        let which =
            select("($1 IS NULL OR id < $1) AND state != 'receiving' ORDER BY id DESC LIMIT $2");
        Ok(sqlx::query_as(which)
            .bind(cursor)
            .bind(i64::from(limit))
            .fetch_all(&self.database.reader)
            .await?)
    }

    /// Returns the number of items by status, and their total cost in US dollars.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn summarize_batch_items(
        &self,
        id: &str,
    ) -> Result<(BTreeMap<String, u32>, f64), StoreError> {
        let sql = "SELECT status, count(*) AS number, sum(cost_usd) AS usd FROM batch_items
                   WHERE batch_id = $1 AND status IS NOT NULL GROUP BY status";
        let (mut numbers, mut usd) = (BTreeMap::new(), 0.0);
        for row in sqlx::query(sql).bind(id).fetch_all(&self.database.reader).await? {
            numbers.insert(row.try_get("status")?, to_unsigned(row.try_get("number")?)?);
            usd += row.try_get::<f64, _>("usd")?;
        }
        Ok((numbers, usd))
    }

    /// Returns the id that the answer to an item has or will have; `None` if there is no such item.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn answer_id_of_item(
        &self,
        id: &str,
        item: u32,
    ) -> Result<Option<String>, StoreError> {
        let sql = "SELECT answer_id FROM batch_items WHERE batch_id = $1 AND item = $2";
        Ok(sqlx::query_scalar(sql)
            .bind(id)
            .bind(i64::from(item))
            .fetch_optional(&self.database.reader)
            .await?)
    }

    /// Returns unanswered items, in order.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn open_batch_items(
        &self,
        id: &str,
        limit: u32,
    ) -> Result<Vec<OpenItem>, StoreError> {
        let sql = "SELECT item, scene_id, request, answer_id FROM batch_items WHERE batch_id = $1 AND status IS NULL ORDER BY item LIMIT $2";
        let rows = sqlx::query(sql)
            .bind(id)
            .bind(i64::from(limit))
            .fetch_all(&self.database.reader)
            .await?;
        let open = |row: &AnyRow| {
            Ok(OpenItem {
                item: to_unsigned(row.try_get("item")?)?,
                scene_id: row.try_get("scene_id")?,
                request: row.try_get("request")?,
                answer_id: row.try_get("answer_id")?,
            })
        };
        rows.iter().map(open).collect()
    }

    /// Stores the results of items in one transaction, under the lease of the batch's job.
    ///
    /// # Errors
    /// [`StoreError::LeaseLost`], [`StoreError::Database`].
    pub async fn close_batch_items(
        &self,
        lease: &JobLease,
        id: &str,
        closed: &[ClosedItem],
    ) -> Result<(), StoreError> {
        let sql = "UPDATE batch_items SET status = $1, cost_usd = $2, error_code = $3, error = $4 WHERE batch_id = $5 AND item = $6";
        let mut tx = self.database.writer.begin().await?;
        lease.check(&mut tx).await?;
        for ClosedItem { item, status, cost_usd, error } in closed {
            let (code, detail) =
                error.as_ref().map_or((None, None), |(code, detail)| (Some(code), Some(detail)));
            sqlx::query(sql)
                .bind(status)
                .bind(cost_usd)
                .bind(code)
                .bind(detail)
                .bind(id)
                .bind(i64::from(*item))
                .execute(&mut *tx)
                .await?;
        }
        tx.commit().await
    }

    /// Moves a batch from one of several states to another. Returns whether it was in one of them.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn change_batch_state(
        &self,
        id: &str,
        from: &[&str],
        to: &str,
        reason: Option<&str>,
    ) -> Result<bool, StoreError> {
        let finished = matches!(to, "succeeded" | "cancelled").then(now);
        let sql = "UPDATE batches SET state = $1, reason = $2, finished_at = $3
                   WHERE id = $4 AND ',' || $5 || ',' LIKE '%,' || state || ',%'";
        let moved = sqlx::query(sql)
            .bind(to)
            .bind(reason)
            .bind(finished)
            .bind(id)
            .bind(from.join(","))
            .execute(self.database.writer.pool())
            .await?;
        Ok(moved.rows_affected() > 0)
    }

    /// Resumes a batch: with its job if that is still queued or running, otherwise with a new one.
    /// In one transaction, so that no two jobs ever process the same batch.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn resume_batch(
        &self,
        id: &str,
        job: &NewJob<'_>,
    ) -> Result<ResumeOutcome, StoreError> {
        let mut tx = self.database.writer.begin().await?;
        let resume = "UPDATE batches SET state = 'running', reason = NULL WHERE id = $1 AND state IN ('running', 'paused')";
        if sqlx::query(resume).bind(id).execute(&mut *tx).await?.rows_affected() == 0 {
            tx.rollback().await?;
            return Ok(ResumeOutcome::Finished);
        }
        let works = "SELECT count(*) FROM jobs JOIN batches ON jobs.id = job_id
                     WHERE batches.id = $1 AND jobs.state IN ('queued', 'running')";
        let works: i64 = sqlx::query_scalar(works).bind(id).fetch_one(&mut *tx).await?;
        if works > 0 {
            tx.commit().await?;
            return Ok(ResumeOutcome::AlreadyRunning);
        }
        let job = super::jobs::insert(&mut tx, &self.database.new_id(), id, job).await?;
        sqlx::query("UPDATE batches SET job_id = $1 WHERE id = $2")
            .bind(&job.id)
            .bind(id)
            .execute(&mut *tx)
            .await?;
        tx.commit().await?;
        Ok(ResumeOutcome::Resumed(Box::new(job)))
    }

    /// Returns items in order from a position on, each with its answer.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn batch_items(
        &self,
        id: &str,
        from: u32,
        limit: u32,
    ) -> Result<Vec<ItemRow>, StoreError> {
        let sql = "SELECT item, batch_items.scene_id, request, answer_id, batch_items.status, error_code, error, body
                   FROM batch_items LEFT JOIN answers ON answers.id = answer_id
                   WHERE batch_id = $1 AND item >= $2 ORDER BY item LIMIT $3";
        let rows = sqlx::query(sql)
            .bind(id)
            .bind(i64::from(from))
            .bind(i64::from(limit))
            .fetch_all(&self.database.reader)
            .await?;
        let item = |row: &AnyRow| {
            let (code, detail): (Option<String>, Option<String>) =
                (row.try_get("error_code")?, row.try_get("error")?);
            Ok(ItemRow {
                item: to_unsigned(row.try_get("item")?)?,
                scene_id: row.try_get("scene_id")?,
                request: row.try_get("request")?,
                answer_id: row.try_get("answer_id")?,
                status: row.try_get("status")?,
                error: code.map(|code| (code, detail.unwrap_or_default())),
                answer: row.try_get("body")?,
            })
        };
        rows.iter().map(item).collect()
    }
}
