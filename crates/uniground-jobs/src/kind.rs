//! The trait of a kind of job.

use serde::Serialize;
use serde::de::DeserializeOwned;
use std::time::Duration;
use tokio_util::sync::CancellationToken;
use uniground_geometry::progress::Progress;
use uniground_storage::JobLease;

/// A kind of job: its name, its payload, and how it runs. Each kind has its own queue.
pub trait JobKind: Send + Sync + 'static {
    /// Stored with every job, so it never changes.
    const NAME: &'static str;
    /// Default number of jobs of this kind that run concurrently in one process.
    const CONCURRENCY: usize;
    const RETRY: Retry;
    /// Stored as JSON. Payloads of earlier versions must remain readable.
    type Payload: Serialize + DeserializeOwned + Send + Sync;

    /// Runs the job. Returns a sentence about the result.
    fn run(
        &self,
        job: JobContext<Self::Payload>,
    ) -> impl Future<Output = Result<String, JobFailure>> + Send;
}

/// When a job is retried.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Retry {
    /// Number of interruptions (ends of its process) in a row, without further progress, after
    /// which a job fails.
    pub interrupted: u32,
    /// Maximum number of attempts for transient failures.
    pub transient: u32,
    /// The delay after a transient failure. It doubles from one failure to the next.
    pub backoff: Duration,
}

/// What a running job gets.
pub struct JobContext<P> {
    /// The lease under which all results of the job are written.
    pub lease: JobLease,
    /// Cancelled once the lease has passed to another worker, because this process missed its
    /// heartbeats. Results are then discarded, and the job must not spend any more money.
    pub lost: CancellationToken,
    pub payload: P,
    /// Reports progress and signals cancellation.
    pub progress: Progress,
}

/// How a job can fail.
#[derive(Debug)]
pub enum JobFailure {
    Failed {
        /// A stable code.
        code: String,
        /// The message for the caller.
        detail: String,
        /// For the log: the error with its causes.
        cause: String,
        /// A retry may succeed: a server that does not answer, a full disk.
        transient: bool,
    },
    Cancelled,
}
