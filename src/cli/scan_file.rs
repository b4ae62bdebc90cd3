//! A scan on the disk as the bytes that are uploaded: a file as it is where a service knows it by
//! its bytes, everything else packed.

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
    /// What a scene of it is called where nobody says: the file's name without its ending.
    pub name: String,
    source: Source,
}

enum Source {
    /// An archive or a `.sens` file.
    File(Utf8PathBuf),
    /// Everything else, as a folder: clouds too, whose names tell what their bytes do not.
    Folder(ScanFolder),
}

impl ScanFile {
    /// # Errors
    /// Nothing is there, or nothing that is read.
    pub fn open(scan: &Utf8Path) -> anyhow::Result<Self> {
        ensure!(scan.exists(), "{scan}: there is no such file or folder");
        let name = name_of(scan);
        let source = match is_known_by_its_bytes(scan).with_context(|| scan.to_string())? {
            true => Source::File(scan.to_owned()),
            false => Source::Folder(
                ScanFolder::open(scan).map_err(|error| hints::of_scan(error.into(), scan))?,
            ),
        };
        Ok(Self { name, source })
    }

    /// SHA-256 of the bytes, hex: what a service knows the scan by.
    ///
    /// # Errors
    /// A file that can not be read.
    pub fn hash(&self) -> anyhow::Result<String> {
        let mut hashing = Hashing(Sha256::new());
        match &self.source {
            Source::File(path) => io::copy(&mut File::open(path)?, &mut hashing).map(drop)?,
            Source::Folder(folder) => pack(&folder.path, Links::All, &mut hashing)?,
        }
        Ok(hashing.0.finalize().iter().map(|byte| format!("{byte:02x}")).collect())
    }

    /// The bytes, to be read from the beginning, and how many they are.
    ///
    /// # Errors
    /// A file that can not be read, no room for what is packed.
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

/// Of `room.tar.zst`, `room`; of `.` and `..`, what the folder is called.
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
    // What is called an archive and is none is for the service to tell.
    Ok(matches!(packed, Some(ArchiveFormat::Archive(_) | ArchiveFormat::Sens))
        || ArchiveKind::from_file_name(scan.as_str()).is_some())
}

struct Hashing(Sha256);

impl Write for Hashing {
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
    fn scans_are_called_what_their_files_are_called() {
        assert_eq!(name_of("scans/living_room.zip".into()), "living_room");
        assert_eq!(name_of("hall.tar.zst".into()), "hall");
        assert_eq!(name_of("src/cli".into()), "cli");
    }
}
