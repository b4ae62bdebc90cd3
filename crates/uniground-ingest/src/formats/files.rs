//! The names in a folder, for the layouts.

use super::check_frames;
use crate::IngestError;
use crate::clouds::CloudKind;
use crate::limited_reader::read_text;
use crate::scan::picture_size;
use camino::{Utf8Component, Utf8Path, Utf8PathBuf};
use serde::{Deserialize, Deserializer};
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::ops::Deref;
use std::sync::{Mutex, PoisonError};

/// The folder that a layout is read from. Records the text files that are read.
pub(super) struct TextFiles {
    root: Utf8PathBuf,
    read: Mutex<BTreeSet<Utf8PathBuf>>,
}

impl TextFiles {
    pub fn new(root: &Utf8Path) -> Self {
        Self { root: root.to_owned(), read: Mutex::default() }
    }

    /// Reads a text file of at most `most` bytes, without a byte order mark.
    pub fn read_text(&self, file: &Utf8Path, most: u64) -> Result<String, IngestError> {
        self.read.lock().unwrap_or_else(PoisonError::into_inner).insert(file.to_owned());
        read_text(&self.root, file, most)
    }

    /// Returns the text files that were read, relative to the folder.
    pub fn into_read(self) -> BTreeSet<Utf8PathBuf> {
        self.read.into_inner().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Deref for TextFiles {
    type Target = Utf8Path;

    fn deref(&self) -> &Utf8Path {
        &self.root
    }
}

/// A folder of a scan: its entries, without hidden files and files that operating systems create.
pub(super) struct FolderListing {
    pub root: TextFiles,
    /// Sorted.
    names: Vec<String>,
}

/// Files and folders that operating systems add, in lower case.
const OF_SYSTEMS: [&str; 4] = ["__macosx", "desktop.ini", "thumbs.db", "icon\r"];
/// Extensions of files that describe a scan for people.
const DOCUMENTS: [&str; 7] = ["txt", "md", "pdf", "html", "rtf", "docx", "log"];
/// Supported extensions of color pictures.
pub(super) const PICTURES: &[&str] = &["jpg", "jpeg", "png"];
/// Supported extensions of depth pictures.
pub(super) const DEPTHS: &[&str] = &["png", "pgm", "exr", "tif", "tiff"];
/// Extensions of archives.
const ARCHIVES: &[&str] = &["zip", "tar", "gz", "tgz", "bz2", "xz", "7z", "rar"];
/// Extensions of clouds and meshes.
const CLOUDS: &[&str] = &[
    "ply", "pcd", "las", "laz", "e57", "glb", "gltf", "obj", "xyz", "xyzrgb", "xyzn", "pts", "txt",
    "csv", "asc",
];

impl FolderListing {
    pub fn open(root: &Utf8Path) -> Result<Self, IngestError> {
        Ok(Self { root: TextFiles::new(root), names: list_names(root)? })
    }

    pub fn names(&self) -> &[String] {
        &self.names
    }

    pub fn has_file(&self, name: &str) -> bool {
        self.root.join(name).is_file()
    }

    pub fn has_folder(&self, name: &str) -> bool {
        self.root.join(name).is_dir()
    }

    /// Returns the first of `names` that is a folder here, in upper or lower case.
    pub fn first_folder(&self, names: &[&str]) -> Option<&str> {
        self.names_like(names).find(|name| self.has_folder(name))
    }

    /// Returns the first of `names`, which can be paths, that is a file here, in upper or lower
    /// case.
    pub fn first_file(&self, names: &[&str]) -> Option<Utf8PathBuf> {
        let exact = names.iter().copied().find(|name| self.has_file(name));
        exact.or_else(|| self.names_like(names).find(|name| self.has_file(name))).map(Into::into)
    }

    /// Returns the entries with these names in upper or lower case, in the order of `names`.
    fn names_like(&self, names: &[&str]) -> impl Iterator<Item = &str> {
        names.iter().flat_map(|wanted| {
            self.names.iter().filter(|name| name.eq_ignore_ascii_case(wanted)).map(String::as_str)
        })
    }

    /// Returns the only folder in this one, if all files beside it are documents.
    pub fn only_folder(&self) -> Option<&str> {
        let (folders, files): (Vec<&str>, Vec<&str>) =
            self.names.iter().map(String::as_str).partition(|name| self.has_folder(name));
        let is_document = |name: &&str| {
            extension_of(name).is_none_or(|ending| DOCUMENTS.contains(&ending.as_str()))
        };
        match folders[..] {
            [only] if files.iter().all(is_document) => Some(only),
            _ => None,
        }
    }

    /// Returns the folders within this one.
    pub fn folders(&self) -> impl Iterator<Item = &str> {
        self.names.iter().map(String::as_str).filter(|name| self.has_folder(name))
    }

    /// Returns the files of a folder below this one (`""`: this one) with one of these extensions,
    /// in natural order. Fails when there are far too many.
    pub fn files(&self, folder: &str, endings: &[&str]) -> Result<Vec<Utf8PathBuf>, IngestError> {
        let names = if folder.is_empty() {
            self.names.clone()
        } else {
            list_names(&self.root.join(folder))?
        };
        let wanted =
            |name: &&String| extension_of(name).is_some_and(|e| endings.contains(&e.as_str()));
        let mut files: Vec<Utf8PathBuf> =
            names.iter().filter(wanted).map(|name| Utf8Path::new(folder).join(name)).collect();
        check_frames(folder, files.len())?;
        files.sort_by_cached_key(|file| super::pairing::natural_sort_key(file));
        Ok(files)
    }

    /// Returns the first of a few pictures whose size is the most frequent one. Unreadable pictures
    /// are reported later.
    pub fn typical_picture<'a>(&self, pictures: &'a [Utf8PathBuf]) -> Option<&'a Utf8PathBuf> {
        const EXAMINED: usize = 9;
        let step = pictures.len().div_ceil(EXAMINED).max(1);
        let sizes: Vec<(&Utf8PathBuf, (u32, u32))> = pictures
            .iter()
            .step_by(step)
            .filter_map(|file| Some((file, picture_size(&self.root, file).ok()??)))
            .collect();
        let count = |size: (u32, u32)| sizes.iter().filter(|(_, other)| *other == size).count();
        let (mut best, mut most) = (pictures.first(), 0);
        for (file, size) in &sizes {
            let here = count(*size);
            if here > most {
                (best, most) = (Some(*file), here);
            }
        }
        best
    }

    /// Returns the most frequent ending of the files in a folder, if any has one.
    pub fn most_frequent_ending(&self, folder: &str) -> Result<Option<String>, IngestError> {
        let mut counts: BTreeMap<String, usize> = BTreeMap::new();
        for name in list_names(&self.root.join(folder))? {
            if let Some(ending) = extension_of(&name) {
                *counts.entry(ending).or_default() += 1;
            }
        }
        Ok(counts.into_iter().max_by_key(|(_, count)| *count).map(|(ending, _)| ending))
    }

    /// Returns the clouds and meshes in this folder. Names that begin or end with a preferred name
    /// come first, and larger files come before smaller ones.
    pub fn clouds(&self, preferred: &[&str]) -> Vec<Utf8PathBuf> {
        let mut found: Vec<(usize, u64, &String)> = Vec::new();
        for name in &self.names {
            let path = self.root.join(name);
            if !extension_of(name).is_some_and(|e| CLOUDS.contains(&e.as_str())) || !path.is_file()
            {
                continue;
            }
            if is_ignored(name, &path) {
                continue;
            }
            // A file named `.ply` is always read as PLY, so that the reader can report what is
            // wrong with it.
            if extension_of(name).as_deref() != Some("ply") && CloudKind::detect(&path).is_none() {
                continue;
            }
            let rank = preferred
                .iter()
                .position(|p| name.starts_with(p) || name.ends_with(p))
                .unwrap_or(preferred.len());
            let bytes = path.metadata().map_or(0, |m| m.len());
            found.push((rank, u64::MAX - bytes, name));
        }
        found.sort();
        found.into_iter().map(|(_, _, name)| Utf8PathBuf::from(name)).collect()
    }

    /// Describes the folder's content for people.
    pub fn describe(&self) -> String {
        let shown = self.names.iter().take(8).cloned().collect::<Vec<_>>().join(", ");
        // The most common misunderstanding: what a camera alone writes.
        if !self.names.is_empty() && self.names.iter().all(|name| is_picture(name)) {
            return format!(
                "only pictures ({shown}). Depth pictures and camera poses are needed too: export \
                 the scan, not only its photos"
            );
        }
        let is_archive = |name: &String| {
            extension_of(name).is_some_and(|ending| ARCHIVES.contains(&ending.as_str()))
        };
        if !self.names.is_empty() && self.names.iter().all(is_archive) {
            return format!("only archives ({shown}): unpack them and upload each scan alone");
        }
        match self.names.len() {
            0 => "nothing".into(),
            n if n > 8 => format!("{shown} and {} more", n - 8),
            _ => shown,
        }
    }
}

/// Returns whether a file name is that of a photograph.
fn is_picture(name: &str) -> bool {
    let extension = Utf8Path::new(name).extension().unwrap_or_default().to_lowercase();
    ["jpg", "jpeg", "png", "heic", "webp"].contains(&extension.as_str())
}

/// Names of text files that belong to posed pictures. They contain lines of numbers too.
const NO_CLOUDS: [&str; 12] = [
    "pose",
    "traj",
    "groundtruth",
    "intrinsic",
    "camera",
    "odometry",
    "rgb",
    "depth",
    "color",
    "label",
    "scene0",
    "_info",
];
/// Minimum size of a text cloud, bytes.
const LEAST_TEXT_BYTES: u64 = 1000;

fn is_ignored(name: &str, path: &Utf8Path) -> bool {
    let is_text = extension_of(name).is_some_and(|e| ["txt", "csv", "asc"].contains(&e.as_str()));
    let lower = name.to_ascii_lowercase();
    let is_named = lower.starts_with(|c: char| c.is_ascii_digit())
        || NO_CLOUDS.iter().any(|other| lower.contains(other));
    is_text && (is_named || path.metadata().is_ok_and(|m| m.len() < LEAST_TEXT_BYTES))
}

fn extension_of(name: &str) -> Option<String> {
    Utf8Path::new(name).extension().map(str::to_ascii_lowercase)
}

/// Returns whether a file or folder is hidden or was added by an operating system.
pub(crate) fn is_of_system(name: &str) -> bool {
    name.starts_with('.') || OF_SYSTEMS.contains(&name.to_ascii_lowercase().as_str())
}

/// Returns the names in a folder, sorted, without hidden files and those of operating systems.
fn list_names(folder: &Utf8Path) -> Result<Vec<String>, IngestError> {
    let io =
        |source| IngestError::Io { file: folder.file_name().unwrap_or("archive").into(), source };
    let mut names = Vec::new();
    for entry in fs::read_dir(folder).map_err(io)? {
        let entry = entry.map_err(io)?;
        // Opening a pipe would wait for ever. Links are followed; a broken one is reported later.
        let is_special =
            fs::metadata(entry.path()).is_ok_and(|found| !found.is_file() && !found.is_dir());
        let name = entry.file_name().to_string_lossy().into_owned();
        if !is_special && !is_of_system(&name) {
            names.push(name);
        }
    }
    names.sort();
    Ok(names)
}

/// Reads a path from a manifest. Programs on Windows write backslashes.
pub(super) fn deserialize_path<'de, D: Deserializer<'de>>(
    from: D,
) -> Result<Utf8PathBuf, D::Error> {
    Ok(String::deserialize(from)?.replace('\\', "/").into())
}

/// Reads an optional path from a manifest, as [`deserialize_path`].
pub(super) fn deserialize_optional_path<'de, D: Deserializer<'de>>(
    from: D,
) -> Result<Option<Utf8PathBuf>, D::Error> {
    Ok(Option::<String>::deserialize(from)?.map(|path| path.replace('\\', "/").into()))
}

/// Checks that a manifest only names files of its own archive.
pub(super) fn check_inside(path: &Utf8Path, manifest: &'static str) -> Result<(), IngestError> {
    let plain =
        path.components().all(|c| matches!(c, Utf8Component::Normal(_) | Utf8Component::CurDir));
    if plain && !path.as_str().is_empty() {
        return Ok(());
    }
    Err(IngestError::UnsafeEntry { entry: path.to_string(), reason: manifest })
}
