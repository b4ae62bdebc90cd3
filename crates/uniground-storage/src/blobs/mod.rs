//! Files outside the database. Only this module publishes and removes them.
//!
//! ```text
//! blobs/contents/<sha256>/...     an unpacked archive
//! blobs/parses/<id>/              cloud.ply  instances.ply  embeddings.npy
//!                                 embedding_norms.npy  embedding_shared.npy
//!                                 report/  views/<instance>-<view>-{crop,frame}.jpg
//! blobs/checkpoints/<sha256>/...  finished stages of parses of that content
//! blobs/answers/<id>/             prompt.json  reply.json  *.jpg: a model's prompt and reply
//! uploads/<id>                    the received part of a resumable upload
//! tmp/                            uploads and folders being written or removed; emptied at start
//! ```
//! A folder is written under `tmp/`, synced to disk, and moved into place as a whole. The row that
//! refers to it is written last. So a visible blob is complete, and a visible row has its blob,
//! also after a power failure.
//!
//! Published folders may be stored in an object store instead ([`objects`]). Local folders are then
//! copies, which readers download ([`shared`]). Copies that are not in use are evicted when there
//! are too many ([`cache`]). Readers get files with [`Blobs::pin_file`] and
//! [`Blobs::pin_folder`], wherever the files are stored.

mod aging;
mod cache;
pub(super) mod checksums;
mod growing;
mod home;
pub(super) mod objects;
mod shared;
mod sizes;
mod stages;

pub use aging::{StoredCheckpoints, size_of};
pub use cache::PinnedPath;
use checksums::Sums;
pub use checksums::{CheckDepth, DamagedFile};
pub use growing::GrowingFile;
pub use home::{BlobHome, BlobsAt, FileAccess};
pub use objects::{AccessKeys, Bucket, Links, ObjectStoreUnavailable};
use objects::{FolderName, UnsealedObjects};
use shared::{PendingUpload, SharedBlobs};
pub use sizes::FolderSizes;

use super::data_folder::sync_folder;
use camino::{Utf8Path, Utf8PathBuf};
use futures::{StreamExt, stream};
use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;
use std::{fs, io};
use tokio::task::spawn_blocking;
use uuid::Uuid;

#[derive(Debug, Clone)]
pub struct Blobs {
    root: Utf8PathBuf,
    tmp: Utf8PathBuf,
    hands: WriteMode,
    /// The id of this storage, where it is not the data folder's own id.
    id: Option<Arc<str>>,
    /// The object store, where folders are stored in one.
    shared: Option<Arc<SharedBlobs>>,
}

/// Whether folders may be changed, or only read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum WriteMode {
    ReadWrite,
    /// Nothing that exists is moved or removed.
    ReadOnly,
}

/// A temporary folder: one being written, or one being removed.
#[derive(Debug)]
pub struct Scratch {
    path: Utf8PathBuf,
    tmp: Utf8PathBuf,
    /// Objects in the object store that are removed together with the folder.
    beyond: Option<UnsealedObjects>,
}

impl Scratch {
    #[must_use]
    pub fn path(&self) -> &Utf8Path {
        &self.path
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        drop(self.beyond.take());
        // A published folder has already been moved. A folder that cannot be removed now is removed
        // at the next start.
        if let Err(error) = remove_tree(&self.path, &self.tmp) {
            tracing::warn!(folder = %self.path, %error, "temporary folder could not be removed");
        }
    }
}

/// The kinds of folders below `blobs/`.
pub const KINDS: [&str; 4] = ["contents", "parses", "checkpoints", "answers"];
/// Kinds of folders that never change once they are published.
const SEALED: [&str; 3] = ["contents", "parses", "answers"];
/// Folders that are removed from an object store concurrently.
const MAX_CONCURRENT_REMOVALS: usize = 16;

/// A folder that is completely written, to disk or to the object store, but not published yet.
#[derive(Debug)]
pub struct Prepared {
    scratch: Scratch,
    place: Utf8PathBuf,
    put: Option<(Arc<SharedBlobs>, FolderName, PendingUpload)>,
}

impl Blobs {
    /// Creates a handle of the folders below `data_dir`, without an object store.
    fn for_data_dir(data_dir: &Utf8Path, hands: WriteMode) -> Self {
        Self {
            root: data_dir.join("blobs"),
            tmp: data_dir.join("tmp"),
            hands,
            id: None,
            shared: None,
        }
    }

    /// Returns whether folders may be moved and removed.
    pub(super) fn is_writable(&self) -> bool {
        self.hands == WriteMode::ReadWrite
    }

    /// Wraps a path under `tmp/` that is to be removed.
    fn to_scratch(&self, path: Utf8PathBuf) -> Scratch {
        Scratch { path, tmp: self.tmp.clone(), beyond: None }
    }

    /// Returns what processes that are gone left under `tmp/`: everything that has not changed for
    /// this long. It is removed when the result is dropped.
    pub(super) fn list_leftovers(&self, unchanged: Duration) -> io::Result<Vec<Scratch>> {
        let mut left = Vec::new();
        for entry in self.tmp.read_dir_utf8()? {
            let entry = entry?;
            // It was removed meanwhile, or its time is in the future: it counts as in use.
            let age =
                entry.metadata().and_then(|m| m.modified()).ok().and_then(|at| at.elapsed().ok());
            if unchanged.is_zero() || age.is_some_and(|age| age >= unchanged) {
                left.push(self.to_scratch(entry.into_path()));
            }
        }
        Ok(left)
    }

    /// Returns the names of the folders of a kind. Ignores anything that is not a folder.
    pub(super) fn names(&self, kind: &str) -> io::Result<Vec<String>> {
        let mut names = Vec::new();
        let folder = self.root.join(kind);
        if !self.is_writable() && !folder.is_dir() {
            return Ok(names);
        }
        for entry in folder.read_dir_utf8()? {
            let entry = entry?;
            if entry.file_type()?.is_dir() {
                names.push(entry.file_name().to_owned());
            }
        }
        Ok(names)
    }

    /// Returns files in places where only folders belong.
    ///
    /// # Errors
    /// Errors of the file system.
    pub fn stray_files(&self) -> io::Result<Vec<Utf8PathBuf>> {
        let mut orphan_folders = Vec::new();
        for folder in KINDS.map(|kind| self.root.join(kind)).iter().chain([&self.root]) {
            for entry in folder.read_dir_utf8()? {
                let entry = entry?;
                if !entry.file_type()?.is_dir() && entry.file_name() != home::CACHE_MARKER {
                    orphan_folders.push(entry.into_path());
                }
            }
        }
        Ok(orphan_folders)
    }

    pub(super) fn folder_path(&self, kind: &str, name: &str) -> Utf8PathBuf {
        self.root.join(kind).join(name)
    }

    #[must_use]
    pub fn content(&self, hash: &str) -> Utf8PathBuf {
        self.folder_path("contents", hash)
    }

    pub(super) fn is_content(&self, folder: &Utf8Path) -> bool {
        folder.parent() == Some(&self.root.join("contents"))
    }

    /// Returns the folder of finished stages of a content, which the next parse of it reuses.
    #[must_use]
    pub fn checkpoints(&self, hash: &str) -> Utf8PathBuf {
        self.folder_path("checkpoints", hash)
    }

    #[must_use]
    pub fn parse(&self, id: &str) -> Utf8PathBuf {
        self.folder_path("parses", id)
    }

    /// Returns the folder with a model's prompt and reply for an answer.
    #[must_use]
    pub fn answer(&self, id: &str) -> Utf8PathBuf {
        self.folder_path("answers", id)
    }

    /// Returns the folder for files being received, on the same file system as the blobs.
    #[must_use]
    pub fn tmp(&self) -> &Utf8Path {
        &self.tmp
    }

    /// Creates an empty folder under `tmp/`. It is removed on drop unless it was published.
    ///
    /// # Errors
    /// Errors of the file system.
    pub fn scratch(&self) -> io::Result<Scratch> {
        let path = self.tmp.join(Uuid::now_v7().to_string());
        fs::create_dir(&path)?;
        Ok(self.to_scratch(path))
    }

    /// Syncs a finished folder to disk and moves it into place. If the place is taken, the existing
    /// folder stays, as the same name means the same content. If the existing one is incomplete,
    /// this one replaces it.
    ///
    /// # Errors
    /// Errors of the file system.
    pub fn publish(&self, scratch: Scratch, place: &Utf8Path) -> io::Result<()> {
        self.publish_with_checksums(scratch, place, &Sums::new())
    }

    /// As [`publish`](Self::publish). Files with known checksums are not read again.
    ///
    /// # Errors
    /// As for [`prepare`](Self::prepare).
    pub fn publish_with_checksums(
        &self,
        scratch: Scratch,
        place: &Utf8Path,
        known: &Sums,
    ) -> io::Result<()> {
        self.publish_prepared(self.prepare_with_checksums(scratch, place, known)?)
    }

    /// Does all of publishing that takes time. The result is removed on drop unless it is
    /// published.
    ///
    /// # Errors
    /// Errors of the file system; the object store cannot be used.
    pub fn prepare(&self, scratch: Scratch, place: &Utf8Path) -> io::Result<Prepared> {
        self.prepare_with_checksums(scratch, place, &Sums::new())
    }

    fn prepare_with_checksums(
        &self,
        scratch: Scratch,
        place: &Utf8Path,
        known: &Sums,
    ) -> io::Result<Prepared> {
        let put = if let (Some(shared), Some(name)) = (&self.shared, self.name_of(place)) {
            let put = shared.upload_edition(&scratch, &name, known)?;
            Some((shared.clone(), name, put))
        } else {
            checksums::seal(scratch.path(), known, "")?;
            None
        };
        Ok(Prepared { scratch, place: place.to_owned(), put })
    }

    /// Publishes a prepared folder, as [`publish`](Self::publish) does.
    ///
    /// # Errors
    /// As for [`prepare`](Self::prepare).
    pub fn publish_prepared(&self, Prepared { scratch, place, put }: Prepared) -> io::Result<()> {
        if let Some((shared, name, put)) = put {
            return self.publish_upload(&shared, &name, &scratch, put, &place);
        }
        if place.exists() {
            if checksums::check_folder(&place, CheckDepth::Bytes)?.is_empty() {
                return Ok(());
            }
            tracing::warn!(blob = %place, "replacing a damaged folder");
            drop(self.move_to_tmp(&place)?);
        }
        fs::rename(&scratch.path, &place)?;
        sync_folder(place.parent().unwrap_or(&place))
    }

    /// Adds the files of a published folder to one that is being written, below `below`. Uses hard
    /// links where the disk supports them. Returns the checksums of the files.
    ///
    /// # Errors
    /// Errors of the file system.
    pub fn link_files(
        &self,
        published: &Utf8Path,
        with: &Scratch,
        below: &Utf8Path,
    ) -> io::Result<Sums> {
        checksums::link_files(&self.pin_folder(published)?, with.path(), below)
    }

    /// Moves a folder away to `tmp/`, so that it disappears at once, whatever it holds. Returns
    /// `None` if it did not exist.
    fn move_to_tmp(&self, folder: &Utf8Path) -> io::Result<Option<Scratch>> {
        if let Some(SharedBlobs { cache, .. }) = self.shared.as_deref() {
            return Ok(cache.move_folder_away(folder)?.map(|path| self.to_scratch(path)));
        }
        let path = self.new_tmp_path();
        match fs::rename(folder, &path) {
            Ok(()) => Ok(Some(self.to_scratch(path))),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(error),
        }
    }

    fn new_tmp_path(&self) -> Utf8PathBuf {
        self.tmp.join(Uuid::now_v7().to_string())
    }

    /// Puts back a folder that was set aside, unless another one has taken its place.
    ///
    /// # Errors
    /// Errors of the file system; the object store cannot be used.
    pub async fn put_back(&self, mut aside: Scratch, place: Utf8PathBuf) -> io::Result<()> {
        let blobs = self.clone();
        spawn_blocking(move || match (blobs.shared.as_deref(), aside.beyond.take()) {
            // The local copy is downloaded again when it is needed.
            (Some(SharedBlobs { objects, .. }), Some(unclaimed)) => {
                objects.block_on(unclaimed.put_back())
            }
            _ => fs::rename(&aside.path, &place)
                .or_else(|error| if place.exists() { Ok(()) } else { Err(error) }),
        })
        .await?
    }

    /// Moves folders away, off the async threads.
    ///
    /// # Errors
    /// Errors of the file system.
    pub async fn set_aside(&self, folders: Vec<Utf8PathBuf>) -> io::Result<Vec<Scratch>> {
        if !self.is_writable() {
            return Ok(Vec::new());
        }
        let blobs = self.clone();
        spawn_blocking(move || {
            let mut beyond = blobs.unseal(&folders);
            let taken = folders.iter().map(|folder| {
                let (aside, beyond) = (blobs.move_to_tmp(folder)?, beyond.remove(folder));
                // Without a local copy, only the objects are removed.
                let aside = aside
                    .or_else(|| beyond.is_some().then(|| blobs.to_scratch(blobs.new_tmp_path())));
                Ok(aside.map(|mut aside| {
                    aside.beyond = beyond;
                    aside
                }))
            });
            taken.filter_map(Result::transpose).collect()
        })
        .await?
    }

    /// Removes folders from the object store, if they exist there. What cannot be reached now is
    /// left to orphan collection: no row refers to it.
    fn unseal(&self, folders: &[Utf8PathBuf]) -> HashMap<Utf8PathBuf, UnsealedObjects> {
        let Some(SharedBlobs { objects, .. }) = self.shared.as_deref() else {
            return HashMap::new();
        };
        let named =
            folders.iter().filter_map(|folder| Some((folder.clone(), self.name_of(folder)?)));
        let unsealed = named.map(async |(folder, name)| match objects.unseal(&name).await {
            Ok(unsealed) => unsealed.map(|unclaimed| (folder, unclaimed)),
            Err(error) => {
                tracing::warn!(%folder, error = &error as &dyn std::error::Error, "objects could not be removed; garbage collection removes them later");
                None
            }
        });
        let unsealed = objects.block_on(
            stream::iter(unsealed).buffer_unordered(MAX_CONCURRENT_REMOVALS).collect::<Vec<_>>(),
        );
        let stages =
            folders.iter().filter(|folder| folder.starts_with(self.root.join("checkpoints")));
        let stages = stages.filter_map(|folder| {
            Some((folder.clone(), objects.unsealed_checkpoints(folder.file_name()?)))
        });
        unsealed.into_iter().flatten().chain(stages).collect()
    }

    /// Removes folders that were set aside, in the background. What a stopping server leaves under
    /// `tmp/` is removed at the next start.
    pub fn remove_later(&self, aside: Vec<Scratch>) {
        if !aside.is_empty() {
            spawn_blocking(move || drop(aside));
        }
    }

    /// Moves a folder away and removes it in the background. A missing folder is no error.
    ///
    /// # Errors
    /// Errors of the file system.
    pub async fn discard(&self, folder: Utf8PathBuf) -> io::Result<()> {
        let aside = self.set_aside(vec![folder]).await?;
        self.remove_later(aside);
        Ok(())
    }
}

/// Removes a file, or a folder with all its content, of any depth. Nested folders are first moved
/// up to `tmp`, so that neither paths nor the number of open folders grow with the depth. A missing
/// path is no error.
pub(super) fn remove_tree(path: &Utf8Path, tmp: &Utf8Path) -> io::Result<()> {
    match fs::symlink_metadata(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
        Err(error) => return Err(error),
        Ok(entry) if !entry.is_dir() => return fs::remove_file(path),
        Ok(_) => {}
    }
    let mut folders = vec![path.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder)? {
            let entry = entry?;
            if entry.file_type()?.is_dir() {
                let within = tmp.join(Uuid::now_v7().to_string());
                fs::rename(entry.path(), &within)?;
                folders.push(within);
            } else {
                fs::remove_file(entry.path())?;
            }
        }
        fs::remove_dir(&folder)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests;
