//! Background jobs: durable queues, one for each kind, with workers, progress and cancellation.
//! This crate defines no kinds.
//!
//! A kind is a [`JobKind`]. `uniground-service` defines the kinds, and `app` starts a lane, that is
//! a group of workers, for each. The progress of a running job is read from memory. Its row is
//! updated twice a second, for other processes and for the next start of this one.

mod kind;
mod queue;
mod request;
mod watchers;
mod worker;

pub use kind::{JobContext, JobFailure, JobKind, Retry};
pub use queue::{Jobs, JobsError};
pub use request::JobRequest;
pub use uniground_types::job::{Job, JobError, JobList};

use jiff::Timestamp;
use uniground_storage::{JobRow, JobState};

/// No remaining time is estimated below this progress.
const MIN_PROGRESS_FOR_ETA: f32 = 0.03;

/// Converts a stored job to its API form at the time `now`.
fn to_job(row: JobRow, now: Timestamp) -> Job {
    let JobRow {
        id,
        kind,
        subject,
        payload: _,
        state,
        stage,
        progress,
        attempts,
        failures: _,
        furthest,
        holder: _,
        message,
        error_code,
        error,
        created_at,
        started_at,
        finished_at,
    } = row;
    let (progress, furthest) = (progress as f32, furthest as f32);
    // Progress of earlier attempts took no time in this one.
    let own = progress - furthest;
    let running_s = started_at
        .as_ref()
        .and_then(|t| t.parse::<Timestamp>().ok())
        .map(|start| now.duration_since(start).as_secs_f32());
    let eta_s = running_s
        .filter(|_| state == JobState::Running && own >= MIN_PROGRESS_FOR_ETA)
        .map(|elapsed| elapsed * (1.0 - progress) / own);
    Job {
        id,
        kind,
        subject,
        state,
        ahead: None,
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
