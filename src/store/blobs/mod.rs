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
//! A folder is written under `tmp/`, put on the disk, and moved into place as a whole; the row that speaks of it comes last. So a blob
//! that can be seen is complete, and a row that can be seen has its blob, also after the power has failed.

mod aging;
pub(super) mod checksums;
mod growing;
mod sizes;

pub use aging::{KeptCheckpoints, size_of};
use checksums::Sums;
pub use checksums::{Damage, Look};
pub use growing::GrowingFile;
pub use sizes::Measured;

use super::data_folder::sync_folder;
use camino::{Utf8Path, Utf8PathBuf};
use std::fs;
use std::io;
use std::time::Duration;
use tokio::task::spawn_blocking;
use uuid::Uuid;

#[derive(Debug, Clone)]
pub struct Blobs {
    root: Utf8PathBuf,
    tmp: Utf8PathBuf,
    hands: Hands,
}

/// Whether what is done with folders is done, or only thought through.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Hands {
    Free,
    /// Nothing that is there is moved or removed.
    Tied,
}

/// A folder being written, or one on its way out.
#[derive(Debug)]
pub struct Scratch {
    path: Utf8PathBuf,
    tmp: Utf8PathBuf,
}

impl Scratch {
    #[must_use]
    pub fn path(&self) -> &Utf8Path {
        &self.path
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        // Published folders have moved away; what can not be removed now goes when the server starts next.
        if let Err(error) = remove_tree(&self.path, &self.tmp) {
            tracing::warn!(folder = %self.path, %error, "a temporary folder stays behind");
        }
    }
}

/// The kinds of folders below `blobs/`.
pub const KINDS: [&str; 4] = ["contents", "parses", "checkpoints", "answers"];

impl Blobs {
    pub(super) fn open(data_dir: &Utf8Path) -> io::Result<Self> {
        let blobs = Self { root: data_dir.join("blobs"), tmp: data_dir.join("tmp"), hands: Hands::Free };
        for folder in KINDS.map(|kind| blobs.root.join(kind)).iter().chain([&blobs.tmp, &blobs.uploads()]) {
            fs::create_dir_all(folder)?;
        }
        Ok(blobs)
    }

    /// Folders that are looked at and stay as they are, whatever is asked: nothing goes out of the way, nothing to the quarantine.
    pub(super) fn look_only(data_dir: &Utf8Path) -> Self {
        Self { root: data_dir.join("blobs"), tmp: data_dir.join("tmp"), hands: Hands::Tied }
    }

    /// Whether folders may be moved and removed.
    pub(super) fn has_free_hands(&self) -> bool {
        self.hands == Hands::Free
    }

    /// What processes that are gone left under `tmp/`, to be removed when it is dropped: what has not changed for so long.
    pub(super) fn left_behind(&self, unchanged: Duration) -> io::Result<Vec<Scratch>> {
        let mut left = Vec::new();
        for entry in self.tmp.read_dir_utf8()? {
            let entry = entry?;
            // Gone meanwhile, or from tomorrow: in somebody's hands.
            let age = entry.metadata().and_then(|m| m.modified()).ok().and_then(|at| at.elapsed().ok());
            if unchanged.is_zero() || age.is_some_and(|age| age >= unchanged) {
                left.push(Scratch { path: entry.into_path(), tmp: self.tmp.clone() });
            }
        }
        Ok(left)
    }

    /// Folders of a kind, by name. What is no folder is none of ours and passed over.
    pub(super) fn names(&self, kind: &str) -> io::Result<Vec<String>> {
        let mut names = Vec::new();
        let folder = self.root.join(kind);
        if !self.has_free_hands() && !folder.is_dir() {
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
        let mut strays = Vec::new();
        for folder in KINDS.map(|kind| self.root.join(kind)).iter().chain([&self.root]) {
            for entry in folder.read_dir_utf8()? {
                let entry = entry?;
                if !entry.file_type()?.is_dir() {
                    strays.push(entry.into_path());
                }
            }
        }
        Ok(strays)
    }

    pub(super) fn place(&self, kind: &str, name: &str) -> Utf8PathBuf {
        self.root.join(kind).join(name)
    }

    #[must_use]
    pub fn content(&self, hash: &str) -> Utf8PathBuf {
        self.place("contents", hash)
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
        Ok(Scratch { path, tmp: self.tmp.clone() })
    }

    /// Moves a finished folder into place, on the disk. When somebody was faster, theirs stays: same name, same content; unless it is not
    /// whole: then ours takes its place.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn publish(&self, scratch: Scratch, place: &Utf8Path) -> io::Result<()> {
        self.publish_knowing(scratch, place, &Sums::new())
    }

    /// As [`publish`](Self::publish); files whose sums are known are not read again.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn publish_knowing(&self, scratch: Scratch, place: &Utf8Path, known: &Sums) -> io::Result<()> {
        if place.exists() {
            if checksums::look(place, Look::Bytes)?.is_empty() {
                return Ok(());
            }
            tracing::warn!(blob = %place, "a damaged folder is replaced");
            drop(self.take_away(place)?);
        }
        checksums::seal(&scratch.path, known)?;
        fs::rename(&scratch.path, place)?;
        sync_folder(place.parent().unwrap_or(place))
    }

    /// Gives a folder that is to be published the files of one that is, below `below`, without copying them where the disk can; their sums.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn share(&self, published: &Utf8Path, with: &Scratch, below: &Utf8Path) -> io::Result<Sums> {
        checksums::share(published, with.path(), below)
    }

    /// Finished stages of one content are those of another that has grown from it.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn inherit_checkpoints(&self, from: &str, to: &str) -> io::Result<()> {
        let (from, to) = (self.checkpoints(from), self.use_checkpoints(to)?);
        if !from.is_dir() {
            return Ok(());
        }
        for entry in from.read_dir_utf8()? {
            let entry = entry?;
            if !entry.file_type()?.is_file() {
                continue;
            }
            // Logs are appended to: each content has its own.
            fs::copy(entry.path(), to.join(entry.file_name()))?;
        }
        Ok(())
    }

    /// What is wrong with a published folder.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn look(&self, place: &Utf8Path, closely: Look) -> io::Result<Vec<Damage>> {
        checksums::look(place, closely)
    }

    /// What is wrong with one file of a published folder.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn look_at(&self, place: &Utf8Path, file: &Utf8Path) -> io::Result<Option<Damage>> {
        checksums::look_at(place, file)
    }

    /// Whether a published folder was published with this file; of folders from before that was written down, whether it is there.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn holds(&self, place: &Utf8Path, file: &Utf8Path) -> io::Result<bool> {
        checksums::holds(place, file.strip_prefix(place).unwrap_or(file))
    }

    /// Takes a folder out of the way, under `tmp/`: it is gone for everybody at once, whatever it holds. `None` where nothing was.
    fn take_away(&self, folder: &Utf8Path) -> io::Result<Option<Scratch>> {
        let path = self.tmp.join(Uuid::now_v7().to_string());
        match fs::rename(folder, &path) {
            Ok(()) => Ok(Some(Scratch { path, tmp: self.tmp.clone() })),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// Takes folders out of the way, off the async threads.
    ///
    /// # Errors
    /// Those of the file system.
    pub async fn set_aside(&self, folders: Vec<Utf8PathBuf>) -> io::Result<Vec<Scratch>> {
        if !self.has_free_hands() {
            return Ok(Vec::new());
        }
        let blobs = self.clone();
        spawn_blocking(move || {
            let taken = folders.iter().map(|folder| blobs.take_away(folder));
            taken.filter_map(Result::transpose).collect()
        })
        .await?
    }

    /// Removes what was set aside, in the background. What a server that stops leaves under `tmp/` goes when the next one starts.
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

/// Removes a file, or a folder with all it holds, however deep: folders within are moved up to `tmp` first, so that no path and no stack
/// of open folders grows with the depth. Nothing to remove is fine.
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
        Blobs::open(Utf8Path::from_path(data.path()).unwrap()).unwrap()
    }

    /// Thousands of folders, one in another, with names that make their path longer than any path may be.
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
            wrong.iter().map(|Damage { file, what }| format!("{file} {what}")).collect::<Vec<_>>()
        };
        assert_eq!(look(Look::Bytes), [""; 0]);
        fs::write(blobs.parse("p").join("cloud.ply"), "pointz").unwrap();
        fs::remove_file(blobs.parse("p").join("views/1.jpg")).unwrap();
        fs::write(blobs.parse("p").join("note"), "x").unwrap();
        assert_eq!(look(Look::Names), ["views/1.jpg missing"]);
        assert_eq!(look(Look::Bytes), ["cloud.ply damaged", "views/1.jpg missing", "note stray"]);
        publish();
        assert_eq!(look(Look::Bytes), [""; 0]);
        assert_eq!(blobs.look(&blobs.parse("q"), Look::Names).unwrap()[0].what, "missing");
    }
}
