//! The database and the blob folder behind typed functions. SQL exists in this crate only.
//!
//! One transaction writes at a time; readers never wait. With PostgreSQL several processes may use
//! the same database (see `cluster`). A scene points at the content it was uploaded as (`contents`)
//! and at a finished parse of that content (`parses`). Scenes with the same content and settings
//! share both.

mod answers;
mod backup;
mod batches;
mod blobs;
mod cluster;
mod contents;
mod copy;
mod corrections;
mod data_folder;
mod data_migration;
mod database;
mod file_lock;
mod growth;
mod health;
mod ids;
mod integrity;
mod jobs;
mod keys;
mod local_locks;
mod lock_table;
mod migrations;
mod notifications;
mod orphan_folders;
mod orphan_objects;
mod parses;
mod records;
mod recovery;
mod reserve;
mod retention;
mod room_index;
mod scenes;
mod statistics;
mod uploads;
mod vectors;
mod vlm;
mod webhook_deliveries;
mod writer;

pub use answers::{AnswerFilter, AnswerRepository, AnswerRow, NewAnswer};
pub use backup::{
    BackupError, BackupReport, BackupSource, BackupTarget, RestoreReport, back_up, check, restore,
};
pub use batches::{
    BatchRepository, BatchRow, ClosedItem, ItemRow, NewBatch, NewItem, OpenItem, ReceivedBatch,
    ResumeOutcome, SubmitOutcome,
};
pub use blobs::{
    AccessKeys, BlobHome, Blobs, BlobsAt, Bucket, CheckDepth, DamagedFile, FolderSizes,
    GrowingFile, Links, ObjectStoreUnavailable, PinnedPath, Prepared, Scratch, StoredCheckpoints,
    size_of,
};
pub use cluster::{LEASE, NamedLock, StoreAccess};
pub use contents::ContentRepository;
pub use corrections::{CorrectionRepository, NewCorrection};
pub use data_migration::{
    MigratedFiles, MigrationError, MigrationProgress, MigrationReport, MigrationStep,
    StoreLocation, migrate_data,
};
pub use database::{Location, PostgresUrl};
pub use file_lock::FileLock;
pub use growth::{ContinuationReason, ContinuedParse, GrowthOutcome, SceneGrowth};
pub use health::{HealthProbe, StoreHealth};
pub use integrity::{BrokenReference, IntegrityRepository};
pub use jobs::{
    InsertedJob, JobFilter, JobLease, JobRecovery, JobRepository, JobRow, JobState, NewJob,
    QueueLengths,
};
pub use keys::{AuditWriter, KeyRepository, KeyRow};
pub use lock_table::LockTable;
pub use notifications::{DbNotification, NotificationListener, Notifications};
pub use orphan_folders::{KEEP_QUARANTINE_DAYS, OrphanFolders, OrphanRepository};
pub use orphan_objects::OrphanObject;
pub use parses::{NewParse, ParseRepository, ParseRow};
pub use records::ParseRecord;
pub use recovery::Recovery;
pub use reserve::Reserve;
pub use retention::{Cutoff, ExpiredRow, RetentionKind, RetentionRepository};
pub use room_index::{ParseToIndex, RoomEntry, RoomIndexRepository, RoomMatch};
pub use scenes::{
    InsertOutcome, NewSceneRow, SceneFilter, SceneRepository, SceneRow, SceneRowChange,
};
pub use statistics::{Figures, JobFigures, StatisticsRepository};
pub use uploads::{SceneRequest, UnfinishedUploads, UploadRepository, UploadResult, UploadRow};
pub use vectors::RoomVectors;
pub use vlm::{BudgetExceeded, BudgetOwner, NameRepository, SpendRequest, SpendingRepository};
pub use webhook_deliveries::WebhookRepository;

use answers::AnswerQueue;
use blobs::FileAccess;
use camino::{Utf8Path, Utf8PathBuf};
use cluster::ClusterMembership;
use data_folder::DataFolder;
use database::{Connections, Database, Engine};
pub use ids::{IdGenerator, first_id_at};
use jiff::Timestamp;
use migrations::migrations;
use sqlx::migrate::MigrateError;
use std::io;
use std::sync::Arc;
use std::time::Duration;
use tempfile::TempDir;
use tokio::task::spawn_blocking;
use uniground_types::labels::Labels;
use writer::Writer;

#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    #[error("database error")]
    Database(#[from] sqlx::Error),
    #[error("the database schema could not be brought up to date")]
    Migration(#[from] sqlx::migrate::MigrateError),
    #[error("error in the blob folder")]
    Blobs(#[from] io::Error),
    #[error(
        "{scheme} is not a supported database: use \"sqlite\" (the file in the data folder) or postgres://USER@HOST/DATABASE"
    )]
    UnknownDatabase { scheme: String },
    #[error("its rows are stored in {kept_in}: set --database (or UNIGROUND_DATABASE) to it")]
    OtherDatabase { kept_in: &'static str },
    #[error(
        "its rows are stored in {kept_in}, but this command supports only SQLite: use {kept_in}'s own tools (copy the rows first, then blobs/)"
    )]
    RequiresSqlite { kept_in: &'static str },
    #[error("its scans and parses are stored in {kept_in}: set --blobs (or UNIGROUND_BLOBS) to it")]
    BlobsElsewhere { kept_in: String },
    #[error(
        "its scans and parses are stored in {kept_in}, but this command supports only data folders: use the object store's own versioning or replication, and \
         the database's own backups (copy the rows first)"
    )]
    RequiresLocalFiles { kept_in: String },
    #[error(
        "this data folder already holds scans and parses: with an object store (--blobs), use an empty folder as its cache"
    )]
    FolderHasOwnBlobs,
    #[error(
        "this data folder, database and object store do not belong together: check --data-dir, --database and --blobs"
    )]
    StoresDoNotMatch,
    #[error(
        "a migration to this folder is unfinished: run the same `uniground migrate` again, or choose another folder"
    )]
    UnfinishedMigration,
    #[error("this database is in use by another server and cannot be opened exclusively")]
    DatabaseInUse,
    /// The lease of this job has passed to another worker.
    #[error("the lease of this job was lost: another worker has the job")]
    LeaseLost,
    #[error("vectors cannot be stored (--vectors pgvector): {why}")]
    NoVectors { why: String },
    #[error("another server uses this data folder")]
    InUse,
    #[error(
        "it contains other files ({found}) and is not a uniground data folder: choose an empty folder"
    )]
    HoldsOtherFiles { found: String },
    #[error("{folder} is not a uniground data folder")]
    NoDataFolder { folder: Utf8PathBuf },
    #[error("a stored record could not be read")]
    Record(#[from] serde_json::Error),
    /// The one error of several writes that were made in one transaction.
    #[error(transparent)]
    Shared(Arc<StoreError>),
}

impl StoreError {
    /// Returns whether the disk is full.
    #[must_use]
    pub fn is_full(&self) -> bool {
        match self {
            // SQLITE_FULL; SQLITE_IOERR_SHMSIZE (no space for the shared-memory file of readers);
            // PostgreSQL's disk_full.
            Self::Database(error)
            | Self::Migration(
                MigrateError::Execute(error) | MigrateError::ExecuteMigration(error, _),
            ) => {
                matches!(database_error_code(error).as_deref(), Some("13" | "4874" | "53100"))
            }
            Self::Blobs(error) => is_disk_full(error),
            Self::Shared(error) => error.is_full(),
            _ => false,
        }
    }

    /// Returns whether the database is temporarily unavailable: another process holds a lock, or
    /// the server cannot be reached. A retry may succeed.
    #[must_use]
    pub fn is_busy(&self) -> bool {
        match self {
            Self::Database(
                sqlx::Error::PoolTimedOut
                | sqlx::Error::PoolClosed
                | sqlx::Error::Io(_)
                | sqlx::Error::WorkerCrashed,
            ) => true,
            Self::Database(error) => {
                database_error_code(error).is_some_and(|code| match code.parse::<i32>() {
                    // SQLITE_BUSY and SQLITE_LOCKED, with any extended code.
                    Ok(number) if code.len() < 5 => matches!(number & 0xff, 5 | 6),
                    // PostgreSQL's classes: connection exception, transaction rollback,
                    // insufficient resources, operator intervention.
                    _ => ["08", "40", "53", "57"].contains(&&code[..2.min(code.len())]),
                })
            }
            Self::Shared(error) => error.is_busy(),
            _ => false,
        }
    }

    /// Returns whether SQLite reported a damaged file.
    #[must_use]
    pub fn is_damaged(&self) -> bool {
        match self {
            // SQLITE_CORRUPT and SQLITE_NOTADB, with any extended code; SQLITE_IOERR_SHORT_READ.
            // PostgreSQL's codes have five characters.
            Self::Database(error) => database_error_code(error).is_some_and(|code| {
                let number = code.parse::<i32>().ok().filter(|_| code.len() < 5);
                number.is_some_and(|number| matches!(number & 0xff, 11 | 26) || number == 522)
            }),
            Self::Shared(error) => error.is_damaged(),
            _ => false,
        }
    }

    /// Returns whether the object store is temporarily unavailable.
    #[must_use]
    pub fn is_object_store_unavailable(&self) -> bool {
        match self {
            Self::Blobs(error) => ObjectStoreUnavailable::is_behind(error),
            Self::Shared(error) => error.is_object_store_unavailable(),
            _ => false,
        }
    }
}

/// Returns the error code of SQLite or PostgreSQL.
fn database_error_code(error: &sqlx::Error) -> Option<String> {
    Some(error.as_database_error()?.code()?.into_owned())
}

/// Returns whether a file could not be written because the disk or a quota is full.
#[must_use]
pub fn is_disk_full(error: &io::Error) -> bool {
    matches!(
        error.kind(),
        io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded | io::ErrorKind::FileTooLarge
    )
}

/// How an opened store treats the leftovers of interrupted processes.
#[derive(Debug, Clone, Copy)]
enum LeftoverPolicy {
    Keep,
    /// Clears them. A process without a heartbeat for the duration of a lease counts as gone.
    Clear {
        lease: Duration,
    },
}

/// The whole store: one repository for each noun, and the blobs. Cheap to clone.
#[derive(Clone)]
pub struct Store {
    pub scenes: SceneRepository,
    pub contents: ContentRepository,
    pub parses: ParseRepository,
    pub answers: AnswerRepository,
    pub batches: BatchRepository,
    pub uploads: UploadRepository,
    pub jobs: JobRepository,
    pub keys: KeyRepository,
    pub names: NameRepository,
    pub spending: SpendingRepository,
    pub corrections: CorrectionRepository,
    pub webhooks: WebhookRepository,
    pub room_index: RoomIndexRepository,
    pub retention: RetentionRepository,
    pub orphans: OrphanRepository,
    pub integrity: IntegrityRepository,
    pub statistics: StatisticsRepository,
    pub health: HealthProbe,
    pub recovery: Recovery,
    pub reserve: Reserve,
    pub locks: LockTable,
    pub notifications: Notifications,
    pub ids: IdGenerator,
    pub blobs: Blobs,
    database: Arc<Database>,
    folder: DataFolder,
    /// The folder of the database, if this is [a copy](Self::open_copy). It is deleted when the
    /// last handle is dropped.
    _copy: Option<Arc<TempDir>>,
}

impl Store {
    /// Opens or creates the store below `data_dir`, updates the schema and clears the leftovers of
    /// interrupted processes. A PostgreSQL database may be in use by other processes; their current
    /// work is left alone.
    ///
    /// # Errors
    /// [`StoreError`] when the folder or the database cannot be used.
    pub async fn open(
        data_dir: &Utf8Path,
        location: &Location,
        home: &BlobHome,
    ) -> Result<Self, StoreError> {
        Self::open_with(data_dir, location, home, LEASE).await
    }

    /// As [`open`](Self::open), with the duration of a `lease`: a process without a heartbeat for
    /// so long counts as gone.
    ///
    /// # Errors
    /// As [`open`](Self::open).
    pub async fn open_with(
        data_dir: &Utf8Path,
        location: &Location,
        home: &BlobHome,
        lease: Duration,
    ) -> Result<Self, StoreError> {
        Self::open_for(
            data_dir,
            location,
            (home, FileAccess::ReadWrite),
            StoreAccess::Shared,
            LeftoverPolicy::Clear { lease },
        )
        .await
    }

    /// Opens the store for access to its rows only, next to the processes that use it, as far as
    /// the database allows that. Changes nothing.
    ///
    /// # Errors
    /// As [`open`](Self::open).
    pub async fn open_alongside_server(
        data_dir: &Utf8Path,
        location: &Location,
        home: &BlobHome,
    ) -> Result<Self, StoreError> {
        Self::open_for(
            data_dir,
            location,
            (home, FileAccess::RowsOnly),
            StoreAccess::Shared,
            LeftoverPolicy::Keep,
        )
        .await
    }

    /// Opens the store exclusively and changes nothing.
    ///
    /// # Errors
    /// As [`open`](Self::open).
    pub async fn open_without_recovery(
        data_dir: &Utf8Path,
        location: &Location,
        home: &BlobHome,
    ) -> Result<Self, StoreError> {
        Self::open_for(
            data_dir,
            location,
            (home, FileAccess::ReadWrite),
            StoreAccess::Exclusive,
            LeftoverPolicy::Keep,
        )
        .await
    }

    /// Opens the store. On a full disk it frees the reserve and tries once more.
    async fn open_for(
        data_dir: &Utf8Path,
        location: &Location,
        used: (&BlobHome, FileAccess),
        access: StoreAccess,
        leftovers: LeftoverPolicy,
    ) -> Result<Self, StoreError> {
        match Self::try_to_open(data_dir, location, used, access, leftovers).await {
            Err(error) if reserve::make_room_to_open(data_dir, &error) => {
                Self::try_to_open(data_dir, location, used, access, leftovers).await
            }
            opened => opened,
        }
    }

    async fn try_to_open(
        data_dir: &Utf8Path,
        location: &Location,
        (home, files): (&BlobHome, FileAccess),
        access: StoreAccess,
        leftovers: LeftoverPolicy,
    ) -> Result<Self, StoreError> {
        let lease = if let LeftoverPolicy::Clear { lease } = leftovers { lease } else { LEASE };
        let engine = location.engine()?;
        DataFolder::check_engine(data_dir, engine)?;
        // Mark the folder as belonging to a server's database only once that database was reached.
        let members = ClusterMembership::join(location, access, lease).await?;
        let server = match location {
            Location::Postgres(url) => Some(url.clone()),
            _ => None,
        };
        let connected = match &server {
            Some(url) => Some(Connections::connect_to_server(url).await?),
            None => None,
        };
        let (path, home) = (data_dir.to_owned(), home.clone());
        let opened = spawn_blocking(move || {
            let folder = DataFolder::open(&path, engine)?;
            let blobs = Blobs::open(&path, &home, files)?;
            Ok::<_, StoreError>((folder, blobs))
        });
        let (folder, blobs) = opened.await.map_err(io::Error::other)??;
        let connections = match connected {
            Some(connections) => connections,
            None => Connections::open_file(&folder.database()).await?,
        };
        let (reader, writer) = (connections.reader.clone(), connections.writer.clone());
        let opened = async {
            let store = Self::connect(connections, server, folder, blobs, members).await?;
            if let LeftoverPolicy::Clear { .. } = leftovers {
                store.clear_leftovers().await?;
            }
            Ok(store)
        };
        let opened = opened.await;
        if opened.is_err() {
            // Close before another try: an open connection holds the disk space and the lock that
            // the next one needs.
            reader.close().await;
            writer.close().await;
        }
        opened
    }

    /// Clears the leftovers of interrupted processes, then lets other processes join. Deleting
    /// needs disk space; on a full disk the reserve provides it.
    async fn clear_leftovers(&self) -> Result<(), StoreError> {
        if let Some(full) = self.recovery.recover().await
            && reserve::make_room_to_open(self.folder.path(), &full)
        {
            self.recovery.recover().await;
        }
        self.database.members.release_exclusive_access().await
    }

    /// As [`open_without_recovery`](Self::open_without_recovery), but requires an existing store.
    ///
    /// # Errors
    /// As [`open`](Self::open); [`StoreError::NoDataFolder`].
    pub async fn open_known(
        data_dir: &Utf8Path,
        location: &Location,
        home: &BlobHome,
    ) -> Result<Self, StoreError> {
        DataFolder::read_identity(data_dir)?;
        Self::open_without_recovery(data_dir, location, home).await
    }

    /// Creates a store over a database and updates its schema.
    async fn connect(
        connections: Connections,
        server: Option<PostgresUrl>,
        folder: DataFolder,
        blobs: Blobs,
        members: ClusterMembership,
    ) -> Result<Self, StoreError> {
        let Connections { engine, reader, writer } = connections;
        migrations(engine).run(&writer).await?;
        let writer = Writer::new(writer, engine);
        let newest = "SELECT max(id) FROM (SELECT max(id) AS id FROM scenes UNION ALL SELECT max(id) FROM jobs
                      UNION ALL SELECT max(id) FROM answers UNION ALL SELECT max(id) FROM parses
                      UNION ALL SELECT max(id) FROM batches
                      UNION ALL SELECT max(id) FROM corrections UNION ALL SELECT max(id) FROM uploads
                      UNION ALL SELECT max(id) FROM keys UNION ALL SELECT max(id) FROM audit) AS newest";
        let newest: Option<String> = sqlx::query_scalar(newest).fetch_one(&reader).await?;
        let ids = IdGenerator::after(newest.as_deref());
        let database = Arc::new(Database { reader, writer, engine, ids, members, server });
        let store = Self::from_database(database, folder, blobs);
        store.store_identity().await?;
        store.database.members.enter(&store.database.writer).await?;
        Ok(store)
    }

    /// Creates the repositories over one database.
    fn from_database(database: Arc<Database>, folder: DataFolder, blobs: Blobs) -> Self {
        let answers = AnswerRepository {
            database: database.clone(),
            queue: AnswerQueue::start(database.writer.clone()),
        };
        let locks = LockTable { members: database.members.clone() };
        let reserve = Reserve { blobs: blobs.clone(), folder: folder.clone() };
        let contents = ContentRepository { database: database.clone(), blobs: blobs.clone() };
        let scenes = SceneRepository {
            database: database.clone(),
            blobs: blobs.clone(),
            contents: contents.clone(),
        };
        let parses = ParseRepository { database: database.clone() };
        let batches = BatchRepository { database: database.clone(), reserve: reserve.clone() };
        let uploads = UploadRepository { database: database.clone(), blobs: blobs.clone() };
        let jobs = JobRepository { database: database.clone() };
        let keys = KeyRepository { database: database.clone() };
        let names = NameRepository { database: database.clone() };
        let spending = SpendingRepository { database: database.clone() };
        let corrections = CorrectionRepository { database: database.clone() };
        let webhooks = WebhookRepository { database: database.clone() };
        let room_index = RoomIndexRepository { database: database.clone() };
        let retention =
            RetentionRepository { database: database.clone(), batches: batches.clone() };
        let orphans = OrphanRepository {
            database: database.clone(),
            blobs: blobs.clone(),
            folder: folder.clone(),
        };
        let integrity = IntegrityRepository { database: database.clone() };
        let statistics =
            StatisticsRepository { database: database.clone(), folder: folder.clone() };
        let health = HealthProbe {
            database: database.clone(),
            blobs: blobs.clone(),
            folder: folder.clone(),
        };
        let notifications = Notifications { database: database.clone() };
        let recovery = Recovery {
            database: database.clone(),
            batches: batches.clone(),
            blobs: blobs.clone(),
            contents: contents.clone(),
            orphans: orphans.clone(),
            spending: spending.clone(),
            uploads: uploads.clone(),
        };
        Self {
            scenes,
            contents,
            parses,
            answers,
            batches,
            uploads,
            jobs,
            keys,
            names,
            spending,
            corrections,
            webhooks,
            room_index,
            retention,
            orphans,
            integrity,
            statistics,
            health,
            recovery,
            reserve,
            locks,
            notifications,
            ids: database.ids.clone(),
            blobs,
            database,
            folder,
            _copy: None,
        }
    }

    /// Ties the database to its file storage (the data folder, or an object store), by id. Files
    /// older than that tie are exempt from cleanup by a database that is new here or came from
    /// another folder.
    async fn store_identity(&self) -> Result<(), StoreError> {
        let known: Option<String> = sqlx::query_scalar("SELECT id FROM data_folder")
            .fetch_optional(&self.database.reader)
            .await?;
        let id = self.blobs.id().unwrap_or(&self.folder.id);
        if known.as_deref() == Some(id) {
            return Ok(());
        }
        // A SQLite file lies in its own folder. A server's database can be combined with any folder
        // by mistake: if their ids do not match, one of them is wrong.
        if self.database.engine == Engine::Postgres
            && (known.is_some() || self.blobs.has_scans().await?)
        {
            return Err(StoreError::StoresDoNotMatch);
        }
        let mut tx = self.database.writer.begin().await?;
        sqlx::query("DELETE FROM data_folder").execute(&mut *tx).await?;
        // A database from before folders had ids has belonged to its folder since its first scan.
        let since = if known.is_none() {
            "coalesce((SELECT min(created_at) FROM contents), $2)"
        } else {
            "$2"
        };
        let sql = format!("INSERT INTO data_folder (id, since) VALUES ($1, {since})");
        sqlx::query(sqlx::AssertSqlSafe(sql)).bind(id).bind(now()).execute(&mut *tx).await?;
        tx.commit().await
    }

    /// Closes the database and checkpoints the WAL.
    pub async fn close(&self) {
        self.database.members.leave().await;
        self.database.reader.close().await;
        self.database.writer.close().await;
    }
}

/// Truncates rows to one page, given up to `limit + 1` rows. Returns the page and, if there are
/// more rows, the id to continue after.
#[must_use]
pub fn split_page<T>(
    mut rows: Vec<T>,
    limit: u32,
    id: impl Fn(&T) -> &str,
) -> (Vec<T>, Option<String>) {
    let more = rows.len() > limit as usize;
    rows.truncate(limit as usize);
    let next_cursor = rows.last().filter(|_| more).map(|row| id(row).to_owned());
    (rows, next_cursor)
}

/// Returns the current time in the format of the database.
#[must_use]
pub fn now() -> String {
    Timestamp::now().to_string()
}
