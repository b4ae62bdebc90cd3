//! Where published folders are kept: in the data folder, or in an object store, of which the data
//! folder then holds copies.

use super::cache::FolderCache;
use super::objects::{AccessKeys, Bucket, Links, Objects};
use super::shared::SharedBlobs;
use super::{Blobs, KINDS, SEALED, Scratch, WriteMode};
use crate::StoreError;
use crate::data_folder::write_synced;
use camino::{Utf8Path, Utf8PathBuf};
use serde::{Deserialize, Serialize};
use std::fs::{self, File, TryLockError};
use std::str::FromStr;
use std::sync::Arc;
use std::time::{Duration, SystemTime};
use std::{fmt, io};
use tokio::task::spawn_blocking;

/// Says in `blobs/` that it holds copies, and of what.
pub const CACHE_OF: &str = "copies-of.json";

/// Where folders are kept, as it is said.
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

/// Where folders are kept, with all that is needed to get there.
#[derive(Debug, Clone)]
pub enum BlobHome {
    Folder,
    Bucket {
        bucket: Bucket,
        /// Those of a file; else those of the environment count.
        keys: Option<AccessKeys>,
        links: Links,
        /// What copies that nobody uses may come to, bytes.
        cache_bytes: u64,
        /// How old objects must be that no row speaks of to be removed.
        grace: Duration,
    },
}

/// Whether who opens a store will read and write files, or rows alone.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FileAccess {
    Used,
    Untouched,
}

/// What a folder holds copies of.
#[derive(Debug, Serialize, Deserialize)]
pub struct CopiesOf {
    bucket: String,
    id: String,
}

impl Blobs {
    /// Opens the folders, and makes those that are not there; blocks.
    pub(crate) fn open(
        data_dir: &Utf8Path,
        home: &BlobHome,
        files: FileAccess,
    ) -> Result<Self, StoreError> {
        let blobs = Self::below(data_dir, WriteMode::Free);
        let kept_in = kept_in(data_dir)?;
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
            FileAccess::Used => blobs.copying(objects, &bucket.to_string(), kept_in, *cache_bytes),
            FileAccess::Untouched => {
                let id = objects.wait(objects.id())?;
                Ok(Self { id: Some(id.into()), hands: WriteMode::Tied, ..blobs })
            }
        }
    }

    /// Has these folders hold copies of what an object store has, by its name and the one they held
    /// copies of; blocks.
    pub(super) fn copying(
        self,
        objects: Objects,
        bucket: &str,
        known: Option<CopiesOf>,
        cache_bytes: u64,
    ) -> Result<Self, StoreError> {
        let id = objects.wait(objects.id())?;
        let mark = self.root.join(CACHE_OF);
        match known {
            Some(known) if known.id != id => return Err(StoreError::NotTogether),
            Some(_) => {}
            None => {
                for kind in SEALED {
                    if !self.names(kind)?.is_empty() {
                        return Err(StoreError::BlobsHere);
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
        // Which copies are in use only their process knows.
        let lock = File::open(&mark)?;
        match lock.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => return Err(StoreError::InUse),
            Err(TryLockError::Error(error)) => return Err(error.into()),
        }
        let mut here = Vec::new();
        for kind in SEALED {
            for name in self.names(kind)? {
                let place = self.place(kind, &name);
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

    /// Folders that are looked at and stay as they are, whatever is asked: nothing goes out of the
    /// way, nothing to the quarantine.
    ///
    /// # Errors
    /// [`StoreError::BlobsElsewhere`].
    pub(crate) fn look_only(data_dir: &Utf8Path) -> Result<Self, StoreError> {
        match kept_in(data_dir)? {
            Some(CopiesOf { bucket, .. }) => Err(StoreError::OnlyOfFolder { kept_in: bucket }),
            None => Ok(Self::below(data_dir, WriteMode::Tied)),
        }
    }

    /// The id what is kept goes by, where that is not the data folder's own.
    pub(crate) fn id(&self) -> Option<&str> {
        self.id.as_deref()
    }

    /// The object store that folders are kept in, if they are.
    pub(crate) fn objects(&self) -> Option<&Objects> {
        self.shared.as_ref().map(|shared| &shared.objects)
    }

    /// Whether what lies here is copies of what an object store has.
    #[must_use]
    pub fn are_copies(&self) -> bool {
        self.shared.is_some()
    }

    /// Takes copies out of the way, off the async threads; where they are from nothing changes.
    pub(crate) async fn forget_copies(&self, places: Vec<Utf8PathBuf>) -> io::Result<Vec<Scratch>> {
        let blobs = self.clone();
        spawn_blocking(move || {
            places.iter().filter_map(|place| blobs.take_away(place).transpose()).collect()
        })
        .await?
    }

    /// Whether any scan is kept.
    pub(crate) async fn hold_scans(&self) -> io::Result<bool> {
        match &self.shared {
            Some(shared) => shared.objects.has_any("contents").await,
            None => Ok(!self.names("contents")?.is_empty()),
        }
    }

    /// Whether folders can be had.
    pub(crate) async fn reach(&self) -> io::Result<()> {
        match &self.shared {
            Some(shared) => shared.objects.reach().await,
            None => Ok(()),
        }
    }
}

/// The object store a data folder holds copies of, if it does.
pub(super) fn kept_in(data_dir: &Utf8Path) -> Result<Option<CopiesOf>, StoreError> {
    match fs::read(data_dir.join("blobs").join(CACHE_OF)) {
        Ok(bytes) => Ok(Some(serde_json::from_slice(&bytes)?)),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error.into()),
    }
}
