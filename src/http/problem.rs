//! API errors: RFC 9457 problem details with a stable code. The only module that maps errors to
//! HTTP statuses.

use super::REQUEST_ID;
use axum::Json;
use axum::extract::Request;
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, Uri, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use uniground_core::ingest::IngestErrorKind;
use uniground_core::models::with_causes;
use uniground_jobs::JobsError;
use uniground_service::error::Error;
use uniground_types::problem::{FieldError, Problem};

/// An error response with its problem.
#[derive(Debug, Clone)]
pub struct ProblemResponse(Box<Problem>);

impl ProblemResponse {
    pub fn new(status: StatusCode, code: &str, detail: impl Into<String>) -> Self {
        Self(Box::new(Problem {
            kind: "about:blank".into(),
            title: title_of(status).into(),
            status: status.as_u16(),
            detail: detail.into(),
            code: code.into(),
            request_id: None,
            errors: Vec::new(),
            job_id: None,
            retry_after_s: None,
        }))
    }

    #[must_use]
    pub fn internal() -> Self {
        Self::new(
            StatusCode::INTERNAL_SERVER_ERROR,
            "internal",
            "internal server error: the cause is in the server's log",
        )
    }

    /// Returns the error for an exhausted connection limit.
    #[must_use]
    pub fn too_many_connections() -> Self {
        Self::new(
            StatusCode::SERVICE_UNAVAILABLE,
            "overloaded",
            "too many connections: try again in a moment",
        )
    }

    /// Returns the problem.
    #[must_use]
    pub fn problem(self) -> Problem {
        *self.0
    }

    /// Returns the problem as JSON.
    #[must_use]
    pub fn body(&self) -> String {
        serde_json::json!(*self.0).to_string()
    }

    /// Sets `Retry-After`, in seconds.
    #[must_use]
    pub fn retry_after(mut self, seconds: u32) -> Self {
        self.0.retry_after_s = Some(seconds);
        self
    }

    pub fn invalid(pointer: impl Into<String>, detail: impl Into<String>) -> Self {
        let (pointer, detail) = (pointer.into(), detail.into());
        let mut refused = Self::new(
            StatusCode::UNPROCESSABLE_ENTITY,
            "invalid_request",
            format!("{pointer}: {detail}"),
        );
        refused.0.errors.push(FieldError { pointer, detail });
        refused
    }
}

impl From<Problem> for ProblemResponse {
    fn from(problem: Problem) -> Self {
        Self(Box::new(problem))
    }
}

/// Converts an error to a problem.
#[must_use]
pub fn to_problem(error: Error) -> Problem {
    ProblemResponse::from(error).problem()
}

impl From<Error> for ProblemResponse {
    fn from(error: Error) -> Self {
        let (code, status) = (error.code(), status_of(&error));
        // The only log line about the error. The span of the request adds its route and id.
        match status {
            StatusCode::BAD_GATEWAY | StatusCode::GATEWAY_TIMEOUT => {
                tracing::warn!(code, cause = with_causes(&error), "request failed");
            }
            // Already logged when the model went down.
            _ if matches!(error, Error::VlmDown { .. }) => tracing::debug!(code, "request failed"),
            _ if status.is_server_error() => {
                tracing::error!(code, cause = with_causes(&error), "request failed");
            }
            _ => tracing::debug!(code, cause = with_causes(&error), "request rejected"),
        }
        let detail = match status {
            // Internal causes are logged but not returned to the caller.
            StatusCode::INTERNAL_SERVER_ERROR => Self::internal().0.detail,
            StatusCode::INSUFFICIENT_STORAGE if error.is_disk_full() => {
                "the server's disk is full: delete scenes, or ask its operator to free space".into()
            }
            StatusCode::SERVICE_UNAVAILABLE if error.is_store_busy() => {
                "the server's database is busy: try again in a moment".into()
            }
            StatusCode::SERVICE_UNAVAILABLE if error.is_object_store_unavailable() => {
                "the object store cannot be reached: try again in a moment".into()
            }
            _ => error.to_string(),
        };
        let Self(mut problem) = Self::new(status, code, detail);
        match error {
            Error::Invalid { pointer, detail } => {
                problem.errors.push(FieldError { pointer, detail });
            }
            Error::SceneNotReady { job_id, .. } => problem.job_id = job_id,
            Error::Overloaded | Error::TooMany { .. } | Error::UploadBusy { .. } => {
                problem.retry_after_s = Some(1);
            }
            // An upload ends within minutes, or expires.
            Error::TooManyUploads { .. } => problem.retry_after_s = Some(60),
            Error::VlmDown { again_in_s } => problem.retry_after_s = u32::try_from(again_in_s).ok(),
            _ if status == StatusCode::SERVICE_UNAVAILABLE => problem.retry_after_s = Some(2),
            Error::Jobs(JobsError::QueueFull { again_in_s, .. }) => {
                problem.retry_after_s = Some(again_in_s);
            }
            _ => {}
        }
        Self(problem)
    }
}

/// Returns the status of an error. Without a wildcard for own kinds, so that new ones must be added
/// here.
fn status_of(error: &Error) -> StatusCode {
    if error.is_disk_full() {
        return StatusCode::INSUFFICIENT_STORAGE;
    }
    if error.is_store_busy() || error.is_object_store_unavailable() {
        return StatusCode::SERVICE_UNAVAILABLE;
    }
    match error {
        Error::Ingest(error) => match error.kind() {
            IngestErrorKind::ArchiveUnreadable
            | IngestErrorKind::UnsafeEntry
            | IngestErrorKind::UnknownLayout
            | IngestErrorKind::Malformed
            | IngestErrorKind::MissingFile
            | IngestErrorKind::MissingIntrinsics
            | IngestErrorKind::BadIntrinsics
            | IngestErrorKind::FrameCountMismatch
            | IngestErrorKind::BadPose
            | IngestErrorKind::EmptyCloud
            | IngestErrorKind::EmptyScene
            | IngestErrorKind::NoUsableFrames
            | IngestErrorKind::Frame
            | IngestErrorKind::IncompleteLayout
            | IngestErrorKind::UpUnknown
            | IngestErrorKind::UnitUnknown
            | IngestErrorKind::DoesNotBelong
            | IngestErrorKind::TooCostly
            | IngestErrorKind::NothingFits => StatusCode::UNPROCESSABLE_ENTITY,
            IngestErrorKind::ArchiveTooLarge => StatusCode::PAYLOAD_TOO_LARGE,
            IngestErrorKind::Cancelled => StatusCode::CONFLICT,
            IngestErrorKind::Io => StatusCode::INTERNAL_SERVER_ERROR,
        },
        Error::Parse(_)
        | Error::Invalid { .. }
        | Error::IdempotencyKeyReused
        | Error::NoScan { .. } => StatusCode::UNPROCESSABLE_ENTITY,
        Error::Jobs(error) => match error {
            JobsError::NotFound { .. } => StatusCode::NOT_FOUND,
            JobsError::QueueFull { .. } => StatusCode::TOO_MANY_REQUESTS,
            JobsError::Store(_) => StatusCode::INTERNAL_SERVER_ERROR,
        },
        Error::SceneNotFound { .. }
        | Error::SceneNameAmbiguous { .. }
        | Error::ImportNotFound { .. }
        | Error::InstanceNotFound { .. }
        | Error::ViewNotFound { .. }
        | Error::ReportPictureNotFound { .. }
        | Error::NoEmbeddings { .. }
        | Error::AnswerNotFound { .. }
        | Error::BatchNotFound { .. }
        | Error::KeyNotFound { .. }
        | Error::UploadNotFound { .. }
        | Error::CorrectionNotFound { .. }
        | Error::FrameNotFound { .. }
        | Error::NoVersion { .. }
        | Error::NoTranscript { .. }
        | Error::AnswerPictureNotFound { .. } => StatusCode::NOT_FOUND,
        Error::VlmNotConfigured
        | Error::NoMap { .. }
        | Error::ParseChanged { .. }
        | Error::NoSourceFrame { .. }
        | Error::SceneNotReady { .. }
        | Error::EncoderChanged { .. }
        | Error::BatchOver { .. }
        | Error::GrownTooOften { .. }
        | Error::GrowthOvertaken { .. }
        | Error::VersionsApart { .. }
        | Error::ScansApart { .. }
        | Error::WrongOffset { .. }
        | Error::CorrectionInUse { .. }
        | Error::NotAThing { .. }
        | Error::WasMerged { .. }
        | Error::NoParts { .. }
        | Error::TooManyCorrections { .. } => StatusCode::CONFLICT,
        Error::VlmFailed { .. } | Error::Model(_) => StatusCode::BAD_GATEWAY,
        Error::OverBudget(_) => StatusCode::PAYMENT_REQUIRED,
        Error::TooManyScenes { .. } | Error::KeyRefused | Error::ImportNotAllowed => {
            StatusCode::FORBIDDEN
        }
        Error::QuestionTimedOut { .. } | Error::ComparisonTimedOut { .. } => {
            StatusCode::GATEWAY_TIMEOUT
        }
        Error::DiskNearlyFull { .. } | Error::MemoryShort { .. } | Error::ReaderKilled => {
            StatusCode::INSUFFICIENT_STORAGE
        }
        Error::Overloaded | Error::TooMany { .. } | Error::TooManyUploads { .. } => {
            StatusCode::TOO_MANY_REQUESTS
        }
        Error::ParseDamaged { .. } | Error::VlmDown { .. } => StatusCode::SERVICE_UNAVAILABLE,
        Error::UploadTooSlow { .. } => StatusCode::REQUEST_TIMEOUT,
        Error::UploadTooLarge { .. } | Error::TooManyItems { .. } | Error::BatchTooLarge { .. } => {
            StatusCode::PAYLOAD_TOO_LARGE
        }
        Error::UploadInterrupted { .. } => StatusCode::BAD_REQUEST,
        Error::UploadExpired { .. } => StatusCode::GONE,
        Error::UploadBusy { .. } => StatusCode::LOCKED,
        Error::ChecksumMismatch => checksum_mismatch(),
        Error::Store(_) | Error::Io(_) | Error::AnswerNotStored | Error::Background(_) => {
            StatusCode::INTERNAL_SERVER_ERROR
        }
    }
}

/// Returns the title of a status. 460 is defined by tus.
pub(super) fn title_of(status: StatusCode) -> &'static str {
    status.canonical_reason().unwrap_or("Checksum Mismatch")
}

/// Returns tus's status for a checksum mismatch.
fn checksum_mismatch() -> StatusCode {
    StatusCode::from_u16(460).unwrap_or(StatusCode::BAD_REQUEST)
}

/// Maximum length of request content that is repeated in an error, characters.
const MAX_TEXT_CHARS: usize = 1000;

fn shorten(text: &mut String) {
    if let Some((cut, _)) = text.char_indices().nth(MAX_TEXT_CHARS) {
        text.truncate(cut);
        text.push_str("...");
    }
}

impl IntoResponse for ProblemResponse {
    fn into_response(self) -> Response {
        let mut problem = *self.0;
        shorten(&mut problem.detail);
        for FieldError { pointer, detail } in &mut problem.errors {
            shorten(pointer);
            shorten(detail);
        }
        let status =
            StatusCode::from_u16(problem.status).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
        let mut response = (status, Json(&problem)).into_response();
        response
            .headers_mut()
            .insert(header::CONTENT_TYPE, HeaderValue::from_static("application/problem+json"));
        if let Some(seconds) = problem.retry_after_s {
            response.headers_mut().insert(header::RETRY_AFTER, seconds.into());
        }
        response.extensions_mut().insert(problem);
        response
    }
}

/// Adds the request id to problem bodies.
pub async fn name_request(request: Request, next: Next) -> Response {
    let id = request_id(request.headers());
    let mut response = next.run(request).await;
    match response.extensions_mut().remove::<Problem>() {
        Some(problem) => {
            let headers = response.headers().clone();
            let mut named =
                ProblemResponse::from(Problem { request_id: id, ..problem }).into_response();
            // Keeps headers that handlers and layers added (like "Allow").
            headers.into_iter().filter_map(|(name, value)| Some((name?, value))).for_each(
                |(name, value)| {
                    if name != header::CONTENT_LENGTH {
                        named.headers_mut().insert(name, value);
                    }
                },
            );
            named
        }
        None => response,
    }
}

pub fn request_id(headers: &HeaderMap) -> Option<String> {
    headers.get(REQUEST_ID).and_then(|id| id.to_str().ok()).map(str::to_owned)
}

pub async fn no_such_route(uri: Uri) -> ProblemResponse {
    ProblemResponse::new(
        StatusCode::NOT_FOUND,
        "no_such_route",
        format!("there is no route {}", uri.path()),
    )
}

pub async fn method_not_allowed(method: Method, uri: Uri) -> ProblemResponse {
    ProblemResponse::new(
        StatusCode::METHOD_NOT_ALLOWED,
        "method_not_allowed",
        format!("the method {method} is not allowed for {}", uri.path()),
    )
}
