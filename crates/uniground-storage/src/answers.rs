//! Answers, kept as they were given.

use super::database::{Database, SqlFilter};
use super::records::RECORD_VERSION;
use super::writer::Writer;
use super::{StoreError, now};
use jiff::Timestamp;
use sqlx::any::AnyRow;
use sqlx::{FromRow, Row};
use std::sync::Arc;
use tokio::sync::{mpsc, oneshot};

/// An answer as stored: the JSON the caller got, whole, and the parse it is about. It is given out
/// again as it is: no version of the service can fail to read it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AnswerRow {
    pub id: String,
    pub parse_id: String,
    pub body: String,
}

impl FromRow<'_, AnyRow> for AnswerRow {
    fn from_row(row: &AnyRow) -> sqlx::Result<Self> {
        Ok(Self {
            id: row.try_get("id")?,
            parse_id: row.try_get("parse_id")?,
            body: row.try_get("body")?,
        })
    }
}

/// Which answers are wanted; what is not said is any.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct AnswerFilter {
    pub scene_id: Option<String>,
    pub batch_id: Option<String>,
    /// As the answer has it.
    pub status: Option<String>,
    /// Given then or later.
    pub since: Option<Timestamp>,
    /// Given before.
    pub until: Option<Timestamp>,
}

/// An answer about to be kept.
#[derive(Debug)]
pub struct NewAnswer {
    pub id: String,
    pub scene_id: String,
    pub parse_id: String,
    pub body: String,
}

struct QueuedAnswer {
    answer: NewAnswer,
    kept: oneshot::Sender<Result<bool, StoreError>>,
}

/// Answers that wait to be written. Each is on the disk before its caller hears of it; those that
/// come together are written together, so that the disk is waited for once.
#[derive(Clone)]
pub(super) struct AnswerQueue(mpsc::Sender<QueuedAnswer>);

/// Answers that may wait; more wait at the door.
const MOST_WAITING: usize = 1024;
/// Answers written as one.
const MOST_TOGETHER: usize = 128;

impl AnswerQueue {
    pub fn start(writer: Writer) -> Self {
        let (sender, mut queue) = mpsc::channel::<QueuedAnswer>(MOST_WAITING);
        tokio::spawn(async move {
            let mut together = Vec::new();
            while queue.recv_many(&mut together, MOST_TOGETHER).await > 0 {
                let (answers, callers): (Vec<_>, Vec<_>) =
                    together.drain(..).map(|waiting| (waiting.answer, waiting.kept)).unzip();
                // A caller that left needs no word.
                match write(&writer, &answers).await {
                    Ok(kept) => callers
                        .into_iter()
                        .zip(kept)
                        .for_each(|(caller, kept)| drop(caller.send(Ok(kept)))),
                    Err(error) => {
                        let error = Arc::new(error);
                        callers.into_iter().for_each(|caller| {
                            drop(caller.send(Err(StoreError::Together(error.clone()))))
                        });
                    }
                }
            }
        });
        Self(sender)
    }
}

/// Writes answers as one; for each, whether its scene and parse were still there.
async fn write(writer: &Writer, answers: &[NewAnswer]) -> Result<Vec<bool>, StoreError> {
    let sql = "INSERT INTO answers (id, scene_id, parse_id, body, created_at, record_version)
               SELECT $1, $2, $3, $4, $5, $6 WHERE EXISTS (SELECT 1 FROM scenes WHERE id = $2) AND EXISTS (SELECT 1 FROM parses WHERE id = $3)
               ON CONFLICT (id) DO UPDATE SET id = answers.id";
    let time = now();
    let mut tx = writer.begin().await?;
    let mut kept = Vec::with_capacity(answers.len());
    for NewAnswer { id, scene_id, parse_id, body } in answers {
        let inserted = sqlx::query(sql)
            .bind(id)
            .bind(scene_id)
            .bind(parse_id)
            .bind(body)
            .bind(&time)
            .bind(i64::from(RECORD_VERSION))
            .execute(&mut *tx)
            .await?;
        kept.push(inserted.rows_affected() > 0);
    }
    tx.commit().await?;
    Ok(kept)
}

/// Answers to questions.
#[derive(Clone)]
pub struct AnswerRepository {
    pub(super) database: Database,
    pub(super) queue: AnswerQueue,
}

impl AnswerRepository {
    /// What was asked under an idempotency key, and the id its answer has or will have. A key that
    /// nobody has used stands for this question from now on.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn question_of_key(
        &self,
        key: &str,
        request: &str,
        answer_id: &str,
    ) -> Result<(String, String), StoreError> {
        let mut tx = self.database.writer.begin().await?;
        let sql = "INSERT INTO question_keys (key, request, answer_id, created_at) VALUES ($1, $2, $3, $4)
                   ON CONFLICT (key) DO UPDATE SET key = question_keys.key RETURNING request, answer_id";
        let row = sqlx::query_as(sql).bind(key).bind(request).bind(answer_id).bind(now());
        let row = row.fetch_one(&mut *tx).await?;
        tx.commit().await?;
        Ok(row)
    }

    /// Keeps an answer; `false` when its scene was deleted meanwhile.
    ///
    /// # Errors
    /// [`StoreError`].
    pub async fn insert_answer(&self, answer: NewAnswer) -> Result<bool, StoreError> {
        let (kept, told) = oneshot::channel();
        let closed = || StoreError::Database(sqlx::Error::PoolClosed);
        self.queue.0.send(QueuedAnswer { answer, kept }).await.map_err(|_| closed())?;
        told.await.map_err(|_| closed())?
    }

    /// # Errors
    /// [`StoreError::Database`].
    pub async fn answer(&self, id: &str) -> Result<Option<AnswerRow>, StoreError> {
        Ok(sqlx::query_as("SELECT id, parse_id, body FROM answers WHERE id = $1")
            .bind(id)
            .fetch_optional(&self.database.reader)
            .await?)
    }

    /// Answers newest first, those before `cursor` (an id) only.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn answers(
        &self,
        filter: &AnswerFilter,
        limit: u32,
        cursor: Option<&str>,
    ) -> Result<Vec<AnswerRow>, StoreError> {
        let AnswerFilter { scene_id, batch_id, status, since, until } = filter;
        // Only what is asked for stands in the statement, so that the index of that is used.
        let columns = "SELECT answers.id, parse_id, body FROM";
        let mut which = match batch_id {
            // Through the batch, a page at a time.
            Some(_) => {
                let join = self.database.engine.in_this_order();
                SqlFilter::behind(format!(
                    "{columns} batch_items {join} answers ON answers.id = answer_id WHERE true"
                ))
            }
            None => SqlFilter::behind(format!("{columns} answers WHERE true")),
        };
        which.and("batch_id =", batch_id.as_ref());
        which.and("answer_id <", cursor.filter(|_| batch_id.is_some()));
        which.and("answers.id <", cursor);
        // An item of a batch has its answer's id long before it is asked: ids do not tell when an
        // answer was given.
        which.and("answers.created_at >=", since.map(|time| time.to_string()));
        which.and("answers.created_at <", until.map(|time| time.to_string()));
        which.and("answers.scene_id =", scene_id.as_ref());
        which.and("answers.status =", status.as_ref());
        which
            .first(
                if batch_id.is_some() { "answer_id DESC" } else { "answers.id DESC" },
                limit,
                &self.database.reader,
            )
            .await
    }

    /// Removes some answers of a scene, few enough that nobody waits long for the database. Their
    /// ids; none when none are left.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn delete_some_answers(&self, scene_id: &str) -> Result<Vec<String>, StoreError> {
        let sql = "DELETE FROM answers WHERE id IN (SELECT id FROM answers WHERE scene_id = $1 LIMIT 500) RETURNING id";
        Ok(sqlx::query_scalar(sql).bind(scene_id).fetch_all(self.database.writer.pool()).await?)
    }
}
