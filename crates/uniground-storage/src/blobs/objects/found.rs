//! Listings of the object store, for maintenance.

use super::folders::SEAL;
use super::{Objects, to_io_error, with_timeout};
use camino::Utf8Path;
use futures::TryStreamExt;
use object_store::ObjectStoreExt;
use object_store::path::Path;
use std::collections::BTreeMap;
use std::io;
use std::time::SystemTime;

/// A folder found in a listing.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FoundFolder {
    /// When it was sealed, if it is sealed.
    pub sealed: Option<SystemTime>,
    /// Upload time of the latest file of each edition.
    pub editions: BTreeMap<String, SystemTime>,
    pub bytes: u64,
}

impl FoundFolder {
    /// Returns the time of the latest upload to this folder.
    pub fn newest(&self) -> SystemTime {
        let all = self.editions.values().chain(&self.sealed);
        all.max().copied().unwrap_or(SystemTime::UNIX_EPOCH)
    }
}

/// A log of finished stages.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StoredLog {
    pub name: String,
    pub bytes: u64,
    pub put: SystemTime,
}

impl Objects {
    /// Lists all folders of a kind.
    ///
    /// # Errors
    /// [`ObjectStoreUnavailable`](super::ObjectStoreUnavailable).
    pub async fn folders(&self, kind: &'static str) -> io::Result<BTreeMap<String, FoundFolder>> {
        let above = self.prefix.clone().join(kind);
        let mut found: BTreeMap<String, FoundFolder> = BTreeMap::new();
        let mut listed = self.store.list(Some(&above));
        while let Some(object) = listed.try_next().await.map_err(to_io_error)? {
            let Some(mut parts) = object.location.prefix_match(&above) else { continue };
            let (Some(name), Some(within)) = (parts.next(), parts.next()) else { continue };
            let put = SystemTime::from(object.last_modified);
            let folder = found.entry(name.as_ref().to_owned()).or_insert_with(|| FoundFolder {
                sealed: None,
                editions: BTreeMap::new(),
                bytes: 0,
            });
            folder.bytes += object.size;
            if within.as_ref() == SEAL {
                folder.sealed = Some(put);
            } else {
                let newest = folder.editions.entry(within.as_ref().to_owned()).or_insert(put);
                *newest = put.max(*newest);
            }
        }
        Ok(found)
    }

    /// Returns whether any folder of a kind exists.
    ///
    /// # Errors
    /// [`ObjectStoreUnavailable`](super::ObjectStoreUnavailable).
    pub async fn has_any(&self, kind: &'static str) -> io::Result<bool> {
        let mut listed = self.store.list(Some(&self.prefix.clone().join(kind)));
        with_timeout(async { listed.try_next().await }).await.map(|first| first.is_some())
    }

    fn log(&self, hash: &str, name: &str) -> Path {
        self.checkpoints(hash).join(name)
    }

    pub(super) fn checkpoints(&self, hash: &str) -> Path {
        self.prefix.clone().join("checkpoints").join(hash)
    }

    /// Lists the logs of finished stages of a content.
    ///
    /// # Errors
    /// [`ObjectStoreUnavailable`](super::ObjectStoreUnavailable).
    pub async fn logs(&self, hash: &str) -> io::Result<Vec<StoredLog>> {
        let listed = self.store.list(Some(&self.checkpoints(hash)));
        let log = |object: object_store::ObjectMeta| {
            let name = object.location.filename().unwrap_or_default().to_owned();
            StoredLog { name, bytes: object.size, put: object.last_modified.into() }
        };
        listed.map_ok(log).try_collect().await.map_err(to_io_error)
    }

    /// Uploads the current state of a log.
    ///
    /// # Errors
    /// Errors of the file system; [`ObjectStoreUnavailable`](super::ObjectStoreUnavailable).
    pub async fn put_log(&self, hash: &str, name: &str, file: &Utf8Path) -> io::Result<()> {
        self.put_file(file, &self.log(hash, name)).await
    }

    /// Downloads a log into a file.
    ///
    /// # Errors
    /// Errors of the file system; [`ObjectStoreUnavailable`](super::ObjectStoreUnavailable).
    pub async fn get_log(&self, hash: &str, name: &str, file: &Utf8Path) -> io::Result<u64> {
        self.get_file(&self.log(hash, name), file).await
    }

    /// Removes a log.
    ///
    /// # Errors
    /// [`ObjectStoreUnavailable`](super::ObjectStoreUnavailable).
    pub async fn remove_log(&self, hash: &str, name: &str) -> io::Result<()> {
        with_timeout(self.store.delete(&self.log(hash, name))).await
    }
}
