//! Answers, kept as they were given.

use super::{Store, StoreError, now};

/// An answer as stored: the JSON the caller got, and the parse it is about.
#[derive(Debug, Clone, PartialEq, Eq, sqlx::FromRow)]
pub struct AnswerRow {
    pub id: String,
    pub parse_id: String,
    pub body: String,
}

impl Store {
    /// Keeps an answer; `false` when its scene was deleted meanwhile.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn insert_answer(&self, id: &str, scene_id: &str, parse_id: &str, body: &str) -> Result<bool, StoreError> {
        let sql = "INSERT INTO answers (id, scene_id, parse_id, body, created_at)
                   SELECT ?1, ?2, ?3, ?4, ?5 WHERE EXISTS (SELECT 1 FROM scenes WHERE id = ?2) AND EXISTS (SELECT 1 FROM parses WHERE id = ?3)";
        let inserted = sqlx::query(sql)
            .bind(id)
            .bind(scene_id)
            .bind(parse_id)
            .bind(body)
            .bind(now())
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
