//! Backups: a snapshot of the database, with all files it refers to. Can be taken while a server
//! runs, without disturbing it.
//!
//! ```text
//! manifest.json               what belongs to the backup, with checksums; written last
//! uniground-<checksum>.sqlite the database
//! blobs/<kind>/<name>/...     published folders, each with the checksums of its files
//! backup.lock                 held while a backup is being taken (folders only)
//! ```
//! Published folders never change, so those that are in the backup already are not copied again.
//! The database is copied first and its folders after it. If a folder is removed in between,
//! another round follows, which has little left to copy. Checkpoints only save time and are left
//! out.

mod manifest;
mod reading;
mod restore;
mod sink;
mod snapshot;

pub(super) use reading::CopyFailure;
pub use restore::{BackupSource, RestoreReport, check, restore};
pub use sink::BackupTarget;
pub(super) use sink::copy_folder;

use super::StoreError;
use super::blobs::Blobs;
use super::data_folder::DataFolder;
use super::database::Engine;
use camino::{Utf8Path, Utf8PathBuf};
use manifest::{BackupFolder, Manifest, OmittedFolder};
use sink::BackupSink;
use snapshot::Snapshot;
use std::collections::BTreeMap;
use std::io;
use tokio::task::spawn_blocking;

#[derive(Debug, thiserror::Error)]
pub enum BackupError {
    #[error(transparent)]
    Store(#[from] StoreError),
    #[error("{folder} contains other files ({found}) and is not a backup: choose an empty folder")]
    NotABackup { folder: Utf8PathBuf, found: String },
    #[error("{folder} is not empty ({found}): choose an empty or new folder")]
    NotEmpty { folder: Utf8PathBuf, found: String },
    #[error("the backup must not be inside the data folder")]
    Within,
    #[error("another backup is being written to {folder}")]
    Busy { folder: Utf8PathBuf },
    #[error("this is not a backup: {why}")]
    Unknown { why: String },
    #[error("the backup is damaged: {what}")]
    Damaged { what: String },
    #[error(
        "the backup was made by the newer uniground {program}: restore it with that version or a later one"
    )]
    Newer { program: String },
    #[error(
        "the data folder changes faster than it can be copied: try again when the server is less busy"
    )]
    ChangesTooFast,
    #[error("{file}")]
    File { file: Utf8PathBuf, source: io::Error },
}

impl From<sqlx::Error> for BackupError {
    fn from(error: sqlx::Error) -> Self {
        Self::Store(error.into())
    }
}

impl From<io::Error> for BackupError {
    fn from(error: io::Error) -> Self {
        Self::Store(error.into())
    }
}

/// The result of a backup.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BackupReport {
    pub scenes: u64,
    pub answers: u64,
    /// Folders of scans, parses and transcripts.
    pub folders: u64,
    pub bytes: u64,
    /// Folders that were not in the backup before.
    pub new_folders: u64,
    pub new_bytes: u64,
    /// Folders that were lost or damaged before; the backup does not contain them. Folder, and what
    /// is wrong with it.
    pub left_out: Vec<(String, String)>,
}

/// Kinds of folders in a backup.
const KINDS: [&str; 3] = ["contents", "parses", "answers"];
/// Maximum number of rounds, for a data folder that changes all the time.
const ROUNDS: u32 = 20;

/// Kind and name of a published folder.
type FolderKey = (&'static str, String);

/// Folders in the backup, and folders that could not be copied.
#[derive(Default)]
struct BackupProgress {
    kept: BTreeMap<FolderKey, BackupFolder>,
    missing: BTreeMap<FolderKey, String>,
    new_folders: u64,
    new_bytes: u64,
}

/// Takes a backup of a data folder, whether or not a server runs there.
///
/// # Errors
/// [`BackupError`]. An earlier backup at the target stays as it was.
pub async fn back_up(
    data_dir: &Utf8Path,
    target: BackupTarget,
) -> Result<BackupReport, BackupError> {
    let (path, opened) = (data_dir.to_owned(), target);
    let opening = spawn_blocking(move || {
        let (id, engine) = DataFolder::read_identity(&path)?;
        if engine != Engine::Sqlite {
            return Err(StoreError::RequiresSqlite { kept_in: engine.name() }.into());
        }
        let source = Blobs::open_read_only(&path)?;
        Ok::<_, BackupError>((id, source, BackupSink::open(opened, &path)?))
    });
    let (id, source, mut sink) = opening.await.map_err(io::Error::other)??;
    let mut progress = BackupProgress::default();
    for _ in 0..ROUNDS {
        let snapshot = Snapshot::take(
            &data_dir.join(super::data_folder::DATABASE),
            sink.database_snapshot_path(),
        )
        .await?;
        let wanted = snapshot.folders(&source).await?;
        let (missed_before, blobs) = (progress.missing.clone(), source.clone());
        (sink, progress) = spawn_blocking(move || copy(&blobs, wanted, sink, progress))
            .await
            .map_err(io::Error::other)??;
        // A folder is lost if it was missing before this snapshot was taken and the snapshot still
        // refers to it.
        if progress.missing.keys().all(|name| missed_before.contains_key(name)) {
            return spawn_blocking(move || finish(sink, &snapshot, &id, progress))
                .await
                .map_err(io::Error::other)?;
        }
    }
    Err(BackupError::ChangesTooFast)
}

/// Copies the folders that a snapshot refers to and the backup does not have.
fn copy(
    source: &Blobs,
    wanted: Vec<FolderKey>,
    mut sink: BackupSink,
    before: BackupProgress,
) -> Result<(BackupSink, BackupProgress), BackupError> {
    let BackupProgress { kept: mut had, new_folders, new_bytes, .. } = before;
    let mut progress = BackupProgress { new_folders, new_bytes, ..BackupProgress::default() };
    for (kind, name) in wanted {
        let name = (kind, name);
        if let Some(kept) = had.remove(&name) {
            progress.kept.insert(name, kept);
            continue;
        }
        match sink.add_folder(kind, &name.1, &source.folder_path(kind, &name.1)) {
            Ok((kept, is_new)) => {
                progress.new_folders += u64::from(is_new);
                progress.new_bytes += if is_new { kept.bytes } else { 0 };
                progress.kept.insert(name, kept);
            }
            // A model's prompt and reply have a retention time of their own: they may be removed
            // before their answer.
            Err(CopyFailure::Missing) if kind == "answers" => {}
            Err(CopyFailure::Missing) => drop(progress.missing.insert(name, "missing".into())),
            Err(CopyFailure::Damaged(what)) => drop(progress.missing.insert(name, what)),
            Err(CopyFailure::NotWritten(error)) => return Err(error.into()),
        }
    }
    Ok((sink, progress))
}

/// Writes the manifest, which makes it a backup.
fn finish(
    mut sink: BackupSink,
    snapshot: &Snapshot,
    id: &str,
    progress: BackupProgress,
) -> Result<BackupReport, BackupError> {
    let BackupProgress { kept, missing, new_folders, new_bytes } = progress;
    let database = sink.add_database(&snapshot.file)?;
    let left_out: Vec<(String, String)> = missing
        .into_iter()
        .map(|((kind, name), what)| (format!("blobs/{kind}/{name}"), what))
        .collect();
    let backed_up = BackupReport {
        scenes: snapshot.scenes,
        answers: snapshot.answers,
        folders: kept.len() as u64,
        bytes: database.bytes + kept.values().map(|kept| kept.bytes).sum::<u64>(),
        new_folders,
        new_bytes,
        left_out: left_out.clone(),
    };
    let manifest = Manifest {
        format: manifest::FORMAT,
        program: env!("CARGO_PKG_VERSION").to_owned(),
        schema: snapshot.schema,
        taken_at: snapshot.taken_at.clone(),
        data_folder: snapshot.data_folder.clone().unwrap_or_else(|| id.to_owned()),
        database,
        scenes: snapshot.scenes,
        answers: snapshot.answers,
        folders: kept.into_values().collect(),
        left_out: left_out.into_iter().map(|(folder, why)| OmittedFolder { folder, why }).collect(),
    };
    sink.finish(&manifest)?;
    Ok(backed_up)
}
