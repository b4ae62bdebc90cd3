//! The target of a backup: a folder that is updated, or an archive that is written sequentially.

use super::manifest::{self, BackupFolder, DatabaseEntry, Manifest, hex};
use super::reading::{
    CopiedFolder, CopyFailure, parse_checksums, read_checksum_file, read_file, read_folder,
};
use super::{BackupError, KINDS};
use crate::blobs::checksums::{SUMS, sync_everything};
use crate::data_folder::write_synced;
use crate::file_lock::FileLock;
use camino::{Utf8Path, Utf8PathBuf};
use sha2::{Digest, Sha256};
use std::collections::HashSet;
use std::fs::{self, File, TryLockError};
use std::io::{self, BufWriter, Read, Write};
use std::time::{SystemTime, UNIX_EPOCH};
use tempfile::{NamedTempFile, TempDir};

/// Where to write a backup.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum BackupTarget {
    /// A folder: empty, missing, or an earlier backup, whose unchanged folders are reused.
    Folder(Utf8PathBuf),
    /// A tar archive, compressed with zstd if its name ends in `.zst`.
    Archive(Utf8PathBuf),
    /// A tar archive on standard output.
    Stdout,
}

impl BackupTarget {
    /// Interprets a path on the command line.
    #[must_use]
    pub fn from_path(path: &Utf8Path) -> Self {
        let packed = path.extension() == Some("zst");
        let name = if packed { path.with_extension("") } else { path.to_owned() };
        match name.extension() {
            _ if path == "-" => Self::Stdout,
            Some("tar") => Self::Archive(path.to_owned()),
            _ => Self::Folder(path.to_owned()),
        }
    }
}

pub enum BackupSink {
    Folder(FolderSink),
    Archive(Box<ArchiveSink>),
}

const LOCK: &str = "backup.lock";
/// Folder for unfinished parts.
const UNFINISHED: &str = "unfinished";
const DATABASES: (&str, &str) = ("uniground-", ".sqlite");

impl BackupSink {
    pub fn open(target: BackupTarget, data_dir: &Utf8Path) -> Result<Self, BackupError> {
        match target {
            BackupTarget::Folder(folder) => Ok(Self::Folder(FolderSink::open(folder, data_dir)?)),
            BackupTarget::Archive(file) => {
                let folder = match file.parent() {
                    Some(parent) if parent != "" => parent.to_owned(),
                    _ => Utf8PathBuf::from("."),
                };
                let unfinished = NamedTempFile::new_in(&folder)
                    .map_err(|source| BackupError::File { file: folder.clone(), source })?;
                let writer = unfinished.reopen()?;
                let packed: Box<dyn Finish> = match file.extension() {
                    Some("zst") => Box::new(zstd::Encoder::new(writer, 0)?),
                    _ => Box::new(BufWriter::new(writer)),
                };
                Ok(Self::Archive(Box::new(ArchiveSink::new(
                    packed,
                    Some((unfinished, file)),
                    tempfile::tempdir_in(folder)?,
                ))))
            }
            BackupTarget::Stdout => Ok(Self::Archive(Box::new(ArchiveSink::new(
                Box::new(BufWriter::new(io::stdout())),
                None,
                tempfile::tempdir()?,
            )))),
        }
    }

    /// Returns a file name for a snapshot of the database, where there is space for it.
    pub fn database_snapshot_path(&self) -> Utf8PathBuf {
        match self {
            Self::Folder(sink) => sink.folder.join(UNFINISHED).join("database"),
            Self::Archive(sink) => {
                Utf8PathBuf::from(sink.scratch.path().to_string_lossy().into_owned())
                    .join("database")
            }
        }
    }

    /// Adds a published folder. The flag says whether it is new in the backup.
    pub fn add_folder(
        &mut self,
        kind: &str,
        name: &str,
        source: &Utf8Path,
    ) -> Result<(BackupFolder, bool), CopyFailure> {
        let published = fs::metadata(source)
            .and_then(|folder| folder.modified())
            .map_err(|_| CopyFailure::Missing)?;
        let (whole, is_new) = match self {
            Self::Folder(sink) => sink.add_folder(kind, name, source)?,
            Self::Archive(sink) => (sink.add_folder(kind, name, source)?, true),
        };
        let CopiedFolder { sums, files, bytes } = whole;
        let published_s = published.duration_since(UNIX_EPOCH).unwrap_or_default().as_secs();
        let kept = BackupFolder {
            kind: kind.to_owned(),
            name: name.to_owned(),
            sha256: hex(&Sha256::digest(&sums)),
            files,
            bytes,
            published_s,
        };
        Ok((kept, is_new))
    }

    /// Adds the final snapshot of the database.
    pub fn add_database(&mut self, snapshot: &Utf8Path) -> Result<DatabaseEntry, BackupError> {
        let unreadable = |_| BackupError::File {
            file: snapshot.to_owned(),
            source: io::Error::other("it cannot be read"),
        };
        let (sha256, bytes) =
            read_file(snapshot, |_, reader| io::copy(reader, &mut io::sink()).map(drop))
                .map_err(unreadable)?;
        let file = format!("{}{}{}", DATABASES.0, &sha256[..16], DATABASES.1);
        match self {
            Self::Folder(sink) => fs::rename(snapshot, sink.folder.join(&file))?,
            Self::Archive(sink) => {
                sink.append(&file, bytes, SystemTime::now(), &mut File::open(snapshot)?)?;
            }
        }
        Ok(DatabaseEntry { file, sha256, bytes })
    }

    /// Completes the backup by writing its manifest.
    pub fn finish(self, manifest: &Manifest) -> Result<(), BackupError> {
        match self {
            Self::Folder(sink) => sink.finish(manifest),
            Self::Archive(sink) => sink.finish(manifest),
        }
    }
}

/// A folder. It remains the previous backup until the new manifest is in place.
pub struct FolderSink {
    folder: Utf8PathBuf,
    _lock: FileLock,
}

impl FolderSink {
    fn open(folder: Utf8PathBuf, data_dir: &Utf8Path) -> Result<Self, BackupError> {
        if !folder.join(manifest::FILE).exists()
            && !folder.join(LOCK).exists()
            && let Ok(mut entries) = folder.read_dir_utf8()
            && let Some(Ok(stranger)) = entries.next()
        {
            return Err(BackupError::NotABackup { found: stranger.file_name().to_owned(), folder });
        }
        let nearest = folder.ancestors().find(|path| path.exists()).unwrap_or(Utf8Path::new("."));
        if nearest.canonicalize_utf8()?.starts_with(data_dir.canonicalize_utf8()?) {
            return Err(BackupError::Within);
        }
        fs::create_dir_all(&folder)
            .map_err(|source| BackupError::File { file: folder.clone(), source })?;
        let lock = match FileLock::try_exclusive(File::create(folder.join(LOCK))?) {
            Ok(lock) => lock,
            Err(TryLockError::WouldBlock) => return Err(BackupError::Busy { folder }),
            Err(TryLockError::Error(error)) => return Err(error.into()),
        };
        // Remove what an earlier attempt left.
        match fs::remove_dir_all(folder.join(UNFINISHED)) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error.into()),
            _ => {}
        }
        fs::create_dir(folder.join(UNFINISHED))?;
        for kind in KINDS {
            fs::create_dir_all(folder.join("blobs").join(kind))?;
        }
        Ok(Self { folder, _lock: lock })
    }

    fn add_folder(
        &mut self,
        kind: &str,
        name: &str,
        source: &Utf8Path,
    ) -> Result<(CopiedFolder, bool), CopyFailure> {
        let place = self.folder.join("blobs").join(kind).join(name);
        if let Some(whole) = find_identical(source, &place)? {
            return Ok((whole, false));
        }
        let unfinished = self.folder.join(UNFINISHED).join(name);
        let copied = copy_folder(source, &unfinished);
        if copied.is_err() {
            let _ = fs::remove_dir_all(&unfinished);
        }
        let whole = copied?;
        if place.exists() {
            fs::remove_dir_all(&place).map_err(CopyFailure::NotWritten)?;
        }
        fs::rename(&unfinished, &place).map_err(CopyFailure::NotWritten)?;
        Ok((whole, true))
    }

    fn finish(self, manifest: &Manifest) -> Result<(), BackupError> {
        fs::remove_dir_all(self.folder.join(UNFINISHED))?;
        sync_everything(&self.folder)?;
        write_synced(&self.folder.join(manifest::FILE), &manifest.to_sealed_bytes()?)?;
        // The previous manifest is gone: remove the folders that only it referred to.
        let kept: HashSet<(&str, &str)> =
            manifest.folders.iter().map(|kept| (kept.kind.as_str(), kept.name.as_str())).collect();
        for kind in KINDS {
            for entry in self.folder.join("blobs").join(kind).read_dir_utf8()? {
                let entry = entry?;
                if !kept.contains(&(kind, entry.file_name())) {
                    fs::remove_dir_all(entry.path())?;
                }
            }
        }
        for entry in self.folder.read_dir_utf8()? {
            let entry = entry?;
            let name = entry.file_name();
            if name.starts_with(DATABASES.0)
                && name.ends_with(DATABASES.1)
                && name != manifest.database.file
            {
                fs::remove_file(entry.path())?;
            }
        }
        Ok(())
    }
}

/// Copies a folder with its checksums, and checks each file on the way.
pub fn copy_folder(source: &Utf8Path, to: &Utf8Path) -> Result<CopiedFolder, CopyFailure> {
    fs::create_dir_all(to).map_err(CopyFailure::NotWritten)?;
    let whole = read_folder(source, |file, _, reader| {
        let path = to.join(file);
        fs::create_dir_all(path.parent().unwrap_or(to))?;
        io::copy(reader, &mut File::create(path)?).map(drop)
    })?;
    fs::write(to.join(SUMS), &whole.sums).map_err(CopyFailure::NotWritten)?;
    Ok(whole)
}

/// Returns a folder that the backup has already, if it equals the source.
fn find_identical(
    source: &Utf8Path,
    place: &Utf8Path,
) -> Result<Option<CopiedFolder>, CopyFailure> {
    let Ok(Some(sums)) = read_checksum_file(place) else { return Ok(None) };
    // A folder from before checksums were stored got them when it was first copied. Its name
    // identifies its content, then as now.
    if read_checksum_file(source)?.is_some_and(|own| own != sums) {
        return Ok(None);
    }
    let (mut files, mut bytes) = (0, 0);
    for (file, _) in parse_checksums(&sums)? {
        match (fs::metadata(place.join(&file)), fs::metadata(source.join(&file))) {
            (Ok(copy), Ok(own)) if copy.len() == own.len() => {
                (files, bytes) = (files + 1, bytes + copy.len());
            }
            _ => return Ok(None),
        }
    }
    Ok(Some(CopiedFolder { sums, files, bytes }))
}

/// A stream that must be finished explicitly.
trait Finish: Write + Send {
    fn finish_stream(self: Box<Self>) -> io::Result<()>;
}

impl<W: Write + Send> Finish for BufWriter<W> {
    fn finish_stream(mut self: Box<Self>) -> io::Result<()> {
        self.flush()
    }
}

impl Finish for zstd::Encoder<'static, File> {
    fn finish_stream(self: Box<Self>) -> io::Result<()> {
        self.finish()?.flush()
    }
}

/// An archive. Partial data of a folder that turned out to be damaged stays in it, but the
/// manifest, which comes last, does not list that folder.
pub struct ArchiveSink {
    archive: tar::Builder<Box<dyn Finish>>,
    /// Moved into place once it is complete.
    file: Option<(NamedTempFile, Utf8PathBuf)>,
    scratch: TempDir,
}

impl ArchiveSink {
    fn new(
        writer: Box<dyn Finish>,
        file: Option<(NamedTempFile, Utf8PathBuf)>,
        scratch: TempDir,
    ) -> Self {
        Self { archive: tar::Builder::new(writer), file, scratch }
    }

    fn append(
        &mut self,
        path: &str,
        length: u64,
        time: SystemTime,
        reader: &mut dyn Read,
    ) -> io::Result<()> {
        let mut header = tar::Header::new_gnu();
        header.set_size(length);
        header.set_mode(0o600);
        header.set_mtime(time.duration_since(UNIX_EPOCH).unwrap_or_default().as_secs());
        self.archive.append_data(&mut header, path, reader)
    }

    fn add_folder(
        &mut self,
        kind: &str,
        name: &str,
        source: &Utf8Path,
    ) -> Result<CopiedFolder, CopyFailure> {
        let below = format!("blobs/{kind}/{name}");
        let now = SystemTime::now();
        let whole = read_folder(source, |file, length, reader| {
            self.append(&format!("{below}/{file}"), length, now, reader)
        })?;
        self.append(
            &format!("{below}/{SUMS}"),
            whole.sums.len() as u64,
            now,
            &mut whole.sums.as_bytes(),
        )
        .map_err(CopyFailure::NotWritten)?;
        Ok(whole)
    }

    fn finish(mut self, manifest: &Manifest) -> Result<(), BackupError> {
        let manifest = manifest.to_sealed_bytes()?;
        self.append(
            manifest::FILE,
            manifest.len() as u64,
            SystemTime::now(),
            &mut manifest.as_slice(),
        )?;
        self.archive.into_inner()?.finish_stream()?;
        if let Some((unfinished, file)) = self.file {
            unfinished.as_file().sync_all()?;
            unfinished
                .persist(&file)
                .map_err(|error| BackupError::File { file, source: error.error })?;
        }
        Ok(())
    }
}
