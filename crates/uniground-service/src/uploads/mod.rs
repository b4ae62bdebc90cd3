//! Uploads that come in parts: begun with a length, gone on with where they stopped, whatever
//! happened in between. No protocol is known here: what tells parts apart is the offset they begin
//! at.
//!
//! How much of an upload is there is what its record says, which is written after the bytes are on
//! the disk. A server that is killed, and a machine that loses its power, forget what was not noted
//! yet, never more.

mod checking;
mod making;
mod parts;

pub use checking::{Checksum, ChecksumAlgorithm};
pub use making::Explain;
pub use parts::UploadPart;

pub(super) use making::unexplained;

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

/// An upload about to begin.
pub struct NewUpload {
    /// Bytes it will have.
    pub length: u64,
    /// What is to be made of it.
    pub wanted: SceneRequest,
}

/// Uploads that one key may have unfinished at once.
const MOST_OF_A_KEY: u32 = 32;

/// Resumable uploads.
#[derive(Clone)]
pub struct UploadService {
    pub(crate) upload_repository: UploadRepository,
    pub(crate) service_locks: ServiceLocks,
    pub(crate) keyring: Keyring,
    pub(crate) explain: Explain,
    pub(crate) blobs: Blobs,
    pub(crate) scene_repository: SceneRepository,
    pub(crate) capacity: Capacity,
    pub(crate) import_service: ImportService,
    pub(crate) limits: Limits,
    pub(crate) jobs: Jobs,
    pub(crate) upload_permits: Arc<Semaphore>,
}

impl UploadService {
    /// Begins an upload; its bytes follow in parts.
    ///
    /// # Errors
    /// [`Error`]: a length or name that makes no sense, no room, no quota, or too many that are unfinished.
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
        // With nobody beside: several at once must not come to more.
        let _beginning = self.service_locks.beginning_uploads().await?;
        let since = self.oldest_upload().map_or_else(String::new, |oldest| oldest.to_string());
        let unfinished = self.upload_repository.unfinished_uploads(&since, caller.key_id()).await?;
        let most = match &caller.key {
            Some(_) if unfinished.of_key >= MOST_OF_A_KEY => Some(MOST_OF_A_KEY),
            _ => (unfinished.uploads >= self.limits.max_unfinished_uploads)
                .then_some(self.limits.max_unfinished_uploads),
        };
        if let Some(most) = most {
            return Err(Error::TooManyUploads { most });
        }
        // What others have announced is as good as taken.
        self.capacity.check_disk(length.saturating_add(unfinished.announced_bytes))?;
        self.import_service.check_quota_beside(unfinished.of_key, caller).await?;
        let row = self.upload_repository.insert_upload(&wanted, length, caller.key_id()).await?;
        Ok(self.present_upload(row))
    }

    /// The most an upload may have.
    #[must_use]
    pub fn max_upload_bytes(&self) -> u64 {
        self.limits.max_upload_bytes
    }

    /// An upload as it stands.
    ///
    /// # Errors
    /// [`Error::UploadNotFound`], [`Error::UploadExpired`].
    pub async fn upload(&self, id: &str, caller: &Caller) -> Result<Upload, Error> {
        Ok(self.present_upload(self.upload_row(id, caller).await?))
    }

    /// What whoever began an upload wanted back.
    ///
    /// # Errors
    /// As [`upload`](Self::upload).
    pub async fn upload_note(&self, id: &str, caller: &Caller) -> Result<Option<String>, Error> {
        Ok(self.upload_row(id, caller).await?.wanted.note)
    }

    /// Gives an upload up, or forgets one that is over; its scene stays.
    ///
    /// # Errors
    /// [`Error::UploadNotFound`], [`Error::UploadExpired`], [`Error::UploadBusy`].
    pub async fn delete_upload(&self, id: &str, caller: &Caller) -> Result<(), Error> {
        self.upload_row(id, caller).await?;
        let _turn = self.service_locks.at_upload(id).await?;
        if !self.upload_repository.delete_upload(id).await? {
            return Err(Error::UploadNotFound { id: id.into() });
        }
        Ok(self.blobs.discard(self.blobs.upload(id)).await?)
    }

    /// The record of a caller's upload, which claims no more than is on the disk.
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
        self.as_on_disk(row).await
    }

    /// A record without its file, as a restored backup has it, is an upload that begins anew.
    async fn as_on_disk(&self, row: UploadRow) -> Result<UploadRow, Error> {
        if row.came_of.is_some() || row.received == 0 {
            return Ok(row);
        }
        let (blobs, id) = (self.blobs.clone(), row.id.clone());
        let there = spawn_blocking(move || blobs.upload_bytes(&id)).await??;
        Ok(UploadRow { received: row.received.min(there), ..row })
    }

    /// Uploads that were not gone on with since then are over; `None`: none ever is.
    fn oldest_upload(&self) -> Option<Timestamp> {
        let days = self.limits.retention.uploads_days;
        (days > 0).then(|| Timestamp::now().checked_sub(hours(days)).unwrap_or(Timestamp::MIN))
    }

    fn present_upload(&self, row: UploadRow) -> Upload {
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
