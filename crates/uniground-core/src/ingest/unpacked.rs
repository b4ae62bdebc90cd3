//! A scan as a folder, whatever it was given as.

use super::IngestError;
use super::archive::{ArchiveKind, UnpackLimits, unpack};
use camino::{Utf8Path, Utf8PathBuf};
use std::fs;
use tempfile::TempDir;

/// A scan's folder. That of an archive or a bare cloud is temporary and goes with this.
#[derive(Debug)]
pub struct Unpacked {
    /// Folder with the scan's files; a temporary one is removed when this is dropped.
    pub path: Utf8PathBuf,
    _temporary: Option<TempDir>,
}

impl Unpacked {
    /// A folder as it is; an archive (`.zip`, `.tar`, `.tar.zst`) unpacked; a cloud (`.ply`) as a scan without frames.
    ///
    /// # Errors
    /// [`IngestError`]: nothing of the kind, or an archive that can not be unpacked.
    pub fn of(scan: &Utf8Path) -> Result<Self, IngestError> {
        if scan.is_dir() {
            return Ok(Self { path: scan.to_owned(), _temporary: None });
        }
        let reading = |source| IngestError::reading(scan, source);
        let temporary = tempfile::tempdir().map_err(reading)?;
        let path = Utf8Path::from_path(temporary.path())
            .ok_or_else(|| reading(std::io::ErrorKind::InvalidFilename.into()))?
            .to_owned();
        if scan.extension() == Some("ply") {
            fs::copy(scan, path.join("cloud.ply")).map_err(reading)?;
        } else if let Some(kind) = ArchiveKind::of_file_name(scan.as_str()) {
            unpack(scan, kind, &path, &UnpackLimits::default())?;
        } else {
            return Err(IngestError::malformed(scan, "expected a folder, .zip, .tar, .tar.zst or .ply"));
        }
        Ok(Self { path, _temporary: Some(temporary) })
    }
}
