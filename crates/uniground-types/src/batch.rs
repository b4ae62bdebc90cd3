//! Lists of questions that are asked in the background.

use crate::job::JobError;
use crate::question::GroundRequest;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use std::collections::BTreeMap;

/// One question of a batch: the scene, and all that a question may have.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct BatchItem {
    /// UUIDv7 of the scene that is asked about.
    pub scene_id: String,
    /// The question.
    #[serde(flatten)]
    pub request: GroundRequest,
}

/// A list of questions, and what holds for all of them.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct BatchRequest {
    /// Questions: `scene_id`, `query`, and whatever else a question may have. Longer lists are
    /// sent as JSONL, an item a line.
    #[cfg_attr(feature = "openapi", schema(value_type = Vec<BatchItem>))]
    pub items: Vec<Map<String, Value>>,
    /// Fields of every item that does not have them itself, `scene_id` too.
    #[serde(default)]
    #[cfg_attr(feature = "openapi", schema(value_type = Object))]
    pub defaults: Map<String, Value>,
    /// For people.
    #[cfg_attr(feature = "openapi", schema(max_length = 200))]
    pub label: Option<String>,
    /// Questions asked at once; default: 4.
    #[cfg_attr(feature = "openapi", schema(minimum = 1, maximum = 64))]
    pub concurrency: Option<u32>,
    /// Most that all questions together may cost, US dollars. Where it is spent, the batch pauses.
    /// With it, `auto` items are asked as `vlm`.
    #[cfg_attr(feature = "openapi", schema(minimum = 0))]
    pub max_cost_usd: Option<f64>,
}

/// Where a batch stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum BatchState {
    /// Its questions are being asked, or wait for their turn.
    Running,
    /// It waits to be resumed: somebody paused it, or `reason` says why.
    Paused,
    /// Every item is answered or has failed.
    Succeeded,
    /// What was not asked by then never will be.
    Cancelled,
}

impl BatchState {
    /// Whether it stays like this.
    #[must_use]
    pub fn is_final(self) -> bool {
        matches!(self, Self::Succeeded | Self::Cancelled)
    }
}

/// A batch as it stands.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Batch {
    /// UUIDv7; in order of time.
    pub id: String,
    /// As it was submitted.
    pub label: Option<String>,
    /// Where it stands.
    pub state: BatchState,
    /// Why it is paused, where nobody asked for that: a stable code.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// Questions in it.
    pub items: u32,
    /// Of those, answered or failed.
    pub done: u32,
    /// Done ones by the status of their answer, or `failed`.
    pub by_status: BTreeMap<String, u32>,
    /// What the answers cost, US dollars.
    pub cost_usd: f64,
    /// Seconds until all are done, as it went so far; absent while nobody can tell.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub eta_s: Option<f32>,
    /// The job that asks them: follow it at `/v1/jobs/{job_id}/events`.
    pub job_id: Option<String>,
    /// RFC 3339, UTC.
    pub created_at: String,
    /// RFC 3339, UTC.
    pub finished_at: Option<String>,
}

/// A page of batches, newest first.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct BatchList {
    /// Newest first.
    pub batches: Vec<Batch>,
    /// `cursor` of the next page; `null` on the last.
    pub next_cursor: Option<String>,
}

/// What came of one item: a line of the results.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct BatchResult {
    /// Its place in the batch, from 0.
    pub item: u32,
    /// The scene it asks about.
    pub scene_id: String,
    /// The question; empty where the item has none.
    pub query: String,
    /// Status of the answer, or `failed`.
    pub status: String,
    /// Where the answer is kept: `/v1/answers/{answer_id}`.
    pub answer_id: String,
    /// The answer, whole; `null` where the item failed, or its scene or its answer was deleted
    /// since.
    #[cfg_attr(feature = "openapi", schema(value_type = Option<crate::answer::Answer>))]
    pub answer: Option<Value>,
    /// Why it failed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<JobError>,
}
