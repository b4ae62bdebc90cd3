//! Answers, kept as they were given.

use super::records::RECORD_VERSION;
use super::{Store, StoreError, now};
use sqlx::sqlite::SqliteRow;
use sqlx::{FromRow, Row};

/// An answer as stored: the JSON the caller got, whole, and the parse it is about. It is given out again as it is: no version of the
/// service can fail to read it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AnswerRow {
    pub id: String,
    pub parse_id: String,
    pub body: String,
}

impl FromRow<'_, SqliteRow> for AnswerRow {
    fn from_row(row: &SqliteRow) -> sqlx::Result<Self> {
        Ok(Self { id: row.try_get("id")?, parse_id: row.try_get("parse_id")?, body: row.try_get("body")? })
    }
}

impl Store {
    /// Keeps an answer; `false` when its scene was deleted meanwhile.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn insert_answer(&self, id: &str, scene_id: &str, parse_id: &str, body: &str) -> Result<bool, StoreError> {
        let sql = "INSERT INTO answers (id, scene_id, parse_id, body, created_at, record_version)
                   SELECT ?1, ?2, ?3, ?4, ?5, ?6 WHERE EXISTS (SELECT 1 FROM scenes WHERE id = ?2) AND EXISTS (SELECT 1 FROM parses WHERE id = ?3)";
        let inserted = sqlx::query(sql)
            .bind(id)
            .bind(scene_id)
            .bind(parse_id)
            .bind(body)
            .bind(now())
            .bind(RECORD_VERSION)
            .execute(&self.writer)
            .await?;
        Ok(inserted.rows_affected() > 0)
    }

    /// # Errors
    /// [`StoreError::Database`].
    pub async fn answer(&self, id: &str) -> Result<Option<AnswerRow>, StoreError> {
        Ok(sqlx::query_as("SELECT id, parse_id, body FROM answers WHERE id = ?")
            .bind(id)
            .fetch_optional(&self.reader)
            .await?)
    }
}
