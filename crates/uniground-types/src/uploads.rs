//! Uploads that come in parts, as callers see them.

use crate::problem::Problem;
use serde::{Deserialize, Serialize};

/// How far an upload has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum UploadState {
    /// More bytes are waited for.
    Receiving,
    /// All of it is there; it is unpacked and checked.
    Making,
    /// It has become a scene.
    Done,
    /// It is no scan that can be read; see `problem`.
    Refused,
}

/// An upload that comes in parts.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Upload {
    /// UUIDv7; in order of time.
    pub id: String,
    /// How far it has come.
    pub state: UploadState,
    /// Bytes that are on the server's disk: where to go on.
    pub offset: u64,
    /// Bytes it will have.
    pub length: u64,
    /// When it is removed unless more of it comes, RFC 3339 UTC; of one that is over, when it is
    /// forgotten. `null`: never.
    pub expires_at: Option<String>,
    /// The scene it has become.
    pub scene_id: Option<String>,
    /// The job that parses the scene; `null` where it was only to be stored.
    pub job_id: Option<String>,
    /// Why it was refused.
    pub problem: Option<Problem>,
    /// When it was begun, RFC 3339 UTC.
    pub created_at: String,
}
