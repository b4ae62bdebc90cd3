//! Long work in the background: a durable queue, workers, progress and events. Knows no kind of job.
//!
//! A kind is a name and a [`Handler`]; [`service`](crate::service) defines the kinds and `app` registers them. A running job's
//! progress is read from memory; its row is updated twice a second, so that a restarted server knows roughly where it was.

mod queue;
mod worker;

pub use queue::{Jobs, JobsError};
pub use worker::{Handler, JobContext, JobFailure};

use crate::store::JobRow;
pub use crate::store::JobState;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// A job as the outside sees it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Job {
    pub id: String,
    /// What it does: `parse`, `naming`.
    pub kind: String,
    pub state: JobState,
    /// Step it is in.
    pub stage: Option<String>,
    /// `0..=1`.
    pub progress: f32,
    /// Estimated seconds left; `null` while too little is done to tell.
    pub eta_s: Option<f32>,
    pub attempts: u32,
    /// What came out of it, in a sentence.
    pub message: Option<String>,
    /// Why it failed.
    pub error: Option<JobError>,
    pub created_at: String,
    pub started_at: Option<String>,
    pub finished_at: Option<String>,
}

/// Why a job failed; `code` is stable.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct JobError {
    pub code: String,
    pub detail: String,
}

/// Below this progress an estimate is a guess.
const MIN_PROGRESS_FOR_ETA: f32 = 0.03;

impl Job {
    /// A stored job, seen at `now`.
    #[must_use]
    pub fn from_row(row: JobRow, now: Timestamp) -> Self {
        let JobRow {
            id,
            kind,
            subject: _,
            payload: _,
            state,
            stage,
            progress,
            attempts,
            message,
            error_code,
            error,
            created_at,
            started_at,
            finished_at,
        } = row;
        let progress = progress as f32;
        let running_s = started_at
            .as_ref()
            .and_then(|t| t.parse::<Timestamp>().ok())
            .map(|start| now.duration_since(start).as_secs_f32());
        let eta_s = running_s
            .filter(|_| state == JobState::Running && progress >= MIN_PROGRESS_FOR_ETA)
            .map(|elapsed| elapsed * (1.0 - progress) / progress);
        Self {
            id,
            kind,
            state,
            stage,
            progress,
            eta_s,
            attempts: u32::try_from(attempts).unwrap_or(0),
            message,
            error: error_code.map(|code| JobError { code, detail: error.unwrap_or_default() }),
            created_at,
            started_at,
            finished_at,
        }
    }
}
