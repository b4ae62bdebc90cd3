//! SQLite and the blob folder. Typed functions; no SQL elsewhere.
//!
//! One writing connection and a pool of readers over the same file (WAL). A scene points at the bytes it was uploaded as
//! (`contents`) and at a finished parse of them (`parses`); both are shared by scenes with the same content and settings.

mod announcements;
mod answers;
mod backup;
mod batches;
mod blobs;
mod contents;
mod copy;
mod corrections;
mod data_folder;
mod figures;
mod growth;
mod health;
mod ids;
mod jobs;
mod keys;
mod parses;
mod records;
mod retention;
mod scenes;
mod sweep;
mod uploads;
mod vlm;
mod writer;

pub use answers::{AnswerFilter, AnswerRow, NewAnswer};
pub use backup::{BackedUp, BackupError, Restored, Source, Target, back_up, check, restore};
pub use batches::{BatchRow, ClosedItem, ItemRow, NewBatch, NewItem, OpenItem, Resumed, Submitted};
pub use blobs::{Blobs, Damage, GrowingFile, KeptCheckpoints, Look, Measured, Scratch, size_of};
pub use corrections::NewCorrection;
pub use figures::{Figures, JobFigures};
pub use growth::{Continued, Grew, Growth};
pub use health::StoreHealth;
pub use jobs::{JobFilter, JobRow, JobState, NewJob, Recovery};
pub use keys::KeyRow;
pub use parses::{NewParse, ParseRow};
pub use records::ParseRecord;
pub use retention::{Aged, Before, Due};
pub use scenes::{Inserted, NewSceneRow, SceneFilter, SceneRow, SceneRowChange};
pub use sweep::{KEEP_QUARANTINE_DAYS, Strays};
pub use uploads::{CameOf, Unfinished, UploadRow, WantedScene};

use answers::AnswerQueue;
use camino::{Utf8Path, Utf8PathBuf};
use data_folder::DataFolder;
use ids::Ids;
use jiff::Timestamp;
use sqlx::SqlSafeStr;
use sqlx::migrate::{Migration, MigrationType, Migrator};
use sqlx::sqlite::{SqliteConnectOptions, SqliteJournalMode, SqlitePool, SqlitePoolOptions, SqliteSynchronous};
use std::io;
use std::sync::Arc;
use std::time::Duration;
use tempfile::TempDir;
use tokio::task::spawn_blocking;
use writer::Writer;

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
    #[error("it holds other things ({found}) and is no data folder of uniground's: choose an empty one")]
    NotOurs { found: String },
    #[error("{folder} is no data folder of uniground's")]
    NoDataFolder { folder: Utf8PathBuf },
    #[error("a stored record can not be read")]
    Record(#[from] serde_json::Error),
    /// What several writes failed of that were made as one.
    #[error(transparent)]
    Together(Arc<StoreError>),
}

impl StoreError {
    /// Whether the disk is full.
    #[must_use]
    pub fn is_full(&self) -> bool {
        match self {
            // SQLITE_FULL, and no room for the file readers share.
            Self::Database(error) => matches!(sqlite_code(error), Some(13 | 4874)),
            Self::Blobs(error) => is_disk_full(error),
            Self::Together(error) => error.is_full(),
            _ => false,
        }
    }

    /// Whether somebody else holds the database: it may be free again in a moment.
    #[must_use]
    pub fn is_busy(&self) -> bool {
        match self {
            Self::Database(sqlx::Error::PoolTimedOut) => true,
            // SQLITE_BUSY and SQLITE_LOCKED, whatever their extended code.
            Self::Database(error) => sqlite_code(error).is_some_and(|code| matches!(code & 0xff, 5 | 6)),
            Self::Together(error) => error.is_busy(),
            _ => false,
        }
    }
}

fn sqlite_code(error: &sqlx::Error) -> Option<i32> {
    error.as_database_error()?.code()?.parse().ok()
}

/// Whether a file could not be written for want of room.
#[must_use]
pub fn is_disk_full(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded | io::ErrorKind::FileTooLarge)
}

/// Handle to everything stored. Cheap to clone.
#[derive(Clone)]
pub struct Store {
    reader: SqlitePool,
    writer: Writer,
    answers: AnswerQueue,
    ids: Ids,
    pub blobs: Blobs,
    folder: DataFolder,
    /// Where the database is, if this is [a copy](Self::open_copy); it goes with the last handle.
    _copy: Option<Arc<TempDir>>,
}

/// How long SQLite waits for a lock that somebody else holds.
const BUSY_TIMEOUT: Duration = Duration::from_secs(1);
const READERS: u32 = 4;

impl Store {
    /// Opens or creates the store below `data_dir`, brings the schema up to date and clears what an interrupted run left.
    ///
    /// # Errors
    /// [`StoreError`] when the folder or the database can not be used.
    pub async fn open(data_dir: &Utf8Path) -> Result<Self, StoreError> {
        let store = Self::open_as_it_is(data_dir).await?;
        store.forget_unused_rows().await?;
        store.forget_half_received_batches().await?;
        store.settle_what_was_left().await?;
        // What can not be swept is no reason not to serve.
        if let Err(error) = store.sweep(Duration::ZERO).await {
            tracing::warn!(error = &error as &dyn std::error::Error, "the data folder could not be swept");
        }
        store.remove_stray_uploads().await?;
        let left_behind = store.blobs.left_behind()?;
        store.blobs.remove_later(left_behind);
        Ok(store)
    }

    /// Opens the store and leaves everything where it is.
    ///
    /// # Errors
    /// As [`open`](Self::open).
    pub async fn open_as_it_is(data_dir: &Utf8Path) -> Result<Self, StoreError> {
        let path = data_dir.to_owned();
        let opened = spawn_blocking(move || {
            let folder = DataFolder::open(&path)?;
            let blobs = Blobs::open(&path)?;
            Ok::<_, StoreError>((folder, blobs))
        });
        let (folder, blobs) = opened.await.map_err(io::Error::other)??;
        let database = folder.database();
        Self::connect(&database, folder, blobs).await
    }

    /// As [`open_as_it_is`](Self::open_as_it_is), where there is a store already.
    ///
    /// # Errors
    /// As [`open`](Self::open); [`StoreError::NoDataFolder`].
    pub async fn open_known(data_dir: &Utf8Path) -> Result<Self, StoreError> {
        DataFolder::identity(data_dir)?;
        Self::open_as_it_is(data_dir).await
    }

    /// A store over a database, which is brought up to date.
    async fn connect(database: &Utf8Path, folder: DataFolder, blobs: Blobs) -> Result<Self, StoreError> {
        let options = SqliteConnectOptions::new()
            .filename(database)
            .create_if_missing(true)
            .journal_mode(SqliteJournalMode::Wal)
            // What a caller was told is stored is on the disk.
            .synchronous(SqliteSynchronous::Full)
            .foreign_keys(true)
            .busy_timeout(BUSY_TIMEOUT);
        let writer = Writer::open(options.clone()).await?;
        migrations().run(writer.pool()).await?;
        let reader = SqlitePoolOptions::new().max_connections(READERS).connect_with(options.read_only(true)).await?;
        let newest = "SELECT max(id) FROM (SELECT max(id) AS id FROM scenes UNION ALL SELECT max(id) FROM jobs
                      UNION ALL SELECT max(id) FROM answers UNION ALL SELECT max(id) FROM parses
                      UNION ALL SELECT max(id) FROM batches
                      UNION ALL SELECT max(id) FROM corrections UNION ALL SELECT max(id) FROM uploads
                      UNION ALL SELECT max(id) FROM keys UNION ALL SELECT max(id) FROM audit)";
        let newest: Option<String> = sqlx::query_scalar(newest).fetch_one(&reader).await?;
        let answers = AnswerQueue::start(writer.clone());
        let store = Self { reader, writer, answers, ids: Ids::after(newest.as_deref()), blobs, folder, _copy: None };
        store.introduce().await?;
        Ok(store)
    }

    /// Lets database and data folder know each other. A database that is new here, or comes from another folder, has no say over files that
    /// are older than that.
    async fn introduce(&self) -> Result<(), StoreError> {
        let known: Option<String> = sqlx::query_scalar("SELECT id FROM data_folder").fetch_optional(&self.reader).await?;
        if known.as_ref() == Some(&self.folder.id) {
            return Ok(());
        }
        let mut tx = self.writer.begin().await?;
        sqlx::query("DELETE FROM data_folder").execute(&mut *tx).await?;
        // A database of before folders had ids has known its own since its first scan.
        let since = if known.is_none() { "coalesce((SELECT min(created_at) FROM contents), ?2)" } else { "?2" };
        let sql = format!("INSERT INTO data_folder (id, since) VALUES (?1, {since})");
        sqlx::query(sqlx::AssertSqlSafe(sql)).bind(&self.folder.id).bind(now()).execute(&mut *tx).await?;
        tx.commit().await
    }

    /// An id for something new, greater than all before it.
    #[must_use]
    pub fn new_id(&self) -> String {
        self.ids.at(Timestamp::now())
    }

    /// The first id that could have been given at a time: ids before it are older.
    #[must_use]
    pub fn first_id_at(time: Timestamp) -> String {
        let millis = u64::try_from(time.as_millisecond()).unwrap_or(0);
        uuid::Builder::from_unix_timestamp_millis(millis, &[0; 10]).into_uuid().to_string()
    }

    /// Closes the database; WAL is checkpointed.
    pub async fn close(&self) {
        self.reader.close().await;
        self.writer.close().await;
    }

    /// Forgets content no scene refers to: the loser of two uploads under one key.
    async fn forget_unused_rows(&self) -> Result<(), StoreError> {
        for unused in [
            "DELETE FROM parses WHERE content_hash NOT IN (SELECT content_hash FROM scenes) AND id NOT IN (SELECT parse_id FROM answers)",
            "DELETE FROM contents WHERE hash NOT IN (SELECT content_hash FROM scenes) AND hash NOT IN (SELECT content_hash FROM parses)",
        ] {
            sqlx::query(unused).execute(self.writer.pool()).await?;
        }
        Ok(())
    }
}

/// What brings a database of any version up to date, in order. A file that has been released is never changed.
const MIGRATIONS: [(i64, &str, &str); 14] = [
    (1, "scenes parses jobs answers", include_str!("../../migrations/0001_scenes_parses_jobs_answers.sql")),
    (2, "instance names spending", include_str!("../../migrations/0002_instance_names_spending.sql")),
    (3, "lanes records", include_str!("../../migrations/0003_lanes_records.sql")),
    (4, "nothing lost", include_str!("../../migrations/0004_nothing_lost.sql")),
    (5, "batches", include_str!("../../migrations/0005_batches.sql")),
    (6, "keys audit lists webhooks", include_str!("../../migrations/0006_keys_audit_lists_webhooks.sql")),
    (7, "superseded parses", include_str!("../../migrations/0007_superseded_parses.sql")),
    (8, "name indexes", include_str!("../../migrations/0008_name_indexes.sql")),
    (9, "corrections", include_str!("../../migrations/0009_corrections.sql")),
    (10, "scene to map", include_str!("../../migrations/0010_scene_to_map.sql")),
    (11, "question keys", include_str!("../../migrations/0011_question_keys.sql")),
    (12, "uploads", include_str!("../../migrations/0012_uploads.sql")),
    (13, "scene changes", include_str!("../../migrations/0013_scene_changes.sql")),
    (14, "labels", include_str!("../../migrations/0014_labels.sql")),
];

fn migrations() -> Migrator {
    let migration = |&(version, name, sql): &(i64, &'static str, &'static str)| {
        Migration::new(version, name.into(), MigrationType::Simple, sql.into_sql_str(), false)
    };
    Migrator::with_migrations(MIGRATIONS.iter().map(migration).collect())
}

/// Rows of a page of which one more was asked for than it has, and the id to go on after, where there is more.
#[must_use]
pub fn page<T>(mut rows: Vec<T>, limit: u32, id: impl Fn(&T) -> &str) -> (Vec<T>, Option<String>) {
    let more = rows.len() > limit as usize;
    rows.truncate(limit as usize);
    let next_cursor = rows.last().filter(|_| more).map(|row| id(row).to_owned());
    (rows, next_cursor)
}

/// The time now, as stored.
pub(crate) fn now() -> String {
    Timestamp::now().to_string()
}
