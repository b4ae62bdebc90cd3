//! Cache of an object store's folders in the data folder. Folders in use are pinned. Of the others
//! the most recently used ones stay, up to a limit.

use super::remove_tree;
use crate::file_lock::FileLock;
use camino::{Utf8Path, Utf8PathBuf};
use std::collections::HashMap;
use std::fs;
use std::io;
use std::ops::Deref;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::SystemTime;
use tokio::runtime::Handle;
use uuid::Uuid;

/// The local copies of an object store's folders.
#[derive(Debug)]
pub struct FolderCache {
    /// Limit for folders that are not in use, bytes.
    most: u64,
    tmp: Utf8PathBuf,
    runtime: Handle,
    state: Mutex<CacheState>,
    /// Keeps other processes from using the same cache.
    _lock: Option<FileLock>,
}

#[derive(Debug, Default)]
struct CacheState {
    folders: HashMap<Utf8PathBuf, CachedFolder>,
    bytes: u64,
    /// Counts uses, to order folders by their last use.
    clock: u64,
}

#[derive(Debug, Default)]
struct CachedFolder {
    bytes: u64,
    used: u64,
    /// Every user of the folder holds a clone of this; a user that adds files also holds the lock.
    download_lock: Arc<Mutex<()>>,
}

/// Keeps a folder in the cache while it lives.
#[derive(Debug)]
pub struct FolderPin {
    cache: Arc<FolderCache>,
    place: Utf8PathBuf,
    download_lock: Option<Arc<Mutex<()>>>,
}

impl FolderPin {
    /// Locks the folder for adding files; blocks.
    pub fn lock_for_download(&self) -> Option<MutexGuard<'_, ()>> {
        self.download_lock
            .as_ref()
            .map(|download_lock| download_lock.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

impl Drop for FolderPin {
    fn drop(&mut self) {
        self.download_lock = None;
        self.cache.drop_missing_entry(&self.place);
        self.cache.evict_least_recently_used();
    }
}

/// A file or folder that stays in place while this lives.
#[derive(Debug)]
pub struct PinnedPath {
    path: Utf8PathBuf,
    _held: Option<FolderPin>,
}

impl PinnedPath {
    pub(super) fn with_pin(path: Utf8PathBuf, held: FolderPin) -> Self {
        Self { path, _held: Some(held) }
    }
}

/// A path that the cache does not manage.
impl From<Utf8PathBuf> for PinnedPath {
    fn from(path: Utf8PathBuf) -> Self {
        Self { path, _held: None }
    }
}

impl Deref for PinnedPath {
    type Target = Utf8Path;

    fn deref(&self) -> &Utf8Path {
        &self.path
    }
}

impl AsRef<Path> for PinnedPath {
    fn as_ref(&self) -> &Path {
        self.path.as_std_path()
    }
}

impl FolderCache {
    /// Creates a cache of existing folders, each with the time of its download and its size in
    /// bytes.
    pub fn new(
        most: u64,
        tmp: &Utf8Path,
        runtime: Handle,
        mut found: Vec<(SystemTime, Utf8PathBuf, u64)>,
        lock: impl Into<Option<FileLock>>,
    ) -> Arc<Self> {
        found.sort();
        let mut state = CacheState::default();
        for (_, place, bytes) in found {
            state.touch(&place).bytes = bytes;
            state.bytes += bytes;
        }
        let cache = Arc::new(Self {
            most,
            tmp: tmp.to_owned(),
            runtime,
            state: Mutex::new(state),
            _lock: lock.into(),
        });
        cache.evict_least_recently_used();
        cache
    }

    fn lock_state(&self) -> MutexGuard<'_, CacheState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Pins a folder, if it exists.
    pub fn pin(self: &Arc<Self>, place: &Utf8Path) -> FolderPin {
        let download_lock = self.lock_state().touch(place).download_lock.clone();
        FolderPin {
            cache: self.clone(),
            place: place.to_owned(),
            download_lock: Some(download_lock),
        }
    }

    /// Drops the entry of a folder that turned out not to exist.
    fn drop_missing_entry(&self, place: &Utf8Path) {
        let mut state = self.lock_state();
        if state.folders.get(place).is_some_and(|folder| {
            folder.bytes == 0 && Arc::strong_count(&folder.download_lock) == 1
        }) {
            state.folders.remove(place);
        }
    }

    /// Records that a folder has grown.
    pub fn add(&self, place: &Utf8Path, bytes: u64) {
        let mut state = self.lock_state();
        state.touch(place).bytes += bytes;
        state.bytes += bytes;
        drop(state);
        self.evict_least_recently_used();
    }

    /// Moves the content of a pinned folder away, so that its user can download it again.
    ///
    /// # Errors
    /// Errors of the file system.
    pub fn move_content_away(&self, place: &Utf8Path) -> io::Result<Option<Utf8PathBuf>> {
        let mut state = self.lock_state();
        let bytes = std::mem::take(&mut state.touch(place).bytes);
        state.bytes -= bytes;
        self.move_away(place)
    }

    /// Moves a folder away, also while it is in use: files that are open stay open. Returns `None`
    /// if it did not exist.
    ///
    /// # Errors
    /// Errors of the file system.
    pub fn move_folder_away(&self, place: &Utf8Path) -> io::Result<Option<Utf8PathBuf>> {
        let mut state = self.lock_state();
        if let Some(folder) = state.folders.remove(place) {
            state.bytes -= folder.bytes;
        }
        self.move_away(place)
    }

    fn move_away(&self, place: &Utf8Path) -> io::Result<Option<Utf8PathBuf>> {
        let aside = self.tmp.join(Uuid::now_v7().to_string());
        match fs::rename(place, &aside) {
            Ok(()) => Ok(Some(aside)),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// Returns the bytes of all cached folders.
    #[cfg(test)]
    pub fn bytes(&self) -> u64 {
        self.lock_state().bytes
    }

    /// Evicts the least recently used folders until the rest is within the limit.
    fn evict_least_recently_used(&self) {
        let mut aside = Vec::new();
        let mut state = self.lock_state();
        while state.bytes > self.most {
            let unused = state
                .folders
                .iter()
                .filter(|(_, folder)| Arc::strong_count(&folder.download_lock) == 1);
            let Some(place) =
                unused.min_by_key(|(_, folder)| folder.used).map(|(place, _)| place.clone())
            else {
                break;
            };
            let Some(folder) = state.folders.remove(&place) else { break };
            state.bytes -= folder.bytes;
            // The lock is held: no task can start to use the folder meanwhile.
            match self.move_away(&place) {
                Ok(gone) => aside.extend(gone),
                Err(error) => {
                    tracing::warn!(folder = %place, %error, "cached folder could not be evicted");
                }
            }
        }
        drop(state);
        if !aside.is_empty() {
            let tmp = self.tmp.clone();
            self.runtime.spawn_blocking(move || {
                for gone in aside {
                    if let Err(error) = remove_tree(&gone, &tmp) {
                        tracing::warn!(folder = %gone, %error, "folder could not be removed");
                    }
                }
            });
        }
    }
}

impl CacheState {
    fn touch(&mut self, place: &Utf8Path) -> &mut CachedFolder {
        self.clock += 1;
        let clock = self.clock;
        let folder = self.folders.entry(place.to_owned()).or_default();
        folder.used = clock;
        folder
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder(root: &Utf8Path, name: &str) -> Utf8PathBuf {
        let place = root.join(name);
        fs::create_dir(&place).unwrap();
        place
    }

    #[tokio::test]
    async fn the_least_recently_used_folder_is_evicted_unless_pinned() {
        let root = tempfile::tempdir().unwrap();
        let root = Utf8Path::from_path(root.path()).unwrap();
        let tmp = folder(root, "tmp");
        let [a, b, c, d] = ["a", "b", "c", "d"].map(|name| folder(root, name));
        let cache = FolderCache::new(20, &tmp, Handle::current(), Vec::new(), None);
        cache.add(&a, 10);
        let in_use = cache.pin(&a);
        cache.add(&b, 10);
        cache.add(&c, 10);
        assert_eq!(
            [a.exists(), b.exists(), c.exists(), cache.bytes() == 20],
            [true, false, true, true]
        );
        // All folders are pinned: the cache exceeds its limit until one is released.
        let also = cache.pin(&c);
        let last = cache.pin(&d);
        cache.add(&d, 10);
        assert_eq!((a.exists(), c.exists(), d.exists(), cache.bytes()), (true, true, true, 30));
        drop(also);
        assert_eq!((a.exists(), c.exists(), d.exists(), cache.bytes()), (true, false, true, 20));
        drop((in_use, last));
        assert_eq!(cache.bytes(), 20);
    }

    #[tokio::test]
    async fn folders_found_at_start_are_evicted_by_age() {
        let root = tempfile::tempdir().unwrap();
        let root = Utf8Path::from_path(root.path()).unwrap();
        let tmp = folder(root, "tmp");
        let found = ["new", "old"].map(|name| folder(root, name));
        let age = |days: u64| SystemTime::UNIX_EPOCH + std::time::Duration::from_hours(24 * days);
        let [new, old] = found.clone();
        let cache = FolderCache::new(
            15,
            &tmp,
            Handle::current(),
            vec![(age(9), new.clone(), 10), (age(1), old.clone(), 10)],
            None,
        );
        assert_eq!((new.exists(), old.exists(), cache.bytes()), (true, false, 10));
    }
}
