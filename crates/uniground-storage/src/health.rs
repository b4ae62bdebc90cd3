//! Whether what is stored can be read and written now.

use super::data_folder::DataFolder;
use super::database::{Database, Engine};
use super::{Blobs, IntegrityRepository, StoreError};
use std::io;
use std::time::Duration;
use tokio::task::spawn_blocking;
use tokio::time::timeout;
use uniground_models::with_causes;

/// How each part of the store is.
#[derive(Debug, Clone, Default)]
pub struct StoreHealth {
    /// Why the database can not be read or written, if so.
    pub database: Option<String>,
    /// Whether its file is damaged: what can not be read now will not be read later.
    pub is_damaged: bool,
    /// Why the blob folder can not be read, or the object store in its place can not be had, if
    /// so.
    pub blobs: Option<String>,
    /// Why the disk takes no more, if so.
    pub disk: Option<String>,
}

/// A database that takes longer is not ready.
const PATIENCE: Duration = Duration::from_secs(1);
/// With less room, uploads are bound to fail.
const LEAST_FREE_BYTES: u64 = 64 << 20;
/// Tables that are read, and the column their rows are ordered by.
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

/// Checks whether the store can be read and written now.
#[derive(Clone)]
pub struct HealthProbe {
    pub(super) database: Database,
    pub(super) blobs: Blobs,
    pub(super) folder: DataFolder,
}

impl HealthProbe {
    /// Tries everything a request may need: a write, a read, room on the disk.
    pub async fn health(&self) -> StoreHealth {
        let written = timeout(PATIENCE, self.write_something()).await;
        // Readers that are all at work are no trouble.
        let read = timeout(PATIENCE, self.read_something()).await.unwrap_or(Ok(()));
        let is_damaged =
            [read.as_ref().err(), written.as_ref().ok().and_then(|written| written.as_ref().err())]
                .into_iter()
                .flatten()
                .any(StoreError::is_damaged);
        let database = match (read, written) {
            (Err(error), _) | (Ok(()), Ok(Err(error))) => Some(with_causes(&error)),
            (Ok(()), Err(_)) => Some(format!("a write took longer than {} s", PATIENCE.as_secs())),
            (Ok(()), Ok(Ok(()))) => None,
        };
        let database = database.map(|trouble| match is_damaged {
            true => format!("its file is damaged, restore a backup: {trouble}"),
            false => trouble,
        });
        let reached = match timeout(PATIENCE, self.blobs.reach()).await {
            Ok(reached) => reached.err().map(|error| with_causes(&error)),
            Err(_) => Some(format!("the object store took longer than {} s", PATIENCE.as_secs())),
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

    /// Bytes that may still be written.
    ///
    /// # Errors
    /// [`StoreError::Blobs`].
    pub fn free_bytes(&self) -> Result<u64, StoreError> {
        Ok(self.folder.free_bytes()?)
    }

    async fn write_something(&self) -> Result<(), StoreError> {
        let mut tx = self.database.writer.begin().await?;
        sqlx::query("UPDATE data_folder SET since = since").execute(&mut *tx).await?;
        tx.commit().await
    }

    /// Reads the oldest and the newest row of every large table, and what a question about the
    /// newest parse needs: from the file, not from memory.
    async fn read_something(&self) -> Result<(), StoreError> {
        let mut connection = self.database.reader.acquire().await?;
        let columns = match self.database.engine {
            Engine::Sqlite => {
                // The pages that this connection keeps in memory may be all that is left of the
                // file.
                sqlx::query("PRAGMA shrink_memory").execute(&mut *connection).await?;
                "*"
            }
            // PostgreSQL has types that are not read here.
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
    /// What SQLite finds wrong with the database; nothing where all is well. PostgreSQL checks its
    /// own pages. Foreign keys: [`broken_references`](Self::broken_references).
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
