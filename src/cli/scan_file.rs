//! Prepares a local scan for upload. Archives and `.sens` files are sent unchanged; everything else
//! is packed.

use super::hints;
use anyhow::{Context, ensure};
use camino::{Utf8Path, Utf8PathBuf};
use sha2::{Digest, Sha256};
use std::fs::File;
use std::io::{self, Read, Seek, Write};
use uniground_core::ingest::archive::ArchiveKind;
use uniground_core::ingest::{ArchiveFormat, ScanFolder};
use uniground_service::packing::{Links, pack};

pub struct ScanFile {
    /// Default name of the scene: the file name without its extension.
    pub name: String,
    source: Source,
}

enum Source {
    /// An archive or a `.sens` file.
    File(Utf8PathBuf),
    /// Everything else, packed as a folder. Point clouds are included, because only their file name
    /// shows the format.
    Folder(ScanFolder),
}

impl ScanFile {
    /// # Errors
    /// Returns an error if the scan does not exist or its format is unknown.
    pub fn open(scan: &Utf8Path) -> anyhow::Result<Self> {
        ensure!(scan.exists(), "{scan}: no such file or folder");
        let name = name_of(scan);
        let source = match is_known_by_its_bytes(scan).with_context(|| scan.to_string())? {
            true => Source::File(scan.to_owned()),
            false => Source::Folder(
                ScanFolder::open(scan)
                    .map_err(|error| hints::with_scan_hint(error.into(), scan))?,
            ),
        };
        Ok(Self { name, source })
    }

    /// Returns the SHA-256 of the bytes as hex. A service finds known scans by it.
    ///
    /// # Errors
    /// Returns an error if a file cannot be read.
    pub fn hash(&self) -> anyhow::Result<String> {
        let mut hashing = HashWriter(Sha256::new());
        match &self.source {
            Source::File(path) => io::copy(&mut File::open(path)?, &mut hashing).map(drop)?,
            Source::Folder(folder) => pack(&folder.path, Links::All, &mut hashing)?,
        }
        Ok(hashing.0.finalize().iter().map(|byte| format!("{byte:02x}")).collect())
    }

    /// Returns the bytes, positioned at the start, and their number.
    ///
    /// # Errors
    /// Returns an error if a file cannot be read or the packed scan does not fit on disk.
    pub fn bytes(&self) -> anyhow::Result<(File, u64)> {
        let file = match &self.source {
            Source::File(path) => File::open(path).with_context(|| path.to_string())?,
            Source::Folder(folder) => {
                let mut file = tempfile::tempfile()?;
                pack(&folder.path, Links::All, &mut file)?;
                file.rewind()?;
                file
            }
        };
        let bytes = file.metadata()?.len();
        Ok((file, bytes))
    }
}

/// Returns the name without extensions: `room` for `room.tar.zst`. `.` and `..` give the folder's
/// name.
fn name_of(scan: &Utf8Path) -> String {
    let whole = scan.canonicalize_utf8();
    let name = scan.file_name().or_else(|| whole.as_deref().ok()?.file_name()).unwrap_or("scan");
    let stem = if scan.is_dir() { name } else { Utf8Path::new(name).file_stem().unwrap_or(name) };
    stem.strip_suffix(".tar").unwrap_or(stem).to_owned()
}

fn is_known_by_its_bytes(scan: &Utf8Path) -> io::Result<bool> {
    if scan.is_dir() {
        return Ok(false);
    }
    let mut head = Vec::new();
    File::open(scan)?.take(ArchiveFormat::HEAD_BYTES as u64).read_to_end(&mut head)?;
    let packed = ArchiveFormat::from_head(&head, scan.as_str());
    // A file with the name of an archive is sent unchanged, so that the service reports why it is
    // invalid.
    Ok(matches!(packed, Some(ArchiveFormat::Archive(_) | ArchiveFormat::Sens))
        || ArchiveKind::from_file_name(scan.as_str()).is_some())
}

struct HashWriter(Sha256);

impl Write for HashWriter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.update(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scan_names_come_from_file_names() {
        assert_eq!(name_of("scans/living_room.zip".into()), "living_room");
        assert_eq!(name_of("hall.tar.zst".into()), "hall");
        assert_eq!(name_of("src/cli".into()), "cli");
    }
}
