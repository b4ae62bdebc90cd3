//! Work in the background.

use serde::{Deserialize, Serialize};

/// Where a job stands. `succeeded`, `failed` and `cancelled` are final.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum JobState {
    /// Waits for its turn, or for another try.
    Queued,
    /// A worker is at it.
    Running,
    /// Done; `message` says what came out.
    Succeeded,
    /// Given up; `error` says why.
    Failed,
    /// Stopped because somebody asked for it.
    Cancelled,
}

impl JobState {
    /// Whether it stays so: the job is over.
    #[must_use]
    pub fn is_final(self) -> bool {
        matches!(self, Self::Succeeded | Self::Failed | Self::Cancelled)
    }
}

impl JobState {
    const ALL: [Self; 5] =
        [Self::Queued, Self::Running, Self::Succeeded, Self::Failed, Self::Cancelled];

    /// As it is written everywhere.
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
            .ok_or_else(|| format!("{word:?} is no state of a job"))
    }
}

/// A job as the outside sees it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Job {
    /// UUIDv7; in order of time.
    pub id: String,
    /// What it does: `parse`, `naming`, `batch`.
    pub kind: String,
    /// What it works on: the id of a scene, or of a batch.
    #[serde(default)]
    pub subject: String,
    /// Where it stands.
    pub state: JobState,
    /// While it waits, and where one job is asked for: how many of its kind were asked for before
    /// it and wait as well. Keys take turns, so one with few jobs waits for fewer.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ahead: Option<u32>,
    /// Step it is in.
    pub stage: Option<String>,
    /// `0..=1`.
    pub progress: f32,
    /// Estimated seconds left; `null` while too little is done to tell.
    pub eta_s: Option<f32>,
    /// How often it was started; 0 while it waits for the first time, or when its result was there
    /// already.
    pub attempts: u32,
    /// What came out of it, in a sentence.
    pub message: Option<String>,
    /// Why it failed.
    pub error: Option<JobError>,
    /// When it was asked for, RFC 3339 UTC.
    pub created_at: String,
    /// When the latest attempt began, RFC 3339 UTC; `null` while it waits for its turn.
    pub started_at: Option<String>,
    /// When it ended, however it did, RFC 3339 UTC; `null` until then.
    pub finished_at: Option<String>,
}

/// A page of jobs, newest first.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct JobList {
    /// Newest first.
    pub jobs: Vec<Job>,
    /// `cursor` of the next page; `null` on the last.
    pub next_cursor: Option<String>,
}

/// Why a job, or an item of a batch, failed; `code` is stable.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct JobError {
    /// Stable, like the codes of problems; `interrupted` when the server stopped too often while
    /// the job ran.
    pub code: String,
    /// For people: names the file, frame or model at fault.
    pub detail: String,
}
