//! Background jobs.

use serde::{Deserialize, Serialize};

/// State of a job. `succeeded`, `failed` and `cancelled` are final.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum JobState {
    /// Waits for a worker, or for a retry.
    Queued,
    /// A worker is running it.
    Running,
    /// Finished. `message` describes the result.
    Succeeded,
    /// Failed. `error` gives the reason.
    Failed,
    /// Cancelled by a user.
    Cancelled,
}

impl JobState {
    /// Returns whether the state is final.
    #[must_use]
    pub fn is_final(self) -> bool {
        matches!(self, Self::Succeeded | Self::Failed | Self::Cancelled)
    }
}

impl JobState {
    const ALL: [Self; 5] =
        [Self::Queued, Self::Running, Self::Succeeded, Self::Failed, Self::Cancelled];

    /// Returns the name of the state in JSON and the database.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Queued => "queued",
            Self::Running => "running",
            Self::Succeeded => "succeeded",
            Self::Failed => "failed",
            Self::Cancelled => "cancelled",
        }
    }
}

impl TryFrom<String> for JobState {
    type Error = String;

    fn try_from(word: String) -> Result<Self, String> {
        Self::ALL
            .into_iter()
            .find(|state| state.as_str() == word)
            .ok_or_else(|| format!("{word:?} is not a job state"))
    }
}

/// A background job.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Job {
    /// UUIDv7, so ids sort by time.
    pub id: String,
    /// Kind of job: `parse`, `full_parse`, `naming`, `batch`.
    pub kind: String,
    /// Id of the scene or batch it works on.
    #[serde(default)]
    pub subject: String,
    /// State of the job.
    pub state: JobState,
    /// Number of queued jobs of this kind created before this one. Set only for a queued job that
    /// is requested by id. Keys share the workers fairly, so a key with few jobs may wait for
    /// fewer.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ahead: Option<u32>,
    /// Current stage.
    pub stage: Option<String>,
    /// Progress, `0..=1`.
    pub progress: f32,
    /// Estimated remaining seconds. `null` while unknown.
    pub eta_s: Option<f32>,
    /// Number of starts. 0 while it waits for the first start, or if the result already existed.
    pub attempts: u32,
    /// Result, one sentence.
    pub message: Option<String>,
    /// Why it failed.
    pub error: Option<JobError>,
    /// Creation time, RFC 3339 UTC.
    pub created_at: String,
    /// Start time of the latest attempt, RFC 3339 UTC. `null` while queued.
    pub started_at: Option<String>,
    /// End time, RFC 3339 UTC. `null` until then.
    pub finished_at: Option<String>,
}

/// A page of jobs, newest first.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct JobList {
    /// Jobs, newest first.
    pub jobs: Vec<Job>,
    /// Cursor of the next page. `null` on the last page.
    pub next_cursor: Option<String>,
}

/// Error of a job or of a batch item. `code` is stable.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct JobError {
    /// Stable code, like the codes of problems. `interrupted` if the server stopped too often
    /// during the job.
    pub code: String,
    /// Description for people that names the file, frame or model.
    pub detail: String,
}
