//! Decodes uploaded scans in child processes.
//!
//! Uploads are untrusted: a decoder may crash, run out of memory, or never end. A child process of
//! this program therefore decodes every file of an upload first, with limits on memory and time. It
//! returns its result as a message, and its unpacked or imported data as files. A fault ends the
//! child, never the service.
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

/// Maximum number of concurrent checks of uploads; further ones wait. The total memory of checks is
/// limited to this many times the limit of one.
const MAX_CONCURRENT_CHECKS: usize = 2;
/// The memory limit of an import divided by that of a check of an upload.
const CHECK_MEMORY_SHARE: u64 = 4;

/// Why a scan could not be read.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
    /// The scan is invalid, or reading was cancelled.
    #[error(transparent)]
    Ingest(#[from] IngestError),
    /// The system killed the child process.
    #[error("the system killed the process that reads the scan; the machine may be out of memory")]
    Killed,
    /// The child process could not be started, or communication with it failed.
    #[error("the process that reads scans failed")]
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
    /// Creates a reader that works in this process, for programs that read only trusted scans.
    #[must_use]
    pub fn in_process() -> Self {
        Self::with_mode(ReaderMode::InProcess)
    }

    /// Creates a reader that uses child processes.
    #[must_use]
    pub fn isolated(child: ChildProcess) -> Self {
        Self::with_mode(ReaderMode::Isolated(Arc::new(child)))
    }

    fn with_mode(how: ReaderMode) -> Self {
        Self { how, checks: Arc::new(Semaphore::new(MAX_CONCURRENT_CHECKS)) }
    }

    /// Runs the check of an upload as soon as a permit for checks is free.
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

    /// Runs a task with the full memory limit, as for imports; blocks.
    ///
    /// # Errors
    /// [`ReadError`], also after cancellation.
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
