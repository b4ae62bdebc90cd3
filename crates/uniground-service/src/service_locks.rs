//! Whose turn something is, among all processes that serve the same rooms.

use crate::error::Error;
use std::time::Duration;
use tokio::time::timeout;
use uniground_storage::{LockTable, NamedLock};

/// How long somebody waits for the turn at an upload before he is told that another is at it.
const MOMENT: Duration = Duration::from_secs(1);

/// The named locks of the use cases.
#[derive(Clone)]
pub struct ServiceLocks {
    pub(crate) named_locks: LockTable,
}

impl ServiceLocks {
    /// Held while a scene starts or ceases to refer to its content, so that content is not removed
    /// under a new scene.
    pub(super) async fn content_references(&self) -> Result<NamedLock, Error> {
        Ok(self.named_locks.lock("contents").await?)
    }

    /// Held while a scene takes a stored parse, or gets a job for another, so that neither the
    /// parse nor what the job goes on from is removed meanwhile. Whoever removes holds both,
    /// this one last.
    pub(super) async fn parse_references(&self) -> Result<NamedLock, Error> {
        Ok(self.named_locks.lock("parses").await?)
    }

    /// At changing what is known of a parse.
    pub(super) async fn correcting(&self, parse_id: &str) -> Result<NamedLock, Error> {
        Ok(self.named_locks.lock(&format!("parse {parse_id}")).await?)
    }

    /// At answering a question under its idempotency key.
    pub(super) async fn answering(&self, key: &str) -> Result<NamedLock, Error> {
        Ok(self.named_locks.lock(&format!("question {key}")).await?)
    }

    /// Held while an upload in parts is begun: several at once must not come to more than may be
    /// unfinished.
    pub(super) async fn beginning_uploads(&self) -> Result<NamedLock, Error> {
        Ok(self.named_locks.lock("uploads").await?)
    }

    /// At an upload in parts: bytes of two senders never mix.
    ///
    /// # Errors
    /// [`Error::UploadBusy`]: somebody else is at it.
    pub(super) async fn at_upload(&self, id: &str) -> Result<NamedLock, Error> {
        // Who was at it a moment ago has had its reply, and may still be letting go.
        let turn = timeout(MOMENT, self.named_locks.lock(&format!("upload {id}"))).await;
        Ok(turn.map_err(|_| Error::UploadBusy { id: id.to_owned() })??)
    }

    /// At looking after everything; `None` while another process does.
    pub(super) async fn keeping_house(&self) -> Result<Option<NamedLock>, Error> {
        Ok(self.named_locks.try_lock("house").await?)
    }

    /// At noting what rooms are known by; `None` while another process does.
    pub(super) async fn indexing(&self) -> Result<Option<NamedLock>, Error> {
        Ok(self.named_locks.try_lock("index").await?)
    }

    /// At telling of jobs that end; `None` while another process does.
    pub(super) async fn announcing(&self) -> Result<Option<NamedLock>, Error> {
        Ok(self.named_locks.try_lock("announcements").await?)
    }
}
