//! Unpacks an uploaded archive into a folder. Entry names, counts and sizes are untrusted input.

mod entries;
mod sink;

use super::{IngestError, sens};
use camino::Utf8Path;
use entries::walk;
use serde::{Deserialize, Serialize};
use sink::{ArchiveCheck, ArchiveExtractor};

/// Archive format of a scan's files.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ArchiveKind {
    /// `.zip`, with compressed or stored entries.
    Zip,
    /// `.tar`, not compressed.
    Tar,
    /// `.tar.gz` or `.tgz`: a tar compressed with gzip.
    TarGz,
    /// `.tar.zst` or `.tzst`: a tar compressed with Zstandard.
    TarZst,
}

impl ArchiveKind {
    /// Detects the kind by file name.
    #[must_use]
    pub fn from_file_name(name: &str) -> Option<Self> {
        let name = name.to_ascii_lowercase();
        [
            (".zip", Self::Zip),
            (".r3d", Self::Zip),
            (".tar", Self::Tar),
            (".tar.gz", Self::TarGz),
            (".tgz", Self::TarGz),
            (".tar.zst", Self::TarZst),
            (".tzst", Self::TarZst),
        ]
        .into_iter()
        .find_map(|(ending, kind)| name.ends_with(ending).then_some(kind))
    }

    /// Detects the kind by the first bytes of a file.
    #[must_use]
    pub fn from_head(head: &[u8]) -> Option<Self> {
        match head {
            [b'P', b'K', 3, 4, ..] | [b'P', b'K', 5, 6, ..] => Some(Self::Zip),
            [0x28, 0xb5, 0x2f, 0xfd, ..] => Some(Self::TarZst),
            [0x1f, 0x8b, ..] => Some(Self::TarGz),
            head if head.get(257..262) == Some(b"ustar") => Some(Self::Tar),
            _ => None,
        }
    }

    /// Returns the content type. Uploads are recognized by their bytes, not by this.
    #[must_use]
    pub fn media_type(self) -> &'static str {
        match self {
            Self::Zip => "application/zip",
            Self::Tar => "application/x-tar",
            Self::TarGz => "application/gzip",
            Self::TarZst => "application/zstd",
        }
    }

    fn name(self) -> &'static str {
        match self {
            Self::Zip => "zip",
            Self::Tar => "tar",
            Self::TarGz => "tar.gz",
            Self::TarZst => "tar.zst",
        }
    }

    fn unreadable(self, reason: impl ToString) -> IngestError {
        let reason = reason.to_string();
        // The zip crate's message for a file without the directory at its end.
        let reason = match reason.contains("EOCD") {
            true => "the file is truncated or not a zip. Upload it again".into(),
            false => reason,
        };
        IngestError::ArchiveUnreadable { kind: self.name(), reason }
    }
}

/// Limits on the content of an archive.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct UnpackLimits {
    /// Maximum number of entries: files, folders and everything else.
    pub max_entries: usize,
    /// Maximum number of folders that contain files.
    pub max_folders: usize,
    /// Maximum number of components of a file's path, including its name.
    pub max_depth: usize,
    /// Maximum length of an entry's name in bytes, including folders.
    pub max_name_bytes: usize,
    /// Maximum total size of all files, unpacked, bytes.
    pub max_bytes: u64,
    /// Maximum ratio of unpacked to packed size. Depth pictures are compressed already, so
    /// legitimate archives stay far below.
    pub max_ratio: u64,
}

impl Default for UnpackLimits {
    fn default() -> Self {
        Self {
            max_entries: 100_000,
            max_folders: 1000,
            max_depth: 16,
            max_name_bytes: 1024,
            max_bytes: 64 << 30,
            max_ratio: 200,
        }
    }
}

impl UnpackLimits {
    /// Returns the maximum unpacked size of an archive of this packed size, bytes.
    fn max_unpacked_bytes(&self, packed_bytes: u64) -> u64 {
        // Small archives can compress very well. The ratio only matters above a minimum size.
        self.max_bytes.min(packed_bytes.max(1 << 20).saturating_mul(self.max_ratio))
    }

    fn too_many_entries(&self) -> IngestError {
        IngestError::ArchiveTooLarge { limit: format!("{} entries", self.max_entries) }
    }

    fn too_many_bytes(&self) -> IngestError {
        IngestError::ArchiveTooLarge {
            limit: format!("{} bytes or {} times its packed size", self.max_bytes, self.max_ratio),
        }
    }
}

/// Unpacks `archive` into the empty folder `target`. Checks the whole list of entries before
/// anything is written.
///
/// # Errors
/// Returns an [`IngestError`] that names the entry. `target` can then contain some of the files,
/// and the caller must remove it.
pub fn unpack(
    archive: &Utf8Path,
    kind: ArchiveKind,
    target: &Utf8Path,
    limits: &UnpackLimits,
) -> Result<(), IngestError> {
    walk(archive, kind, limits, false, &mut ArchiveCheck::new(limits))?;
    walk(archive, kind, limits, true, &mut ArchiveExtractor::new(target))?;
    // ScanNet's own container: its frames are unpacked next to it, within the same limits.
    match sens::find_single_file(target)? {
        Some(file) => {
            sens::unpack(&file, file.parent().unwrap_or(target), limits.max_bytes).map(drop)
        }
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use camino::Utf8Component;
    use proptest::prelude::*;
    use sink::safe_path;
    use std::fs;
    use std::io::{self, Write};

    fn zip_of(entries: &[(&str, &[u8])]) -> Vec<u8> {
        let mut zip = zip::ZipWriter::new(io::Cursor::new(Vec::new()));
        for (name, content) in entries {
            zip.start_file(*name, zip::write::SimpleFileOptions::default()).unwrap();
            zip.write_all(content).unwrap();
        }
        zip.finish().unwrap().into_inner()
    }

    fn unpack_bytes(
        bytes: &[u8],
        kind: ArchiveKind,
        limits: &UnpackLimits,
    ) -> Result<Vec<String>, IngestError> {
        let folder = tempfile::tempdir().unwrap();
        let folder = Utf8Path::from_path(folder.path()).unwrap();
        let (archive, target) = (folder.join("upload"), folder.join("out"));
        fs::write(&archive, bytes).unwrap();
        fs::create_dir(&target).unwrap();
        unpack(&archive, kind, &target, limits)?;
        let mut names: Vec<_> = fs::read_dir(&target)
            .unwrap()
            .map(|e| e.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        Ok(names)
    }

    #[test]
    fn archives_of_every_kind_unpack_to_the_same_files() {
        let mut tar = tar::Builder::new(Vec::new());
        for name in ["a.txt", "b/c.txt"] {
            let mut header = tar::Header::new_gnu();
            header.set_size(2);
            tar.append_data(&mut header, name, &b"hi"[..]).unwrap();
        }
        let tar = tar.into_inner().unwrap();
        let zst = zstd::encode_all(&tar[..], 1).unwrap();
        let mut gz = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        gz.write_all(&tar).unwrap();
        let gz = gz.finish().unwrap();
        let zip = zip_of(&[("a.txt", b"hi"), ("b/c.txt", b"hi")]);
        // As some programs on Windows write it.
        let backslashes = zip_of(&[("a.txt", b"hi"), ("b\\c.txt", b"hi")]);
        for (bytes, kind) in [
            (zip, ArchiveKind::Zip),
            (backslashes, ArchiveKind::Zip),
            (tar, ArchiveKind::Tar),
            (gz, ArchiveKind::TarGz),
            (zst, ArchiveKind::TarZst),
        ] {
            assert_eq!(ArchiveKind::from_head(&bytes), Some(kind));
            assert_eq!(
                unpack_bytes(&bytes, kind, &UnpackLimits::default()).unwrap(),
                ["a.txt", "b"]
            );
        }
    }

    #[test]
    fn truncated_and_invalid_archives_are_refused() {
        let zip = zip_of(&[("a.txt", &[7; 5000])]);
        let cut = unpack_bytes(&zip[..zip.len() - 30], ArchiveKind::Zip, &UnpackLimits::default());
        let cut = cut.unwrap_err();
        assert!(matches!(cut, IngestError::ArchiveUnreadable { kind: "zip", .. }), "{cut:?}");
        assert!(cut.to_string().contains("Upload it again"), "{cut}");
        let noise = unpack_bytes(b"not an archive", ArchiveKind::TarZst, &UnpackLimits::default());
        assert!(
            matches!(noise, Err(IngestError::ArchiveUnreadable { kind: "tar.zst", .. })),
            "{noise:?}"
        );
    }

    #[test]
    fn archive_bombs_are_refused_at_the_limits() {
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
    fn entries_outside_the_folder_are_refused() {
        for name in
            ["../evil", "a/../../evil", "/etc/passwd", "a\\..\\evil", "..\\evil", "\\evil", "a\nb"]
        {
            let refused =
                unpack_bytes(&zip_of(&[(name, b"x")]), ArchiveKind::Zip, &UnpackLimits::default());
            assert!(matches!(refused, Err(IngestError::UnsafeEntry { .. })), "{name}: {refused:?}");
        }
    }

    /// Returns another spelling of a path that leads to the same file, at least on some file
    /// systems.
    fn respell(path: &str, upper: &[bool], dots: &[bool], doubled: &[bool]) -> String {
        let cased: String = path
            .chars()
            .zip(upper.iter().cycle())
            .map(|(c, upper)| if *upper { c.to_ascii_uppercase() } else { c })
            .collect();
        let mut spelling = String::new();
        for (i, name) in cased.split('/').enumerate() {
            let slash = if doubled[i % doubled.len()] { "//" } else { "/" };
            spelling.push_str(if i > 0 { slash } else { "" });
            spelling.push_str(if dots[i % dots.len()] { "./" } else { "" });
            spelling.push_str(name);
        }
        spelling
    }

    proptest! {
        #[test]
        fn reserved_names_are_refused_in_every_spelling_and_nothing_is_written(
            path in prop::sample::select(vec!["grown.json", "any room/grown.json", ".sha256sums", "parts/0/pose/0.txt", "parts/42/x"]),
            upper in prop::collection::vec(any::<bool>(), 1..20),
            dots in prop::collection::vec(any::<bool>(), 1..4),
            doubled in prop::collection::vec(any::<bool>(), 1..4),
        ) {
            let name = respell(path, &upper, &dots, &doubled);
            let folder = tempfile::tempdir().unwrap();
            let folder = Utf8Path::from_path(folder.path()).unwrap();
            let mut tar = tar::Builder::new(Vec::new());
            for name in ["color/0.png", &name] {
                let mut header = tar::Header::new_gnu();
                header.set_size(1);
                // The builder would write a normalized path.
                header.as_old_mut().name[..name.len()].copy_from_slice(name.as_bytes());
                header.set_cksum();
                tar.append(&header, &b"x"[..]).unwrap();
            }
            let zip = zip_of(&[("color/0.png", b"x"), (&name, b"x")]);
            for (bytes, kind) in [(zip, ArchiveKind::Zip), (tar.into_inner().unwrap(), ArchiveKind::Tar)] {
                let (archive, target) = (folder.join("upload"), folder.join(kind.name()));
                fs::write(&archive, bytes).unwrap();
                fs::create_dir(&target).unwrap();
                match unpack(&archive, kind, &target, &UnpackLimits::default()) {
                    Err(IngestError::UnsafeEntry { entry, reason }) => {
                        prop_assert!(entry == name && reason.contains("reserved"), "{entry}: {reason}");
                    }
                    other => prop_assert!(false, "{name} in a {}: {other:?}", kind.name()),
                }
                prop_assert_eq!(fs::read_dir(&target).unwrap().count(), 0);
            }
        }

        #[test]
        fn safe_paths_never_leave_the_folder(name in "[a-z./\\\\]{0,20}") {
            if let Ok(path) = safe_path(&name) {
                prop_assert!(path.is_relative() && path.components().all(|c| matches!(c, Utf8Component::Normal(_))));
            }
        }
    }
}
