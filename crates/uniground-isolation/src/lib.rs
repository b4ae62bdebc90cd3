//! Reading of uploaded scans in processes of their own.
//!
//! Uploads are hostile: a decoder may crash, ask for more memory than there is, or never end. So
//! every file of an upload is decoded first by a child process of this program with limits on its
//! memory and time. What it found comes back as a message, what it has unpacked or imported as
//! files. A fault ends the child, never the service.
//!
//! ```text
//! service ── Request (a line of JSON on stdin) ──> uniground isolated-reader
//!         <── Message… (lines of JSON on stdout) ── progress, then Done or Failed
//! ```

mod child;
mod task;
mod wire;
mod worker;

pub use child::ChildProcess;
pub use task::{Task, TaskOutcome};
pub use worker::run;

use std::io;
use std::sync::Arc;
use tokio::sync::Semaphore;
use tokio::task::spawn_blocking;
use uniground_geometry::progress::Progress;
use uniground_ingest::IngestError;

/// Checks of uploads that run at once; more wait. Together they take no more memory than so many
/// times the limit of one.
const MAX_CONCURRENT_CHECKS: usize = 2;
/// A check of an upload has this share of the memory that an import has.
const CHECK_MEMORY_SHARE: u64 = 4;

/// Why a scan was not read.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
    /// The scan is at fault, or the reading was cancelled.
    #[error(transparent)]
    Ingest(#[from] IngestError),
    /// The system killed the child process.
    #[error(
        "the process that decoded the scan was killed by the system, which may be out of memory"
    )]
    Killed,
    /// The child process could not be started or talked to.
    #[error("the process that reads scans could not be run")]
    Process(#[from] io::Error),
}

/// Runs [`Task`]s. Cheap to clone.
#[derive(Debug, Clone)]
pub struct ScanReader {
    how: ReaderMode,
    checks: Arc<Semaphore>,
}

#[derive(Debug, Clone)]
enum ReaderMode {
    InProcess,
    Isolated(Arc<ChildProcess>),
}

impl ScanReader {
    /// Reads in this process: for programs whose scans are their user's own.
    #[must_use]
    pub fn in_process() -> Self {
        Self::of(ReaderMode::InProcess)
    }

    /// Reads in child processes.
    #[must_use]
    pub fn isolated(child: ChildProcess) -> Self {
        Self::of(ReaderMode::Isolated(Arc::new(child)))
    }

    fn of(how: ReaderMode) -> Self {
        Self { how, checks: Arc::new(Semaphore::new(MAX_CONCURRENT_CHECKS)) }
    }

    /// Runs the check of an upload as soon as one of the places for checks is free.
    ///
    /// # Errors
    /// [`ReadError`].
    pub async fn check(&self, task: Task) -> Result<TaskOutcome, ReadError> {
        let permit = self.checks.clone().acquire_owned().await.map_err(io::Error::other)?;
        let (reader, span) = (self.clone(), tracing::Span::current());
        let run = move || {
            let (_permit, _entered) = (permit, span.entered());
            reader.run(&task, CHECK_MEMORY_SHARE, &Progress::silent())
        };
        spawn_blocking(run).await.map_err(io::Error::other)?
    }

    /// Runs a task with all of the memory, as imports are; blocks.
    ///
    /// # Errors
    /// [`ReadError`], also when it was cancelled.
    pub fn import(&self, task: &Task, progress: &Progress) -> Result<TaskOutcome, ReadError> {
        self.run(task, 1, progress)
    }

    fn run(
        &self,
        task: &Task,
        memory_share: u64,
        progress: &Progress,
    ) -> Result<TaskOutcome, ReadError> {
        match &self.how {
            ReaderMode::InProcess => Ok(task.run(progress)?),
            ReaderMode::Isolated(child) => child.run(task, memory_share, progress),
        }
    }
}
