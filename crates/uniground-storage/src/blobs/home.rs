//! Where published folders are stored: in the data folder, or in an object store, with copies in
//! the data folder.

use super::cache::FolderCache;
use super::objects::{AccessKeys, Bucket, Links, Objects};
use super::shared::SharedBlobs;
use super::{Blobs, KINDS, SEALED, Scratch, WriteMode};
use crate::StoreError;
use crate::data_folder::write_synced;
use crate::file_lock::FileLock;
use camino::{Utf8Path, Utf8PathBuf};
use serde::{Deserialize, Serialize};
use std::fs::{self, File, TryLockError};
use std::str::FromStr;
use std::sync::Arc;
use std::time::{Duration, SystemTime};
use std::{fmt, io};
use tokio::task::spawn_blocking;

/// The file in `blobs/` that marks it as a cache, and names the object store.
pub const CACHE_MARKER: &str = "copies-of.json";

/// Where folders are stored, as configured.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum BlobsAt {
    /// In the data folder.
    Folder,
    Bucket(Bucket),
}

impl FromStr for BlobsAt {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        if text == "folder" { Ok(Self::Folder) } else { text.parse().map(Self::Bucket) }
    }
}

impl fmt::Display for BlobsAt {
    fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Folder => to.write_str("folder"),
            Self::Bucket(bucket) => bucket.fmt(to),
        }
    }
}

/// Where folders are stored, with everything needed to connect.
#[derive(Debug, Clone)]
pub enum BlobHome {
    Folder,
    Bucket {
        bucket: Bucket,
        /// Keys from a file; without them, those of the environment.
        keys: Option<AccessKeys>,
        links: Links,
        /// Limit for copies that are not in use, bytes.
        cache_bytes: u64,
        /// Age after which objects that no row refers to are removed.
        grace: Duration,
    },
}

/// Whether the opened store will access files, or rows only.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FileAccess {
    ReadWrite,
    RowsOnly,
}

/// The object store that a folder holds copies of.
#[derive(Debug, Serialize, Deserialize)]
pub struct CopiesOf {
    bucket: String,
    id: String,
}

impl Blobs {
    /// Opens the folders, creating those that do not exist; blocks.
    pub(crate) fn open(
        data_dir: &Utf8Path,
        home: &BlobHome,
        files: FileAccess,
    ) -> Result<Self, StoreError> {
        let blobs = Self::for_data_dir(data_dir, WriteMode::ReadWrite);
        let kept_in = read_source_store(data_dir)?;
        if let (BlobHome::Folder, Some(CopiesOf { bucket, .. })) = (home, &kept_in) {
            return Err(StoreError::BlobsElsewhere { kept_in: bucket.clone() });
        }
        for folder in
            KINDS.map(|kind| blobs.root.join(kind)).iter().chain([&blobs.tmp, &blobs.uploads()])
        {
            fs::create_dir_all(folder)?;
        }
        let BlobHome::Bucket { bucket, keys, links, cache_bytes, grace } = home else {
            return Ok(blobs);
        };
        let objects = bucket.objects(keys.as_ref(), *links, *grace)?;
        match files {
            FileAccess::ReadWrite => {
                blobs.with_object_store(objects, &bucket.to_string(), kept_in, *cache_bytes)
            }
            FileAccess::RowsOnly => {
                let id = objects.block_on(objects.id())?;
                Ok(Self { id: Some(id.into()), hands: WriteMode::ReadOnly, ..blobs })
            }
        }
    }

    /// Turns these folders into a cache of an object store, given its name and the store they
    /// cached before; blocks.
    pub(super) fn with_object_store(
        self,
        objects: Objects,
        bucket: &str,
        known: Option<CopiesOf>,
        cache_bytes: u64,
    ) -> Result<Self, StoreError> {
        let id = objects.block_on(objects.id())?;
        let mark = self.root.join(CACHE_MARKER);
        match known {
            Some(known) if known.id != id => return Err(StoreError::StoresDoNotMatch),
            Some(_) => {}
            None => {
                for kind in SEALED {
                    if !self.names(kind)?.is_empty() {
                        return Err(StoreError::FolderHasOwnBlobs);
                    }
                }
                write_synced(
                    &mark,
                    &serde_json::to_vec_pretty(&CopiesOf {
                        bucket: bucket.to_owned(),
                        id: id.clone(),
                    })?,
                )?;
            }
        }
        // Only the process that uses the cache knows which copies are in use.
        let lock = match FileLock::try_exclusive(File::open(&mark)?) {
            Ok(lock) => lock,
            Err(TryLockError::WouldBlock) => return Err(StoreError::InUse),
            Err(TryLockError::Error(error)) => return Err(error.into()),
        };
        let mut here = Vec::new();
        for kind in SEALED {
            for name in self.names(kind)? {
                let place = self.folder_path(kind, &name);
                let brought = fs::metadata(&place)?.modified().unwrap_or(SystemTime::UNIX_EPOCH);
                let bytes = super::size_of(&place)?;
                here.push((brought, place, bytes));
            }
        }
        let cache = FolderCache::new(cache_bytes, &self.tmp, objects.runtime().clone(), here, lock);
        Ok(Self {
            id: Some(id.into()),
            shared: Some(Arc::new(SharedBlobs { objects, cache })),
            ..self
        })
    }

    /// Opens folders read-only: nothing is moved away, removed or quarantined, whatever is called.
    ///
    /// # Errors
    /// [`StoreError::BlobsElsewhere`].
    pub(crate) fn open_read_only(data_dir: &Utf8Path) -> Result<Self, StoreError> {
        match read_source_store(data_dir)? {
            Some(CopiesOf { bucket, .. }) => {
                Err(StoreError::RequiresLocalFiles { kept_in: bucket })
            }
            None => Ok(Self::for_data_dir(data_dir, WriteMode::ReadOnly)),
        }
    }

    /// Returns the id of this storage, where it is not the data folder's own id.
    pub(crate) fn id(&self) -> Option<&str> {
        self.id.as_deref()
    }

    /// Returns the object store that folders are stored in, if there is one.
    pub(crate) fn objects(&self) -> Option<&Objects> {
        self.shared.as_ref().map(|shared| &shared.objects)
    }

    /// Returns whether the local folders are copies of an object store's.
    #[must_use]
    pub fn is_cache(&self) -> bool {
        self.shared.is_some()
    }

    /// Moves copies away, off the async threads. Their originals stay unchanged.
    pub(crate) async fn evict_copies(&self, places: Vec<Utf8PathBuf>) -> io::Result<Vec<Scratch>> {
        let blobs = self.clone();
        spawn_blocking(move || {
            places.iter().filter_map(|place| blobs.move_to_tmp(place).transpose()).collect()
        })
        .await?
    }

    /// Returns whether any scan is stored.
    pub(crate) async fn has_scans(&self) -> io::Result<bool> {
        match &self.shared {
            Some(shared) => shared.objects.has_any("contents").await,
            None => Ok(!self.names("contents")?.is_empty()),
        }
    }

    /// Checks that the storage can be reached.
    pub(crate) async fn check_reachable(&self) -> io::Result<()> {
        match &self.shared {
            Some(shared) => shared.objects.check_reachable().await,
            None => Ok(()),
        }
    }
}

/// Returns the object store that a data folder holds copies of, if any.
pub(super) fn read_source_store(data_dir: &Utf8Path) -> Result<Option<CopiesOf>, StoreError> {
    match fs::read(data_dir.join("blobs").join(CACHE_MARKER)) {
        Ok(bytes) => Ok(Some(serde_json::from_slice(&bytes)?)),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error.into()),
    }
}
