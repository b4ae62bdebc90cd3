//! Stored answers.

use super::database::{Database, SqlFilter};
use super::records::RECORD_VERSION;
use super::writer::Writer;
use super::{StoreError, now};
use jiff::Timestamp;
use sqlx::any::AnyRow;
use sqlx::{FromRow, Row};
use std::sync::Arc;
use tokio::sync::{mpsc, oneshot};

/// An answer as stored: the complete JSON that the caller received, and the parse it refers to. The
/// JSON is returned unchanged, so every version of the service can return it.
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

/// Which answers to list. An empty field matches every answer.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct AnswerFilter {
    pub scene_id: Option<String>,
    pub batch_id: Option<String>,
    /// The answer's `status`.
    pub status: Option<String>,
    /// Created at or after this time.
    pub since: Option<Timestamp>,
    /// Created before this time.
    pub until: Option<Timestamp>,
}

/// An answer to be stored.
#[derive(Debug)]
pub struct NewAnswer {
    pub id: String,
    pub scene_id: String,
    pub parse_id: String,
    pub body: String,
    /// The conversation that it belongs to, with the caller's name for it.
    pub session: Option<String>,
}

struct QueuedAnswer {
    answer: NewAnswer,
    reply: oneshot::Sender<Result<bool, StoreError>>,
}

/// Queue of answers to be written. Each answer is on disk before its caller gets it. Answers that
/// arrive together are written in one transaction, with a single wait for the disk.
#[derive(Clone)]
pub(super) struct AnswerQueue(mpsc::Sender<QueuedAnswer>);

/// Capacity of the queue. Further callers wait for a free place.
const QUEUE_CAPACITY: usize = 1024;
/// Answers written in one transaction.
const ANSWERS_PER_TRANSACTION: usize = 128;

impl AnswerQueue {
    pub fn start(writer: Writer) -> Self {
        let (sender, mut queue) = mpsc::channel::<QueuedAnswer>(QUEUE_CAPACITY);
        tokio::spawn(async move {
            let mut together = Vec::new();
            while queue.recv_many(&mut together, ANSWERS_PER_TRANSACTION).await > 0 {
                let (answers, callers): (Vec<_>, Vec<_>) =
                    together.drain(..).map(|waiting| (waiting.answer, waiting.reply)).unzip();
                // A disconnected caller needs no result.
                match write(&writer, &answers).await {
                    Ok(reply) => callers
                        .into_iter()
                        .zip(reply)
                        .for_each(|(caller, reply)| drop(caller.send(Ok(reply)))),
                    Err(error) => {
                        let error = Arc::new(error);
                        callers.into_iter().for_each(|caller| {
                            drop(caller.send(Err(StoreError::Shared(error.clone()))));
                        });
                    }
                }
            }
        });
        Self(sender)
    }
}

/// Writes answers in one transaction. Returns for each whether its scene and parse still exist.
async fn write(writer: &Writer, answers: &[NewAnswer]) -> Result<Vec<bool>, StoreError> {
    let sql = "INSERT INTO answers (id, scene_id, parse_id, body, created_at, record_version, session)
               SELECT $1, $2, $3, $4, $5, $6, $7 WHERE EXISTS (SELECT 1 FROM scenes WHERE id = $2) AND EXISTS (SELECT 1 FROM parses WHERE id = $3)
               ON CONFLICT (id) DO UPDATE SET id = answers.id";
    let time = now();
    let mut tx = writer.begin().await?;
    let mut reply = Vec::with_capacity(answers.len());
    for NewAnswer { id, scene_id, parse_id, body, session } in answers {
        let inserted = sqlx::query(sql)
            .bind(id)
            .bind(scene_id)
            .bind(parse_id)
            .bind(body)
            .bind(&time)
            .bind(i64::from(RECORD_VERSION))
            .bind(session)
            .execute(&mut *tx)
            .await?;
        reply.push(inserted.rows_affected() > 0);
    }
    tx.commit().await?;
    Ok(reply)
}

/// Repository of answers.
#[derive(Clone)]
pub struct AnswerRepository {
    pub(super) database: Arc<Database>,
    pub(super) queue: AnswerQueue,
}

impl AnswerRepository {
    /// Returns the question that was asked under an idempotency key, and the id that its answer has
    /// or will have. A new key is stored for this question.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn claim_idempotency_key(
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

    /// Stores an answer. Returns `false` if its scene was deleted meanwhile.
    ///
    /// # Errors
    /// [`StoreError`].
    pub async fn insert_answer(&self, answer: NewAnswer) -> Result<bool, StoreError> {
        let (reply, receiver) = oneshot::channel();
        let closed = || StoreError::Database(sqlx::Error::PoolClosed);
        self.queue.0.send(QueuedAnswer { answer, reply }).await.map_err(|_| closed())?;
        receiver.await.map_err(|_| closed())?
    }

    /// # Errors
    /// [`StoreError::Database`].
    pub async fn answer(&self, id: &str) -> Result<Option<AnswerRow>, StoreError> {
        Ok(sqlx::query_as("SELECT id, parse_id, body FROM answers WHERE id = $1")
            .bind(id)
            .fetch_optional(&self.database.reader)
            .await?)
    }

    /// Returns the newest answer of a conversation about a scene.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn latest_of_session(
        &self,
        session: &str,
        scene_id: &str,
    ) -> Result<Option<AnswerRow>, StoreError> {
        let sql = "SELECT id, parse_id, body FROM answers
                   WHERE session = $1 AND scene_id = $2 ORDER BY id DESC LIMIT 1";
        Ok(sqlx::query_as(sql)
            .bind(session)
            .bind(scene_id)
            .fetch_optional(&self.database.reader)
            .await?)
    }

    /// Returns answers, newest first; with a `cursor` (an id) only those before it.
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
        // Include only the requested conditions, so that their index is used.
        let columns = "SELECT answers.id, parse_id, body FROM";
        let mut which = match batch_id {
            // Join through the batch, one page at a time.
            Some(_) => {
                let join = self.database.engine.ordered_join();
                SqlFilter::new(format!(
                    "{columns} batch_items {join} answers ON answers.id = answer_id WHERE true"
                ))
            }
            None => SqlFilter::new(format!("{columns} answers WHERE true")),
        };
        which.and_if_some("batch_id =", batch_id.as_ref());
        which.and_if_some("answer_id <", cursor.filter(|_| batch_id.is_some()));
        which.and_if_some("answers.id <", cursor);
        // An item of a batch gets its answer's id long before it is answered, so the order of ids
        // does not tell when an answer was created.
        which.and_if_some("answers.created_at >=", since.map(|time| time.to_string()));
        which.and_if_some("answers.created_at <", until.map(|time| time.to_string()));
        which.and_if_some("answers.scene_id =", scene_id.as_ref());
        which.and_if_some("answers.status =", status.as_ref());
        which
            .fetch(
                if batch_id.is_some() { "answer_id DESC" } else { "answers.id DESC" },
                limit,
                &self.database.reader,
            )
            .await
    }

    /// Deletes up to 500 answers of a scene, to hold the write lock only briefly. Returns their
    /// ids, or none when there are no more.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn delete_some_answers(&self, scene_id: &str) -> Result<Vec<String>, StoreError> {
        let sql = "DELETE FROM answers WHERE id IN (SELECT id FROM answers WHERE scene_id = $1 LIMIT 500) RETURNING id";
        Ok(sqlx::query_scalar(sql).bind(scene_id).fetch_all(self.database.writer.pool()).await?)
    }
}
