//! Files beside the database.
//!
//! ```text
//! blobs/contents/<sha256>/...     an unpacked archive
//! blobs/parses/<id>/cloud.ply  instances.ply  embeddings.npy  embedding_norms.npy  report/  views/<instance>-<view>-{crop,frame}.jpg
//! blobs/checkpoints/<sha256>/...  finished stages of parses of that content
//! blobs/answers/<id>/prompt.json  reply.json  *.jpg   what a model was shown and said for an answer
//! tmp/                            uploads and folders being written, folders being removed; emptied at start
//! ```
//! A folder is written under `tmp/` and moved into place as a whole, so a blob that can be seen is complete.

use camino::{Utf8Path, Utf8PathBuf};
use std::collections::HashSet;
use std::fs;
use std::io;
use std::time::{Duration, SystemTime};
use tokio::task::spawn_blocking;
use uuid::Uuid;

#[derive(Debug, Clone)]
pub struct Blobs {
    root: Utf8PathBuf,
    tmp: Utf8PathBuf,
}

/// A folder being written.
#[derive(Debug)]
pub struct Scratch {
    path: Utf8PathBuf,
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
        if let Err(error) = fs::remove_dir_all(&self.path)
            && error.kind() != io::ErrorKind::NotFound
        {
            tracing::warn!(folder = %self.path, %error, "a temporary folder stays behind");
        }
    }
}

impl Blobs {
    pub(super) fn open(data_dir: &Utf8Path) -> io::Result<Self> {
        let blobs = Self { root: data_dir.join("blobs"), tmp: data_dir.join("tmp") };
        if blobs.tmp.exists() {
            fs::remove_dir_all(&blobs.tmp)?;
        }
        for folder in [
            &blobs.tmp,
            &blobs.root.join("contents"),
            &blobs.root.join("parses"),
            &blobs.root.join("checkpoints"),
            &blobs.root.join("answers"),
        ] {
            fs::create_dir_all(folder)?;
        }
        Ok(blobs)
    }

    #[must_use]
    pub fn content(&self, hash: &str) -> Utf8PathBuf {
        self.root.join("contents").join(hash)
    }

    /// Finished stages of parses of a content, for the next parse of it.
    #[must_use]
    pub fn checkpoints(&self, hash: &str) -> Utf8PathBuf {
        self.root.join("checkpoints").join(hash)
    }

    #[must_use]
    pub fn parse(&self, id: &str) -> Utf8PathBuf {
        self.root.join("parses").join(id)
    }

    /// What a model was shown and said for an answer.
    #[must_use]
    pub fn answer(&self, id: &str) -> Utf8PathBuf {
        self.root.join("answers").join(id)
    }

    /// Removes what was kept for answers whose folder is older.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn forget_answers(&self, older_than: Duration, now: SystemTime) -> io::Result<usize> {
        let mut forgotten = 0;
        for entry in self.root.join("answers").read_dir_utf8()? {
            let entry = entry?;
            let age = now.duration_since(entry.metadata()?.modified()?).unwrap_or_default();
            if age > older_than {
                self.remove(entry.path())?;
                forgotten += 1;
            }
        }
        Ok(forgotten)
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
        Ok(Scratch { path })
    }

    /// Moves a finished folder into place. When somebody was faster, theirs stays: same name, same content.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn publish(&self, scratch: Scratch, place: &Utf8Path) -> io::Result<()> {
        if place.exists() {
            return Ok(());
        }
        fs::rename(&scratch.path, place)
    }

    /// Removes a folder; nothing to remove is fine.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn remove(&self, folder: &Utf8Path) -> io::Result<()> {
        match fs::remove_dir_all(folder) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
            _ => Ok(()),
        }
    }

    /// Takes folders out of the way, under `tmp/`: they are gone for everybody at once, whatever they hold. Off the async threads.
    ///
    /// # Errors
    /// Those of the file system.
    pub async fn set_aside(&self, folders: Vec<Utf8PathBuf>) -> io::Result<Vec<Scratch>> {
        let blobs = self.clone();
        let renamed = spawn_blocking(move || {
            let mut aside = Vec::new();
            for folder in folders {
                let path = blobs.tmp.join(Uuid::now_v7().to_string());
                match fs::rename(&folder, &path) {
                    Ok(()) => aside.push(Scratch { path }),
                    Err(error) if error.kind() == io::ErrorKind::NotFound => {}
                    Err(error) => return Err(error),
                }
            }
            Ok(aside)
        });
        renamed.await?
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

    /// Whether files can be written.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn probe(&self) -> io::Result<()> {
        self.scratch().map(drop)
    }

    pub(super) fn keep_only(&self, contents: &[String], parses: &[String], answers: &[String]) -> io::Result<()> {
        for (folder, known) in [("contents", contents), ("checkpoints", contents), ("parses", parses), ("answers", answers)] {
            let known: HashSet<&str> = known.iter().map(String::as_str).collect();
            for entry in self.root.join(folder).read_dir_utf8()? {
                let entry = entry?;
                if !known.contains(entry.file_name()) {
                    tracing::info!(blob = %entry.path(), "removing a blob no record speaks of");
                    fs::remove_dir_all(entry.path())?;
                }
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_kept_long_enough_goes() {
        let data = tempfile::tempdir().unwrap();
        let blobs = Blobs::open(Utf8Path::from_path(data.path()).unwrap()).unwrap();
        for id in ["a", "b"] {
            fs::create_dir(blobs.answer(id)).unwrap();
        }
        let (day, now) = (Duration::from_hours(24), SystemTime::now());
        assert_eq!(blobs.forget_answers(day, now + day / 2).unwrap(), 0);
        assert_eq!(blobs.forget_answers(day, now + day * 2).unwrap(), 2);
        assert!(!blobs.answer("a").exists());
    }
}
