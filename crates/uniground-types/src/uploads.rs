//! Resumable uploads.

use crate::problem::Problem;
use serde::{Deserialize, Serialize};

/// State of an upload.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum UploadState {
    /// Waiting for more bytes.
    Receiving,
    /// Complete. The scan is being unpacked and checked.
    Making,
    /// The scene was created.
    Done,
    /// The scan is invalid. See `problem`.
    Refused,
}

/// A resumable upload.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Upload {
    /// UUIDv7, so ids sort by time.
    pub id: String,
    /// State of the upload.
    pub state: UploadState,
    /// Number of received bytes. Resume from this offset.
    pub offset: u64,
    /// Total number of bytes.
    pub length: u64,
    /// Time when the upload expires without further bytes, RFC 3339 UTC. For a finished upload,
    /// when its record is removed. `null`: never.
    pub expires_at: Option<String>,
    /// Id of the created scene.
    pub scene_id: Option<String>,
    /// Id of the parse job. `null` if the scan is only stored.
    pub job_id: Option<String>,
    /// Why the scan was rejected.
    pub problem: Option<Problem>,
    /// Creation time, RFC 3339 UTC.
    pub created_at: String,
}
