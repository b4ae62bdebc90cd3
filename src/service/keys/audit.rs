//! What was done: every request that changes what is stored, whose key it came with and what came of it.

use super::{Caller, Keyring};
use crate::error::Error;
use crate::store::{now, page};
use uniground_types::keys::{AuditEntry, AuditList};

/// A request that is under way, and what came of it.
#[derive(Debug, Clone)]
pub struct Done {
    pub method: String,
    pub path: String,
    pub status: u16,
    pub request_id: Option<String>,
}

/// The status of a request whose caller left before the answer: what it did is done.
const LEFT: u16 = 499;

/// A request that is written down however it ends: answered, or because whoever asked left, or because the handler panicked.
pub struct Noting {
    keys: Keyring,
    open: Option<(Caller, Done)>,
}

impl Noting {
    /// It was answered. Whoever asked waits until that is written down.
    pub async fn answered(mut self, status: u16) {
        if let Some((caller, done)) = self.open.take() {
            let keys = self.keys.clone();
            // A task of its own: nor does leaving now keep it from being written.
            let noted = tokio::spawn(async move { keys.note(&caller, Done { status, ..done }).await });
            if let Err(panic) = noted.await {
                tracing::error!(error = &panic as &dyn std::error::Error, "what was done could not be written down");
            }
        }
    }
}

impl Drop for Noting {
    fn drop(&mut self) {
        if let Some((caller, done)) = self.open.take() {
            let keys = self.keys.clone();
            tokio::spawn(async move { keys.note(&caller, Done { status: LEFT, ..done }).await });
        }
    }
}

/// No path of ours is longer.
const MAX_PATH_CHARS: usize = 300;

impl Keyring {
    /// Begins to write down what somebody does.
    #[must_use]
    pub fn noting(&self, caller: Caller, done: Done) -> Noting {
        Noting { keys: self.clone(), open: Some((caller, done)) }
    }

    /// Writes down what somebody did. That it can not be written is for the log: it was done all the same.
    async fn note(&self, caller: &Caller, done: Done) {
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
        let (entries, next_cursor) = page(self.store.audit(limit + 1, cursor).await?, limit, |entry| &entry.id);
        Ok(AuditList { entries, next_cursor })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::Store;
    use camino::Utf8Path;
    use std::time::Duration;
    use tokio::time::sleep;

    #[tokio::test]
    async fn what_somebody_did_who_left_is_written_down_all_the_same() {
        let folder = tempfile::tempdir().unwrap();
        let store =
            Store::open(Utf8Path::from_path(folder.path()).unwrap(), &crate::store::Location::Folder, &crate::store::BlobHome::Folder)
                .await
                .unwrap();
        let keys = Keyring::open(store, None).await.unwrap();
        let done = |path: &str| Done { method: "DELETE".into(), path: path.into(), status: 0, request_id: None };
        keys.noting(Caller::operator(), done("/answered")).answered(204).await;
        drop(keys.noting(Caller::operator(), done("/left")));
        let mut told = Vec::new();
        for _ in 0..200 {
            told = keys.audit(10, None).await.unwrap().entries;
            if told.len() == 2 {
                break;
            }
            sleep(Duration::from_millis(5)).await;
        }
        let told: Vec<(&str, u16)> = told.iter().map(|entry| (entry.path.as_str(), entry.status)).collect();
        assert_eq!(told, [("/left", LEFT), ("/answered", 204)]);
    }
}
