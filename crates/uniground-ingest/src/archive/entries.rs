//! Iterates over the entries of an archive of any kind. Limits the size of names and extension
//! headers.

use super::{ArchiveKind, UnpackLimits};
use crate::IngestError;
use crate::limited_reader::{LimitedReader, ReadLimit};
use camino::Utf8Path;
use std::fs::File;
use std::io::{self, BufReader, Read, Seek, SeekFrom};

/// The kind of an entry.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum EntryKind {
    File,
    Folder,
}

/// Receives every entry: its name, its kind and its content.
pub(super) trait EntryVisitor {
    fn entry(
        &mut self,
        name: &str,
        kind: EntryKind,
        content: &mut dyn Read,
    ) -> Result<(), IngestError>;
}

/// Maximum size of a zip's central directory: enough for the maximum number of entries with names
/// of usual length.
const MAX_ZIP_DIRECTORY_BYTES: u64 = 12 << 20;
/// Bytes of tar headers per entry, in addition to the files themselves.
const TAR_HEADER_BYTES: u64 = 1536;
/// Maximum size of extended headers. They hold a name, times and similar values.
const MAX_EXTENDED_HEADER_BYTES: u64 = 64 << 10;
/// Maximum window of a compressed tar, as a power of two: 64 MiB of memory.
const MAX_WINDOW_LOG: u32 = 26;

/// Passes every entry to `visitor`. The entries of a zip are decompressed only if `with_content` is
/// true.
pub(super) fn walk(
    archive: &Utf8Path,
    kind: ArchiveKind,
    limits: &UnpackLimits,
    with_content: bool,
    visitor: &mut dyn EntryVisitor,
) -> Result<(), IngestError> {
    let file =
        File::open(archive).map_err(|source| IngestError::Io { file: "upload".into(), source })?;
    let packed_bytes = file.metadata().map_or(0, |m| m.len());
    match kind {
        ArchiveKind::Zip => walk_zip(file, limits, with_content, visitor),
        // If only names are needed, seeks from header to header.
        ArchiveKind::Tar if !with_content => {
            let mut tar = tar::Archive::new(file);
            walk_tar_entries(
                tar.entries_with_seek().map_err(|e| kind.unreadable(e))?,
                kind,
                visitor,
            )
        }
        ArchiveKind::Tar => {
            walk_tar(file, kind, limits.max_unpacked_bytes(packed_bytes), limits, visitor)
        }
        ArchiveKind::TarGz => {
            let decoder = flate2::read::MultiGzDecoder::new(file);
            walk_tar(decoder, kind, limits.max_unpacked_bytes(packed_bytes), limits, visitor)
        }
        ArchiveKind::TarZst => {
            let mut decoder = zstd::Decoder::new(file).map_err(|e| kind.unreadable(e))?;
            decoder.window_log_max(MAX_WINDOW_LOG).map_err(|e| kind.unreadable(e))?;
            walk_tar(decoder, kind, limits.max_unpacked_bytes(packed_bytes), limits, visitor)
        }
    }
}

fn walk_zip(
    mut file: File,
    limits: &UnpackLimits,
    with_content: bool,
    visitor: &mut dyn EntryVisitor,
) -> Result<(), IngestError> {
    let unreadable = |reason: &dyn ToString| ArchiveKind::Zip.unreadable(reason.to_string());
    let packed_bytes = file.metadata().map_or(0, |m| m.len());
    if declared_entry_count(&mut file)
        .map_err(|e| unreadable(&e))?
        .is_some_and(|entries| entries > limits.max_entries as u64)
    {
        return Err(limits.too_many_entries());
    }
    // The directory is held in memory as a whole.
    let allowance = ReadLimit::new(MAX_ZIP_DIRECTORY_BYTES);
    let mut zip = zip::ZipArchive::new(BufReader::new(LimitedReader::new(file, &allowance)))
        .map_err(|e| match allowance.is_spent() {
            true => limits.too_many_entries(),
            false => unreadable(&e),
        })?;
    if zip.len() > limits.max_entries {
        return Err(limits.too_many_entries());
    }
    allowance.reset(u64::MAX);
    let unpacked = ReadLimit::new(limits.max_unpacked_bytes(packed_bytes));
    for i in 0..zip.len() {
        let entry = if with_content { zip.by_index(i) } else { zip.by_index_raw(i) };
        let mut entry = entry.map_err(|e| unreadable(&e))?;
        let name = entry.name().map_err(|e| unreadable(&e))?.into_owned();
        if entry.is_symlink() {
            return Err(IngestError::unsafe_entry(
                &name,
                "is a link; only plain files and folders are accepted",
            ));
        }
        let kind = if entry.is_dir() { EntryKind::Folder } else { EntryKind::File };
        let visited = visitor.entry(&name, kind, &mut LimitedReader::new(&mut entry, &unpacked));
        if unpacked.is_spent() {
            return Err(limits.too_many_bytes());
        }
        visited?;
    }
    Ok(())
}

/// Returns the number of entries from the record at the end of a zip, or `None` if there is none.
/// The caller checks it before it reads the directory, which is held in memory as a whole. Rewinds
/// the file to its start.
fn declared_entry_count(file: &mut File) -> io::Result<Option<u64>> {
    // The record, the longest comment after it, and the record of large archives (zip64) before it.
    const RECORD: usize = 22;
    const LOCATOR: usize = 20;
    const LONGEST_TAIL: usize = LOCATOR + RECORD + u16::MAX as usize;
    let length = file.seek(SeekFrom::End(0))?;
    file.seek(SeekFrom::Start(length.saturating_sub(LONGEST_TAIL as u64)))?;
    let mut tail = Vec::new();
    file.take(LONGEST_TAIL as u64).read_to_end(&mut tail)?;
    let mut entries = None;
    if let Some(at) = tail.windows(4).rposition(|four| four == b"PK\x05\x06")
        && let Some(count) = tail.get(at + 10..at + 12)
    {
        entries = Some(u64::from(u16::from_le_bytes([count[0], count[1]])));
        let locator = at
            .checked_sub(LOCATOR)
            .map(|start| &tail[start..at])
            .filter(|locator| locator.starts_with(b"PK\x06\x07"));
        if let Some(offset) =
            locator.and_then(|locator| locator[8..16].try_into().ok()).map(u64::from_le_bytes)
        {
            let mut large = [0; 40];
            file.seek(SeekFrom::Start(offset))?;
            if file.read_exact(&mut large).is_ok() && large.starts_with(b"PK\x06\x06") {
                entries = large[32..40].try_into().ok().map(u64::from_le_bytes);
            }
        }
    }
    file.rewind()?;
    Ok(entries)
}

fn walk_tar(
    source: impl Read,
    kind: ArchiveKind,
    bytes: u64,
    limits: &UnpackLimits,
    visitor: &mut dyn EntryVisitor,
) -> Result<(), IngestError> {
    // Headers count too. Otherwise a tar could consist of any number of headers.
    let allowance =
        ReadLimit::new(bytes.saturating_add(limits.max_entries as u64 * TAR_HEADER_BYTES));
    let mut tar = tar::Archive::new(LimitedReader::new(source, &allowance));
    let walked = tar
        .entries()
        .map_err(|e| kind.unreadable(e))
        .and_then(|entries| walk_tar_entries(entries, kind, visitor));
    if allowance.is_spent() { Err(limits.too_many_bytes()) } else { walked }
}

/// Handles extended headers as separate entries. By default, the tar reader would load them into
/// memory whatever their size.
fn walk_tar_entries(
    entries: tar::Entries<'_, impl Read>,
    kind: ArchiveKind,
    visitor: &mut dyn EntryVisitor,
) -> Result<(), IngestError> {
    use tar::EntryType::{
        Continuous, Directory, GNULongLink, GNULongName, Regular, XGlobalHeader, XHeader,
    };
    let mut seen_any = false;
    let mut long_name: Option<Vec<u8>> = None;
    for entry in entries.raw(true) {
        let mut entry = entry.map_err(|e| kind.unreadable(e))?;
        seen_any = true;
        let entry_type = entry.header().entry_type();
        match entry_type {
            GNULongName => {
                let mut name = extended_header(&mut entry, kind)?;
                name.truncate(name.iter().position(|byte| *byte == 0).unwrap_or(name.len()));
                long_name = Some(name);
                continue;
            }
            XHeader => {
                let header = extended_header(&mut entry, kind)?;
                if let Some(name) = pax_path(&header, kind)? {
                    long_name = Some(name);
                }
                continue;
            }
            XGlobalHeader | GNULongLink => continue,
            _ => {}
        }
        let name = long_name.take().unwrap_or_else(|| entry.path_bytes().into_owned());
        let name = String::from_utf8_lossy(&name).into_owned();
        match entry_type {
            Directory => visitor.entry(&name, EntryKind::Folder, &mut entry)?,
            // The oldest kind of tar marks folders by a trailing slash in their name.
            Regular if name.ends_with('/') => {
                visitor.entry(&name, EntryKind::Folder, &mut entry)?;
            }
            Regular | Continuous => visitor.entry(&name, EntryKind::File, &mut entry)?,
            _ => return Err(IngestError::unsafe_entry(&name, "is not a plain file or folder")),
        }
    }
    if seen_any { Ok(()) } else { Err(kind.unreadable("it has no entries")) }
}

fn extended_header(
    entry: &mut tar::Entry<'_, impl Read>,
    kind: ArchiveKind,
) -> Result<Vec<u8>, IngestError> {
    let size = entry.size();
    if size > MAX_EXTENDED_HEADER_BYTES {
        return Err(kind.unreadable(format!(
            "an extended header has {size} bytes; the limit is {MAX_EXTENDED_HEADER_BYTES}"
        )));
    }
    let mut bytes = Vec::new();
    entry.read_to_end(&mut bytes).map_err(|e| kind.unreadable(e))?;
    Ok(bytes)
}

/// Returns the name that an extended header gives to the next entry. A header that changes the size
/// is refused, because readers would disagree on the content.
fn pax_path(header: &[u8], kind: ArchiveKind) -> Result<Option<Vec<u8>>, IngestError> {
    let mut path = None;
    for extension in tar::PaxExtensions::new(header) {
        let extension = extension.map_err(|e| kind.unreadable(e))?;
        match extension.key_bytes() {
            b"path" => path = Some(extension.value_bytes().to_owned()),
            b"size" => {
                return Err(kind.unreadable("it has a file of 8 GiB or more, or with two sizes"));
            }
            key if key.starts_with(b"GNU.sparse.") => {
                return Err(kind.unreadable("sparse files are not supported"));
            }
            _ => {}
        }
    }
    Ok(path)
}
