//! `/v1/links`

use super::extract::Json;
use super::problem::ProblemResponse;
use super::problems;
use super::{App, CallerExtension};
use axum::Extension;
use axum::extract::State;
use jiff::Timestamp;
use uniground_types::links::{LinkList, LinkRequest};

/// Creates signed links that work without a key for a limited time, for pictures, clouds and event
/// streams in a web page, where no header can be sent.
///
/// A link only allows reading its path and becomes invalid with its key. It is the path with the
/// query parameter `link`.
#[utoipa::path(
    post, path = "/v1/links", operation_id = "create_links", tag = "keys", request_body = LinkRequest,
    responses(
        (status = 200, body = LinkList),
        problems::Common, problems::BadRequest, problems::TooLarge, problems::UnsupportedMediaType,
        problems::Unprocessable,
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
