//! Receives an archive: streams it to disk and hashes it, unpacks and checks it, then creates a
//! scene.

use super::pieces::BodyPieces;
use crate::error::Error;
use crate::{
    Caller, Capacity, Limits, MAX_UPLOADS, ParseJob, ParseService, SceneLookup, ServiceLocks,
};
use bytes::Bytes;
use camino::{Utf8Path, Utf8PathBuf};
use futures::Stream;
use sha2::{Digest, Sha256};
use std::fs::File;
use std::io::{self, Read, Write};
use std::sync::Arc;
use tempfile::NamedTempFile;
use tokio::sync::Semaphore;
use tokio::task::spawn_blocking;
use uniground_ingest::archive::UnpackLimits;
use uniground_ingest::{ArchiveFormat, describe_content};
use uniground_isolation::{ScanReader, Task, TaskOutcome};
use uniground_jobs::{Job, Jobs};
use uniground_storage::{
    Blobs, CheckDepth, ContentRepository, IdGenerator, InsertOutcome, KeyRepository, NewSceneRow,
    Prepared, SceneRepository, SceneRow,
};
use uniground_types::scenes::Scene;
use uniground_types::settings::ParseSettings;

/// Metadata of an upload.
pub struct NewScene {
    /// The scene's name. Defaults to the name in the archive.
    pub name: Option<String>,
    /// The name of the uploaded file, if known. The extension helps where the bytes are ambiguous.
    pub file_name: Option<String>,
    /// If set, the scene is parsed at once with these settings.
    pub parse: Option<ParseSettings>,
    pub idempotency_key: Option<String>,
    /// The size in bytes that the client announced.
    pub announced_bytes: u64,
}

/// An archive on disk.
pub struct ReceivedArchive {
    path: Utf8PathBuf,
    /// The temporary file, deleted with this value. `None` if the file belongs to someone else.
    file: Option<NamedTempFile>,
    /// The name of the uploaded file. Empty if unknown.
    file_name: String,
    /// SHA-256 of the bytes, hex.
    pub hash: String,
    pub bytes: u64,
}

/// The scene to create from an archive.
pub struct SceneToMake {
    pub name: Option<String>,
    pub parse: Option<ParseSettings>,
    /// The idempotency key, qualified by the caller.
    pub idempotency_key: Option<String>,
    /// The scene that this key created earlier, with the digest of that request if it was stored.
    pub made_before: Option<(SceneRow, Option<String>)>,
}

/// An unpacked archive that is a valid scan.
struct UnpackedScan {
    folder: Prepared,
    /// The name in the archive.
    name: String,
}

/// The bytes of a file that are read and hashed at once.
const READ_BYTES: usize = 1 << 20;
const MAX_NAME_CHARS: usize = 200;

/// An archive being received.
#[derive(Default)]
struct ArchiveReceiver {
    /// The first bytes of the archive.
    head: Vec<u8>,
    hasher: Sha256,
    bytes: u64,
}

impl ArchiveReceiver {
    fn append(&mut self, chunk: &[u8]) {
        let missing = ArchiveFormat::HEAD_BYTES.saturating_sub(self.head.len()).min(chunk.len());
        self.head.extend_from_slice(&chunk[..missing]);
        self.bytes += chunk.len() as u64;
        self.hasher.update(chunk);
    }

    fn finish(
        self,
        path: Utf8PathBuf,
        file: Option<NamedTempFile>,
        file_name: &str,
    ) -> Result<ReceivedArchive, Error> {
        detect_format(&self.head, file_name)?;
        let hash = self.hasher.finalize().iter().map(|byte| format!("{byte:02x}")).collect();
        Ok(ReceivedArchive { path, file, file_name: file_name.to_owned(), hash, bytes: self.bytes })
    }
}

/// Detects the archive's format from its first bytes and file name.
pub fn detect_format(head: &[u8], file_name: &str) -> Result<ArchiveFormat, Error> {
    ArchiveFormat::from_head(head, file_name).ok_or(Error::NoScan { what: describe_content(head) })
}

impl ReceivedArchive {
    /// Returns the task that unpacks the archive into an existing empty folder and checks that it
    /// is a scan.
    pub fn unpack_task(&self, into: &Utf8Path, limits: &UnpackLimits) -> Task {
        Task::Unpack {
            archive: self.path.clone(),
            file_name: self.file_name.clone(),
            folder: into.to_owned(),
            limits: *limits,
        }
    }

    /// Reads and hashes an archive that is already on disk. The file stays there.
    pub fn read(path: Utf8PathBuf, file_name: &str) -> Result<Self, Error> {
        let (mut receiving, mut file, mut chunk) =
            (ArchiveReceiver::default(), File::open(&path)?, vec![0; READ_BYTES]);
        loop {
            match file.read(&mut chunk) {
                Ok(0) => return receiving.finish(path, None, file_name),
                Ok(read) => receiving.append(&chunk[..read]),
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error.into()),
            }
        }
    }
}

/// Creates scenes from uploaded archives and starts their parses.
#[derive(Clone)]
pub struct ImportService {
    pub(crate) import_root: Option<Utf8PathBuf>,
    pub(crate) scene_repository: SceneRepository,
    pub(crate) upload_permits: Arc<Semaphore>,
    pub(crate) capacity: Arc<Capacity>,
    pub(crate) jobs: Jobs,
    pub(crate) blobs: Blobs,
    pub(crate) ids: IdGenerator,
    pub(crate) service_locks: Arc<ServiceLocks>,
    pub(crate) parse_service: Arc<ParseService>,
    pub(crate) scene_lookup: Arc<SceneLookup>,
    pub(crate) key_repository: KeyRepository,
    pub(crate) content_repository: ContentRepository,
    pub(crate) limits: Limits,
    pub(crate) reader: ScanReader,
}

impl ImportService {
    /// Creates a scene from an uploaded archive and starts parsing it. Nothing is stored unless the
    /// whole archive is valid.
    ///
    /// Returns a job only if parsing was requested. A repeated request with the same idempotency
    /// key returns the scene that the first one created.
    ///
    /// # Errors
    /// [`Error`] if the archive is invalid or the server's disk fails;
    /// [`Error::IdempotencyKeyReused`].
    pub async fn create_scene<E>(
        &self,
        new: NewScene,
        body: impl Stream<Item = Result<Bytes, E>> + Unpin,
        caller: &Caller,
    ) -> Result<(Scene, Option<Job>), Error> {
        // Checked first, so that rejecting an upload costs nothing.
        let place = self.upload_permits.clone().try_acquire_owned();
        let place = place.map_err(|_| Error::TooMany { what: "uploads", most: MAX_UPLOADS })?;
        let NewScene { name, file_name, parse, idempotency_key, announced_bytes } = new;
        let idempotency_key = idempotency_key.map(|key| caller.qualify_name(key));
        if let Some(name) = &name {
            check_name("/name", name)?;
        }
        let made_before = match &idempotency_key {
            Some(key) => self.scene_repository.scene_of_idempotency_key(key).await?,
            None => None,
        };
        if made_before.is_none() {
            self.capacity.check_disk(announced_bytes)?;
            self.check_quota(caller).await?;
            if parse.is_some() {
                self.jobs.check_queue_capacity::<ParseJob>(caller.key_id()).await?;
            }
        }
        let file_name = file_name.or_else(|| name.clone()).unwrap_or_default();
        let received = Arc::new(self.receive(body, &file_name).await?);
        drop(place);
        self.make_scene(SceneToMake { name, parse, idempotency_key, made_before }, received, caller)
            .await
    }

    /// Creates a scene from an archive that is already on disk, and starts parsing it.
    ///
    /// # Errors
    /// Those of [`create_scene`](Self::create_scene).
    pub(crate) async fn make_scene(
        &self,
        asked: SceneToMake,
        received: Arc<ReceivedArchive>,
        caller: &Caller,
    ) -> Result<(Scene, Option<Job>), Error> {
        let SceneToMake { name, parse, idempotency_key, made_before } = asked;
        let request = request_digest(&received.hash, name.as_deref(), parse.as_ref())?;
        if let Some((scene, before)) = made_before {
            // Earlier versions stored no request digest. Their keys are accepted without
            // comparison.
            return match before.is_none_or(|before| before == request) {
                true => self.made_before(scene, parse, caller).await,
                false => Err(Error::IdempotencyKeyReused),
            };
        }
        let mut unpacked = match self.has_content(&received.hash).await? {
            true => None,
            false => Some(self.unpack(received.clone()).await?),
        };
        // Read before the lock is taken: a scan with many files takes a while.
        let name = match (name, &unpacked) {
            (Some(name), _) => name,
            (None, Some(unpacked)) => unpacked.name.clone(),
            (None, None) => self.archive_name(&received.hash).await?,
        };
        let mut references = self.service_locks.lock_content_references().await?;
        if unpacked.is_none() && !self.has_content(&received.hash).await? {
            // Its last scene was deleted in the meantime.
            drop(references);
            unpacked = Some(self.unpack(received.clone()).await?);
            references = self.service_locks.lock_content_references().await?;
        }
        // Checked again under the lock: concurrent uploads together must not exceed the quota.
        self.check_quota(caller).await?;
        if let Some(UnpackedScan { folder, .. }) = unpacked {
            let blobs = self.blobs.clone();
            spawn_blocking(move || blobs.publish_prepared(folder)).await??;
        }
        let id = self.ids.new_id();
        let wanted = match &parse {
            Some(settings) => {
                let wanted =
                    self.parse_service.prepare_parse(&id, &received.hash, false, settings, caller);
                Some(wanted.await?)
            }
            None => None,
        };
        let insert = self.scene_repository.insert_scene(NewSceneRow {
            id: &id,
            name: &name,
            content_hash: &received.hash,
            content_bytes: received.bytes,
            key_id: caller.key_id(),
            key: idempotency_key.as_deref().map(|key| (key, request.as_str())),
            job: wanted.as_ref().map(|wanted| wanted.job.row()),
        });
        let inserted = match &wanted {
            Some(wanted) => wanted.job.enqueue(&self.jobs, insert).await?,
            None => insert.await?,
        };
        drop(references);
        match inserted {
            InsertOutcome::New(row, job) => {
                Ok((self.scene_lookup.to_scene(row).await?, job.map(|job| self.jobs.to_job(*job))))
            }
            InsertOutcome::AlreadyExists(row) => self.made_before(row, parse, caller).await,
            InsertOutcome::KeyReused => Err(Error::IdempotencyKeyReused),
        }
    }

    pub(crate) async fn check_quota(&self, caller: &Caller) -> Result<(), Error> {
        self.check_quota_beside(0, caller).await
    }

    /// Checks that a key may have one more scene, counting the `coming` uploads in progress.
    pub(crate) async fn check_quota_beside(
        &self,
        coming: u32,
        caller: &Caller,
    ) -> Result<(), Error> {
        let Some(key) = &caller.key else { return Ok(()) };
        let Some(most) = key.row.max_scenes else { return Ok(()) };
        let scenes =
            self.key_repository.count_scenes_of_key(&key.row.id).await?.saturating_add(coming);
        if scenes >= most { Err(Error::TooManyScenes { most }) } else { Ok(()) }
    }

    /// Returns the scene that an idempotency key created. Starts its job if a server that was
    /// killed in between did not.
    async fn made_before(
        &self,
        row: SceneRow,
        parse: Option<ParseSettings>,
        caller: &Caller,
    ) -> Result<(Scene, Option<Job>), Error> {
        let job = match (self.scene_lookup.current_job(&row).await?, parse) {
            (None, Some(settings)) if row.parse_id.is_none() => {
                Some(self.parse_service.start_parse(&row.id, &settings, caller).await?)
            }
            (job, _) => job,
        };
        Ok((self.scene_lookup.scene(&row.id).await?, job))
    }

    /// Returns whether this content is stored, both in the database and on disk.
    async fn has_content(&self, hash: &str) -> Result<bool, Error> {
        if !self.content_repository.has_content(hash).await? {
            return Ok(false);
        }
        let (blobs, content) = (self.blobs.clone(), self.blobs.content(hash));
        let wrong =
            spawn_blocking(move || blobs.check_folder(&content, CheckDepth::Names)).await??;
        if !wrong.is_empty() {
            tracing::warn!(
                hash,
                files = wrong.len(),
                "stored scan is incomplete; storing it again"
            );
        }
        Ok(wrong.is_empty())
    }

    /// Streams a body to a temporary file. Hashing and writing run outside the async threads.
    pub(super) async fn receive<E>(
        &self,
        body: impl Stream<Item = Result<Bytes, E>> + Unpin,
        file_name: &str,
    ) -> Result<ReceivedArchive, Error> {
        let max_bytes = self.limits.max_upload_bytes;
        let tmp = self.blobs.tmp().to_owned();
        let mut file = spawn_blocking(move || NamedTempFile::new_in(tmp)).await??;
        let mut receiving = ArchiveReceiver::default();
        let mut pieces = BodyPieces::new(body, max_bytes, max_bytes);
        while let Some(piece) = pieces.next().await? {
            let written = spawn_blocking(move || {
                for chunk in piece {
                    receiving.append(&chunk);
                    file.write_all(&chunk)?;
                }
                Ok::<_, io::Error>((file, receiving))
            });
            (file, receiving) = written.await??;
            // The format is checked early. The client need not send a whole video before it is
            // rejected.
            if receiving.head.len() == ArchiveFormat::HEAD_BYTES {
                detect_format(&receiving.head, file_name)?;
            }
        }
        let path = Utf8Path::from_path(file.path())
            .ok_or_else(|| io::Error::other("the data folder's path is not UTF-8"))?
            .to_owned();
        receiving.finish(path, Some(file), file_name)
    }

    /// Unpacks a received archive, runs the importer's checks, and prepares the folder for
    /// publishing.
    async fn unpack(&self, received: Arc<ReceivedArchive>) -> Result<UnpackedScan, Error> {
        let blobs = self.blobs.clone();
        let folder = spawn_blocking(move || blobs.scratch()).await??;
        let name =
            self.check_scan_name(received.unpack_task(folder.path(), &self.limits.unpack)).await?;
        let blobs = self.blobs.clone();
        spawn_blocking(move || {
            if let Some(file) = &received.file {
                // The archive is unpacked. Truncating it drops its cached pages before they are
                // written to disk.
                file.as_file().set_len(0)?;
            }
            let folder = blobs.prepare(folder, &blobs.content(&received.hash))?;
            Ok(UnpackedScan { folder, name })
        })
        .await?
    }

    /// Checks a scan and returns its name.
    async fn check_scan_name(&self, check: Task) -> Result<String, Error> {
        Ok(match self.reader.check(check).await? {
            TaskOutcome::Scan { name } => name_or_scene(name),
            TaskOutcome::Fits | TaskOutcome::Imported { .. } => name_or_scene(None),
        })
    }

    /// Returns the name of a stored archive.
    async fn archive_name(&self, hash: &str) -> Result<String, Error> {
        let (blobs, content) = (self.blobs.clone(), self.blobs.content(hash));
        let Ok(scan) = spawn_blocking(move || blobs.pin_folder(&content)).await? else {
            return Ok(name_or_scene(None));
        };
        // If the content was removed in the meantime, it is unpacked again, and the scene gets the
        // default name.
        Ok(self
            .check_scan_name(Task::Inspect { folder: scan.to_path_buf() })
            .await
            .unwrap_or_else(|_| name_or_scene(None)))
    }
}

/// Returns the digest of a request, which is compared when its idempotency key is used again.
fn request_digest(
    hash: &str,
    name: Option<&str>,
    parse: Option<&ParseSettings>,
) -> Result<String, Error> {
    let digest = Sha256::digest(serde_json::to_vec(&(hash, name, parse))?);
    Ok(digest.iter().map(|byte| format!("{byte:02x}")).collect())
}

/// Returns the archive's name if it is valid, else "scene".
fn name_or_scene(name: Option<String>) -> String {
    name.filter(|name| check_name("/name", name).is_ok()).unwrap_or_else(|| "scene".into())
}

/// Checks that a scene's name is one line of text.
pub(crate) fn check_name(pointer: &str, name: &str) -> Result<(), Error> {
    if name.trim().is_empty() {
        return Err(Error::invalid(pointer, "a name must not be empty"));
    }
    if name.chars().count() > MAX_NAME_CHARS {
        return Err(Error::invalid(
            pointer,
            format!("a name has at most {MAX_NAME_CHARS} characters"),
        ));
    }
    if name.chars().any(char::is_control) {
        return Err(Error::invalid(pointer, "a name must not hold control characters"));
    }
    Ok(())
}
