//! Folders and zip files as sources: their files, brought into a bundle's folder.

use super::AddError;
use super::install::MAX_JSON_BYTES;
use super::transfer::partial_of;
use camino::Utf8Path;
use std::fs::{self, File};
use std::io::{self, BufReader, Read};
use zip::ZipArchive;

/// Deepest folder that is searched: networks lie in the root or in `onnx/`.
const MAX_DEPTH: usize = 2;
/// Maximum number of files.
const MAX_FILES: usize = 10_000;
/// Largest file of an archive.
const MAX_FILE_BYTES: u64 = 16 << 30;

/// Returns the paths of the files below a folder, relative to it.
///
/// # Errors
/// Returns an error if the folder cannot be read.
pub fn list(root: &Utf8Path) -> Result<Vec<String>, AddError> {
    let (mut found, mut folders) = (Vec::new(), vec![(root.to_owned(), 0)]);
    while let Some((folder, depth)) = folders.pop() {
        let failed = |why: io::Error| AddError::File { file: folder.clone(), why };
        for entry in folder.read_dir_utf8().map_err(failed)? {
            let path = entry.map_err(failed)?.into_path();
            match path.is_dir() {
                true if depth < MAX_DEPTH => folders.push((path, depth + 1)),
                // Not a pipe or a device, which may never end.
                false if path.is_file() && found.len() < MAX_FILES => {
                    found.extend(path.strip_prefix(root).map(ToString::to_string));
                }
                _ => {}
            }
        }
    }
    found.sort();
    Ok(found)
}

/// Places a file that nobody writes to at `to`, without a second copy where the file system allows
/// it.
///
/// # Errors
/// Returns an error if the file cannot be read or written.
pub fn link(from: &Utf8Path, to: &Utf8Path) -> Result<(), AddError> {
    if from == to {
        return Ok(());
    }
    // A link to the file itself, not to a symbolic link.
    let from =
        from.canonicalize_utf8().map_err(|why| AddError::File { file: from.to_owned(), why })?;
    match fs::remove_file(to) {
        Err(why) if why.kind() != io::ErrorKind::NotFound => {
            Err(AddError::File { file: to.to_owned(), why })
        }
        _ if fs::hard_link(&from, to).is_ok() => Ok(()),
        _ => copy(&from, to),
    }
}

/// Copies a file to `to`.
///
/// # Errors
/// Returns an error if the file cannot be read or written.
pub fn copy(from: &Utf8Path, to: &Utf8Path) -> Result<(), AddError> {
    let failed = |why: io::Error| AddError::File { file: to.to_owned(), why };
    // Half a copy must not look like a whole one.
    let partial = partial_of(to);
    fs::copy(from, &partial).map_err(|why| AddError::File { file: from.to_owned(), why })?;
    fs::rename(&partial, to).map_err(failed)
}

/// Returns whether a file only exists because an archive was made on macOS.
fn is_macos_companion(path: &str) -> bool {
    path.starts_with("__MACOSX/") || path.rsplit('/').next().is_some_and(|f| f.starts_with("._"))
}

/// A zip file on this machine. One folder around all its files is left out of their paths.
pub struct Archive {
    zip: ZipArchive<BufReader<File>>,
    /// Paths of its files and folders.
    names: Vec<String>,
    around: String,
    name: String,
}

impl Archive {
    /// # Errors
    /// Returns an error for a file that is not a zip file.
    pub fn open(file: &Utf8Path, name: &str) -> Result<Self, AddError> {
        let opened =
            File::open(file).map_err(|why| AddError::File { file: file.to_owned(), why })?;
        let zip = ZipArchive::new(BufReader::new(opened)).map_err(|e| AddError::Source {
            source_name: name.to_owned(),
            why: format!("not a zip file: {e}"),
        })?;
        // Names that are not text belong to no network.
        let names: Vec<String> = zip
            .file_names()
            .filter_map(|name| Some(name.ok()?.into_owned()))
            .filter(|name| !is_macos_companion(name))
            .collect();
        let around = match names.first().and_then(|name| name.split_once('/')) {
            Some((folder, _)) if names.iter().all(|n| n.starts_with(&format!("{folder}/"))) => {
                format!("{folder}/")
            }
            _ => String::new(),
        };
        // A folder that exporters make is part of the layout.
        let around = if around == "onnx/" { String::new() } else { around };
        Ok(Self { zip, names, around, name: name.to_owned() })
    }

    /// Returns the paths of its files.
    #[must_use]
    pub fn list(&self) -> Vec<String> {
        let mut paths: Vec<String> = self
            .names
            .iter()
            .filter(|path| !path.ends_with('/'))
            .filter_map(|path| path.strip_prefix(&self.around).map(str::to_owned))
            .take(MAX_FILES)
            .collect();
        paths.sort();
        paths
    }

    /// Extracts a file to `to`.
    ///
    /// # Errors
    /// Returns an error for a damaged archive, or if the file cannot be written.
    pub fn extract(&mut self, path: &str, to: &Utf8Path) -> Result<(), AddError> {
        let broken = |why: String| AddError::Source { source_name: self.name.clone(), why };
        let mut entry = self
            .zip
            .by_name(&format!("{}{path}", self.around))
            .map_err(|e| broken(format!("{path}: {e}")))?;
        let bytes = entry.size();
        let is_json = Utf8Path::new(path).extension() == Some("json");
        let limit = if is_json { MAX_JSON_BYTES } else { MAX_FILE_BYTES };
        if bytes > limit {
            return Err(broken(format!("{path} is larger than {} MB", limit >> 20)));
        }
        let partial = partial_of(to);
        let failed = |why: io::Error| AddError::File { file: to.to_owned(), why };
        let mut target = File::create(&partial).map_err(failed)?;
        // Sizes in an archive can be wrong.
        let copied = io::copy(&mut (&mut entry).take(bytes + 1), &mut target)
            .map_err(|e| broken(format!("{path}: {e}")))?;
        if copied != bytes {
            return Err(broken(format!("{path} does not have the stated size")));
        }
        fs::rename(&partial, to).map_err(failed)
    }
}
