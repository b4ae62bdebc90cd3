//! Published folders in an S3-compatible object store, shared by several machines. The data folder
//! is then a cache of it.
//!
//! ```text
//! <prefix>/uniground-data.json               id of the data these objects belong to
//! <prefix>/<kind>/<name>/.sha256sums         the seal: the edition and its files
//! <prefix>/<kind>/<name>/<edition>/<file>    for `contents`, `parses` and `answers`
//! <prefix>/checkpoints/<sha256>/<log>        finished stages of a parse, optional: they grow, and
//!                                            are overwritten
//! ```
//! A folder exists exactly if its seal exists. The seal is uploaded last and removed first. Every
//! upload of a folder writes its files to an edition of its own, so removing leftovers of one
//! writer never touches the files of another one, however slow either is.

mod client;
mod folders;
mod found;
mod transfer;

pub use client::{AccessKeys, Bucket, Links};
pub use folders::{FolderName, Seal, SealOutcome, UnsealedObjects, new_edition};
pub use found::{FoundFolder, StoredLog};

use super::checksums::Sums;
use camino::Utf8PathBuf;
use futures::TryStreamExt;
use object_store::path::Path;
use object_store::signer::Signer;
use object_store::{ObjectStore, ObjectStoreExt, PutMode, PutOptions};
use serde::{Deserialize, Serialize};
use std::io;
use std::sync::Arc;
use std::time::Duration;
use tokio::runtime::Handle;
use tokio::sync::Semaphore;
use tokio::time::timeout;
use uuid::Uuid;

const MARKER: &str = "uniground-data.json";
/// Pieces of files in memory at once, over all uploads.
const PIECES: usize = 16;
/// Timeout for small objects.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(5);

/// An object store and the prefix within it.
#[derive(Debug, Clone)]
pub struct Objects {
    store: Arc<dyn ObjectStore>,
    prefix: Path,
    runtime: Handle,
    pieces: Arc<Semaphore>,
    /// Signs links to objects, if links are given out.
    signer: Option<Arc<dyn Signer>>,
    /// Age after which unreferenced objects are removed. Publishing must finish within half of it.
    pub grace: Duration,
}

/// The object store cannot be reached, or refuses. A retry may succeed.
#[derive(Debug, thiserror::Error)]
#[error("the object store is not available")]
pub struct ObjectStoreUnavailable(#[source] Box<dyn std::error::Error + Send + Sync>);

impl ObjectStoreUnavailable {
    pub(super) fn wrap(error: impl Into<Box<dyn std::error::Error + Send + Sync>>) -> io::Error {
        io::Error::other(Self(error.into()))
    }

    /// Returns whether this is the cause of an error.
    #[must_use]
    pub fn is_behind(error: &io::Error) -> bool {
        matches!(error.get_ref(), Some(inner) if inner.is::<Self>())
    }
}

/// Converts an error of the object store to an I/O error.
fn to_io_error(error: object_store::Error) -> io::Error {
    use object_store::Error;
    match error {
        // Only the store itself can say that an object does not exist. A proxy, or a missing
        // bucket, answers with 404 too.
        Error::NotFound { ref source, .. } => match source.to_string() {
            text if text.contains("status code") && !text.contains("NoSuchKey") => {
                ObjectStoreUnavailable::wrap(error)
            }
            _ => io::Error::new(io::ErrorKind::NotFound, error),
        },
        Error::AlreadyExists { .. } | Error::Precondition { .. } => {
            io::Error::new(io::ErrorKind::AlreadyExists, error)
        }
        _ => ObjectStoreUnavailable::wrap(error),
    }
}

/// Turns the error "not found" into `None`.
fn none_if_missing<T>(got: io::Result<T>) -> io::Result<Option<T>> {
    match got {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        got => got.map(Some),
    }
}

#[derive(Serialize, Deserialize)]
struct Marker {
    /// Version of the layout.
    format: u32,
    id: String,
}

impl Objects {
    /// Creates the objects of a store. Its work runs on the runtime that this is called on.
    pub fn new(store: Arc<dyn ObjectStore>, prefix: &str, grace: Duration) -> Self {
        let pieces = Arc::new(Semaphore::new(PIECES));
        Self {
            store,
            prefix: Path::from(prefix),
            runtime: Handle::current(),
            pieces,
            signer: None,
            grace,
        }
    }

    /// Sets the signer, which enables links to objects.
    #[must_use]
    pub fn with_signer(self, signer: Arc<dyn Signer>) -> Self {
        Self { signer: Some(signer), ..self }
    }

    /// Blocks on work of the store. Never call this on an async thread.
    pub fn block_on<T>(&self, work: impl Future<Output = T>) -> T {
        self.runtime.block_on(work)
    }

    /// Returns the runtime that the work runs on.
    pub fn runtime(&self) -> &Handle {
        &self.runtime
    }

    /// Returns the id of these objects, and assigns one if they have none.
    ///
    /// # Errors
    /// [`ObjectStoreUnavailable`].
    pub async fn id(&self) -> io::Result<String> {
        let place = self.prefix.clone().join(MARKER);
        if let Some(known) = none_if_missing(self.read(&place).await)? {
            return Ok(serde_json::from_slice::<Marker>(&known)?.id);
        }
        let marker =
            serde_json::to_vec_pretty(&Marker { format: 1, id: Uuid::new_v4().to_string() })?;
        match self.create(&place, marker).await {
            // Another process created it first.
            Err(error) if error.kind() != io::ErrorKind::AlreadyExists => return Err(error),
            _ => {}
        }
        Ok(serde_json::from_slice::<Marker>(&self.read(&place).await?)?.id)
    }

    /// Checks that the object store answers.
    ///
    /// # Errors
    /// [`ObjectStoreUnavailable`].
    pub async fn check_reachable(&self) -> io::Result<()> {
        self.read(&self.prefix.clone().join(MARKER)).await.map(drop)
    }

    /// Reads a small object.
    async fn read(&self, place: &Path) -> io::Result<Vec<u8>> {
        with_timeout(async { Ok(self.store.get(place).await?.bytes().await?.to_vec()) }).await
    }

    /// Creates a small object if it does not exist. If the store does not support conditional
    /// writes, the last write wins.
    async fn create(&self, place: &Path, bytes: Vec<u8>) -> io::Result<()> {
        let created = with_timeout(async {
            let options = PutOptions { mode: PutMode::Create, ..PutOptions::default() };
            match self.store.put_opts(place, bytes.clone().into(), options).await {
                Err(
                    object_store::Error::NotImplemented { .. }
                    | object_store::Error::NotSupported { .. },
                ) => self.store.put(place, bytes.into()).await,
                put => put,
            }
        });
        created.await.map(drop)
    }

    /// Removes everything below a prefix.
    async fn remove_below(&self, place: &Path) -> io::Result<()> {
        let store = self.store.clone();
        let all: Vec<Path> = store
            .list(Some(place))
            .map_ok(|object| object.location)
            .try_collect()
            .await
            .map_err(to_io_error)?;
        let found = futures::stream::iter(all.into_iter().map(Ok));
        store
            .delete_stream(Box::pin(found))
            .try_for_each(|_| async { Ok(()) })
            .await
            .map_err(to_io_error)
    }
}

/// Runs short work with a timeout.
async fn with_timeout<T>(work: impl Future<Output = object_store::Result<T>>) -> io::Result<T> {
    match timeout(REQUEST_TIMEOUT, work).await {
        Ok(done) => done.map_err(to_io_error),
        Err(_) => Err(ObjectStoreUnavailable::wrap(format!(
            "no response within {} s",
            REQUEST_TIMEOUT.as_secs()
        ))),
    }
}

/// Returns the edition that a seal names.
pub fn parse_edition(seal: &str) -> Option<&str> {
    seal.lines().next()?.strip_prefix("# ")
}

/// Returns the first line of a seal, which is a comment for `sha256sum`.
pub fn seal_header(edition: &str) -> String {
    format!("# {edition}\n")
}

/// Returns the checksums of a seal, in order.
pub fn parse_seal_checksums(seal: &str) -> Sums {
    seal.lines()
        .filter_map(|line| line.split_once("  "))
        .map(|(sum, file)| (Utf8PathBuf::from(file), sum.to_owned()))
        .collect()
}
