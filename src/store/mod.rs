//! SQLite and the blob folder. Typed functions; no SQL elsewhere.
//!
//! One writing connection and a pool of readers over the same file (WAL). A scene points at the bytes it was uploaded as
//! (`contents`) and at a finished parse of them (`parses`); both are shared by scenes with the same content and settings.

mod answers;
mod blobs;
mod contents;
mod jobs;
mod parses;
mod records;
mod scenes;
mod vlm;

pub use answers::AnswerRow;
pub use blobs::{Blobs, Scratch};
pub use jobs::{JobRow, JobState};
pub use parses::{NewParse, ParseRow};
pub use records::ParseRecord;
pub use scenes::SceneRow;

use camino::Utf8Path;
use jiff::Timestamp;
use sqlx::SqlSafeStr;
use sqlx::migrate::{Migration, MigrationType, Migrator};
use sqlx::sqlite::{SqliteConnectOptions, SqliteJournalMode, SqlitePool, SqlitePoolOptions, SqliteSynchronous};
use std::fs::{self, File, TryLockError};
use std::io;
use std::sync::Arc;
use std::time::Duration;

#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    #[error("the database failed")]
    Database(#[from] sqlx::Error),
    #[error("the database schema could not be brought up to date")]
    Migration(#[from] sqlx::migrate::MigrateError),
    #[error("the blob folder failed")]
    Blobs(#[from] io::Error),
    #[error("another server uses this data folder")]
    InUse,
    #[error("a stored record can not be read")]
    Record(#[from] serde_json::Error),
}

/// Handle to everything stored. Cheap to clone.
#[derive(Clone)]
pub struct Store {
    reader: SqlitePool,
    writer: SqlitePool,
    pub blobs: Blobs,
    /// Held as long as the store lives: two servers over one folder would take each other's jobs and files.
    _lock: Arc<File>,
}

const BUSY_TIMEOUT: Duration = Duration::from_secs(10);
const READERS: u32 = 4;

impl Store {
    /// Opens or creates the store below `data_dir`, brings the schema up to date and clears what an interrupted run left.
    ///
    /// # Errors
    /// [`StoreError`] when the folder or the database can not be used.
    pub async fn open(data_dir: &Utf8Path) -> Result<Self, StoreError> {
        let lock = lock(data_dir)?;
        let blobs = Blobs::open(data_dir)?;
        let options = SqliteConnectOptions::new()
            .filename(data_dir.join("uniground.sqlite"))
            .create_if_missing(true)
            .journal_mode(SqliteJournalMode::Wal)
            .synchronous(SqliteSynchronous::Normal)
            .foreign_keys(true)
            .busy_timeout(BUSY_TIMEOUT);
        let writer = SqlitePoolOptions::new().max_connections(1).connect_with(options.clone()).await?;
        migrations().run(&writer).await?;
        let reader = SqlitePoolOptions::new().max_connections(READERS).connect_with(options.read_only(true)).await?;
        let store = Self { reader, writer, blobs, _lock: Arc::new(lock) };
        store.sweep().await?;
        Ok(store)
    }

    /// Answers when the database does.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn ping(&self) -> Result<(), StoreError> {
        sqlx::query("SELECT 1").execute(&self.reader).await?;
        Ok(())
    }

    /// Closes the database; WAL is checkpointed.
    pub async fn close(&self) {
        self.reader.close().await;
        self.writer.close().await;
    }

    /// Removes content no scene refers to (the loser of two uploads under one key) and blobs no row speaks of (what a crash
    /// between writing a blob and its row left behind).
    async fn sweep(&self) -> Result<(), StoreError> {
        for unused in [
            "DELETE FROM parses WHERE content_hash NOT IN (SELECT content_hash FROM scenes)",
            "DELETE FROM contents WHERE hash NOT IN (SELECT content_hash FROM scenes)",
        ] {
            sqlx::query(unused).execute(&self.writer).await?;
        }
        let contents: Vec<String> = sqlx::query_scalar("SELECT hash FROM contents").fetch_all(&self.reader).await?;
        let parses: Vec<String> = sqlx::query_scalar("SELECT id FROM parses").fetch_all(&self.reader).await?;
        let answers: Vec<String> = sqlx::query_scalar("SELECT id FROM answers").fetch_all(&self.reader).await?;
        Ok(self.blobs.keep_only(&contents, &parses, &answers)?)
    }
}

/// What brings a database of any version up to date, in order. A file that has been released is never changed.
const MIGRATIONS: [(i64, &str, &str); 3] = [
    (1, "scenes parses jobs answers", include_str!("../../migrations/0001_scenes_parses_jobs_answers.sql")),
    (2, "instance names spending", include_str!("../../migrations/0002_instance_names_spending.sql")),
    (3, "lanes records", include_str!("../../migrations/0003_lanes_records.sql")),
];

fn migrations() -> Migrator {
    let migration = |&(version, name, sql): &(i64, &'static str, &'static str)| {
        Migration::new(version, name.into(), MigrationType::Simple, sql.into_sql_str(), false)
    };
    Migrator::with_migrations(MIGRATIONS.iter().map(migration).collect())
}

fn lock(data_dir: &Utf8Path) -> Result<File, StoreError> {
    fs::create_dir_all(data_dir)?;
    let file = File::create(data_dir.join("lock"))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => Err(StoreError::InUse),
        Err(TryLockError::Error(error)) => Err(error.into()),
    }
}

/// The time now, as stored.
pub(crate) fn now() -> String {
    Timestamp::now().to_string()
}
