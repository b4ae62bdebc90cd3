//! The two passes over an archive: first a check of all names, then the extraction of the files.

use super::UnpackLimits;
use super::entries::{EntryKind, EntryVisitor};
use crate::{IngestError, is_reserved};
use camino::{Utf8Component, Utf8Path, Utf8PathBuf};
use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io::{self, Read, Write};

/// Counts and checks names. Reads no content.
pub(super) struct ArchiveCheck<'a> {
    limits: &'a UnpackLimits,
    entries: usize,
    folders: BTreeSet<Utf8PathBuf>,
}

impl<'a> ArchiveCheck<'a> {
    pub fn new(limits: &'a UnpackLimits) -> Self {
        Self { limits, entries: 0, folders: BTreeSet::new() }
    }
}

impl EntryVisitor for ArchiveCheck<'_> {
    fn entry(&mut self, name: &str, kind: EntryKind, _: &mut dyn Read) -> Result<(), IngestError> {
        self.entries += 1;
        if self.entries > self.limits.max_entries {
            return Err(self.limits.too_many_entries());
        }
        if name.len() > self.limits.max_name_bytes {
            let short: String = name.chars().take(80).collect();
            return Err(IngestError::unsafe_entry(
                &format!("{short}..."),
                "has a name that is too long",
            ));
        }
        if kind == EntryKind::Folder {
            return Ok(());
        }
        let path = safe_path(name)?;
        if path.components().count() > self.limits.max_depth {
            return Err(IngestError::unsafe_entry(name, "is nested in too many folders"));
        }
        for folder in path.ancestors().skip(1).filter(|folder| !folder.as_str().is_empty()) {
            if self.folders.contains(folder) {
                break;
            }
            self.folders.insert(folder.to_owned());
        }
        if self.folders.len() > self.limits.max_folders {
            return Err(IngestError::ArchiveTooLarge {
                limit: format!("{} folders", self.limits.max_folders),
            });
        }
        Ok(())
    }
}

/// Writes files below one folder. Folders without files are not created.
pub(super) struct ArchiveExtractor<'a> {
    target: &'a Utf8Path,
    folders: BTreeSet<Utf8PathBuf>,
    buffer: Vec<u8>,
}

impl<'a> ArchiveExtractor<'a> {
    pub fn new(target: &'a Utf8Path) -> Self {
        Self { target, folders: BTreeSet::new(), buffer: vec![0; 64 << 10] }
    }
}

impl EntryVisitor for ArchiveExtractor<'_> {
    fn entry(
        &mut self,
        name: &str,
        kind: EntryKind,
        content: &mut dyn Read,
    ) -> Result<(), IngestError> {
        if kind == EntryKind::Folder {
            return Ok(());
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
        loop {
            let n = content
                .read(&mut self.buffer)
                .map_err(|e| IngestError::malformed(name, format!("it cannot be unpacked: {e}")))?;
            if n == 0 {
                return Ok(());
            }
            file.write_all(&self.buffer[..n]).map_err(io)?;
        }
    }
}

/// Converts an error of writing an entry. Some names are valid in an archive but not on a disk. A
/// full disk is an error of the server.
fn cannot_store(name: &str, source: io::Error) -> IngestError {
    use io::ErrorKind::{
        AlreadyExists, InvalidFilename, InvalidInput, IsADirectory, NotADirectory,
    };
    let reason = match source.kind() {
        AlreadyExists => "appears twice in the archive",
        InvalidFilename | InvalidInput => "has a name that is not valid on disk: rename it",
        IsADirectory | NotADirectory => "is both a file and a folder",
        _ => return IngestError::Io { file: name.into(), source },
    };
    IngestError::unsafe_entry(name, reason)
}

/// Returns the entry's path if it is relative, stays inside the archive and does not collide with
/// the server's own files. Backslashes separate folders, as in archives from Windows.
pub(super) fn safe_path(name: &str) -> Result<Utf8PathBuf, IngestError> {
    if name.contains(char::is_control) {
        return Err(IngestError::unsafe_entry(name, "has a control character in its name"));
    }
    let slashed = name.replace('\\', "/");
    let mut path = Utf8PathBuf::new();
    for component in Utf8Path::new(&slashed).components() {
        match component {
            Utf8Component::Normal(part) => path.push(part),
            Utf8Component::CurDir => {}
            _ => return Err(IngestError::unsafe_entry(name, "points outside the archive")),
        }
    }
    if path.as_str().is_empty() {
        return Err(IngestError::unsafe_entry(name, "has an empty name"));
    }
    match is_reserved(&path) {
        true => Err(IngestError::unsafe_entry(
            name,
            "has a name that is reserved for the server: rename it or leave it out",
        )),
        false => Ok(path),
    }
}
