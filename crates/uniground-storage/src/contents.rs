//! Uploaded bytes, by hash.

use super::{Store, StoreError};

impl Store {
    /// Whether these bytes are stored.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn has_content(&self, hash: &str) -> Result<bool, StoreError> {
        let found: Option<i64> = sqlx::query_scalar("SELECT 1 FROM contents WHERE hash = $1")
            .bind(hash)
            .fetch_optional(&self.reader)
            .await?;
        Ok(found.is_some())
    }

    /// Hashes of everything that was uploaded.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn all_contents(&self) -> Result<Vec<String>, StoreError> {
        Ok(sqlx::query_scalar("SELECT hash FROM contents ORDER BY hash")
            .fetch_all(&self.reader)
            .await?)
    }
}
