//! Whether what is stored can be read and written now.

use super::database::Engine;
use super::{Store, StoreError};
use std::io;
use std::time::Duration;
use tokio::task::spawn_blocking;
use tokio::time::timeout;

/// How each part of the store is.
#[derive(Debug, Clone, Default)]
pub struct StoreHealth {
    /// Why the database can not be written, if so.
    pub database: Option<String>,
    /// Why the blob folder can not be read, or the object store in its place can not be had, if so.
    pub blobs: Option<String>,
    /// Why the disk takes no more, if so.
    pub disk: Option<String>,
}

/// A database that takes longer is not ready.
const PATIENCE: Duration = Duration::from_secs(1);
/// With less room, uploads are bound to fail.
const LEAST_FREE_BYTES: u64 = 64 << 20;

impl Store {
    /// Tries everything a request may need: a write, a read, room on the disk.
    pub async fn health(&self) -> StoreHealth {
        let database = match timeout(PATIENCE, self.write_something()).await {
            Ok(Ok(())) => None,
            Ok(Err(error)) => Some(uniground_core::models::with_causes(&error)),
            Err(_) => Some(format!("a write took longer than {} s", PATIENCE.as_secs())),
        };
        let reached = match timeout(PATIENCE, self.blobs.reach()).await {
            Ok(reached) => reached.err().map(|error| uniground_core::models::with_causes(&error)),
            Err(_) => Some(format!("the object store took longer than {} s", PATIENCE.as_secs())),
        };
        let (folder, blobs) = (self.folder.clone(), self.blobs.clone());
        let looked = spawn_blocking(move || {
            let readable = folder.check_marker().and_then(|()| blobs.scratch().map(drop));
            (readable, folder.free_bytes())
        });
        let (readable, free) = looked.await.unwrap_or_else(|error| (Err(io::Error::other(error)), Ok(u64::MAX)));
        let disk = match free {
            Ok(free) if free < LEAST_FREE_BYTES => Some(format!("full: only {} MB are free", free >> 20)),
            Ok(_) => None,
            Err(error) => Some(error.to_string()),
        };
        StoreHealth { database, blobs: readable.err().map(|error| error.to_string()).or(reached), disk }
    }

    /// Bytes that may still be written.
    ///
    /// # Errors
    /// [`StoreError::Blobs`].
    pub fn free_bytes(&self) -> Result<u64, StoreError> {
        Ok(self.folder.free_bytes()?)
    }

    /// What SQLite finds wrong with the database; nothing where all is well. PostgreSQL checks its own pages. Foreign keys: [`broken_references`](Self::broken_references).
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn integrity(&self) -> Result<Vec<String>, StoreError> {
        if self.engine == Engine::Postgres {
            return Ok(Vec::new());
        }
        let mut complaints: Vec<String> = sqlx::query_scalar("PRAGMA integrity_check").fetch_all(&self.reader).await?;
        complaints.retain(|complaint| complaint != "ok");
        Ok(complaints)
    }

    async fn write_something(&self) -> Result<(), StoreError> {
        let mut tx = self.writer.begin().await?;
        sqlx::query("UPDATE data_folder SET since = since").execute(&mut *tx).await?;
        tx.commit().await
    }
}
