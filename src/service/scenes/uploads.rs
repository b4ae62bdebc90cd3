//! Receiving an archive: streamed to disk and hashed, unpacked, checked, and only then a scene.

use crate::error::Error;
use crate::jobs::Job;
use crate::service::{ParseJob, Service};
use crate::store::Scratch;
use bytes::Bytes;
use camino::Utf8Path;
use futures::{Stream, StreamExt};
use sha2::{Digest, Sha256};
use std::io::Write;
use std::sync::Arc;
use tempfile::NamedTempFile;
use tokio::sync::mpsc;
use tokio::task::spawn_blocking;
use uniground_core::ingest;
use uniground_core::ingest::archive::{ArchiveKind, unpack};
use uniground_types::scenes::Scene;
use uniground_types::settings::ParseSettings;

/// What comes with an upload.
pub struct NewScene {
    /// Default: what the archive calls itself.
    pub name: Option<String>,
    pub kind: ArchiveKind,
    /// Parse at once, with these settings.
    pub parse: Option<ParseSettings>,
    pub idempotency_key: Option<String>,
}

/// An archive on disk.
struct Received {
    file: NamedTempFile,
    /// SHA-256 of the bytes, hex.
    hash: String,
    bytes: u64,
}

/// An archive unpacked and found to be a scan.
struct Unpacked {
    folder: Scratch,
    /// What it calls itself.
    name: String,
}

/// Chunks that may wait for the disk.
const CHUNKS_AHEAD: usize = 8;
const MAX_NAME_CHARS: usize = 200;

impl Service {
    /// Makes a scene from an uploaded archive and starts parsing it. Nothing is stored unless all of it is fine.
    ///
    /// The job is there only when parsing was asked for. A known idempotency key returns the scene it made before, unread.
    ///
    /// # Errors
    /// [`Error`]: what is wrong with the archive, or with the server's disk.
    pub async fn create_scene<E>(
        &self,
        new: NewScene,
        body: impl Stream<Item = Result<Bytes, E>> + Unpin,
    ) -> Result<(Scene, Option<Job>), Error> {
        let NewScene { name, kind, parse, idempotency_key } = new;
        if let Some(name) = &name {
            check_name("/name", name)?;
        }
        if let Some(key) = &idempotency_key
            && let Some(row) = self.store.scene_of_idempotency_key(key).await?
        {
            let job = self.job_of(&row).await?;
            return Ok((self.present(row).await?, job));
        }
        if parse.is_some() {
            self.jobs.check_room::<ParseJob>().await?;
        }
        let received = Arc::new(self.receive(body).await?);
        let mut unpacked = match self.store.has_content(&received.hash).await? {
            true => None,
            false => Some(self.unpack(received.clone(), kind).await?),
        };
        // Read before anybody has to wait for it: a scan of many files takes its time.
        let name = match (name, &unpacked) {
            (Some(name), _) => name,
            (None, Some(unpacked)) => unpacked.name.clone(),
            (None, None) => self.archive_name(&received.hash).await?,
        };
        let mut references = self.content_references.lock().await;
        if unpacked.is_none() && !self.store.has_content(&received.hash).await? {
            // Its last scene was deleted in between.
            drop(references);
            unpacked = Some(self.unpack(received.clone(), kind).await?);
            references = self.content_references.lock().await;
        }
        if let Some(Unpacked { folder, .. }) = unpacked {
            let (blobs, content) = (self.store.blobs.clone(), self.store.blobs.content(&received.hash));
            spawn_blocking(move || blobs.publish(folder, &content)).await??;
            self.store.insert_content(&received.hash, received.bytes).await?;
        }
        let (row, new) = self.store.insert_scene(&name, &received.hash, idempotency_key.as_deref()).await?;
        drop(references);
        match parse {
            Some(settings) if new => match self.start_parse(&row.id, &settings).await {
                Ok(job) => Ok((self.scene(&row.id).await?, Some(job))),
                Err(error) => {
                    // Refused is refused: no scene that nobody parses stays behind.
                    self.delete_scene(&row.id).await?;
                    Err(error)
                }
            },
            _ => {
                let job = self.job_of(&row).await?;
                Ok((self.present(row).await?, job))
            }
        }
    }

    /// Streams a body to a temporary file. Hashing and writing happen on a blocking thread; a slow disk slows the sender.
    async fn receive<E>(&self, mut body: impl Stream<Item = Result<Bytes, E>> + Unpin) -> Result<Received, Error> {
        let max_bytes = self.limits.max_upload_bytes;
        let (chunks, mut queue) = mpsc::channel::<Bytes>(CHUNKS_AHEAD);
        let tmp = self.store.blobs.tmp().to_owned();
        let writer = spawn_blocking(move || {
            let mut file = NamedTempFile::new_in(tmp)?;
            let (mut hasher, mut bytes) = (Sha256::new(), 0_u64);
            while let Some(chunk) = queue.blocking_recv() {
                bytes += chunk.len() as u64;
                hasher.update(&chunk);
                file.write_all(&chunk)?;
            }
            let hash = hasher.finalize().iter().map(|byte| format!("{byte:02x}")).collect();
            Ok::<_, Error>(Received { file, hash, bytes })
        });
        let (mut received, mut interrupted) = (0, false);
        while let Some(chunk) = body.next().await {
            let Ok(chunk) = chunk else {
                interrupted = true;
                break;
            };
            received += chunk.len() as u64;
            if received > max_bytes {
                break;
            }
            if chunks.send(chunk).await.is_err() {
                // The writer gave up: its error says why.
                break;
            }
        }
        drop(chunks);
        // The file is gone before the caller hears of a failure: the writer holds it until here.
        let written = writer.await?;
        match (interrupted, received > max_bytes) {
            (true, _) => Err(Error::UploadInterrupted { received }),
            (_, true) => Err(Error::UploadTooLarge { max_bytes }),
            _ => written,
        }
    }

    /// Unpacks an archive and puts it through the importer's checks.
    async fn unpack(&self, received: Arc<Received>, kind: ArchiveKind) -> Result<Unpacked, Error> {
        let (blobs, limits) = (self.store.blobs.clone(), self.limits.unpack);
        spawn_blocking(move || {
            let folder = blobs.scratch()?;
            let archive =
                Utf8Path::from_path(received.file.path()).ok_or_else(|| std::io::Error::other("the data folder's path is not UTF-8"))?;
            unpack(archive, kind, folder.path(), &limits)?;
            let name = name_or_scene(ingest::open(folder.path())?.name);
            Ok(Unpacked { folder, name })
        })
        .await?
    }

    /// What a stored archive calls itself.
    async fn archive_name(&self, hash: &str) -> Result<String, Error> {
        let content = self.store.blobs.content(hash);
        let read = spawn_blocking(move || ingest::open(&content)).await?;
        // Removed in between: it is unpacked again, and called what scenes without a name are called.
        Ok(name_or_scene(read.ok().and_then(|scan| scan.name)))
    }
}

/// What an archive calls itself, where that is a name.
fn name_or_scene(name: Option<String>) -> String {
    name.filter(|name| check_name("/name", name).is_ok()).unwrap_or_else(|| "scene".into())
}

/// A scene's name is one line of text.
pub(super) fn check_name(pointer: &str, name: &str) -> Result<(), Error> {
    if name.trim().is_empty() {
        return Err(Error::invalid(pointer, "a name must not be empty"));
    }
    if name.chars().count() > MAX_NAME_CHARS {
        return Err(Error::invalid(pointer, format!("a name has at most {MAX_NAME_CHARS} characters")));
    }
    if name.chars().any(char::is_control) {
        return Err(Error::invalid(pointer, "a name must not hold control characters"));
    }
    Ok(())
}
