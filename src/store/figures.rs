//! How much is stored, in numbers. Read beside whoever writes.

use super::{Store, StoreError};
use sqlx::sqlite::SqliteRow;
use sqlx::{FromRow, Row};
use std::collections::BTreeMap;
use std::fs;
use std::io;
use tokio::task::spawn_blocking;

/// Numbers of everything that is stored.
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
    /// The database with its journal.
    pub database_bytes: u64,
    /// What may still be written beside it.
    pub free_bytes: u64,
}

/// Jobs of one kind in one state.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct JobFigures {
    pub kind: String,
    pub state: String,
    pub jobs: u32,
    /// When the oldest of them was asked for.
    pub oldest: String,
}

impl FromRow<'_, SqliteRow> for JobFigures {
    fn from_row(row: &SqliteRow) -> sqlx::Result<Self> {
        Ok(Self { kind: row.try_get("kind")?, state: row.try_get("state")?, jobs: row.try_get("jobs")?, oldest: row.try_get("oldest")? })
    }
}

impl Store {
    /// Counts what is stored. It takes milliseconds, and longer with millions of answers.
    ///
    /// # Errors
    /// [`StoreError`].
    pub async fn figures(&self) -> Result<Figures, StoreError> {
        // Instances as reports tell them: to count them would be to read them.
        let counts = "SELECT (SELECT count(*) FROM scenes), (SELECT count(*) FROM parses),
                      (SELECT coalesce(sum(coalesce(json_extract(parse_report, '$.instances'), 0)
                                           + coalesce(json_extract(parse_report, '$.parts_and_wholes'), 0)), 0) FROM parses),
                      (SELECT count(*) FROM answers)";
        let (scenes, parses, instances, answers) = sqlx::query_as(counts).fetch_one(&self.reader).await?;
        let batches: Vec<(String, u32)> =
            sqlx::query_as("SELECT state, count(*) FROM batches GROUP BY state").fetch_all(&self.reader).await?;
        // Ids are in order of time: the least is the oldest, and SQLite takes the other columns from its row.
        let jobs = "SELECT kind, state, count(*) AS jobs, min(id), created_at AS oldest FROM jobs GROUP BY kind, state";
        let jobs = sqlx::query_as(jobs).fetch_all(&self.reader).await?;
        let folder = self.folder.clone();
        let sizes = spawn_blocking(move || {
            let database = folder.database();
            let journal = fs::metadata(format!("{database}-wal")).map_or(0, |file| file.len());
            Ok::<_, io::Error>((fs::metadata(database)?.len() + journal, folder.free_bytes()?))
        });
        let (database_bytes, free_bytes) = sizes.await.map_err(io::Error::other)??;
        Ok(Figures { scenes, parses, instances, answers, batches: batches.into_iter().collect(), jobs, database_bytes, free_bytes })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::NewJob;
    use camino::Utf8Path;

    fn written(kind: &str) -> NewJob<'_> {
        NewJob { kind, payload: "{}", key_id: None, done: None }
    }

    #[tokio::test]
    async fn jobs_are_counted_by_kind_and_state_with_the_oldest_of_each() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(Utf8Path::from_path(folder.path()).unwrap()).await.unwrap();
        let empty = store.figures().await.unwrap();
        assert_eq!((empty.scenes, empty.answers, empty.jobs.len()), (0, 0, 0));
        assert!(empty.database_bytes > 4096 && empty.free_bytes > 0);
        let first = store.insert_job("s", &written("parse")).await.unwrap();
        store.insert_job("s", &written("parse")).await.unwrap();
        store.insert_job("s", &written("naming")).await.unwrap();
        store.claim_job("naming").await.unwrap();
        let jobs = store.figures().await.unwrap().jobs;
        let told: Vec<_> = jobs.iter().map(|j| (j.kind.as_str(), j.state.as_str(), j.jobs)).collect();
        assert_eq!(told, [("naming", "running", 1), ("parse", "queued", 2)]);
        assert_eq!(jobs[1].oldest, first.created_at);
    }
}
