//! What a kind of job is.

use serde::Serialize;
use serde::de::DeserializeOwned;
use std::time::Duration;
use tokio_util::sync::CancellationToken;
use uniground_geometry::progress::Progress;
use uniground_storage::JobLease;

/// A kind of job: its name, what it is asked to do, and how that is done. Every kind waits in a
/// queue of its own.
pub trait JobKind: Send + Sync + 'static {
    /// Stored with every job: it never changes.
    const NAME: &'static str;
    /// Jobs of this kind that run at once in one process, where nobody says otherwise.
    const CONCURRENCY: usize;
    const RETRY: Retry;
    /// Stored as JSON; what a server of yesterday has written must still be read.
    type Payload: Serialize + DeserializeOwned + Send + Sync;

    /// Does the work. The result is a sentence about what came out.
    fn run(
        &self,
        job: JobContext<Self::Payload>,
    ) -> impl Future<Output = Result<String, JobFailure>> + Send;
}

/// When a job is tried again.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Retry {
    /// After how many ends of its process in a row, without getting further than before, a job
    /// that was running fails.
    pub interrupted: u32,
    /// How often in all a job is tried whose failure may pass.
    pub transient: u32,
    /// The wait after such a failure; it doubles from one to the next.
    pub backoff: Duration,
}

/// What a job is run with.
pub struct JobContext<P> {
    /// What is written down of it is written in this hold.
    pub hold: JobLease,
    /// Cancelled once it was given to somebody else, because this process was not seen for longer
    /// than its lease: what comes of it counts for nothing, and nothing more may be bought for
    /// it.
    pub lost: CancellationToken,
    pub payload: P,
    /// Progress sink and cancellation in one.
    pub progress: Progress,
}

/// How a job ends badly.
#[derive(Debug)]
pub enum JobFailure {
    Failed {
        /// Stable.
        code: String,
        /// For the caller.
        detail: String,
        /// For the log: the error with everything that led to it.
        cause: String,
        /// It may pass: a server that does not answer, a full disk.
        transient: bool,
    },
    Cancelled,
}
