//! A store moved over to another data folder, another database, or both; `uniground migrate`.
//!
//! Nobody else may be at work on either side. What is moved stays where it was, as it was: rows are
//! copied, files are given a second name or copied. Until the marker of the target's folder is
//! written, last of all, the target is nobody's: its database knows an id that no folder has, and a
//! folder that is new has a note instead of a marker, by which servers know that something is
//! missing. Whoever is interrupted begins again: rows from the start, of the files what is missing.
//!
//! In place (the folder stays, the rows go to another database) it is the same, without files: the
//! marker is the moment from which the folder belongs to the other database.

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

/// A data folder, and where its rows are.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StoreLocation {
    pub data_dir: Utf8PathBuf,
    pub database: Location,
}

#[derive(Debug, thiserror::Error)]
pub enum MigrationError {
    #[error("what is to be moved can not be opened ({data_dir})")]
    From { data_dir: Utf8PathBuf, source: StoreError },
    #[error("the rows of {data_dir} are kept in {kept_in}: say so with --from-database")]
    FromOtherDatabase { data_dir: Utf8PathBuf, kept_in: &'static str },
    #[error(
        "scans and parses of {data_dir} are kept in {kept_in}, and those of a folder alone are moved"
    )]
    FromElsewhere { data_dir: Utf8PathBuf, kept_in: String },
    #[error("the target can not be used ({place})")]
    To { place: String, source: StoreError },
    #[error("{place} is not empty ({found}): choose one that is")]
    NotEmpty { place: String, found: String },
    #[error(
        "nothing would move: --from and --to have the same database (a folder alone is moved by copying it while its server is stopped)"
    )]
    SameDatabase,
    #[error("one data folder can not lie in the other: choose a folder beside {data_dir}")]
    Within { data_dir: Utf8PathBuf },
    #[error(
        "rows of {table} could not be moved (`uniground doctor` looks for what is wrong; what was begun goes on when the command is run again)"
    )]
    Rows { table: &'static str, source: StoreError },
    #[error("{file} could not be moved (what was begun goes on when the command is run again)")]
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

/// What was moved.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MigrationReport {
    /// How many rows of which table.
    pub rows: Vec<(&'static str, u64)>,
    /// Texts with a NUL, which PostgreSQL does not keep: U+FFFD stands there instead.
    pub texts_changed: u64,
    /// None where the folder stays.
    pub files: Vec<MigratedFiles>,
    /// What was lost or damaged before, and is as it was: folder, and what is wrong.
    pub damaged: Vec<(String, String)>,
    /// The database's file that a folder which stays does not use any more.
    pub set_aside: Option<Utf8PathBuf>,
}

/// How far a part has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MigrationProgress {
    pub part: MigrationStep,
    /// Rows or folders, of so many.
    pub done: u64,
    pub of: u64,
}

/// What is moved one after the other.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MigrationStep {
    /// Of a table.
    Rows(&'static str),
    /// Of a kind of folders.
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

/// Who is told how far it has come.
pub type OnProgress = Arc<dyn Fn(MigrationProgress) + Send + Sync>;

/// Whether files move.
#[derive(Clone, Copy, PartialEq, Eq)]
enum FileTransfer {
    Move,
    Stay,
}

/// Moves everything over. What is moved is left as it was, but for the schema, which is brought up
/// to date; in place, the file of a database that is not used any more gets another name.
///
/// # Errors
/// [`MigrationError`]: nothing has moved, and it can be tried again.
pub async fn migrate_data(
    from: &StoreLocation,
    to: &StoreLocation,
    tell: OnProgress,
) -> Result<MigrationReport, MigrationError> {
    let files = way(from, to)?;
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
    let brought = bring(&source, to, files, &tell).await;
    source.close().await;
    let (folder, moved) = brought?;
    let set_aside = spawn_blocking(move || folder.settle()).await.map_err(io::Error::other)??;
    // The folder was ours until here.
    drop(source);
    Ok(MigrationReport { set_aside, ..moved })
}

/// Brings everything that a place lacks to it.
async fn bring(
    source: &Store,
    to: &StoreLocation,
    files: FileTransfer,
    tell: &OnProgress,
) -> Result<(TargetFolder, MigrationReport), MigrationError> {
    let (path, engine) = (to.data_dir.clone(), to.database.engine()?);
    let current =
        (files == FileTransfer::Stay).then(|| (source.folder.id.clone(), source.database.engine));
    let opening = spawn_blocking(move || match current {
        Some((id, engine_before)) => TargetFolder::in_place(path, &id, engine_before, engine),
        None => TargetFolder::open(path, engine),
    });
    let mut folder = opening.await.map_err(io::Error::other)??;
    let database = TargetDatabase::open(&to.database, &mut folder).await?;
    let rows = rows::move_rows(source, &database, &folder.id, tell).await;
    database.close().await;
    let rows::MigratedRows { moved: rows, texts_changed } = rows?;
    let mut moved = MigrationReport {
        rows,
        texts_changed,
        files: Vec::new(),
        damaged: Vec::new(),
        set_aside: None,
    };
    if files == FileTransfer::Move {
        let (from, to, tell) = (source.blobs.clone(), folder.clone(), tell.clone());
        let moving = spawn_blocking(move || files::move_files(&from, &to.blobs()?, &tell));
        (moved.files, moved.damaged) = moving.await.map_err(io::Error::other)??;
    }
    Ok((folder, moved))
}

/// Whether the folder stays, for two places between which there is something to move.
fn way(from: &StoreLocation, to: &StoreLocation) -> Result<FileTransfer, MigrationError> {
    let no_folder = |_| {
        let (data_dir, folder) = (from.data_dir.clone(), from.data_dir.clone());
        MigrationError::From { data_dir, source: StoreError::NoDataFolder { folder } }
    };
    let own = from.data_dir.canonicalize_utf8().map_err(no_folder)?;
    // Where it is not there yet, what it would lie in.
    let nearest = to.data_dir.ancestors().find(|path| path.exists()).unwrap_or(Utf8Path::new("."));
    let other = nearest.canonicalize_utf8()?;
    let is_there = nearest == to.data_dir;
    let files = match own == other && is_there {
        true => FileTransfer::Stay,
        false if other.starts_with(&own) || (is_there && own.starts_with(&other)) => {
            return Err(MigrationError::Within { data_dir: from.data_dir.clone() });
        }
        false => FileTransfer::Move,
    };
    match from.database == to.database
        && (files == FileTransfer::Stay || from.database != Location::Folder)
    {
        true => Err(MigrationError::SameDatabase),
        false => Ok(files),
    }
}
