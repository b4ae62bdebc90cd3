//! `/v1/links`

use super::extract::Json;
use super::problem::ProblemResponse;
use super::{App, CallerExtension};
use axum::Extension;
use axum::extract::State;
use jiff::Timestamp;
use uniground_types::links::{LinkList, LinkRequest};
use uniground_types::problem::Problem;

/// Creates signed links that work without a key for a limited time, for pictures, clouds and event
/// streams in a web page, where no header can be sent.
///
/// A link only allows reading its path and becomes invalid with its key. It is the path with the
/// query parameter `link`.
#[utoipa::path(
    post, path = "/v1/links", operation_id = "create_links", tag = "keys", request_body = LinkRequest,
    responses(
        (status = 200, body = LinkList),
        (status = 400, body = Problem, content_type = "application/problem+json"),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 413, body = Problem, content_type = "application/problem+json"),
        (status = 415, body = Problem, content_type = "application/problem+json"),
        (status = 422, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["read"]), ())
)]
pub async fn create(
    State(app): State<App>,
    Extension(caller): CallerExtension,
    Json(request): Json<LinkRequest>,
) -> Result<axum::Json<LinkList>, ProblemResponse> {
    Ok(axum::Json(app.services.keyring.links(request, &caller, Timestamp::now())?))
}
