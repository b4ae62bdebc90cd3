//! API errors: RFC 9457 problem details with a stable code.

use serde::{Deserialize, Serialize};

/// An error. `code` is stable. `detail` is for people and names the file, frame or field.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Problem {
    /// Always `about:blank`. `code` identifies the problem.
    #[serde(rename = "type")]
    pub kind: String,
    /// HTTP status as text.
    pub title: String,
    /// HTTP status code.
    pub status: u16,
    /// Description of the error for people. The wording may change.
    pub detail: String,
    /// Stable error code for programs.
    #[cfg_attr(feature = "openapi", schema(example = "scene_not_found"))]
    pub code: String,
    /// Request id, as in the header `x-request-id`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub request_id: Option<String>,
    /// Invalid fields of the request.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub errors: Vec<FieldError>,
    /// Id of the job to wait for, if any.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub job_id: Option<String>,
    /// Seconds until a retry may succeed, as in the header `Retry-After`.
    #[serde(skip)]
    pub retry_after_s: Option<u32>,
}

/// An invalid field of a request.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct FieldError {
    /// JSON pointer into the request body, or the name of a query parameter.
    #[cfg_attr(feature = "openapi", schema(example = "/query"))]
    pub pointer: String,
    /// The expected value.
    pub detail: String,
}

impl FieldError {
    /// Creates an error. `detail` describes the expected value.
    pub fn new(pointer: impl Into<String>, detail: impl Into<String>) -> Self {
        Self { pointer: pointer.into(), detail: detail.into() }
    }
}

impl std::fmt::Display for FieldError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}: {}", self.pointer, self.detail)
    }
}

impl std::error::Error for FieldError {}
