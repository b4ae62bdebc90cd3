//! Uploaded contents, by hash.

use super::database::Database;
use super::{Blobs, StoreError};
use std::sync::Arc;

/// Repository of uploaded contents, stored once per SHA-256.
#[derive(Clone)]
pub struct ContentRepository {
    pub(super) database: Arc<Database>,
    pub(super) blobs: Blobs,
}

impl ContentRepository {
    /// Returns whether this content is stored.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn has_content(&self, hash: &str) -> Result<bool, StoreError> {
        let found: Option<i64> = sqlx::query_scalar("SELECT 1 FROM contents WHERE hash = $1")
            .bind(hash)
            .fetch_optional(&self.database.reader)
            .await?;
        Ok(found.is_some())
    }

    /// Returns the hashes of all stored contents.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn all_contents(&self) -> Result<Vec<String>, StoreError> {
        Ok(sqlx::query_scalar("SELECT hash FROM contents ORDER BY hash")
            .fetch_all(&self.database.reader)
            .await?)
    }
}
