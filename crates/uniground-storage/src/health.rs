//! Health checks of the store.

use super::data_folder::DataFolder;
use super::database::{Database, Engine};
use super::{Blobs, IntegrityRepository, StoreError};
use std::io;
use std::sync::Arc;
use std::time::Duration;
use tokio::task::spawn_blocking;
use tokio::time::timeout;
use uniground_models::with_causes;

/// The health of each part of the store.
#[derive(Debug, Clone, Default)]
pub struct StoreHealth {
    /// Why the database cannot be read or written, if so.
    pub database: Option<String>,
    /// Whether its file is damaged, so that a retry cannot succeed.
    pub is_damaged: bool,
    /// Why the blob folder cannot be read, or the object store cannot be used, if so.
    pub blobs: Option<String>,
    /// Why nothing can be written to the disk, if so.
    pub disk: Option<String>,
}

/// Timeout after which the database counts as not ready.
const DATABASE_TIMEOUT: Duration = Duration::from_secs(1);
/// With less free space, uploads are bound to fail.
const LEAST_FREE_BYTES: u64 = 64 << 20;
/// Tables to read, with the column that orders their rows.
const TABLES: [(&str, &str); 8] = [
    ("contents", "hash"),
    ("parses", "id"),
    ("instances", "parse_id"),
    ("scenes", "id"),
    ("answers", "id"),
    ("jobs", "id"),
    ("batch_items", "batch_id"),
    ("audit", "id"),
];

/// Checks whether the store can be read and written.
#[derive(Clone)]
pub struct HealthProbe {
    pub(super) database: Arc<Database>,
    pub(super) blobs: Blobs,
    pub(super) folder: DataFolder,
}

impl HealthProbe {
    /// Tries everything a request may need: a write, a read, free disk space.
    pub async fn health(&self) -> StoreHealth {
        let written = timeout(DATABASE_TIMEOUT, self.probe_write()).await;
        // If all readers are busy, that is no failure.
        let read = timeout(DATABASE_TIMEOUT, self.probe_read()).await.unwrap_or(Ok(()));
        let is_damaged =
            [read.as_ref().err(), written.as_ref().ok().and_then(|written| written.as_ref().err())]
                .into_iter()
                .flatten()
                .any(StoreError::is_damaged);
        let database = match (read, written) {
            (Err(error), _) | (Ok(()), Ok(Err(error))) => Some(with_causes(&error)),
            (Ok(()), Err(_)) => {
                Some(format!("a write took longer than {} s", DATABASE_TIMEOUT.as_secs()))
            }
            (Ok(()), Ok(Ok(()))) => None,
        };
        let database = database.map(|trouble| match is_damaged {
            true => format!("its file is damaged, restore a backup: {trouble}"),
            false => trouble,
        });
        let reached = match timeout(DATABASE_TIMEOUT, self.blobs.check_reachable()).await {
            Ok(reached) => reached.err().map(|error| with_causes(&error)),
            Err(_) => {
                Some(format!("the object store took longer than {} s", DATABASE_TIMEOUT.as_secs()))
            }
        };
        let (folder, blobs) = (self.folder.clone(), self.blobs.clone());
        let looked = spawn_blocking(move || {
            let readable = folder.check_marker().and_then(|()| blobs.scratch().map(drop));
            (readable, folder.free_bytes())
        });
        let (readable, free) =
            looked.await.unwrap_or_else(|error| (Err(io::Error::other(error)), Ok(u64::MAX)));
        let disk = match free {
            Ok(free) if free < LEAST_FREE_BYTES => {
                Some(format!("full: only {} MB are free", free >> 20))
            }
            Ok(_) => None,
            Err(error) => Some(error.to_string()),
        };
        StoreHealth {
            database,
            is_damaged,
            blobs: readable.err().map(|error| error.to_string()).or(reached),
            disk,
        }
    }

    /// Returns the free disk space, bytes.
    ///
    /// # Errors
    /// [`StoreError::Blobs`].
    pub fn free_bytes(&self) -> Result<u64, StoreError> {
        Ok(self.folder.free_bytes()?)
    }

    async fn probe_write(&self) -> Result<(), StoreError> {
        let mut tx = self.database.writer.begin().await?;
        sqlx::query("UPDATE data_folder SET since = since").execute(&mut *tx).await?;
        tx.commit().await
    }

    /// Reads the oldest and the newest row of every large table, and what a question about the
    /// newest parse needs: from the file, not from memory.
    async fn probe_read(&self) -> Result<(), StoreError> {
        let mut connection = self.database.reader.acquire().await?;
        let columns = match self.database.engine {
            Engine::Sqlite => {
                // Drop the connection's page cache, which could hide that the file is gone.
                sqlx::query("PRAGMA shrink_memory").execute(&mut *connection).await?;
                "*"
            }
            // PostgreSQL has column types that cannot be decoded here.
            Engine::Postgres => "1",
        };
        for (table, key) in TABLES {
            for order in ["ASC", "DESC"] {
                let sql = format!("SELECT {columns} FROM {table} ORDER BY {key} {order} LIMIT 1");
                sqlx::query(sqlx::AssertSqlSafe(sql)).fetch_optional(&mut *connection).await?;
            }
        }
        let sql = "SELECT count(*) FROM instances WHERE parse_id = (SELECT max(id) FROM parses) AND length(body) > 0";
        sqlx::query(sql).fetch_optional(&mut *connection).await?;
        Ok(())
    }
}

impl IntegrityRepository {
    /// Returns the problems that SQLite finds in the database; empty if it is intact. PostgreSQL
    /// checks its own pages. For foreign keys see [`broken_references`](Self::broken_references).
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn integrity(&self) -> Result<Vec<String>, StoreError> {
        if self.database.engine == Engine::Postgres {
            return Ok(Vec::new());
        }
        let mut complaints: Vec<String> =
            sqlx::query_scalar("PRAGMA integrity_check").fetch_all(&self.database.reader).await?;
        complaints.retain(|complaint| complaint != "ok");
        Ok(complaints)
    }
}
