//! Statistics of the store. They are read without blocking writers.

use super::StoreError;
use super::data_folder::DataFolder;
use super::database::{Database, Engine, to_unsigned};
use sqlx::any::AnyRow;
use sqlx::{AssertSqlSafe, FromRow, Row};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::{fs, io};
use tokio::task::spawn_blocking;

/// Counts and sizes of everything that is stored.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Figures {
    pub scenes: u32,
    pub parses: u32,
    pub instances: u32,
    pub answers: u32,
    /// By state, as stored.
    pub batches: BTreeMap<String, u32>,
    /// By kind and state.
    pub jobs: Vec<JobFigures>,
    /// The database with its write-ahead log.
    pub database_bytes: u64,
    /// Free space on its disk.
    pub free_bytes: u64,
}

/// Jobs of one kind in one state.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct JobFigures {
    pub kind: String,
    pub state: String,
    pub jobs: u32,
    /// Creation time of the oldest of them.
    pub oldest: String,
}

impl FromRow<'_, AnyRow> for JobFigures {
    fn from_row(row: &AnyRow) -> sqlx::Result<Self> {
        Ok(Self {
            kind: row.try_get("kind")?,
            state: row.try_get("state")?,
            jobs: to_unsigned(row.try_get("jobs")?)?,
            oldest: row.try_get("oldest")?,
        })
    }
}

/// Repository of counts and sizes.
#[derive(Clone)]
pub struct StatisticsRepository {
    pub(super) database: Arc<Database>,
    pub(super) folder: DataFolder,
}

impl StatisticsRepository {
    /// Counts what is stored. It takes milliseconds, and longer with millions of answers.
    ///
    /// # Errors
    /// [`StoreError`].
    pub async fn figures(&self) -> Result<Figures, StoreError> {
        // Take the number of instances from reports: counting the rows would read all of them.
        let (things, others) = (
            self.database.engine.json_number("parse_report", "instances"),
            self.database.engine.json_number("parse_report", "parts_and_wholes"),
        );
        let counts = format!(
            "SELECT (SELECT count(*) FROM scenes), (SELECT count(*) FROM parses),
             (SELECT CAST(coalesce(sum({things} + {others}), 0) AS bigint) FROM parses), (SELECT count(*) FROM answers)"
        );
        let counts: (i64, i64, i64, i64) =
            sqlx::query_as(AssertSqlSafe(counts)).fetch_one(&self.database.reader).await?;
        let batches: Vec<(String, i64)> =
            sqlx::query_as("SELECT state, count(*) FROM batches GROUP BY state")
                .fetch_all(&self.database.reader)
                .await?;
        let batches = batches
            .into_iter()
            .map(|(state, batches)| Ok((state, to_unsigned(batches)?)))
            .collect::<sqlx::Result<_>>()?;
        let jobs = "SELECT kind, state, count(*) AS jobs, min(created_at) AS oldest FROM jobs GROUP BY kind, state ORDER BY kind, state";
        let jobs = sqlx::query_as(jobs).fetch_all(&self.database.reader).await?;
        let (folder, of_server) = (self.folder.clone(), self.bytes_on_server().await?);
        let sizes = spawn_blocking(move || {
            let here = || {
                let database = folder.database();
                let journal = fs::metadata(format!("{database}-wal")).map_or(0, |file| file.len());
                Ok::<_, io::Error>(fs::metadata(database)?.len() + journal)
            };
            Ok::<_, io::Error>((of_server.map_or_else(here, Ok)?, folder.free_bytes()?))
        });
        let (database_bytes, free_bytes) = sizes.await.map_err(io::Error::other)??;
        Ok(Figures {
            scenes: to_unsigned(counts.0)?,
            parses: to_unsigned(counts.1)?,
            instances: to_unsigned(counts.2)?,
            answers: to_unsigned(counts.3)?,
            batches,
            jobs,
            database_bytes,
            free_bytes,
        })
    }

    /// Returns the size of a PostgreSQL database, bytes.
    async fn bytes_on_server(&self) -> Result<Option<u64>, StoreError> {
        let Engine::Postgres = self.database.engine else { return Ok(None) };
        let bytes = sqlx::query_scalar("SELECT pg_database_size(current_database())")
            .fetch_one(&self.database.reader);
        Ok(Some(to_unsigned(bytes.await?)?))
    }
}

#[cfg(test)]
mod tests {
    use crate::{BlobHome, Location, NewJob, Store};
    use camino::Utf8Path;

    fn written(kind: &str) -> NewJob<'_> {
        NewJob { kind, payload: "{}", key_id: None, done: None }
    }

    #[tokio::test]
    async fn jobs_are_counted_by_kind_and_state_with_the_oldest_creation_time() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(
            Utf8Path::from_path(folder.path()).unwrap(),
            &Location::Folder,
            &BlobHome::Folder,
        )
        .await
        .unwrap();
        let empty = store.statistics.figures().await.unwrap();
        assert_eq!((empty.scenes, empty.answers, empty.jobs.len()), (0, 0, 0));
        assert!(empty.database_bytes > 4096 && empty.free_bytes > 0);
        let first = store.jobs.insert_job("s", &written("parse")).await.unwrap();
        store.jobs.insert_job("s", &written("parse")).await.unwrap();
        store.jobs.insert_job("s", &written("naming")).await.unwrap();
        store.jobs.claim_job("naming").await.unwrap();
        let jobs = store.statistics.figures().await.unwrap().jobs;
        let counted: Vec<_> =
            jobs.iter().map(|j| (j.kind.as_str(), j.state.as_str(), j.jobs)).collect();
        assert_eq!(counted, [("naming", "running", 1), ("parse", "queued", 2)]);
        assert_eq!(jobs[1].oldest, first.created_at);
    }
}
