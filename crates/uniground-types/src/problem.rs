//! Errors on the wire: RFC 9457 problem details with a stable code.

use serde::{Deserialize, Serialize};

/// An error. `code` is stable; `detail` is for people and names the file, frame or field.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Problem {
    /// Always `about:blank`: the code says which problem it is.
    #[serde(rename = "type")]
    pub kind: String,
    /// The status in words.
    pub title: String,
    /// HTTP status, as in the status line.
    pub status: u16,
    /// What was wrong with this very request, for people; wording may change.
    pub detail: String,
    /// Stable; what a program should look at.
    #[cfg_attr(feature = "openapi", schema(example = "scene_not_found"))]
    pub code: String,
    /// The same as the header `x-request-id`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub request_id: Option<String>,
    /// Fields of the request that are wrong.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub errors: Vec<FieldError>,
    /// The job to wait for, where there is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub job_id: Option<String>,
    /// Seconds to wait before trying again, where that helps: the header `Retry-After`.
    #[serde(skip)]
    pub retry_after_s: Option<u32>,
}

/// A field of a request that is wrong, and why.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct FieldError {
    /// JSON pointer into the request body, or the name of a query parameter.
    #[cfg_attr(feature = "openapi", schema(example = "/query"))]
    pub pointer: String,
    /// What would be right.
    pub detail: String,
}

impl FieldError {
    /// `detail` says what would be right.
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
