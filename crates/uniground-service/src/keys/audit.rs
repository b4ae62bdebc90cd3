//! The audit log: every request that changes stored data, with its key and its outcome.

use super::{Caller, Keyring};
use crate::error::Error;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::{mpsc, oneshot};
use tokio::time::{sleep, timeout};
use uniground_models::with_causes;
use uniground_storage::{AuditWriter, StoreError, now, split_page};
use uniground_telemetry::metrics::Metrics;
use uniground_types::keys::{AuditEntry, AuditList};

/// A request and its outcome.
#[derive(Debug, Clone)]
pub struct AuditedRequest {
    pub method: String,
    pub path: String,
    pub status: u16,
    pub request_id: Option<String>,
}

/// The status of a request whose client disconnected before the answer. Its changes remain.
const LEFT: u16 = 499;

/// A request whose audit entry is written however it ends: answered, abandoned by its client, or
/// ended by a panic of the handler.
pub struct PendingAudit {
    keys: Keyring,
    open: Option<(Caller, AuditedRequest)>,
}

impl PendingAudit {
    /// Records the status of the answer. Waits until the entry is written, for at most `MAX_WAIT`.
    pub async fn record_status(mut self, status: u16) {
        if let Some((caller, done)) = self.open.take() {
            let written = self
                .keys
                .audit_log
                .push(self.keys.entry(&caller, AuditedRequest { status, ..done }));
            // An entry that is still queued is written later. Dropped entries have been logged.
            let _ = timeout(MAX_WAIT, written).await;
        }
    }
}

impl Drop for PendingAudit {
    fn drop(&mut self) {
        if let Some((caller, done)) = self.open.take() {
            drop(
                self.keys
                    .audit_log
                    .push(self.keys.entry(&caller, AuditedRequest { status: LEFT, ..done })),
            );
        }
    }
}

/// The maximum length of a stored path. No path of this API is longer.
const MAX_PATH_CHARS: usize = 300;
/// The longest time for which an answer waits for its entry to be written.
const MAX_WAIT: Duration = Duration::from_secs(2);
/// The maximum number of queued entries.
const MAX_QUEUED: usize = 4096;
/// The maximum number of entries written in one transaction.
const ENTRIES_PER_TRANSACTION: usize = 256;
/// Attempts to write entries while the database is busy, and the pause between attempts.
const ATTEMPTS: u32 = 5;
const RETRY_AFTER: Duration = Duration::from_millis(200);
/// The shortest interval between two log lines about dropped entries.
const LOG_EVERY: Duration = Duration::from_secs(10);

/// Writes audit entries in the background, in order. Queued entries are written together.
#[derive(Clone)]
pub(super) struct AuditLog {
    queue: mpsc::Sender<QueuedEntry>,
    dropped: Arc<DroppedEntries>,
}

struct QueuedEntry {
    entry: AuditEntry,
    /// Closed when the entry was written or dropped.
    written: oneshot::Sender<()>,
}

impl AuditLog {
    /// Starts the writer. It ends when the last handle is dropped and all entries are written.
    pub fn start(writer: AuditWriter, metrics: Arc<Metrics>) -> Self {
        let (queue, pending) = mpsc::channel(MAX_QUEUED);
        let dropped = Arc::new(DroppedEntries { metrics, unlogged: Mutex::default() });
        tokio::spawn(write_entries(writer, pending, dropped.clone()));
        Self { queue, dropped }
    }

    /// Queues an entry. The receiver ends when the entry is written, or dropped because the queue
    /// is full.
    fn push(&self, entry: AuditEntry) -> oneshot::Receiver<()> {
        let (written, receiver) = oneshot::channel();
        if let Err(error) = self.queue.try_send(QueuedEntry { entry, written }) {
            self.dropped.count(
                std::slice::from_ref(&error.into_inner().entry),
                "too many are waiting to be written",
            );
        }
        receiver
    }
}

async fn write_entries(
    writer: AuditWriter,
    mut queue: mpsc::Receiver<QueuedEntry>,
    dropped: Arc<DroppedEntries>,
) {
    let mut pending = Vec::new();
    while queue.recv_many(&mut pending, ENTRIES_PER_TRANSACTION).await > 0 {
        let (entries, callers): (Vec<_>, Vec<_>) =
            pending.drain(..).map(|pending| (pending.entry, pending.written)).unzip();
        if let Err(error) = write(&writer, &entries).await {
            dropped.count(&entries, &with_causes(&error));
        }
        drop(callers);
    }
}

async fn write(writer: &AuditWriter, entries: &[AuditEntry]) -> Result<(), StoreError> {
    for _ in 1..ATTEMPTS {
        match writer.insert(entries).await {
            Err(error) if error.is_busy() => sleep(RETRY_AFTER).await,
            done => return done,
        }
    }
    writer.insert(entries).await
}

/// Entries that were not written.
struct DroppedEntries {
    metrics: Arc<Metrics>,
    /// How many entries were dropped since the last log line, and when that was.
    unlogged: Mutex<(usize, Option<Instant>)>,
}

impl DroppedEntries {
    fn count(&self, entries: &[AuditEntry], why: &str) {
        self.metrics.requests.audit_entries_dropped.inc_by(entries.len() as u64);
        let mut unlogged = self.unlogged.lock().unwrap_or_else(PoisonError::into_inner);
        let (count, logged_at) = &mut *unlogged;
        *count += entries.len();
        if logged_at.is_none_or(|at| at.elapsed() >= LOG_EVERY) {
            tracing::error!(entries = *count, last = ?entries.last(), why, "audit entries dropped");
            *unlogged = (0, Some(Instant::now()));
        }
    }
}

impl Keyring {
    /// Starts the audit entry of a request.
    #[must_use]
    pub fn begin_audit(&self, caller: Caller, done: AuditedRequest) -> PendingAudit {
        PendingAudit { keys: self.clone(), open: Some((caller, done)) }
    }

    fn entry(&self, caller: &Caller, done: AuditedRequest) -> AuditEntry {
        let AuditedRequest { method, path, status, request_id } = done;
        let path = path.chars().take(MAX_PATH_CHARS).collect();
        let key_id = caller.key_id().map(str::to_owned);
        AuditEntry { id: self.ids.new_id(), at: now(), key_id, method, path, status, request_id }
    }

    /// Lists audit entries, newest first.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn audit(&self, limit: u32, cursor: Option<&str>) -> Result<AuditList, Error> {
        let (entries, next_cursor) =
            split_page(self.keys.audit(limit + 1, cursor).await?, limit, |entry| &entry.id);
        Ok(AuditList { entries, next_cursor })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use camino::Utf8Path;
    use uniground_storage::{BlobHome, Location, Store};

    async fn keyring(folder: &tempfile::TempDir) -> Keyring {
        Keyring::open(&store(folder).await, None).await.unwrap()
    }

    async fn store(folder: &tempfile::TempDir) -> Store {
        let folder = Utf8Path::from_path(folder.path()).unwrap();
        Store::open(folder, &Location::Folder, &BlobHome::Folder).await.unwrap()
    }

    fn done(path: &str) -> AuditedRequest {
        AuditedRequest { method: "DELETE".into(), path: path.into(), status: 0, request_id: None }
    }

    /// Returns all entries once there are at least `count`.
    async fn entries(keys: &Keyring, count: usize) -> Vec<AuditEntry> {
        loop {
            let entries = keys.audit(10_000, None).await.unwrap().entries;
            if entries.len() >= count {
                return entries;
            }
            sleep(Duration::from_millis(5)).await;
        }
    }

    #[tokio::test]
    async fn requests_of_disconnected_clients_are_audited() {
        let folder = tempfile::tempdir().unwrap();
        let keys = keyring(&folder).await;
        keys.begin_audit(Caller::operator(), done("/answered")).record_status(204).await;
        drop(keys.begin_audit(Caller::operator(), done("/left")));
        let entries = entries(&keys, 2).await;
        let written: Vec<(&str, u16)> =
            entries.iter().map(|entry| (entry.path.as_str(), entry.status)).collect();
        assert_eq!(written, [("/left", LEFT), ("/answered", 204)]);
    }

    #[tokio::test]
    async fn under_load_audit_entries_are_written_or_counted_as_dropped() {
        const FLOOD: usize = MAX_QUEUED + 100;
        let folder = tempfile::tempdir().unwrap();
        let metrics = Arc::<Metrics>::default();
        let keys = keyring(&folder).await.with_metrics(metrics.clone());
        // The test has one thread, so the writer does not run in between.
        for _ in 0..FLOOD {
            drop(keys.begin_audit(Caller::operator(), done("/flood")));
        }
        assert!(
            metrics.text().contains("uniground_audit_entries_dropped_total 100"),
            "{}",
            metrics.text()
        );
        assert_eq!(entries(&keys, MAX_QUEUED).await.len(), MAX_QUEUED);
        keys.begin_audit(Caller::operator(), done("/later")).record_status(200).await;
        assert_eq!(entries(&keys, MAX_QUEUED + 1).await[0].path, "/later");
    }

    #[tokio::test]
    async fn entries_that_the_database_rejects_are_counted_as_dropped() {
        let folder = tempfile::tempdir().unwrap();
        let metrics = Arc::<Metrics>::default();
        let store = store(&folder).await;
        let keys = Keyring::open(&store, None).await.unwrap().with_metrics(metrics.clone());
        store.close().await;
        let refused = keys.entry(&Caller::operator(), done("/refused"));
        let _ = keys.audit_log.push(refused).await;
        assert!(
            metrics.text().contains("uniground_audit_entries_dropped_total 1"),
            "{}",
            metrics.text()
        );
    }
}
