//! The folder in which the hub's own tools keep repositories:
//! `models--OWNER--NAME/{refs/REVISION, snapshots/COMMIT/…, blobs/HASH}`.

use super::source::HubName;
use super::transfer::{Hash, RemoteFile};
use camino::{Utf8Path, Utf8PathBuf};
use std::fs;

/// Deepest folder of a repository that is searched.
const MAX_DEPTH: usize = 8;
/// Maximum number of files of a repository.
const MAX_FILES: usize = 100_000;

/// A repository in the cache, which may hold only some of its files.
pub struct CachedRepository {
    folder: Utf8PathBuf,
}

impl CachedRepository {
    /// Finds a repository. The folder need not exist.
    #[must_use]
    pub fn new(cache: &Utf8Path, name: &HubName) -> Self {
        Self { folder: cache.join(format!("models--{}--{}", name.owner, name.name)) }
    }

    /// Returns the commit of a branch or tag when it was last downloaded, or a commit itself if
    /// files of it are here.
    #[must_use]
    pub fn commit(&self, revision: &str) -> Option<String> {
        let is_commit =
            |text: &str| text.len() == 40 && text.chars().all(|c| c.is_ascii_hexdigit());
        if is_commit(revision) && self.folder.join("snapshots").join(revision).is_dir() {
            return Some(revision.to_owned());
        }
        let commit = fs::read_to_string(self.folder.join("refs").join(revision)).ok()?;
        Some(commit.trim().to_owned()).filter(|commit| is_commit(commit))
    }

    /// Returns the paths of the files of a commit.
    #[must_use]
    pub fn files(&self, commit: &str) -> Vec<String> {
        let root = self.folder.join("snapshots").join(commit);
        let (mut found, mut folders) = (Vec::new(), vec![(root.clone(), 0)]);
        while let Some((folder, depth)) = folders.pop() {
            for entry in folder.read_dir_utf8().into_iter().flatten().flatten() {
                let path = entry.path().to_owned();
                match path.is_dir() {
                    true if depth < MAX_DEPTH => folders.push((path, depth + 1)),
                    false if path.is_file() && found.len() < MAX_FILES => {
                        found.extend(path.strip_prefix(&root).map(ToString::to_string));
                    }
                    _ => {}
                }
            }
        }
        found.sort();
        found
    }

    /// Returns the license in the model card of a commit, as the hub states it, or an empty text.
    #[must_use]
    pub fn license(&self, commit: &str) -> String {
        let card = self.folder.join("snapshots").join(commit).join("README.md");
        let text = fs::read_to_string(card).unwrap_or_default();
        let mut lines = text.lines();
        if lines.next().map(str::trim) != Some("---") {
            return String::new();
        }
        let license = lines
            .take_while(|line| line.trim() != "---")
            .find_map(|line| line.strip_prefix("license:"));
        license.unwrap_or_default().trim().trim_matches(['"', '\'']).to_owned()
    }

    /// Returns where a file of a commit is, if it is here: by its path, or by its hash, under which
    /// other commits may have it.
    #[must_use]
    pub fn find(&self, commit: &str, path: &str, file: &RemoteFile) -> Option<Utf8PathBuf> {
        let of_commit = self.folder.join("snapshots").join(commit).join(path);
        let by_hash = file.hash.as_ref().map(|hash| {
            let (Hash::Sha256(hash) | Hash::GitBlob(hash)) = hash;
            self.folder.join("blobs").join(hash)
        });
        [Some(of_commit), by_hash]
            .into_iter()
            .flatten()
            .filter_map(|path| path.canonicalize_utf8().ok())
            .find(|path| {
                path.metadata()
                    .is_ok_and(|m| m.is_file() && file.bytes.is_none_or(|bytes| bytes == m.len()))
            })
    }
}
