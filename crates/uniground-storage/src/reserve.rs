//! The reserve: a file of a few megabytes in the data folder that is removed when the disk is full.
//! Opening a database and deleting rows need disk space too.
//!
//! A running server releases half of it in order to delete. The rest is for the next start, which
//! needs space before it can delete anything. The reserve is written again once the free space is
//! several times its size.

use super::blobs::remove_tree;
use super::data_folder::{DataFolder, LOCK};
use super::file_lock::FileLock;
use super::{Blobs, StoreError};
use camino::{Utf8DirEntry, Utf8Path, Utf8PathBuf};
use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use tokio::task::spawn_blocking;

const RESERVE: &str = "reserve";
const BYTES: u64 = 8 << 20;
/// The bytes that a running server does not release.
const LEFT_FOR_START: u64 = BYTES / 2;
/// The reserve is written if the free space is at least this many times its size.
const TIMES_FREE: u64 = 4;
/// A disk with less space counts as full, whatever the error: SQLite reports a file that cannot be
/// created without a specific code.
const FULL_BELOW_BYTES: u64 = 256 << 10;
/// Folders that only save time, or were left by a killed process.
const DISPENSABLE: [&str; 2] = ["tmp", "blobs/checkpoints"];

/// The reserve file.
#[derive(Clone)]
pub struct Reserve {
    pub(super) blobs: Blobs,
    pub(super) folder: DataFolder,
}

impl Reserve {
    /// Releases a part of the reserve, so that rows can be deleted on a full disk. Returns whether
    /// there was any.
    #[must_use]
    pub fn release_reserve(&self) -> bool {
        self.blobs.is_writable() && release_half(self.folder.path())
    }

    /// Writes the reserve again if the disk has space for it, off the async threads.
    pub async fn restore_reserve(&self) {
        if !self.blobs.is_writable() {
            return;
        }
        let folder = self.folder.clone();
        let written = spawn_blocking(move || write(folder.path()))
            .await
            .unwrap_or_else(|error| Err(io::Error::other(error)));
        match written {
            Ok(is_there) => tracing::trace!(is_there, "reserve file checked"),
            Err(error) => tracing::debug!(%error, "reserve file could not be written"),
        }
    }
}

/// Returns the free space on the disk of a folder, bytes.
pub(super) fn free_bytes(folder: &Utf8Path) -> io::Result<u64> {
    let disk = rustix::fs::statvfs(folder.as_std_path())?;
    Ok(disk.f_bavail.saturating_mul(disk.f_frsize))
}

/// Writes the reserve, or its missing part. Returns `false` if the disk has too little space.
pub(super) fn write(data_dir: &Utf8Path) -> io::Result<bool> {
    let file = data_dir.join(RESERVE);
    let there = fs::metadata(&file).map_or(0, |file| file.len());
    if there >= BYTES {
        return Ok(true);
    }
    if free_bytes(data_dir)? < TIMES_FREE * BYTES {
        return Ok(false);
    }
    let mut reserve = OpenOptions::new().create(true).append(true).open(&file)?;
    // Write actual bytes: a sparse file occupies no space.
    let missing = vec![1; usize::try_from(BYTES - there).unwrap_or(0)];
    let written = reserve.write_all(&missing).and_then(|()| reserve.sync_all());
    written.inspect_err(|_| drop(reserve.set_len(there))).map(|()| true)
}

/// Releases a part of the reserve, for a running server. Returns whether there was any.
pub(super) fn release_half(data_dir: &Utf8Path) -> bool {
    let file = data_dir.join(RESERVE);
    let Some(bytes) =
        fs::metadata(&file).ok().map(|file| file.len()).filter(|bytes| *bytes > LEFT_FOR_START)
    else {
        return false;
    };
    let shortened = OpenOptions::new()
        .write(true)
        .open(&file)
        .and_then(|reserve| reserve.set_len(LEFT_FOR_START));
    if shortened.is_ok() {
        tracing::warn!(
            "disk full: released {} MB of the reserve file",
            (bytes - LEFT_FOR_START) >> 20
        );
    }
    shortened.is_ok()
}

/// Frees space for a store that could not be opened because of a full disk. Returns whether another
/// attempt is worthwhile.
pub(super) fn make_room_to_open(data_dir: &Utf8Path, error: &StoreError) -> bool {
    let may_be_full =
        matches!(error, StoreError::Database(_) | StoreError::Migration(_) | StoreError::Blobs(_));
    let is_full = error.is_full()
        || (may_be_full && free_bytes(data_dir).is_ok_and(|free| free < FULL_BELOW_BYTES));
    if !is_full {
        return false;
    }
    if let Some(bytes) = release(data_dir) {
        tracing::warn!("disk full: released the reserve file of {} MB", bytes >> 20);
        return true;
    }
    match remove_dispensable(data_dir) {
        Ok(0) => tracing::error!(
            "disk full, and there is no reserve file: free {} MB on the disk of {data_dir}",
            BYTES >> 20
        ),
        Ok(folders) => {
            tracing::warn!(
                "disk full, and there is no reserve file: removed {folders} temporary folders and checkpoints of parses"
            );
            return true;
        }
        Err(error) => tracing::error!(
            %error,
            "disk full, and no space could be freed: free {} MB on the disk of {data_dir}",
            BYTES >> 20
        ),
    }
    false
}

/// Removes the reserve. Returns its bytes, or `None` if there was none.
fn release(data_dir: &Utf8Path) -> Option<u64> {
    let file = data_dir.join(RESERVE);
    let bytes = fs::metadata(&file).ok()?.len();
    fs::remove_file(file).ok()?;
    (bytes > 0).then_some(bytes)
}

/// Removes dispensable folders, if no process uses the data folder, until there is as much space as
/// the reserve gives. Returns the number of folders.
fn remove_dispensable(data_dir: &Utf8Path) -> io::Result<u32> {
    let Ok(_lock) = FileLock::try_exclusive(File::open(data_dir.join(LOCK))?) else {
        return Ok(0);
    };
    let mut removed = 0;
    for folder in DISPENSABLE.map(|folder| data_dir.join(folder)) {
        let Ok(entries) = folder.read_dir_utf8() else { continue };
        let entries: Vec<Utf8PathBuf> =
            entries.filter_map(Result::ok).map(Utf8DirEntry::into_path).collect();
        for entry in entries {
            if free_bytes(data_dir)? >= BYTES {
                return Ok(removed);
            }
            removed += u32::from(remove_tree(&entry, &data_dir.join("tmp")).is_ok());
        }
    }
    Ok(removed)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bytes(folder: &Utf8Path) -> u64 {
        fs::metadata(folder.join(RESERVE)).map_or(0, |file| file.len())
    }

    /// The rest is released at the next start, which may need disk space too.
    #[test]
    fn a_running_server_releases_only_half_of_the_reserve() {
        let place = tempfile::tempdir().unwrap();
        let folder = Utf8Path::from_path(place.path()).unwrap();
        assert!(!release_half(folder));
        assert!(write(folder).unwrap());
        assert_eq!(bytes(folder), BYTES);
        assert!(release_half(folder));
        assert!(!release_half(folder));
        assert_eq!(bytes(folder), LEFT_FOR_START);
        assert!(write(folder).unwrap());
        assert_eq!(bytes(folder), BYTES);
        let full = || StoreError::Blobs(io::ErrorKind::StorageFull.into());
        assert!(make_room_to_open(folder, &full()) && bytes(folder) == 0);
        assert!(!make_room_to_open(folder, &full()), "nothing is left to release");
    }

    #[test]
    fn the_reserve_is_released_only_if_the_disk_is_full() {
        let place = tempfile::tempdir().unwrap();
        let folder = Utf8Path::from_path(place.path()).unwrap();
        write(folder).unwrap();
        for error in [
            StoreError::InUse,
            StoreError::UnfinishedMigration,
            StoreError::Blobs(io::ErrorKind::PermissionDenied.into()),
        ] {
            assert!(!make_room_to_open(folder, &error), "{error}");
        }
        assert_eq!(bytes(folder), BYTES);
    }
}
