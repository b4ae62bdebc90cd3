//! Data migration to another data folder, another database, or both: `uniground migrate`.
//!
//! No other process may use either side. The source stays unchanged: rows are copied, files are
//! hard-linked or copied. The marker of the target's folder is written last. Until then no server
//! accepts the target: its database has an id that no folder has, and a new folder has a note
//! instead of a marker, which tells servers that something is missing. An interrupted migration is
//! started again: all rows are copied again, and only missing files.
//!
//! In place (the folder stays, the rows go to another database) works the same way, without files.
//! Writing the marker is the moment from which the folder belongs to the other database.

mod files;
mod rows;
mod target;

pub use files::MigratedFiles;

use super::database::Location;
use super::{BlobHome, Store, StoreError};
use camino::{Utf8Path, Utf8PathBuf};
use rows::TargetDatabase;
use std::sync::Arc;
use std::{fmt, io};
use target::TargetFolder;
use tokio::task::spawn_blocking;

/// A data folder, and the location of its rows.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StoreLocation {
    pub data_dir: Utf8PathBuf,
    pub database: Location,
}

#[derive(Debug, thiserror::Error)]
pub enum MigrationError {
    #[error("the source {data_dir} cannot be opened")]
    From { data_dir: Utf8PathBuf, source: StoreError },
    #[error("the rows of {data_dir} are stored in {kept_in}: set --from-database to it")]
    FromOtherDatabase { data_dir: Utf8PathBuf, kept_in: &'static str },
    #[error(
        "the scans and parses of {data_dir} are stored in {kept_in}, but only those in a data folder can be migrated"
    )]
    FromElsewhere { data_dir: Utf8PathBuf, kept_in: String },
    #[error("the target {place} cannot be used")]
    To { place: String, source: StoreError },
    #[error("{place} is not empty ({found}): choose an empty one")]
    NotEmpty { place: String, found: String },
    #[error(
        "--from and --to have the same database: to move only the folder, stop its server and copy it"
    )]
    SameDatabase,
    #[error("one data folder must not be inside the other: choose a folder next to {data_dir}")]
    Within { data_dir: Utf8PathBuf },
    #[error(
        "rows of {table} could not be migrated (find the cause with `uniground doctor`, then run the same command again to continue)"
    )]
    Rows { table: &'static str, source: StoreError },
    #[error("{file} could not be migrated (run the same command again to continue)")]
    File { file: Utf8PathBuf, source: io::Error },
    #[error(transparent)]
    Store(#[from] StoreError),
}

impl From<sqlx::Error> for MigrationError {
    fn from(error: sqlx::Error) -> Self {
        Self::Store(error.into())
    }
}

impl From<io::Error> for MigrationError {
    fn from(error: io::Error) -> Self {
        Self::Store(error.into())
    }
}

/// The result of a migration.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MigrationReport {
    /// Number of rows by table.
    pub rows: Vec<(&'static str, u64)>,
    /// Texts with a NUL character, which PostgreSQL cannot store: U+FFFD replaces it.
    pub texts_changed: u64,
    /// Empty where the folder stays.
    pub files: Vec<MigratedFiles>,
    /// Folders that were lost or damaged before, copied as they are: folder, and what is wrong.
    pub damaged: Vec<(String, String)>,
    /// The database file that a folder does not use after an in-place migration.
    pub set_aside: Option<Utf8PathBuf>,
}

/// Progress of one step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MigrationProgress {
    pub part: MigrationStep,
    /// Finished rows or folders, out of `of`.
    pub done: u64,
    pub of: u64,
}

/// The steps of a migration, one after the other.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MigrationStep {
    /// Rows of a table.
    Rows(&'static str),
    /// Folders of a kind.
    Files(&'static str),
}

impl fmt::Display for MigrationStep {
    fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Rows(table) => write!(to, "rows of {table}"),
            Self::Files(kind) => write!(to, "files of {kind}"),
        }
    }
}

/// Callback for progress.
pub type OnProgress = Arc<dyn Fn(MigrationProgress) + Send + Sync>;

/// Whether files are migrated.
#[derive(Clone, Copy, PartialEq, Eq)]
enum FileTransfer {
    Copy,
    InPlace,
}

/// Migrates everything. The source stays unchanged, except that its schema is updated. In place, a
/// database file that is not used any more is renamed.
///
/// # Errors
/// [`MigrationError`]: the source is unchanged, and the migration can be repeated.
pub async fn migrate_data(
    from: &StoreLocation,
    to: &StoreLocation,
    on_progress: OnProgress,
) -> Result<MigrationReport, MigrationError> {
    let files = choose_file_transfer(from, to)?;
    let source = Store::open_known(&from.data_dir, &from.database, &BlobHome::Folder)
        .await
        .map_err(|source| match source {
            StoreError::OtherDatabase { kept_in } => {
                MigrationError::FromOtherDatabase { data_dir: from.data_dir.clone(), kept_in }
            }
            StoreError::BlobsElsewhere { kept_in } => {
                MigrationError::FromElsewhere { data_dir: from.data_dir.clone(), kept_in }
            }
            source => MigrationError::From { data_dir: from.data_dir.clone(), source },
        })?;
    let brought = copy_store(&source, to, files, &on_progress).await;
    source.close().await;
    let (folder, moved) = brought?;
    let set_aside = spawn_blocking(move || folder.complete()).await.map_err(io::Error::other)??;
    // Keep the source's lock until here.
    drop(source);
    Ok(MigrationReport { set_aside, ..moved })
}

/// Copies everything that the target lacks.
async fn copy_store(
    source: &Store,
    to: &StoreLocation,
    files: FileTransfer,
    on_progress: &OnProgress,
) -> Result<(TargetFolder, MigrationReport), MigrationError> {
    let (path, engine) = (to.data_dir.clone(), to.database.engine()?);
    let current = (files == FileTransfer::InPlace)
        .then(|| (source.folder.id.clone(), source.database.engine));
    let opening = spawn_blocking(move || match current {
        Some((id, engine_before)) => TargetFolder::in_place(path, &id, engine_before, engine),
        None => TargetFolder::open(path, engine),
    });
    let mut folder = opening.await.map_err(io::Error::other)??;
    let database = TargetDatabase::open(&to.database, &mut folder).await?;
    let rows = rows::move_rows(source, &database, &folder.id, on_progress).await;
    database.close().await;
    let rows::MigratedRows { moved: rows, texts_changed } = rows?;
    let mut moved = MigrationReport {
        rows,
        texts_changed,
        files: Vec::new(),
        damaged: Vec::new(),
        set_aside: None,
    };
    if files == FileTransfer::Copy {
        let (from, to, on_progress) = (source.blobs.clone(), folder.clone(), on_progress.clone());
        let moving = spawn_blocking(move || files::move_files(&from, &to.blobs()?, &on_progress));
        (moved.files, moved.damaged) = moving.await.map_err(io::Error::other)??;
    }
    Ok((folder, moved))
}

/// Returns whether the folder stays, or an error if there is nothing to migrate.
fn choose_file_transfer(
    from: &StoreLocation,
    to: &StoreLocation,
) -> Result<FileTransfer, MigrationError> {
    let no_folder = |_| {
        let (data_dir, folder) = (from.data_dir.clone(), from.data_dir.clone());
        MigrationError::From { data_dir, source: StoreError::NoDataFolder { folder } }
    };
    let own = from.data_dir.canonicalize_utf8().map_err(no_folder)?;
    // If the target does not exist yet, use its nearest existing ancestor.
    let nearest = to.data_dir.ancestors().find(|path| path.exists()).unwrap_or(Utf8Path::new("."));
    let other = nearest.canonicalize_utf8()?;
    let is_there = nearest == to.data_dir;
    let files = match own == other && is_there {
        true => FileTransfer::InPlace,
        false if other.starts_with(&own) || (is_there && own.starts_with(&other)) => {
            return Err(MigrationError::Within { data_dir: from.data_dir.clone() });
        }
        false => FileTransfer::Copy,
    };
    match from.database == to.database
        && (files == FileTransfer::InPlace || from.database != Location::Folder)
    {
        true => Err(MigrationError::SameDatabase),
        false => Ok(files),
    }
}
