//! Named locks, shared by all processes that use the same store.

use crate::error::Error;
use std::time::Duration;
use tokio::time::timeout;
use uniground_storage::{LockTable, NamedLock};

/// How long a request waits for the lock of an upload before it fails as busy.
const LOCK_TIMEOUT: Duration = Duration::from_secs(1);

/// The named locks of the use cases.
#[derive(Clone)]
pub struct ServiceLocks {
    pub(crate) named_locks: LockTable,
}

impl ServiceLocks {
    /// Held while a scene starts or stops referring to its content, so that content is not removed
    /// under a new scene.
    pub(super) async fn lock_content_references(&self) -> Result<NamedLock, Error> {
        Ok(self.named_locks.lock("contents").await?)
    }

    /// Held while a scene takes a stored parse, or gets a job for a new one. Meanwhile neither the
    /// parse nor the one that the job continues is removed. Removal holds both locks and acquires
    /// this one last.
    pub(super) async fn lock_parse_references(&self) -> Result<NamedLock, Error> {
        Ok(self.named_locks.lock("parses").await?)
    }

    /// Held while the data of a parse is changed.
    pub(super) async fn lock_parse_data(&self, parse_id: &str) -> Result<NamedLock, Error> {
        Ok(self.named_locks.lock(&format!("parse {parse_id}")).await?)
    }

    /// Held while a question is answered under its idempotency key.
    pub(super) async fn lock_idempotency_key(&self, key: &str) -> Result<NamedLock, Error> {
        Ok(self.named_locks.lock(&format!("question {key}")).await?)
    }

    /// Held while an upload is started: concurrent starts must not exceed the limit of unfinished
    /// uploads.
    pub(super) async fn lock_upload_start(&self) -> Result<NamedLock, Error> {
        Ok(self.named_locks.lock("uploads").await?)
    }

    /// Held while a part of an upload is received: the bytes of two clients never mix.
    ///
    /// # Errors
    /// [`Error::UploadBusy`] if another request holds the lock.
    pub(super) async fn lock_upload(&self, id: &str) -> Result<NamedLock, Error> {
        // The previous request may have been answered while it still releases the lock.
        let lock = timeout(LOCK_TIMEOUT, self.named_locks.lock(&format!("upload {id}"))).await;
        Ok(lock.map_err(|_| Error::UploadBusy { id: id.to_owned() })??)
    }

    /// Held during maintenance. Returns `None` while another process holds it.
    pub(super) async fn try_lock_maintenance(&self) -> Result<Option<NamedLock>, Error> {
        Ok(self.named_locks.try_lock("house").await?)
    }

    /// Held while rooms are indexed. Returns `None` while another process holds it.
    pub(super) async fn try_lock_room_index(&self) -> Result<Option<NamedLock>, Error> {
        Ok(self.named_locks.try_lock("index").await?)
    }

    /// Held while webhooks are delivered. Returns `None` while another process holds it.
    pub(super) async fn try_lock_webhook_delivery(&self) -> Result<Option<NamedLock>, Error> {
        Ok(self.named_locks.try_lock("announcements").await?)
    }
}
