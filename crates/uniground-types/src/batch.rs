//! Batches: lists of questions that run in the background.

use crate::job::JobError;
use crate::question::GroundRequest;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use std::collections::BTreeMap;

/// One question of a batch: the scene and all fields of a question.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct BatchItem {
    /// UUIDv7 of the scene.
    pub scene_id: String,
    /// The question.
    #[serde(flatten)]
    pub request: GroundRequest,
}

/// A new batch: a list of questions and common options.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct BatchRequest {
    /// Questions with `scene_id`, `query` and any other fields of a question. Send longer lists as
    /// JSONL, one item per line.
    #[cfg_attr(feature = "openapi", schema(value_type = Vec<BatchItem>))]
    pub items: Vec<Map<String, Value>>,
    /// Default fields of all items, may include `scene_id`. Fields of an item take precedence.
    #[serde(default)]
    #[cfg_attr(feature = "openapi", schema(value_type = Object))]
    pub defaults: Map<String, Value>,
    /// Display name, at most 200 characters.
    #[cfg_attr(feature = "openapi", schema(max_length = 200))]
    pub label: Option<String>,
    /// Number of questions answered in parallel, 1 to 64. Default: 4.
    #[cfg_attr(feature = "openapi", schema(minimum = 1, maximum = 64))]
    pub concurrency: Option<u32>,
    /// Spending limit for the whole batch, US dollars. The batch pauses when it is reached. If set,
    /// `auto` items use the vision-language model.
    #[cfg_attr(feature = "openapi", schema(minimum = 0))]
    pub max_cost_usd: Option<f64>,
}

/// State of a batch.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum BatchState {
    /// Its questions are running or queued.
    Running,
    /// Paused by a user, or for the cause in `reason`. It can be resumed.
    Paused,
    /// All items have an answer or an error.
    Succeeded,
    /// Cancelled. Remaining items will not run.
    Cancelled,
}

impl BatchState {
    /// Returns whether the state is final.
    #[must_use]
    pub fn is_final(self) -> bool {
        matches!(self, Self::Succeeded | Self::Cancelled)
    }
}

/// A batch and its progress.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Batch {
    /// UUIDv7, so ids sort by time.
    pub id: String,
    /// Display name.
    pub label: Option<String>,
    /// State of the batch.
    pub state: BatchState,
    /// Why the server paused the batch: a stable code. Absent if a user paused it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// Number of questions.
    pub items: u32,
    /// Number of questions that are answered or failed.
    pub done: u32,
    /// Number of finished questions by answer status, or `failed`.
    pub by_status: BTreeMap<String, u32>,
    /// Cost of the answers, US dollars.
    pub cost_usd: f64,
    /// Estimated seconds until the batch is finished. Absent while unknown.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub eta_s: Option<f32>,
    /// Id of the job that runs the batch. Its progress is at `/v1/jobs/{job_id}/events`.
    pub job_id: Option<String>,
    /// Creation time, RFC 3339 UTC.
    pub created_at: String,
    /// Completion time, RFC 3339 UTC. `null` until then.
    pub finished_at: Option<String>,
}

/// A page of batches, newest first.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct BatchList {
    /// Batches, newest first.
    pub batches: Vec<Batch>,
    /// Cursor of the next page. `null` on the last page.
    pub next_cursor: Option<String>,
}

/// Result of one item: one line of the results.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct BatchResult {
    /// Index of the item in the batch, from 0.
    pub item: u32,
    /// UUIDv7 of the scene.
    pub scene_id: String,
    /// The question. Empty if the item has none.
    pub query: String,
    /// Status of the answer, or `failed`.
    pub status: String,
    /// Id of the answer, available at `/v1/answers/{answer_id}`.
    pub answer_id: String,
    /// The complete answer. `null` if the item failed, or if its scene or answer was deleted.
    #[cfg_attr(feature = "openapi", schema(value_type = Option<crate::answer::Answer>))]
    pub answer: Option<Value>,
    /// Why the item failed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<JobError>,
}
