//! Messages between the service and a child process, one line of JSON each.

use super::{ReadError, Task, TaskOutcome};
use camino::Utf8PathBuf;
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::io;
use uniground_geometry::progress::Cancelled;
use uniground_ingest::{IngestError, IngestErrorKind};

/// The task of a child, with its limits.
#[derive(Serialize, Deserialize)]
pub(super) struct Request<'a> {
    pub task: Cow<'a, Task>,
    pub memory_bytes: u64,
    pub cpu_s: u64,
}

/// A message from a child.
#[derive(Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Message {
    Progress { stage: String, done: f32 },
    Done(TaskOutcome),
    Failed(Failure),
}

/// An [`IngestError`] in transit.
#[derive(Serialize, Deserialize)]
pub(super) struct Failure {
    kind: IngestErrorKind,
    message: String,
    /// The file, for an error of the file system.
    file: Option<Utf8PathBuf>,
    is_disk_full: bool,
}

/// Longest error message, characters. Callers get an even shorter one.
const MAX_MESSAGE_CHARS: usize = 4000;

fn shorten(message: String) -> String {
    match message.char_indices().nth(MAX_MESSAGE_CHARS) {
        Some((end, _)) => message[..end].to_owned(),
        None => message,
    }
}

impl From<IngestError> for Failure {
    fn from(error: IngestError) -> Self {
        let (kind, message) = (error.kind(), shorten(error.to_string()));
        match error {
            IngestError::Io { file, source } => {
                let is_disk_full = matches!(
                    source.kind(),
                    io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded
                );
                Self { kind, message: shorten(source.to_string()), file: Some(file), is_disk_full }
            }
            _ => Self { kind, message, file: None, is_disk_full: false },
        }
    }
}

impl From<Failure> for ReadError {
    fn from(Failure { kind, message, file, is_disk_full }: Failure) -> Self {
        Self::Ingest(match (kind, file) {
            (IngestErrorKind::Cancelled, _) => IngestError::Cancelled(Cancelled),
            (IngestErrorKind::Io, Some(file)) if is_disk_full => {
                IngestError::Io { file, source: io::Error::from(io::ErrorKind::StorageFull) }
            }
            (IngestErrorKind::Io, Some(file)) => {
                IngestError::Io { file, source: io::Error::other(message) }
            }
            (kind, _) => IngestError::Reported { kind, message },
        })
    }
}
