//! What was done: every request that changes what is stored, whose key it came with and what came of it.

use super::{Caller, Keyring};
use crate::error::Error;
use crate::store::now;
use uniground_types::keys::{AuditEntry, AuditList};

/// A request that was answered.
#[derive(Debug, Clone)]
pub struct Done {
    pub method: String,
    pub path: String,
    pub status: u16,
    pub request_id: Option<String>,
}

/// No path of ours is longer.
const MAX_PATH_CHARS: usize = 300;

impl Keyring {
    /// Writes down what somebody did. That it can not be written is for the log: it was done all the same.
    pub async fn note(&self, caller: &Caller, done: Done) {
        let Done { method, path, status, request_id } = done;
        let path = path.chars().take(MAX_PATH_CHARS).collect();
        let key_id = caller.key_id().map(str::to_owned);
        let entry = AuditEntry { id: self.store.new_id(), at: now(), key_id, method, path, status, request_id };
        if let Err(error) = self.store.insert_audit_entry(&entry).await {
            tracing::error!(error = &error as &dyn std::error::Error, ?entry, "what was done could not be written down");
        }
    }

    /// What was done, newest first.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn audit(&self, limit: u32, cursor: Option<&str>) -> Result<AuditList, Error> {
        let mut entries = self.store.audit(limit + 1, cursor).await?;
        let more = entries.len() > limit as usize;
        entries.truncate(limit as usize);
        let next_cursor = entries.last().filter(|_| more).map(|entry| entry.id.clone());
        Ok(AuditList { entries, next_cursor })
    }
}
