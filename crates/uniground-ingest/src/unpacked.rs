//! Opens a scan of any form as a folder.

use super::IngestError;
use super::archive::{ArchiveKind, UnpackLimits, unpack};
use super::clouds::CloudKind;
use super::sens;
use camino::{Utf8Path, Utf8PathBuf};
use std::fs;
use std::io::Read;
use tempfile::TempDir;

/// A scan's folder. For an archive or a single cloud it is temporary and removed on drop.
#[derive(Debug)]
pub struct ScanFolder {
    /// Folder with the scan's files. A temporary one is removed when this is dropped.
    pub path: Utf8PathBuf,
    _temporary: Option<TempDir>,
}

impl ScanFolder {
    /// Opens a scan: a folder is used unchanged, an archive (`.zip`, `.tar`, `.tar.gz`, `.tar.zst`, `.r3d`) or
    /// a `.sens` file is unpacked, and a cloud or a mesh becomes a scan without frames.
    ///
    /// # Errors
    /// Returns an [`IngestError`] for an unsupported file, or an archive that cannot be unpacked.
    pub fn open(scan: &Utf8Path) -> Result<Self, IngestError> {
        if scan.is_dir() {
            let Some(sens) = sens::find_single_file(scan)? else {
                return Ok(Self { path: scan.to_owned(), _temporary: None });
            };
            return Self::open(&sens);
        }
        let reading = |source| IngestError::reading(scan, source);
        let temporary = tempfile::tempdir().map_err(reading)?;
        let path = Utf8Path::from_path(temporary.path())
            .ok_or_else(|| reading(std::io::ErrorKind::InvalidFilename.into()))?
            .to_owned();
        match ArchiveFormat::detect(scan)
            .ok_or_else(|| IngestError::malformed(scan, describe_content(&read_head(scan))))?
        {
            // Files that a mesh refers to are next to it.
            ArchiveFormat::Cloud("obj" | "gltf") => {
                copy_sibling_files(scan, scan.parent().unwrap_or(Utf8Path::new(".")), &path)
                    .map_err(reading)?;
            }
            ArchiveFormat::Cloud(ending) => {
                put(scan, &path.join("cloud").with_extension(ending)).map_err(reading)?;
            }
            packed => packed.unpack(scan, &path, &UnpackLimits::default())?,
        }
        Ok(Self { path, _temporary: Some(temporary) })
    }
}

/// How a scan is packed into one file, detected from its bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ArchiveFormat {
    /// An archive with the scan's files.
    Archive(ArchiveKind),
    /// `ScanNet`'s stream of frames.
    Sens,
    /// A cloud or a mesh, with the extension of such files.
    Cloud(&'static str),
}

impl ArchiveFormat {
    /// Number of bytes at the start of a file that suffice for detection.
    pub const HEAD_BYTES: usize = 4096;

    /// Detects the format from a file's first bytes. If those are only numbers, the extension of
    /// its name decides. `None`: not a supported format.
    #[must_use]
    pub fn from_head(head: &[u8], name: &str) -> Option<Self> {
        let extension = Utf8Path::new(name).extension().unwrap_or_default();
        ArchiveKind::from_head(head)
            .map(Self::Archive)
            .or_else(|| sens::can_read(head, extension).then_some(Self::Sens))
            .or_else(|| CloudKind::from_head(head, extension).map(|kind| Self::Cloud(kind.name())))
    }

    fn detect(file: &Utf8Path) -> Option<Self> {
        let head = read_head(file);
        Self::from_head(&head, file.as_str())
            .or_else(|| {
                let named = ArchiveKind::from_file_name(file.as_str());
                named.filter(|_| !is_unsupported_archive(&head)).map(Self::Archive)
            })
            .or((file.extension() == Some("ply")).then_some(Self::Cloud("ply")))
    }

    /// Writes the scan's files into a folder. A cloud is copied.
    ///
    /// # Errors
    /// Returns an [`IngestError`] for an archive that cannot be unpacked or a file that cannot be
    /// copied.
    pub fn unpack(
        self,
        file: &Utf8Path,
        folder: &Utf8Path,
        limits: &UnpackLimits,
    ) -> Result<(), IngestError> {
        match self {
            Self::Archive(kind) => unpack(file, kind, folder, limits),
            Self::Sens => sens::unpack(file, folder, limits.max_bytes).map(drop),
            Self::Cloud(ending) => {
                let copied = fs::copy(file, folder.join("cloud").with_extension(ending));
                copied.map(drop).map_err(|source| IngestError::reading(file, source))
            }
        }
    }
}

/// Returns the first bytes of a file.
#[must_use]
pub fn read_head(file: &Utf8Path) -> Vec<u8> {
    let mut head = Vec::new();
    // An unreadable file is reported when it is loaded.
    let _ = fs::File::open(file)
        .and_then(|f| f.take(ArchiveFormat::HEAD_BYTES as u64).read_to_end(&mut head));
    head
}

/// Returns whether these are the first bytes of bzip2, xz, 7-Zip or RAR.
fn is_unsupported_archive(head: &[u8]) -> bool {
    let starts: [&[u8]; 4] = [b"BZh", b"\xfd7zXZ", b"7z\xbc\xaf", b"Rar!"];
    starts.iter().any(|start| head.starts_with(start))
}

/// Creates a symbolic link to a file, or copies it where linking is not possible.
fn put(file: &Utf8Path, target: &Utf8Path) -> std::io::Result<()> {
    let linked = file.canonicalize_utf8().and_then(|file| std::os::unix::fs::symlink(file, target));
    linked.or_else(|_| fs::copy(file, target).map(drop))
}

/// Extensions of files that a mesh can refer to: its materials, buffers and pictures.
pub(super) const BESIDE_MESHES: [&str; 5] = ["mtl", "bin", "png", "jpg", "jpeg"];

fn copy_sibling_files(
    mesh: &Utf8Path,
    folder: &Utf8Path,
    target: &Utf8Path,
) -> std::io::Result<()> {
    fs::copy(mesh, target.join("mesh").with_extension(mesh.extension().unwrap_or("obj")))?;
    let folder = if folder.as_str().is_empty() { Utf8Path::new(".") } else { folder };
    for entry in folder.read_dir_utf8()? {
        let entry = entry?;
        let wanted = entry
            .path()
            .extension()
            .is_some_and(|e| BESIDE_MESHES.contains(&e.to_ascii_lowercase().as_str()));
        if wanted && entry.file_type()?.is_file() {
            fs::copy(entry.path(), target.join(entry.file_name()))?;
        }
    }
    Ok(())
}

/// Returns a hint for file types that are often uploaded but are not scans.
#[must_use]
pub fn describe_content(head: &[u8]) -> &'static str {
    match head {
        [] => "the file is empty",
        [0xff, 0xd8, ..] | [0x89, b'P', b'N', b'G', ..] => {
            "this is a single picture: a scan needs many, with depth and poses"
        }
        [_, _, _, _, b'f', b't', b'y', b'p', ..] => {
            "this is a video: a scan needs its frames as pictures, with depth and poses"
        }
        [b'#', b'R', b'O', b'S', b'B', b'A', b'G', ..] => {
            "this is a ROS bag: export color, depth and poses from it first"
        }
        [b'S', b'Q', b'L', b'i', b't', b'e', ..] => {
            "this is a database: if it is RTAB-Map's, run `rtabmap-export --images --poses_camera`"
        }
        head if is_unsupported_archive(head) => {
            "this archive is compressed with bzip2, xz, 7-Zip or RAR: pack the scan as .zip, .tar or .tar.gz"
        }
        _ => {
            "no scan was recognized: expected an archive (.zip, .tar, .tar.gz, .tar.zst, .r3d), a .sens file, a cloud or a mesh"
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn content_counts_more_than_the_name_of_an_archive() {
        let folder = tempfile::tempdir().unwrap();
        let file = Utf8Path::from_path(folder.path()).unwrap().join("scan.zip");
        fs::write(&file, b"Rar!\x1a\x07\x01\x00 and more").unwrap();
        let refused = ScanFolder::open(&file).unwrap_err().to_string();
        assert!(refused.contains("7-Zip or RAR: pack the scan"), "{refused}");
        fs::write(&file, [0x1f, 0x8b, 8, 0]).unwrap();
        let detected = ArchiveFormat::detect(&file);
        assert_eq!(detected, Some(ArchiveFormat::Archive(ArchiveKind::TarGz)));
    }
}
