//! Published folders in an object store that speaks S3, for several machines to share: what lies in
//! the data folder is a cache of it then.
//!
//! ```text
//! <prefix>/uniground-data.json               whose objects these are
//! <prefix>/<kind>/<name>/.sha256sums         the seal: the edition, and what files it has
//! <prefix>/<kind>/<name>/<edition>/<file>    for `contents`, `parses` and `answers`
//! <prefix>/checkpoints/<sha256>/<log>        finished stages of a parse, advice only: they grow, and are overwritten
//! ```
//! A folder is there exactly if its seal is, which is put last and taken away first. Whoever puts a
//! folder there has an edition of its own for the files: so whoever removes what another has left
//! never touches what somebody is writing, however slow either is.

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
/// Pieces of files in memory at once, whoever puts them.
const PIECES: usize = 16;
/// A small object that takes longer is not to be had.
const BRIEFLY: Duration = Duration::from_secs(5);

/// An object store, and where in it.
#[derive(Debug, Clone)]
pub struct Objects {
    store: Arc<dyn ObjectStore>,
    prefix: Path,
    runtime: Handle,
    pieces: Arc<Semaphore>,
    /// Who signs links to objects, where such are given out.
    signer: Option<Arc<dyn Signer>>,
    /// What no row speaks of goes when it is older. Whoever publishes has half of it.
    pub grace: Duration,
}

/// The object store can not be reached, or refuses: that may pass.
#[derive(Debug, thiserror::Error)]
#[error("the object store can not be used")]
pub struct ObjectStoreUnavailable(#[source] Box<dyn std::error::Error + Send + Sync>);

impl ObjectStoreUnavailable {
    pub(super) fn because(error: impl Into<Box<dyn std::error::Error + Send + Sync>>) -> io::Error {
        io::Error::other(Self(error.into()))
    }

    /// Whether this is what is behind an error.
    #[must_use]
    pub fn is_behind(error: &io::Error) -> bool {
        matches!(error.get_ref(), Some(inner) if inner.is::<Self>())
    }
}

/// An error of the store as those of files are told.
fn told(error: object_store::Error) -> io::Error {
    use object_store::Error;
    match error {
        // Only the store itself knows that something is not there: a proxy, or a bucket that is
        // gone, says 404 too.
        Error::NotFound { ref source, .. } => match source.to_string() {
            text if text.contains("status code") && !text.contains("NoSuchKey") => {
                ObjectStoreUnavailable::because(error)
            }
            _ => io::Error::new(io::ErrorKind::NotFound, error),
        },
        Error::AlreadyExists { .. } | Error::Precondition { .. } => {
            io::Error::new(io::ErrorKind::AlreadyExists, error)
        }
        _ => ObjectStoreUnavailable::because(error),
    }
}

/// Nothing where nothing is.
fn if_there<T>(got: io::Result<T>) -> io::Result<Option<T>> {
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
    /// Objects of a store; work is done on the runtime this is called on.
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

    /// Links to objects may be given out, which this signs.
    #[must_use]
    pub fn linked_by(self, signer: Arc<dyn Signer>) -> Self {
        Self { signer: Some(signer), ..self }
    }

    /// Waits for work of the store's; never on an async thread.
    pub fn wait<T>(&self, work: impl Future<Output = T>) -> T {
        self.runtime.block_on(work)
    }

    /// The runtime its work is done on.
    pub fn runtime(&self) -> &Handle {
        &self.runtime
    }

    /// The id these objects go by, which is given to them where nobody has done so.
    ///
    /// # Errors
    /// [`ObjectStoreUnavailable`].
    pub async fn id(&self) -> io::Result<String> {
        let place = self.prefix.clone().join(MARKER);
        if let Some(known) = if_there(self.read(&place).await)? {
            return Ok(serde_json::from_slice::<Marker>(&known)?.id);
        }
        let marker =
            serde_json::to_vec_pretty(&Marker { format: 1, id: Uuid::new_v4().to_string() })?;
        match self.create(&place, marker).await {
            // Somebody was faster.
            Err(error) if error.kind() != io::ErrorKind::AlreadyExists => return Err(error),
            _ => {}
        }
        Ok(serde_json::from_slice::<Marker>(&self.read(&place).await?)?.id)
    }

    /// Whether it answers.
    ///
    /// # Errors
    /// [`ObjectStoreUnavailable`].
    pub async fn reach(&self) -> io::Result<()> {
        self.read(&self.prefix.clone().join(MARKER)).await.map(drop)
    }

    /// A small object.
    async fn read(&self, place: &Path) -> io::Result<Vec<u8>> {
        briefly(async { Ok(self.store.get(place).await?.bytes().await?.to_vec()) }).await
    }

    /// Puts a small object where none is; where the store does not know conditions, the last one
    /// counts.
    async fn create(&self, place: &Path, bytes: Vec<u8>) -> io::Result<()> {
        let created = briefly(async {
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

    /// Removes everything below a place.
    async fn remove_below(&self, place: &Path) -> io::Result<()> {
        let store = self.store.clone();
        let all: Vec<Path> = store
            .list(Some(place))
            .map_ok(|object| object.location)
            .try_collect()
            .await
            .map_err(told)?;
        let found = futures::stream::iter(all.into_iter().map(Ok));
        store.delete_stream(Box::pin(found)).try_for_each(|_| async { Ok(()) }).await.map_err(told)
    }
}

/// Work that takes a moment, or is not to be had.
async fn briefly<T>(work: impl Future<Output = object_store::Result<T>>) -> io::Result<T> {
    match timeout(BRIEFLY, work).await {
        Ok(done) => done.map_err(told),
        Err(_) => Err(ObjectStoreUnavailable::because(format!(
            "it took longer than {} s",
            BRIEFLY.as_secs()
        ))),
    }
}

/// The edition that a seal is of.
pub fn edition_of(seal: &str) -> Option<&str> {
    seal.lines().next()?.strip_prefix("# ")
}

/// The first line of a seal: a comment for whoever else reads sums.
pub fn head_of_seal(edition: &str) -> String {
    format!("# {edition}\n")
}

/// The sums of a seal, in order.
pub fn sums_of_seal(seal: &str) -> Sums {
    seal.lines()
        .filter_map(|line| line.split_once("  "))
        .map(|(sum, file)| (Utf8PathBuf::from(file), sum.to_owned()))
        .collect()
}
