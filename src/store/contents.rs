//! Uploaded bytes, by hash.

use super::{Store, StoreError, now};

impl Store {
    /// Whether these bytes are stored.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn has_content(&self, hash: &str) -> Result<bool, StoreError> {
        let found: Option<i64> = sqlx::query_scalar("SELECT 1 FROM contents WHERE hash = ?")
            .bind(hash)
            .fetch_optional(&self.reader)
            .await?;
        Ok(found.is_some())
    }

    /// Records bytes whose blob is in place; recording them twice is fine.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn insert_content(&self, hash: &str, bytes: u64) -> Result<(), StoreError> {
        sqlx::query("INSERT INTO contents (hash, bytes, created_at) VALUES (?, ?, ?) ON CONFLICT DO NOTHING")
            .bind(hash)
            .bind(i64::try_from(bytes).unwrap_or(i64::MAX))
            .bind(now())
            .execute(&self.writer)
            .await?;
        Ok(())
    }
}
