//! Receiving an archive: streamed to disk and hashed, unpacked, checked, and only then a scene.

use super::pieces::BodyPieces;
use crate::error::Error;
use crate::parses::WantedParse;
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
use uniground_ingest::{ArchiveFormat, what_it_is};
use uniground_isolation::{ScanReader, Task, TaskOutcome};
use uniground_jobs::{Job, Jobs};
use uniground_storage::{
    Blobs, CheckDepth, ContentRepository, IdGenerator, InsertOutcome, KeyRepository, NewSceneRow,
    Prepared, SceneRepository, SceneRow,
};
use uniground_types::scenes::Scene;
use uniground_types::settings::ParseSettings;

/// What comes with an upload.
pub struct NewScene {
    /// Default: what the archive calls itself.
    pub name: Option<String>,
    /// What its file was called, where that is known: endings tell what bytes do not.
    pub file_name: Option<String>,
    /// Parse at once, with these settings.
    pub parse: Option<ParseSettings>,
    pub idempotency_key: Option<String>,
    /// Bytes it says it has.
    pub announced_bytes: u64,
}

/// An archive on disk.
pub struct ReceivedArchive {
    path: Utf8PathBuf,
    /// Goes with this, where it is nobody else's.
    file: Option<NamedTempFile>,
    /// What it was called, where that is known.
    file_name: String,
    /// SHA-256 of the bytes, hex.
    pub hash: String,
    pub bytes: u64,
}

/// What is asked to be made of an archive.
pub struct SceneToMake {
    pub name: Option<String>,
    pub parse: Option<ParseSettings>,
    /// The caller's own.
    pub idempotency_key: Option<String>,
    /// The scene that key made before, and what identifies the request it came with, where that
    /// was noted.
    pub made_before: Option<(SceneRow, Option<String>)>,
}

/// An archive unpacked and found to be a scan.
struct UnpackedScan {
    folder: Prepared,
    /// What it calls itself.
    name: String,
}

/// Bytes of a file that are read and hashed at once.
const READ_BYTES: usize = 1 << 20;
const MAX_NAME_CHARS: usize = 200;

/// An archive being received.
#[derive(Default)]
struct ArchiveReceiver {
    /// The first bytes.
    head: Vec<u8>,
    hasher: Sha256,
    bytes: u64,
}

impl ArchiveReceiver {
    fn take(&mut self, chunk: &[u8]) {
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
        what_comes(&self.head, file_name)?;
        let hash = self.hasher.finalize().iter().map(|byte| format!("{byte:02x}")).collect();
        Ok(ReceivedArchive { path, file, file_name: file_name.to_owned(), hash, bytes: self.bytes })
    }
}

/// What is coming, by its first bytes.
pub fn what_comes(head: &[u8], file_name: &str) -> Result<ArchiveFormat, Error> {
    ArchiveFormat::of_head(head, file_name).ok_or(Error::NoScan { what: what_it_is(head) })
}

impl ReceivedArchive {
    /// The task that unpacks it into a folder, which is there and empty, and checks it as a scan.
    pub fn unpacking(&self, into: &Utf8Path, limits: &UnpackLimits) -> Task {
        Task::Unpack {
            archive: self.path.clone(),
            file_name: self.file_name.clone(),
            folder: into.to_owned(),
            limits: *limits,
        }
    }

    /// An archive that is on the disk already, read once; it stays there.
    pub fn read(path: Utf8PathBuf, file_name: &str) -> Result<Self, Error> {
        let (mut receiving, mut file, mut chunk) =
            (ArchiveReceiver::default(), File::open(&path)?, vec![0; READ_BYTES]);
        loop {
            match file.read(&mut chunk) {
                Ok(0) => return receiving.finish(path, None, file_name),
                Ok(read) => receiving.take(&chunk[..read]),
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error.into()),
            }
        }
    }
}

/// Makes scenes of uploaded archives and starts their parses.
#[derive(Clone)]
pub struct ImportService {
    pub(crate) import_root: Option<Utf8PathBuf>,
    pub(crate) scene_repository: SceneRepository,
    pub(crate) upload_permits: Arc<Semaphore>,
    pub(crate) capacity: Capacity,
    pub(crate) jobs: Jobs,
    pub(crate) blobs: Blobs,
    pub(crate) ids: IdGenerator,
    pub(crate) service_locks: ServiceLocks,
    pub(crate) parse_service: ParseService,
    pub(crate) scene_lookup: SceneLookup,
    pub(crate) key_repository: KeyRepository,
    pub(crate) content_repository: ContentRepository,
    pub(crate) limits: Limits,
    pub(crate) reader: ScanReader,
}

impl ImportService {
    /// Makes a scene from an uploaded archive and starts parsing it. Nothing is stored unless all
    /// of it is fine.
    ///
    /// The job is there only when parsing was asked for. The same request again under its
    /// idempotency key returns the scene it made.
    ///
    /// # Errors
    /// [`Error`]: what is wrong with the archive, or with the server's disk; [`Error::IdempotencyKeyReused`].
    pub async fn create_scene<E>(
        &self,
        new: NewScene,
        body: impl Stream<Item = Result<Bytes, E>> + Unpin,
        caller: &Caller,
    ) -> Result<(Scene, Option<Job>), Error> {
        // First: who is turned away costs nothing.
        let place = self.upload_permits.clone().try_acquire_owned();
        let place = place.map_err(|_| Error::TooMany { what: "uploads", most: MAX_UPLOADS })?;
        let NewScene { name, file_name, parse, idempotency_key, announced_bytes } = new;
        let idempotency_key = idempotency_key.map(|key| caller.own(key));
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

    /// Makes a scene of an archive that is there, and starts parsing it.
    ///
    /// # Errors
    /// As [`create_scene`](Self::create_scene).
    pub(crate) async fn make_scene(
        &self,
        asked: SceneToMake,
        received: Arc<ReceivedArchive>,
        caller: &Caller,
    ) -> Result<(Scene, Option<Job>), Error> {
        let SceneToMake { name, parse, idempotency_key, made_before } = asked;
        let request = request_of(&received.hash, name.as_deref(), parse.as_ref())?;
        if let Some((scene, before)) = made_before {
            // Servers of before requests were noted believed the key.
            return match before.is_none_or(|before| before == request) {
                true => self.made_before(scene, parse, caller).await,
                false => Err(Error::IdempotencyKeyReused),
            };
        }
        let mut unpacked = match self.has_content(&received.hash).await? {
            true => None,
            false => Some(self.unpack(received.clone()).await?),
        };
        // Read before anybody has to wait for it: a scan of many files takes its time.
        let name = match (name, &unpacked) {
            (Some(name), _) => name,
            (None, Some(unpacked)) => unpacked.name.clone(),
            (None, None) => self.archive_name(&received.hash).await?,
        };
        let mut references = self.service_locks.content_references().await?;
        if unpacked.is_none() && !self.has_content(&received.hash).await? {
            // Its last scene was deleted in between.
            drop(references);
            unpacked = Some(self.unpack(received.clone()).await?);
            references = self.service_locks.content_references().await?;
        }
        // Again, with nobody beside: several uploads at once must not come to more.
        self.check_quota(caller).await?;
        if let Some(UnpackedScan { folder, .. }) = unpacked {
            let blobs = self.blobs.clone();
            spawn_blocking(move || blobs.publish_prepared(folder)).await??;
        }
        let id = self.ids.new_id();
        let wanted = match &parse {
            Some(settings) => {
                Some(self.parse_service.wanted_parse(&id, &received.hash, settings, caller).await?)
            }
            None => None,
        };
        if wanted.as_ref().is_some_and(|wanted| wanted.stored.is_none()) {
            self.jobs.check_queue_capacity::<ParseJob>(caller.key_id()).await?;
        }
        let inserted = self.scene_repository.insert_scene(NewSceneRow {
            id: &id,
            name: &name,
            content_hash: &received.hash,
            content_bytes: received.bytes,
            key_id: caller.key_id(),
            key: idempotency_key.as_deref().map(|key| (key, request.as_str())),
            job: wanted.as_ref().map(WantedParse::job),
        });
        let inserted = inserted.await?;
        drop(references);
        match inserted {
            InsertOutcome::New(row, job) => Ok((
                self.scene_lookup.present(row).await?,
                job.map(|job| self.jobs.notify_worker::<ParseJob>(*job)),
            )),
            InsertOutcome::MadeBefore(row) => self.made_before(row, parse, caller).await,
            InsertOutcome::KeyReused => Err(Error::IdempotencyKeyReused),
        }
    }

    pub(crate) async fn check_quota(&self, caller: &Caller) -> Result<(), Error> {
        self.check_quota_beside(0, caller).await
    }

    /// Whether a key may have one more scene, where so many are on their way.
    pub(crate) async fn check_quota_beside(
        &self,
        coming: u32,
        caller: &Caller,
    ) -> Result<(), Error> {
        let Some(key) = &caller.key else { return Ok(()) };
        let Some(most) = key.row.max_scenes else { return Ok(()) };
        let scenes = self.key_repository.scenes_of_key(&key.row.id).await?.saturating_add(coming);
        if scenes >= most { Err(Error::TooManyScenes { most }) } else { Ok(()) }
    }

    /// The scene an idempotency key made. A server that was killed in the middle may have left it
    /// without its job.
    async fn made_before(
        &self,
        row: SceneRow,
        parse: Option<ParseSettings>,
        caller: &Caller,
    ) -> Result<(Scene, Option<Job>), Error> {
        let job = match (self.scene_lookup.job_of(&row).await?, parse) {
            (None, Some(settings)) if row.parse_id.is_none() => {
                Some(self.parse_service.start_parse(&row.id, &settings, caller).await?)
            }
            (job, _) => job,
        };
        Ok((self.scene_lookup.scene(&row.id).await?, job))
    }

    /// Whether these bytes are stored: in the database, and on the disk.
    async fn has_content(&self, hash: &str) -> Result<bool, Error> {
        if !self.content_repository.has_content(hash).await? {
            return Ok(false);
        }
        let (blobs, content) = (self.blobs.clone(), self.blobs.content(hash));
        let wrong = spawn_blocking(move || blobs.look(&content, CheckDepth::Names)).await??;
        if !wrong.is_empty() {
            tracing::warn!(
                hash,
                files = wrong.len(),
                "stored scan is incomplete; storing it again"
            );
        }
        Ok(wrong.is_empty())
    }

    /// Streams a body to a temporary file, hashed and written off the async threads.
    pub(super) async fn receive<E>(
        &self,
        body: impl Stream<Item = Result<Bytes, E>> + Unpin,
        file_name: &str,
    ) -> Result<ReceivedArchive, Error> {
        let max_bytes = self.limits.max_upload_bytes;
        let tmp = self.blobs.tmp().to_owned();
        let mut file = spawn_blocking(move || NamedTempFile::new_in(tmp)).await??;
        let mut receiving = ArchiveReceiver::default();
        let mut pieces = BodyPieces::of(body, max_bytes, max_bytes);
        while let Some(piece) = pieces.next().await? {
            let written = spawn_blocking(move || {
                for chunk in piece {
                    receiving.take(&chunk);
                    file.write_all(&chunk)?;
                }
                Ok::<_, io::Error>((file, receiving))
            });
            (file, receiving) = written.await??;
            // Nobody sends a whole video to hear that it is none.
            if receiving.head.len() == ArchiveFormat::HEAD_BYTES {
                what_comes(&receiving.head, file_name)?;
            }
        }
        let path = Utf8Path::from_path(file.path())
            .ok_or_else(|| io::Error::other("the data folder's path is not UTF-8"))?
            .to_owned();
        receiving.finish(path, Some(file), file_name)
    }

    /// Unpacks what came, puts it through the importer's checks, and has all of it ready to be
    /// published.
    async fn unpack(&self, received: Arc<ReceivedArchive>) -> Result<UnpackedScan, Error> {
        let blobs = self.blobs.clone();
        let folder = spawn_blocking(move || blobs.scratch()).await??;
        let name =
            self.checked_name(received.unpacking(folder.path(), &self.limits.unpack)).await?;
        let blobs = self.blobs.clone();
        spawn_blocking(move || {
            if let Some(file) = &received.file {
                // It is all unpacked: nothing of the archive that is still in memory has to reach
                // the disk.
                file.as_file().set_len(0)?;
            }
            let folder = blobs.prepare(folder, &blobs.content(&received.hash))?;
            Ok(UnpackedScan { folder, name })
        })
        .await?
    }

    /// Checks a scan and returns what it calls itself.
    async fn checked_name(&self, check: Task) -> Result<String, Error> {
        Ok(match self.reader.check(check).await? {
            TaskOutcome::Scan { name } => name_or_scene(name),
            TaskOutcome::Fits | TaskOutcome::Imported { .. } => name_or_scene(None),
        })
    }

    /// What a stored archive calls itself.
    async fn archive_name(&self, hash: &str) -> Result<String, Error> {
        let (blobs, content) = (self.blobs.clone(), self.blobs.content(hash));
        let Ok(scan) = spawn_blocking(move || blobs.whole(&content)).await? else {
            return Ok(name_or_scene(None));
        };
        // Removed in between: it is unpacked again, and called what scenes without a name are
        // called.
        Ok(self
            .checked_name(Task::Inspect { folder: scan.to_path_buf() })
            .await
            .unwrap_or_else(|_| name_or_scene(None)))
    }
}

/// Identifies what was asked for under an idempotency key.
fn request_of(
    hash: &str,
    name: Option<&str>,
    parse: Option<&ParseSettings>,
) -> Result<String, Error> {
    let digest = Sha256::digest(serde_json::to_vec(&(hash, name, parse))?);
    Ok(digest.iter().map(|byte| format!("{byte:02x}")).collect())
}

/// What an archive calls itself, where that is a name.
fn name_or_scene(name: Option<String>) -> String {
    name.filter(|name| check_name("/name", name).is_ok()).unwrap_or_else(|| "scene".into())
}

/// A scene's name is one line of text.
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
