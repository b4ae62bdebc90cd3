//! Files beside the database. The one place that publishes and removes them.
//!
//! ```text
//! blobs/contents/<sha256>/...     an unpacked archive
//! blobs/parses/<id>/cloud.ply  instances.ply  embeddings.npy  embedding_norms.npy  report/  views/<instance>-<view>-{crop,frame}.jpg
//! blobs/checkpoints/<sha256>/...  finished stages of parses of that content
//! blobs/answers/<id>/prompt.json  reply.json  *.jpg   what a model was shown and said for an answer
//! uploads/<id>                    what has come of an upload that comes in parts
//! tmp/                            uploads and folders being written, folders being removed; emptied after a start
//! ```
//! A folder is written under `tmp/`, put on the disk, and moved into place as a whole; the row that
//! speaks of it comes last. So a blob that can be seen is complete, and a row that can be seen has
//! its blob, also after the power has failed.
//!
//! Published folders may be kept in an object store instead ([`objects`]): those that lie here are
//! then copies of what is there, brought by whoever reads them ([`shared`]), and go when they are
//! not in use and too many ([`cache`]). Whoever reads a folder asks for its files ([`Blobs::file`],
//! [`Blobs::whole`]) wherever they are kept.

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
    /// What it all goes by, where that is not the data folder's own id.
    id: Option<Arc<str>>,
    /// Where folders are kept in an object store.
    shared: Option<Arc<SharedBlobs>>,
}

/// Whether what is done with folders is done, or only thought through.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum WriteMode {
    Free,
    /// Nothing that is there is moved or removed.
    Tied,
}

/// A folder being written, or one on its way out.
#[derive(Debug)]
pub struct Scratch {
    path: Utf8PathBuf,
    tmp: Utf8PathBuf,
    /// What goes with it elsewhere.
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
        // Published folders have moved away; what can not be removed now goes when the server
        // starts next.
        if let Err(error) = remove_tree(&self.path, &self.tmp) {
            tracing::warn!(folder = %self.path, %error, "temporary folder could not be removed");
        }
    }
}

/// The kinds of folders below `blobs/`.
pub const KINDS: [&str; 4] = ["contents", "parses", "checkpoints", "answers"];
/// Those that never change once they are published.
const SEALED: [&str; 3] = ["contents", "parses", "answers"];
/// Folders that are taken away from an object store at once.
const AT_ONCE: usize = 16;

/// A folder that is written, all of it on the disk or in the object store, and not published yet.
#[derive(Debug)]
pub struct Prepared {
    scratch: Scratch,
    place: Utf8PathBuf,
    put: Option<(Arc<SharedBlobs>, FolderName, PendingUpload)>,
}

impl Blobs {
    /// Folders below `data_dir`, and nowhere else.
    fn below(data_dir: &Utf8Path, hands: WriteMode) -> Self {
        Self {
            root: data_dir.join("blobs"),
            tmp: data_dir.join("tmp"),
            hands,
            id: None,
            shared: None,
        }
    }

    /// Whether folders may be moved and removed.
    pub(super) fn is_writable(&self) -> bool {
        self.hands == WriteMode::Free
    }

    /// What lies under `tmp/` and is to go.
    fn aside(&self, path: Utf8PathBuf) -> Scratch {
        Scratch { path, tmp: self.tmp.clone(), beyond: None }
    }

    /// What processes that are gone left under `tmp/`, to be removed when it is dropped: what has
    /// not changed for so long.
    pub(super) fn left_behind(&self, unchanged: Duration) -> io::Result<Vec<Scratch>> {
        let mut left = Vec::new();
        for entry in self.tmp.read_dir_utf8()? {
            let entry = entry?;
            // Gone meanwhile, or from tomorrow: in somebody's hands.
            let age =
                entry.metadata().and_then(|m| m.modified()).ok().and_then(|at| at.elapsed().ok());
            if unchanged.is_zero() || age.is_some_and(|age| age >= unchanged) {
                left.push(self.aside(entry.into_path()));
            }
        }
        Ok(left)
    }

    /// Folders of a kind, by name. What is no folder is none of ours and passed over.
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

    /// Files that lie where only folders belong.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn stray_files(&self) -> io::Result<Vec<Utf8PathBuf>> {
        let mut orphan_folders = Vec::new();
        for folder in KINDS.map(|kind| self.root.join(kind)).iter().chain([&self.root]) {
            for entry in folder.read_dir_utf8()? {
                let entry = entry?;
                if !entry.file_type()?.is_dir() && entry.file_name() != home::CACHE_OF {
                    orphan_folders.push(entry.into_path());
                }
            }
        }
        Ok(orphan_folders)
    }

    pub(super) fn place(&self, kind: &str, name: &str) -> Utf8PathBuf {
        self.root.join(kind).join(name)
    }

    #[must_use]
    pub fn content(&self, hash: &str) -> Utf8PathBuf {
        self.place("contents", hash)
    }

    pub(super) fn is_content(&self, folder: &Utf8Path) -> bool {
        folder.parent() == Some(&self.root.join("contents"))
    }

    /// Finished stages of parses of a content, for the next parse of it.
    #[must_use]
    pub fn checkpoints(&self, hash: &str) -> Utf8PathBuf {
        self.place("checkpoints", hash)
    }

    #[must_use]
    pub fn parse(&self, id: &str) -> Utf8PathBuf {
        self.place("parses", id)
    }

    /// What a model was shown and said for an answer.
    #[must_use]
    pub fn answer(&self, id: &str) -> Utf8PathBuf {
        self.place("answers", id)
    }

    /// Folder for files being received, on the same file system as the blobs.
    #[must_use]
    pub fn tmp(&self) -> &Utf8Path {
        &self.tmp
    }

    /// A new empty folder under `tmp/`, removed again unless it is published.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn scratch(&self) -> io::Result<Scratch> {
        let path = self.tmp.join(Uuid::now_v7().to_string());
        fs::create_dir(&path)?;
        Ok(self.aside(path))
    }

    /// Moves a finished folder into place, on the disk. When somebody was faster, theirs stays:
    /// same name, same content; unless it is not whole: then ours takes its place.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn publish(&self, scratch: Scratch, place: &Utf8Path) -> io::Result<()> {
        self.publish_knowing(scratch, place, &Sums::new())
    }

    /// As [`publish`](Self::publish); files whose sums are known are not read again.
    ///
    /// # Errors
    /// As for [`prepare`](Self::prepare).
    pub fn publish_knowing(
        &self,
        scratch: Scratch,
        place: &Utf8Path,
        known: &Sums,
    ) -> io::Result<()> {
        self.publish_prepared(self.prepare_knowing(scratch, place, known)?)
    }

    /// All of publishing that takes time. What is not published after all goes again.
    ///
    /// # Errors
    /// Those of the file system; that the object store can not be used.
    pub fn prepare(&self, scratch: Scratch, place: &Utf8Path) -> io::Result<Prepared> {
        self.prepare_knowing(scratch, place, &Sums::new())
    }

    fn prepare_knowing(
        &self,
        scratch: Scratch,
        place: &Utf8Path,
        known: &Sums,
    ) -> io::Result<Prepared> {
        let put = if let (Some(shared), Some(name)) = (&self.shared, self.name_of(place)) {
            let put = shared.put(&scratch, &name, known)?;
            Some((shared.clone(), name, put))
        } else {
            checksums::seal(scratch.path(), known, "")?;
            None
        };
        Ok(Prepared { scratch, place: place.to_owned(), put })
    }

    /// Publishes what is prepared, as [`publish`](Self::publish) does.
    ///
    /// # Errors
    /// As for [`prepare`](Self::prepare).
    pub fn publish_prepared(&self, Prepared { scratch, place, put }: Prepared) -> io::Result<()> {
        if let Some((shared, name, put)) = put {
            return self.publish_put(&shared, &name, &scratch, put, &place);
        }
        if place.exists() {
            if checksums::look(&place, CheckDepth::Bytes)?.is_empty() {
                return Ok(());
            }
            tracing::warn!(blob = %place, "replacing a damaged folder");
            drop(self.take_away(&place)?);
        }
        fs::rename(&scratch.path, &place)?;
        sync_folder(place.parent().unwrap_or(&place))
    }

    /// Gives a folder that is to be published the files of one that is, below `below`, without
    /// copying them where the disk can; their sums.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn share(
        &self,
        published: &Utf8Path,
        with: &Scratch,
        below: &Utf8Path,
    ) -> io::Result<Sums> {
        checksums::share(&self.whole(published)?, with.path(), below)
    }

    /// Takes a folder out of the way, under `tmp/`: it is gone for everybody at once, whatever it
    /// holds. `None` where nothing was.
    fn take_away(&self, folder: &Utf8Path) -> io::Result<Option<Scratch>> {
        if let Some(SharedBlobs { cache, .. }) = self.shared.as_deref() {
            return Ok(cache.take(folder)?.map(|path| self.aside(path)));
        }
        let path = self.free_name();
        match fs::rename(folder, &path) {
            Ok(()) => Ok(Some(self.aside(path))),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(error),
        }
    }

    fn free_name(&self) -> Utf8PathBuf {
        self.tmp.join(Uuid::now_v7().to_string())
    }

    /// Puts a folder back that was set aside, unless there is another in its place by now.
    ///
    /// # Errors
    /// Those of the file system; that the object store can not be used.
    pub async fn put_back(&self, mut aside: Scratch, place: Utf8PathBuf) -> io::Result<()> {
        let blobs = self.clone();
        spawn_blocking(move || match (blobs.shared.as_deref(), aside.beyond.take()) {
            // Its copy comes again when somebody wants it.
            (Some(SharedBlobs { objects, .. }), Some(unclaimed)) => {
                objects.wait(unclaimed.put_back())
            }
            _ => fs::rename(&aside.path, &place)
                .or_else(|error| if place.exists() { Ok(()) } else { Err(error) }),
        })
        .await?
    }

    /// Takes folders out of the way, off the async threads.
    ///
    /// # Errors
    /// Those of the file system.
    pub async fn set_aside(&self, folders: Vec<Utf8PathBuf>) -> io::Result<Vec<Scratch>> {
        if !self.is_writable() {
            return Ok(Vec::new());
        }
        let blobs = self.clone();
        spawn_blocking(move || {
            let mut beyond = blobs.unseal(&folders);
            let taken = folders.iter().map(|folder| {
                let (aside, beyond) = (blobs.take_away(folder)?, beyond.remove(folder));
                // Of what there is no copy of here, only the objects go.
                let aside =
                    aside.or_else(|| beyond.is_some().then(|| blobs.aside(blobs.free_name())));
                Ok(aside.map(|mut aside| {
                    aside.beyond = beyond;
                    aside
                }))
            });
            taken.filter_map(Result::transpose).collect()
        })
        .await?
    }

    /// Takes folders away from the object store, where they are there. What can not be had now is
    /// for the sweep: no row speaks of it any more.
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
        let unsealed =
            objects.wait(stream::iter(unsealed).buffer_unordered(AT_ONCE).collect::<Vec<_>>());
        let stages =
            folders.iter().filter(|folder| folder.starts_with(self.root.join("checkpoints")));
        let stages = stages
            .filter_map(|folder| Some((folder.clone(), objects.loose_stages(folder.file_name()?))));
        unsealed.into_iter().flatten().chain(stages).collect()
    }

    /// Removes what was set aside, in the background. What a server that stops leaves under `tmp/`
    /// goes when the next one starts.
    pub fn remove_later(&self, aside: Vec<Scratch>) {
        if !aside.is_empty() {
            spawn_blocking(move || drop(aside));
        }
    }

    /// Takes a folder out of the way and removes it in the background; nothing there is fine.
    ///
    /// # Errors
    /// Those of the file system.
    pub async fn discard(&self, folder: Utf8PathBuf) -> io::Result<()> {
        let aside = self.set_aside(vec![folder]).await?;
        self.remove_later(aside);
        Ok(())
    }
}

/// Removes a file, or a folder with all it holds, however deep: folders within are moved up to
/// `tmp` first, so that no path and no stack of open folders grows with the depth. Nothing to
/// remove is fine.
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
mod tests {
    use super::*;

    fn opened(data: &tempfile::TempDir) -> Blobs {
        Blobs::open(Utf8Path::from_path(data.path()).unwrap(), &BlobHome::Folder, FileAccess::Used)
            .unwrap()
    }

    /// Thousands of folders, one in another, with names that make their path longer than any path
    /// may be.
    #[test]
    fn folders_of_any_depth_are_removed() {
        let data = tempfile::tempdir().unwrap();
        let blobs = opened(&data);
        let mut top = blobs.tmp.join("0");
        fs::create_dir(&top).unwrap();
        for i in 1..3000 {
            // From the inside out: what lies below moves into the next.
            let outer = blobs.tmp.join(i.to_string());
            fs::create_dir(&outer).unwrap();
            fs::rename(&top, outer.join("a name that is not short")).unwrap();
            top = outer;
        }
        let content = blobs.content("deep");
        fs::rename(&top, &content).unwrap();
        drop(blobs.take_away(&content).unwrap());
        assert!(!content.exists() && blobs.left_behind(Duration::ZERO).unwrap().is_empty());
    }

    #[test]
    fn damage_is_told_and_a_damaged_folder_is_replaced() {
        let data = tempfile::tempdir().unwrap();
        let blobs = opened(&data);
        let publish = || {
            let scratch = blobs.scratch().unwrap();
            fs::create_dir(scratch.path().join("views")).unwrap();
            fs::write(scratch.path().join("cloud.ply"), "points").unwrap();
            fs::write(scratch.path().join("views/1.jpg"), "picture").unwrap();
            blobs.publish(scratch, &blobs.parse("p")).unwrap();
        };
        publish();
        let look = |closely| {
            let wrong = blobs.look(&blobs.parse("p"), closely).unwrap();
            wrong
                .iter()
                .map(|DamagedFile { file, what }| format!("{file} {what}"))
                .collect::<Vec<_>>()
        };
        assert_eq!(look(CheckDepth::Bytes), [""; 0]);
        fs::write(blobs.parse("p").join("cloud.ply"), "pointz").unwrap();
        fs::remove_file(blobs.parse("p").join("views/1.jpg")).unwrap();
        fs::write(blobs.parse("p").join("note"), "x").unwrap();
        assert_eq!(look(CheckDepth::Names), ["views/1.jpg missing"]);
        assert_eq!(
            look(CheckDepth::Bytes),
            ["cloud.ply damaged", "views/1.jpg missing", "note stray"]
        );
        publish();
        assert_eq!(look(CheckDepth::Bytes), [""; 0]);
        assert_eq!(blobs.look(&blobs.parse("q"), CheckDepth::Names).unwrap()[0].what, "missing");
    }
}
