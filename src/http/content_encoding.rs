//! Request bodies compressed with gzip. They are decompressed while they are read, so that the
//! limits on bodies apply to what they unpack to.

use super::problem::ProblemResponse;
use axum::extract::Request;
use axum::http::{StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

/// Refuses encodings that are not decompressed.
pub async fn check(request: Request, next: Next) -> Response {
    let encodings = request.headers().get_all(header::CONTENT_ENCODING);
    let unknown = encodings.iter().map(|value| value.to_str().unwrap_or_default()).find(|value| {
        !["gzip", "identity"].iter().any(|known| value.trim().eq_ignore_ascii_case(known))
    });
    match unknown {
        None => next.run(request).await,
        Some(value) => ProblemResponse::new(
            StatusCode::UNSUPPORTED_MEDIA_TYPE,
            "unsupported_media_type",
            format!("the body has the content encoding {value:?}: send it as it is, or with gzip"),
        )
        .into_response(),
    }
}
