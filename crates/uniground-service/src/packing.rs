//! Packs a folder into one archive, in the form of an upload.

use camino::{Utf8Path, Utf8PathBuf};
use std::fs::{self, File};
use std::io::{self, Write};

/// The maximum depth of nested folders. It ends the recursion into a folder that links to itself.
const MAX_DEPTH: usize = 16;

/// Which links are followed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Links<'a> {
    /// All of them: the files belong to the caller.
    All,
    /// Links that stay below this folder, whose path must be canonical. Other links are left out.
    Below(&'a Utf8Path),
}

/// Why a folder cannot be packed.
#[derive(Debug, thiserror::Error)]
pub enum PackingError {
    #[error("{0}: there is nothing in it")]
    Empty(Utf8PathBuf),
    #[error("{path}: {source}")]
    File { path: Utf8PathBuf, source: io::Error },
}

/// Packs all files that are not hidden into a tar archive. The archive is sorted and has no times,
/// so that the same folder gives the same archive.
///
/// # Errors
/// [`PackingError`].
pub fn pack(folder: &Utf8Path, links: Links, to: impl Write) -> Result<(), PackingError> {
    let mut files = Vec::new();
    collect(folder, links, MAX_DEPTH, &mut files)?;
    if files.is_empty() {
        return Err(PackingError::Empty(folder.to_owned()));
    }
    files.sort();
    let mut archive = tar::Builder::new(to);
    for path in files {
        let name = path.strip_prefix(folder).unwrap_or(&path);
        append(&mut archive, &path, name)
            .map_err(|source| PackingError::File { path: path.clone(), source })?;
    }
    archive.finish().map_err(|source| PackingError::File { path: folder.to_owned(), source })
}

fn append(
    archive: &mut tar::Builder<impl Write>,
    path: &Utf8Path,
    name: &Utf8Path,
) -> io::Result<()> {
    let file = File::open(path)?;
    let mut header = tar::Header::new_gnu();
    header.set_size(file.metadata()?.len());
    header.set_mode(0o644);
    archive.append_data(&mut header, name, file)
}

fn collect(
    folder: &Utf8Path,
    links: Links,
    deeper: usize,
    files: &mut Vec<Utf8PathBuf>,
) -> Result<(), PackingError> {
    let unreadable = |source| PackingError::File { path: folder.to_owned(), source };
    for entry in folder.read_dir_utf8().map_err(unreadable)? {
        let path = entry.map_err(unreadable)?.into_path();
        // Hidden files belong to file managers and git.
        if path.file_name().is_some_and(|name| name.starts_with('.')) || !links.should_follow(&path)
        {
            continue;
        }
        match fs::metadata(&path) {
            Ok(metadata) if metadata.is_file() => files.push(path),
            Ok(metadata) if metadata.is_dir() && deeper > 0 => {
                collect(&path, links, deeper - 1, files)?;
            }
            // A broken link or a socket is not part of a scan.
            _ => {}
        }
    }
    Ok(())
}

impl Links<'_> {
    fn should_follow(self, path: &Utf8Path) -> bool {
        match self {
            Self::All => true,
            Self::Below(root) => path.canonicalize_utf8().is_ok_and(|path| path.starts_with(root)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(packed: &[u8]) -> Vec<String> {
        let mut archive = tar::Archive::new(packed);
        let entries = archive.entries().unwrap();
        entries.map(|entry| entry.unwrap().path().unwrap().to_str().unwrap().to_owned()).collect()
    }

    #[test]
    fn packing_is_deterministic() {
        let folder = tempfile::tempdir().unwrap();
        let path = Utf8Path::from_path(folder.path()).unwrap();
        fs::create_dir(path.join("color")).unwrap();
        for name in ["color/1.jpg", "color/0.jpg", "cloud.ply", ".DS_Store"] {
            fs::write(path.join(name), name).unwrap();
        }
        let packed = || {
            let mut bytes = Vec::new();
            pack(path, Links::All, &mut bytes).unwrap();
            bytes
        };
        let before = packed();
        fs::write(path.join("color/0.jpg"), "color/0.jpg").unwrap();
        assert_eq!(packed(), before);
        assert_eq!(names(&before), ["cloud.ply", "color/0.jpg", "color/1.jpg"]);
    }

    #[test]
    fn symlinks_out_of_the_root_are_not_followed() {
        let folder = tempfile::tempdir().unwrap();
        let root = Utf8Path::from_path(folder.path()).unwrap().canonicalize_utf8().unwrap();
        for place in ["scans/room", "scans/shared", "elsewhere"] {
            fs::create_dir_all(root.join(place)).unwrap();
            fs::write(root.join(place).join("secret.txt"), place).unwrap();
        }
        let (scans, room) = (root.join("scans"), root.join("scans/room"));
        let link = |to: &str, name: &str| {
            std::os::unix::fs::symlink(root.join(to), room.join(name)).unwrap();
        };
        link("elsewhere", "a");
        link("elsewhere/secret.txt", "b.txt");
        link("scans/shared", "c");
        link("scans/room", "d");
        let packed = |links| {
            let mut bytes = Vec::new();
            pack(&room, links, &mut bytes).unwrap();
            names(&bytes).into_iter().filter(|name| !name.starts_with('d')).collect::<Vec<_>>()
        };
        assert_eq!(packed(Links::Below(&scans)), ["c/secret.txt", "secret.txt"]);
        assert_eq!(packed(Links::All), ["a/secret.txt", "b.txt", "c/secret.txt", "secret.txt"]);
        fs::create_dir(scans.join("empty")).unwrap();
        assert!(matches!(
            pack(&scans.join("empty"), Links::All, io::sink()),
            Err(PackingError::Empty(_))
        ));
    }
}
