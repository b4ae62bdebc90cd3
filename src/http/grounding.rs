//! `/v1/scenes/{scene_id}/ground` and `/shortlist`, and `/v1/ground`

use super::extract::{IdempotencyKey, Json, ScenePath};
use super::problem::ProblemResponse;
use super::problems;
use super::{App, CallerExtension};
use axum::Extension;
use axum::extract::State;
use axum::http::{HeaderMap, HeaderValue};
use axum::response::{IntoResponse, Response};
use uniground_types::answer::{Answer, Shortlisted};
use uniground_types::many::{ManyAnswers, ManyGroundRequest};
use uniground_types::question::{GroundRequest, ShortlistRequest};

/// Answers a question about a parsed scene.
///
/// `no_match` and `ambiguous` are results, not errors: `box` is `null` and, for `ambiguous`,
/// `alternatives` lists the tied objects.
#[utoipa::path(
    post, path = "/v1/scenes/{scene_id}/ground", operation_id = "ground", tag = "grounding",
    params(
        ("scene_id" = String, Path),
        ("Idempotency-Key" = Option<String>, Header, description = "A repeated key returns the first answer, so that a retry does not call the model again"),
    ),
    request_body = GroundRequest,
    responses(
        (status = 200, body = Answer, headers(("Idempotent-Replayed" = Option<String>, description = "`true` if the answer was stored earlier under the same `Idempotency-Key`"))),
        problems::Common, problems::BadRequest, problems::BudgetSpent, problems::NotFound,
        problems::Conflict, problems::TooLarge, problems::UnsupportedMediaType,
        problems::Unprocessable, problems::BadGateway, problems::Unavailable,
        problems::GatewayTimeout,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn ground(
    State(app): State<App>,
    ScenePath(scene_id): ScenePath<String>,
    Extension(caller): CallerExtension,
    IdempotencyKey(key): IdempotencyKey,
    Json(request): Json<GroundRequest>,
) -> Result<Response, ProblemResponse> {
    let Some(key) = key else {
        return Ok(axum::Json(app.services.grounding.ground(&scene_id, request, caller).await?)
            .into_response());
    };
    let (answer, is_replayed) =
        app.services.grounding.ground_once(&scene_id, request, caller, key).await?;
    let mut response = axum::Json(answer).into_response();
    if is_replayed {
        response.headers_mut().insert("idempotent-replayed", HeaderValue::from_static("true"));
    }
    Ok(response)
}

/// Finds the scenes that contain an object.
///
/// Searches every scene without a model, then answers the question for the most likely scenes and
/// stores these answers. Each of them counts towards the rate limit of the key. `Idempotency-Key`
/// is not supported.
#[utoipa::path(
    post, path = "/v1/ground", operation_id = "ground_many", tag = "grounding", request_body = ManyGroundRequest,
    responses(
        (status = 200, body = ManyAnswers),
        problems::Common, problems::BadRequest, problems::BudgetSpent, problems::NotFound,
        problems::Conflict, problems::TooLarge, problems::UnsupportedMediaType,
        problems::Unprocessable, problems::BadGateway, problems::Unavailable,
        problems::GatewayTimeout,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn ground_many(
    State(app): State<App>,
    Extension(caller): CallerExtension,
    headers: HeaderMap,
    Json(request): Json<ManyGroundRequest>,
) -> Result<axum::Json<ManyAnswers>, ProblemResponse> {
    // Rejects the header, because a client that relies on it could pay twice.
    if headers.contains_key("idempotency-key") {
        return Err(ProblemResponse::invalid(
            "Idempotency-Key",
            "is not supported for questions about many scenes: the stored answers are in \
             /v1/answers",
        ));
    }
    Ok(axum::Json(app.services.grounding.ground_many(request, caller).await?))
}

/// Returns the candidates for a query without spatial reasoning.
///
/// Candidates are ranked by appearance if an encoder has processed the scene, else by names and
/// attributes.
#[utoipa::path(
    post, path = "/v1/scenes/{scene_id}/shortlist", operation_id = "shortlist", tag = "grounding", params(("scene_id" = String, Path)), request_body = ShortlistRequest,
    responses(
        (status = 200, body = Shortlisted),
        problems::Common, problems::BadRequest, problems::NotFound, problems::Conflict,
        problems::TooLarge, problems::UnsupportedMediaType, problems::Unprocessable,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn shortlist(
    State(app): State<App>,
    ScenePath(scene_id): ScenePath<String>,
    Json(request): Json<ShortlistRequest>,
) -> Result<axum::Json<Shortlisted>, ProblemResponse> {
    Ok(axum::Json(app.services.grounding.shortlist(&scene_id, request).await?))
}
