//! Unpacks an uploaded archive into a folder. Entry names, counts and sizes are hostile input.

use super::IngestError;
use camino::{Utf8Component, Utf8Path, Utf8PathBuf};
use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io::{self, BufReader, Read, Write};

/// Container of an upload, as declared by its content type.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ArchiveKind {
    /// `.zip`; its entries may be compressed.
    Zip,
    /// `.tar`, not compressed.
    Tar,
    /// `.tar.zst` or `.tzst`: a tar compressed with Zstandard.
    TarZst,
}

impl ArchiveKind {
    /// By media type, parameters ignored.
    #[must_use]
    pub fn of_media_type(media_type: &str) -> Option<Self> {
        match media_type.split(';').next().unwrap_or_default().trim().to_ascii_lowercase().as_str() {
            "application/zip" | "application/x-zip-compressed" => Some(Self::Zip),
            "application/x-tar" => Some(Self::Tar),
            "application/zstd" | "application/x-zstd" => Some(Self::TarZst),
            _ => None,
        }
    }

    /// By file name.
    #[must_use]
    pub fn of_file_name(name: &str) -> Option<Self> {
        let name = name.to_ascii_lowercase();
        [(".zip", Self::Zip), (".tar", Self::Tar), (".tar.zst", Self::TarZst), (".tzst", Self::TarZst)]
            .into_iter()
            .find_map(|(ending, kind)| name.ends_with(ending).then_some(kind))
    }

    /// Its content type in an upload; [`of_media_type`](Self::of_media_type) knows other spellings too.
    #[must_use]
    pub fn media_type(self) -> &'static str {
        match self {
            Self::Zip => "application/zip",
            Self::Tar => "application/x-tar",
            Self::TarZst => "application/zstd",
        }
    }

    fn name(self) -> &'static str {
        match self {
            Self::Zip => "zip",
            Self::Tar => "tar",
            Self::TarZst => "tar.zst",
        }
    }
}

/// Bounds on what an archive may unpack to.
#[derive(Debug, Clone, Copy)]
pub struct UnpackLimits {
    /// Number of files, folders not counted.
    pub max_entries: usize,
    /// Size of all files together, unpacked.
    pub max_bytes: u64,
    /// Unpacked over packed size; depth pictures are compressed already, so honest archives stay far below.
    pub max_ratio: u64,
}

impl Default for UnpackLimits {
    fn default() -> Self {
        Self { max_entries: 200_000, max_bytes: 64 << 30, max_ratio: 200 }
    }
}

/// Unpacks `archive` into the empty folder `target`.
///
/// # Errors
/// [`IngestError`] naming the entry; `target` may then hold a part and is the caller's to remove.
pub fn unpack(archive: &Utf8Path, kind: ArchiveKind, target: &Utf8Path, limits: &UnpackLimits) -> Result<(), IngestError> {
    let file = File::open(archive).map_err(|source| IngestError::Io { file: "upload".into(), source })?;
    let packed_bytes = file.metadata().map_or(0, |m| m.len());
    let mut sink = Sink::new(target, kind, packed_bytes, limits);
    match kind {
        ArchiveKind::Zip => unpack_zip(file, &mut sink),
        ArchiveKind::Tar => unpack_tar(BufReader::new(file), &mut sink),
        ArchiveKind::TarZst => unpack_tar(zstd::Decoder::new(file).map_err(|e| sink.unreadable(e))?, &mut sink),
    }
}

fn unpack_zip(file: File, sink: &mut Sink) -> Result<(), IngestError> {
    let mut zip = zip::ZipArchive::new(BufReader::new(file)).map_err(|e| sink.unreadable(e))?;
    for i in 0..zip.len() {
        let mut entry = zip.by_index(i).map_err(|e| sink.unreadable(e))?;
        let name = entry.name().map_err(|e| sink.unreadable(e))?.into_owned();
        if entry.is_symlink() {
            return Err(IngestError::UnsafeEntry { entry: name, reason: "is a link; only plain files and folders are accepted" });
        }
        if !entry.is_dir() {
            sink.write(&name, &mut entry)?;
        }
    }
    Ok(())
}

fn unpack_tar(reader: impl Read, sink: &mut Sink) -> Result<(), IngestError> {
    let mut tar = tar::Archive::new(reader);
    let mut seen_any = false;
    for entry in tar.entries().map_err(|e| sink.unreadable(e))? {
        let mut entry = entry.map_err(|e| sink.unreadable(e))?;
        seen_any = true;
        let name = String::from_utf8_lossy(&entry.path_bytes()).into_owned();
        match entry.header().entry_type() {
            tar::EntryType::Directory | tar::EntryType::XGlobalHeader => {}
            tar::EntryType::Regular | tar::EntryType::Continuous => sink.write(&name, &mut entry)?,
            _ => return Err(IngestError::UnsafeEntry { entry: name, reason: "is not a plain file or folder" }),
        }
    }
    if seen_any { Ok(()) } else { Err(sink.unreadable("it has no entries")) }
}

/// Writes entries below one folder and keeps count.
struct Sink<'a> {
    target: &'a Utf8Path,
    kind: ArchiveKind,
    limits: &'a UnpackLimits,
    bytes_left: u64,
    entries: usize,
    folders: BTreeSet<Utf8PathBuf>,
}

impl<'a> Sink<'a> {
    fn new(target: &'a Utf8Path, kind: ArchiveKind, packed_bytes: u64, limits: &'a UnpackLimits) -> Self {
        // Small archives may compress very well; the ratio only matters once there is something to blow up.
        let by_ratio = packed_bytes.max(1 << 20).saturating_mul(limits.max_ratio);
        Self { target, kind, limits, bytes_left: limits.max_bytes.min(by_ratio), entries: 0, folders: BTreeSet::new() }
    }

    fn unreadable(&self, reason: impl ToString) -> IngestError {
        IngestError::ArchiveUnreadable { kind: self.kind.name(), reason: reason.to_string() }
    }

    fn write(&mut self, name: &str, content: &mut dyn Read) -> Result<(), IngestError> {
        self.entries += 1;
        if self.entries > self.limits.max_entries {
            return Err(IngestError::ArchiveTooLarge { limit: format!("{} files", self.limits.max_entries) });
        }
        let path = self.target.join(safe_path(name)?);
        let io = |source| cannot_store(name, source);
        if let Some(folder) = path.parent()
            && !self.folders.contains(folder)
        {
            fs::create_dir_all(folder).map_err(io)?;
            self.folders.insert(folder.to_owned());
        }
        let mut file = File::create_new(&path).map_err(io)?;
        let mut buffer = vec![0; 64 << 10];
        loop {
            let n = content.read(&mut buffer).map_err(|e| self.unreadable(format!("{name}: {e}")))?;
            if n == 0 {
                return Ok(());
            }
            self.bytes_left = self.bytes_left.checked_sub(n as u64).ok_or_else(|| IngestError::ArchiveTooLarge {
                limit: format!("{} bytes or {} times its packed size", self.limits.max_bytes, self.limits.max_ratio),
            })?;
            file.write_all(&buffer[..n]).map_err(io)?;
        }
    }
}

/// Some names fit an archive but not a disk; a full disk is the server's trouble.
fn cannot_store(name: &str, source: io::Error) -> IngestError {
    use io::ErrorKind::{AlreadyExists, InvalidFilename, InvalidInput, IsADirectory, NotADirectory};
    let reason = match source.kind() {
        AlreadyExists => "stands in the archive twice",
        InvalidFilename | InvalidInput => "has a name no disk takes",
        IsADirectory | NotADirectory => "is both a file and a folder",
        _ => return IngestError::Io { file: name.into(), source },
    };
    IngestError::UnsafeEntry { entry: name.into(), reason }
}

/// The entry's path when it is relative and stays inside the archive.
fn safe_path(name: &str) -> Result<Utf8PathBuf, IngestError> {
    let unsafe_entry = |reason| IngestError::UnsafeEntry { entry: name.into(), reason };
    if name.contains(['\\', '\0']) {
        return Err(unsafe_entry("holds a backslash or NUL"));
    }
    let mut path = Utf8PathBuf::new();
    for component in Utf8Path::new(name).components() {
        match component {
            Utf8Component::Normal(part) => path.push(part),
            Utf8Component::CurDir => {}
            _ => return Err(unsafe_entry("points outside the archive")),
        }
    }
    if path.as_str().is_empty() { Err(unsafe_entry("has no name")) } else { Ok(path) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn zip_of(entries: &[(&str, &[u8])]) -> Vec<u8> {
        let mut zip = zip::ZipWriter::new(io::Cursor::new(Vec::new()));
        for (name, content) in entries {
            zip.start_file(*name, zip::write::SimpleFileOptions::default()).unwrap();
            zip.write_all(content).unwrap();
        }
        zip.finish().unwrap().into_inner()
    }

    fn unpack_bytes(bytes: &[u8], kind: ArchiveKind, limits: &UnpackLimits) -> Result<Vec<String>, IngestError> {
        let folder = tempfile::tempdir().unwrap();
        let folder = Utf8Path::from_path(folder.path()).unwrap();
        let (archive, target) = (folder.join("upload"), folder.join("out"));
        fs::write(&archive, bytes).unwrap();
        fs::create_dir(&target).unwrap();
        unpack(&archive, kind, &target, limits)?;
        let mut names: Vec<_> = fs::read_dir(&target).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        Ok(names)
    }

    #[test]
    fn zip_tar_and_tar_zst_unpack_alike() {
        let mut tar = tar::Builder::new(Vec::new());
        for name in ["a.txt", "b/c.txt"] {
            let mut header = tar::Header::new_gnu();
            header.set_size(2);
            tar.append_data(&mut header, name, &b"hi"[..]).unwrap();
        }
        let tar = tar.into_inner().unwrap();
        let zst = zstd::encode_all(&tar[..], 1).unwrap();
        let zip = zip_of(&[("a.txt", b"hi"), ("b/c.txt", b"hi")]);
        for (bytes, kind) in [(zip, ArchiveKind::Zip), (tar, ArchiveKind::Tar), (zst, ArchiveKind::TarZst)] {
            assert_eq!(unpack_bytes(&bytes, kind, &UnpackLimits::default()).unwrap(), ["a.txt", "b"]);
        }
    }

    #[test]
    fn a_truncated_archive_is_named_as_such() {
        let zip = zip_of(&[("a.txt", &[7; 5000])]);
        let cut = unpack_bytes(&zip[..zip.len() - 30], ArchiveKind::Zip, &UnpackLimits::default());
        assert!(matches!(cut, Err(IngestError::ArchiveUnreadable { kind: "zip", .. })), "{cut:?}");
        let noise = unpack_bytes(b"not an archive", ArchiveKind::TarZst, &UnpackLimits::default());
        assert!(matches!(noise, Err(IngestError::ArchiveUnreadable { kind: "tar.zst", .. })), "{noise:?}");
    }

    #[test]
    fn bombs_stop_at_the_limit() {
        let zeros = vec![0; 40 << 20];
        let limits = UnpackLimits { max_ratio: 20, ..UnpackLimits::default() };
        assert!(matches!(
            unpack_bytes(&zip_of(&[("z", &zeros)]), ArchiveKind::Zip, &limits),
            Err(IngestError::ArchiveTooLarge { .. })
        ));
        let limits = UnpackLimits { max_entries: 1, ..UnpackLimits::default() };
        assert!(matches!(
            unpack_bytes(&zip_of(&[("a", b""), ("b", b"")]), ArchiveKind::Zip, &limits),
            Err(IngestError::ArchiveTooLarge { .. })
        ));
    }

    #[test]
    fn entries_that_leave_the_folder_are_refused_by_name() {
        for name in ["../evil", "a/../../evil", "/etc/passwd", "a\\..\\evil"] {
            let refused = unpack_bytes(&zip_of(&[(name, b"x")]), ArchiveKind::Zip, &UnpackLimits::default());
            assert!(matches!(refused, Err(IngestError::UnsafeEntry { .. })), "{name}: {refused:?}");
        }
    }

    proptest! {
        #[test]
        fn a_safe_path_never_climbs(name in "[a-z./\\\\]{0,20}") {
            if let Ok(path) = safe_path(&name) {
                prop_assert!(path.is_relative() && path.components().all(|c| matches!(c, Utf8Component::Normal(_))));
            }
        }
    }
}
