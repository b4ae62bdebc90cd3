//! Restores a data folder from a backup, completely or not at all.

use super::BackupError;
use super::manifest::{self, BackupFolder, Manifest, hex};
use super::reading::{CopiedFolder, CopyFailure, read_checksum_file, read_file, read_folder};
use super::sink::copy_folder;
use super::snapshot::rename_folder;
use crate::StoreError;
use crate::blobs::checksums::sync_everything;
use crate::data_folder::{DATABASE, LOCK, is_harmless, write_marker};
use crate::database::Engine;
use crate::file_lock::FileLock;
use crate::migrations::MIGRATIONS;
use camino::{Utf8Component, Utf8Path, Utf8PathBuf};
use sha2::{Digest, Sha256};
use std::fs::{self, File};
use std::io::{self, BufRead, BufReader, Read};
use std::time::{Duration, UNIX_EPOCH};
use tokio::task::spawn_blocking;
use uuid::Uuid;

/// Where a backup is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum BackupSource {
    Folder(Utf8PathBuf),
    Archive(Utf8PathBuf),
    Stdin,
}

impl BackupSource {
    /// Interprets a path on the command line.
    #[must_use]
    pub fn from_path(path: &Utf8Path) -> Self {
        match path.as_str() {
            "-" => Self::Stdin,
            _ if path.is_dir() => Self::Folder(path.to_owned()),
            _ => Self::Archive(path.to_owned()),
        }
    }
}

/// The result of restoring or checking a backup.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RestoreReport {
    pub taken_at: String,
    /// Version of the program that made the backup.
    pub program: String,
    pub scenes: u64,
    pub answers: u64,
    pub folders: u64,
    pub bytes: u64,
    /// Folders missing from the backup: folder, and what was wrong with it.
    pub left_out: Vec<(String, String)>,
}

/// Folder for unfinished work, until all of it is complete and checked.
const RESTORING: &str = "restoring";
/// The magic number of zstd streams.
const ZSTD: [u8; 4] = [0x28, 0xb5, 0x2f, 0xfd];

/// What a caller needs from a backup.
#[derive(Clone, Copy, PartialEq, Eq)]
enum ManifestRequest {
    Full,
    /// Only to check it.
    CheckOnly,
}

/// How a backup's folders are read.
#[derive(Clone, Copy, PartialEq, Eq)]
enum FolderTransfer {
    Copy,
    /// It was unpacked to a temporary folder, so it can be moved.
    Move,
    /// Folders are checked and stay where they are.
    CheckOnly,
}

/// Restores a backup to a data folder. Every byte is checked before anything is moved into place.
///
/// # Errors
/// [`BackupError`]; the folder is as empty as before.
pub async fn restore(
    source: BackupSource,
    data_dir: &Utf8Path,
) -> Result<RestoreReport, BackupError> {
    let path = data_dir.to_owned();
    let place =
        spawn_blocking(move || RestoreTarget::open(path)).await.map_err(io::Error::other)??;
    // Dropping it removes everything that is unfinished.
    let gathering = spawn_blocking(move || {
        let gathered = stage_backup(&source, &place.staging(), ManifestRequest::Full)?;
        Ok::<_, BackupError>((place, gathered))
    });
    let (place, manifest) = gathering.await.map_err(io::Error::other)??;
    let id = Uuid::new_v4().to_string();
    rename_folder(&place.staging().join(NEW).join(DATABASE), &id).await?;
    spawn_blocking(move || {
        place.move_into_place(&id)?;
        Ok(RestoreReport::from_manifest(manifest))
    })
    .await
    .map_err(io::Error::other)?
}

/// Checks every byte of a backup. Returns what could be restored.
///
/// # Errors
/// [`BackupError`].
pub async fn check(source: BackupSource) -> Result<RestoreReport, BackupError> {
    let looking = spawn_blocking(move || {
        let scratch = tempfile::tempdir()?;
        let staging = Utf8PathBuf::try_from(scratch.path().to_owned()).map_err(io::Error::other)?;
        Ok(RestoreReport::from_manifest(stage_backup(
            &source,
            &staging,
            ManifestRequest::CheckOnly,
        )?))
    });
    looking.await.map_err(io::Error::other)?
}

impl RestoreReport {
    fn from_manifest(manifest: Manifest) -> Self {
        let Manifest { program, taken_at, database, scenes, answers, folders, left_out, .. } =
            manifest;
        Self {
            taken_at,
            program,
            scenes,
            answers,
            folders: folders.len() as u64,
            bytes: database.bytes + folders.iter().map(|kept| kept.bytes).sum::<u64>(),
            left_out: left_out.into_iter().map(|left| (left.folder, left.why)).collect(),
        }
    }
}

/// The new data folder, below [`RESTORING`].
const NEW: &str = "new";

/// The folder to restore to. Drop removes what is unfinished there.
struct RestoreTarget {
    data_dir: Utf8PathBuf,
    was_there: bool,
    _lock: FileLock,
}

impl RestoreTarget {
    fn open(data_dir: Utf8PathBuf) -> Result<Self, BackupError> {
        let was_there = data_dir.is_dir();
        fs::create_dir_all(&data_dir)
            .map_err(|source| BackupError::File { file: data_dir.clone(), source })?;
        for entry in data_dir.read_dir_utf8()? {
            let entry = entry?;
            if !is_harmless(entry.file_name()) && entry.file_name() != RESTORING {
                return Err(BackupError::NotEmpty {
                    found: entry.file_name().to_owned(),
                    folder: data_dir,
                });
            }
        }
        let lock = FileLock::try_exclusive(File::create(data_dir.join(LOCK))?)
            .map_err(|_| StoreError::InUse)?;
        let place = Self { data_dir, was_there, _lock: lock };
        // Remove what an earlier attempt left.
        place.clear()?;
        fs::create_dir(place.staging())?;
        Ok(place)
    }

    fn staging(&self) -> Utf8PathBuf {
        self.data_dir.join(RESTORING)
    }

    fn clear(&self) -> io::Result<()> {
        match fs::remove_dir_all(self.staging()) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
            _ => Ok(()),
        }
    }

    /// Moves everything into place. The marker, by which a server knows the folder, comes last.
    fn move_into_place(&self, id: &str) -> io::Result<()> {
        let new = self.staging().join(NEW);
        sync_everything(&self.data_dir)?;
        for part in ["blobs", DATABASE] {
            fs::rename(new.join(part), self.data_dir.join(part))?;
        }
        write_marker(&self.data_dir, id, Engine::Sqlite)
    }
}

impl Drop for RestoreTarget {
    fn drop(&mut self) {
        if let Err(error) = self.clear() {
            tracing::warn!(folder = %self.staging(), %error, "partially restored folder could not be removed");
        }
        if !self.was_there && !self.data_dir.join(DATABASE).exists() {
            let _ = fs::remove_file(self.data_dir.join(LOCK));
            let _ = fs::remove_dir(&self.data_dir);
        }
    }
}

/// Copies or moves the content of a backup to a staging folder, and checks it.
fn stage_backup(
    source: &BackupSource,
    staging: &Utf8Path,
    wanted: ManifestRequest,
) -> Result<Manifest, BackupError> {
    let unpacked = staging.join("unpacked");
    let (folder, take) = match source {
        BackupSource::Folder(folder) => (folder.as_path(), FolderTransfer::Copy),
        BackupSource::Archive(file) => {
            let archive = File::open(file)
                .map_err(|source| BackupError::File { file: file.clone(), source })?;
            unpack(BufReader::new(archive), &unpacked)?;
            (unpacked.as_path(), FolderTransfer::Move)
        }
        BackupSource::Stdin => {
            unpack(BufReader::new(io::stdin()), &unpacked)?;
            (unpacked.as_path(), FolderTransfer::Move)
        }
    };
    let take = if wanted == ManifestRequest::CheckOnly { FolderTransfer::CheckOnly } else { take };
    let manifest = match fs::read(folder.join(manifest::FILE)) {
        Ok(bytes) => Manifest::from_sealed_bytes(&bytes)?,
        Err(error) if error.kind() == io::ErrorKind::NotFound => {
            return Err(BackupError::Unknown { why: format!("it has no {}", manifest::FILE) });
        }
        Err(source) => return Err(BackupError::File { file: folder.join(manifest::FILE), source }),
    };
    if MIGRATIONS.last().is_none_or(|(newest, ..)| manifest.schema > *newest) {
        return Err(BackupError::Newer { program: manifest.program });
    }
    let new = staging.join(NEW);
    fs::create_dir_all(new.join("blobs"))?;
    restore_database(&manifest, folder, &new.join(DATABASE))?;
    for kept in &manifest.folders {
        restore_folder(kept, folder, &new, take)?;
    }
    Ok(manifest)
}

fn restore_database(
    manifest: &Manifest,
    folder: &Utf8Path,
    to: &Utf8Path,
) -> Result<(), BackupError> {
    let manifest::DatabaseEntry { file, sha256, .. } = &manifest.database;
    let copied = read_file(&folder.join(file), |_, reader| {
        io::copy(reader, &mut File::create(to)?).map(drop)
    });
    match copied {
        Ok((sum, _)) if sum == *sha256 => Ok(()),
        Ok(_) => Err(damaged(file, "damaged")),
        Err(unsound) => Err(to_backup_error(file, unsound)),
    }
}

fn restore_folder(
    kept: &BackupFolder,
    folder: &Utf8Path,
    new: &Utf8Path,
    take: FolderTransfer,
) -> Result<(), BackupError> {
    let below = format!("blobs/{}/{}", kept.kind, kept.name);
    let (from, to) = (folder.join(&below), new.join(&below));
    let sums = read_checksum_file(&from).map_err(|unsound| to_backup_error(&below, unsound))?;
    if sums.is_none_or(|sums| hex(&Sha256::digest(sums)) != kept.sha256) {
        return Err(damaged(&below, ".sha256sums damaged"));
    }
    let read: Result<CopiedFolder, CopyFailure> = match take {
        FolderTransfer::Copy => copy_folder(&from, &to),
        FolderTransfer::Move | FolderTransfer::CheckOnly => {
            read_folder(&from, |_, _, reader| io::copy(reader, &mut io::sink()).map(drop))
        }
    };
    read.map_err(|unsound| to_backup_error(&below, unsound))?;
    if take == FolderTransfer::Move {
        fs::create_dir_all(to.parent().unwrap_or(new))?;
        fs::rename(&from, &to)?;
    }
    if take == FolderTransfer::CheckOnly {
        return Ok(());
    }
    // Keep the original time, so that retention counts from it.
    File::open(&to)?.set_modified(UNIX_EPOCH + Duration::from_secs(kept.published_s))?;
    Ok(())
}

fn damaged(place: &str, what: &str) -> BackupError {
    BackupError::Damaged { what: format!("{place}: {what}") }
}

fn to_backup_error(place: &str, unsound: CopyFailure) -> BackupError {
    match unsound {
        CopyFailure::Missing => damaged(place, "missing"),
        CopyFailure::Damaged(what) => damaged(place, &what),
        CopyFailure::NotWritten(error) => error.into(),
    }
}

/// Unpacks an archive. Accepts only files, and no path outside the target.
fn unpack(mut archive: impl BufRead, to: &Utf8Path) -> Result<(), BackupError> {
    let broken = |error: io::Error| BackupError::Damaged {
        what: format!("the archive cannot be read: {error}"),
    };
    let is_packed = archive.fill_buf().map_err(broken)?.starts_with(&ZSTD);
    let reader: Box<dyn Read> =
        if is_packed { Box::new(zstd::Decoder::with_buffer(archive)?) } else { Box::new(archive) };
    fs::create_dir_all(to)?;
    for entry in tar::Archive::new(reader).entries().map_err(broken)? {
        let mut entry = entry.map_err(broken)?;
        let path = entry.path().map_err(broken)?.into_owned();
        let path = Utf8PathBuf::try_from(path)
            .map_err(|path| damaged(&format!("{path:?}"), "not allowed in a backup"))?;
        if entry.header().entry_type().is_dir() {
            continue;
        }
        if !entry.header().entry_type().is_file()
            || path.components().any(|step| !matches!(step, Utf8Component::Normal(_)))
        {
            return Err(damaged(path.as_str(), "not allowed in a backup"));
        }
        let file = to.join(&path);
        fs::create_dir_all(file.parent().unwrap_or(to))?;
        let mut out = File::create(&file)?;
        let mut buffer = vec![0; 256 << 10];
        loop {
            match entry.read(&mut buffer).map_err(broken)? {
                0 => break,
                n => io::Write::write_all(&mut out, &buffer[..n])?,
            }
        }
    }
    Ok(())
}
