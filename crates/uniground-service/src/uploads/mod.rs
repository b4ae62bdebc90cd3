//! Resumable uploads: started with a length, and resumed at the current offset after any
//! interruption. This module knows no protocol. A part is identified by the offset at which it
//! begins.
//!
//! The stored record says how many bytes were received. It is written after the bytes are on disk.
//! A killed server or a power failure loses only the bytes received since the last write of the
//! record.

mod checking;
mod making;
mod parts;

pub use checking::{Checksum, ChecksumAlgorithm};
pub use making::Explain;
pub use parts::UploadPart;

pub(super) use making::default_problem;

use super::scenes::check_name;
use super::{Caller, ParseJob};
use crate::error::Error;
use crate::{Capacity, ImportService, Keyring, Limits, ServiceLocks};
use jiff::{Timestamp, ToSpan};
use std::sync::Arc;
use tokio::sync::Semaphore;
use tokio::task::spawn_blocking;
use uniground_jobs::Jobs;
use uniground_storage::{
    Blobs, SceneRepository, SceneRequest, UploadRepository, UploadResult, UploadRow,
};
use uniground_types::uploads::{Upload, UploadState};

/// A new upload.
pub struct NewUpload {
    /// The total length in bytes.
    pub length: u64,
    /// The scene to create from it.
    pub wanted: SceneRequest,
}

/// The maximum number of unfinished uploads of one key.
const MAX_UPLOADS_OF_KEY: u32 = 32;

/// Resumable uploads.
#[derive(Clone)]
pub struct UploadService {
    pub(crate) upload_repository: UploadRepository,
    pub(crate) service_locks: Arc<ServiceLocks>,
    pub(crate) keyring: Keyring,
    pub(crate) explain: Explain,
    pub(crate) blobs: Blobs,
    pub(crate) scene_repository: SceneRepository,
    pub(crate) capacity: Arc<Capacity>,
    pub(crate) import_service: Arc<ImportService>,
    pub(crate) limits: Limits,
    pub(crate) jobs: Jobs,
    pub(crate) upload_permits: Arc<Semaphore>,
}

impl UploadService {
    /// Starts an upload. Its bytes follow in parts.
    ///
    /// # Errors
    /// [`Error`] if the length or a name is invalid, the disk has no room, the quota is exhausted,
    /// or too many uploads are unfinished.
    pub async fn begin_upload(&self, new: NewUpload, caller: &Caller) -> Result<Upload, Error> {
        let NewUpload { length, wanted } = new;
        let max_bytes = self.limits.max_upload_bytes;
        if length == 0 {
            return Err(Error::invalid("length", "an empty file is no scan"));
        }
        if length > max_bytes {
            return Err(Error::UploadTooLarge { max_bytes });
        }
        if let Some(name) = &wanted.name {
            check_name("/name", name)?;
        }
        if wanted.parse {
            self.jobs.check_queue_capacity::<ParseJob>(caller.key_id()).await?;
        }
        // Checked under a lock: concurrent starts together must not exceed the limits.
        let _beginning = self.service_locks.lock_upload_start().await?;
        let since = self.oldest_upload().map_or_else(String::new, |oldest| oldest.to_string());
        let unfinished = self.upload_repository.unfinished_uploads(&since, caller.key_id()).await?;
        let most = match &caller.key {
            Some(_) if unfinished.of_key >= MAX_UPLOADS_OF_KEY => Some(MAX_UPLOADS_OF_KEY),
            _ => (unfinished.uploads >= self.limits.max_unfinished_uploads)
                .then_some(self.limits.max_unfinished_uploads),
        };
        if let Some(most) = most {
            return Err(Error::TooManyUploads { most });
        }
        // Bytes that other uploads announced count as used.
        self.capacity.check_disk(length.saturating_add(unfinished.announced_bytes))?;
        self.import_service.check_quota_beside(unfinished.of_key, caller).await?;
        let row = self.upload_repository.insert_upload(&wanted, length, caller.key_id()).await?;
        Ok(self.to_upload(row))
    }

    /// Returns the largest size of an upload in bytes.
    #[must_use]
    pub fn max_upload_bytes(&self) -> u64 {
        self.limits.max_upload_bytes
    }

    /// Returns the state of an upload.
    ///
    /// # Errors
    /// [`Error::UploadNotFound`], [`Error::UploadExpired`].
    pub async fn upload(&self, id: &str, caller: &Caller) -> Result<Upload, Error> {
        Ok(self.to_upload(self.upload_row(id, caller).await?))
    }

    /// Returns the note that the client stored with the upload.
    ///
    /// # Errors
    /// Those of [`upload`](Self::upload).
    pub async fn upload_note(&self, id: &str, caller: &Caller) -> Result<Option<String>, Error> {
        Ok(self.upload_row(id, caller).await?.wanted.note)
    }

    /// Cancels an upload, or deletes the record of a finished one. Its scene stays.
    ///
    /// # Errors
    /// [`Error::UploadNotFound`], [`Error::UploadExpired`], [`Error::UploadBusy`].
    pub async fn delete_upload(&self, id: &str, caller: &Caller) -> Result<(), Error> {
        self.upload_row(id, caller).await?;
        let _lock = self.service_locks.lock_upload(id).await?;
        if !self.upload_repository.delete_upload(id).await? {
            return Err(Error::UploadNotFound { id: id.into() });
        }
        Ok(self.blobs.discard(self.blobs.upload(id)).await?)
    }

    /// Returns the record of a caller's upload. The offset never exceeds what is on disk.
    async fn upload_row(&self, id: &str, caller: &Caller) -> Result<UploadRow, Error> {
        let row = self
            .upload_repository
            .upload(id)
            .await?
            .filter(|row| row.key_id.as_deref() == caller.key_id());
        let row = row.ok_or_else(|| Error::UploadNotFound { id: id.into() })?;
        if self
            .oldest_upload()
            .is_some_and(|oldest| row.updated_at.parse().is_ok_and(|at: Timestamp| at < oldest))
        {
            return Err(Error::UploadExpired { id: id.into() });
        }
        self.with_stored_size(row).await
    }

    /// Lowers the offset to the bytes that are on disk. The offset becomes zero if the file is
    /// missing, as after restoring a backup.
    async fn with_stored_size(&self, row: UploadRow) -> Result<UploadRow, Error> {
        if row.came_of.is_some() || row.received == 0 {
            return Ok(row);
        }
        let (blobs, id) = (self.blobs.clone(), row.id.clone());
        let there = spawn_blocking(move || blobs.upload_bytes(&id)).await??;
        Ok(UploadRow { received: row.received.min(there), ..row })
    }

    /// Returns the time since when uploads must have been active. Older uploads have expired.
    /// Returns `None` if uploads never expire.
    fn oldest_upload(&self) -> Option<Timestamp> {
        let days = self.limits.retention.uploads_days;
        (days > 0).then(|| Timestamp::now().checked_sub(hours(days)).unwrap_or(Timestamp::MIN))
    }

    fn to_upload(&self, row: UploadRow) -> Upload {
        let days = self.limits.retention.uploads_days;
        let expires_at = row.updated_at.parse::<Timestamp>().ok().filter(|_| days > 0);
        let expires_at =
            expires_at.and_then(|at| at.checked_add(hours(days)).ok()).map(|at| at.to_string());
        let UploadRow {
            id,
            key_id: _,
            wanted: _,
            length,
            received,
            came_of,
            created_at,
            updated_at: _,
        } = row;
        let state = match &came_of {
            Some(UploadResult::Scene { .. }) => UploadState::Done,
            Some(UploadResult::Nothing(_)) => UploadState::Refused,
            None if received == length => UploadState::Making,
            None => UploadState::Receiving,
        };
        let (scene_id, job_id, problem) = match came_of {
            Some(UploadResult::Scene { scene_id, job_id }) => (Some(scene_id), job_id, None),
            Some(UploadResult::Nothing(problem)) => (None, None, problem),
            None => (None, None, None),
        };
        Upload {
            id,
            state,
            offset: received,
            length,
            expires_at,
            scene_id,
            job_id,
            problem,
            created_at,
        }
    }
}

fn hours(days: u32) -> jiff::Span {
    (i64::from(days) * 24).hours()
}

#[cfg(test)]
mod tests;
