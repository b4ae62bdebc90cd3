//! `/v1/scenes/{scene_id}/ground` and `/shortlist`, and `/v1/ground`

use super::extract::{IdempotencyKey, Json, Path};
use super::problem::ProblemResponse;
use super::{App, CallerExtension};
use axum::Extension;
use axum::extract::State;
use axum::http::{HeaderMap, HeaderValue};
use axum::response::{IntoResponse, Response};
use uniground_types::answer::{Answer, Shortlisted};
use uniground_types::many::{ManyAnswers, ManyGroundRequest};
use uniground_types::problem::Problem;
use uniground_types::question::{GroundRequest, ShortlistRequest};

/// Grounds one expression in a parsed scene.
///
/// `no_match` and `ambiguous` are answers, not errors: `box` is `null` and, for `ambiguous`,
/// `alternatives` lists the tied objects.
#[utoipa::path(
    post, path = "/v1/scenes/{scene_id}/ground", operation_id = "ground", tag = "grounding",
    params(
        ("scene_id" = String, Path),
        ("Idempotency-Key" = Option<String>, Header, description = "The same key again returns the answer it got: a model is paid once, however often a question is sent"),
    ),
    request_body = GroundRequest,
    responses(
        (status = 200, body = Answer, headers(("Idempotent-Replayed" = Option<String>, description = "`true`: this answer was given before, under the same `Idempotency-Key`"))),
        (status = 400, body = Problem, content_type = "application/problem+json"),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 402, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 409, body = Problem, content_type = "application/problem+json"),
        (status = 413, body = Problem, content_type = "application/problem+json"),
        (status = 415, body = Problem, content_type = "application/problem+json"),
        (status = 422, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
        (status = 502, body = Problem, content_type = "application/problem+json"),
        (status = 503, body = Problem, content_type = "application/problem+json"),
        (status = 504, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["read"]), ())
)]
pub async fn ground(
    State(app): State<App>,
    Path(scene_id): Path<String>,
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

/// Finds out in which of many scenes something is.
///
/// Every scene is looked into without a model; those that most likely have it are asked in full,
/// and their answers kept. A key's rate counts each of these; there is no `Idempotency-Key`.
#[utoipa::path(
    post, path = "/v1/ground", operation_id = "ground_many", tag = "grounding", request_body = ManyGroundRequest,
    responses(
        (status = 200, body = ManyAnswers),
        (status = 400, body = Problem, content_type = "application/problem+json"),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 402, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 409, body = Problem, content_type = "application/problem+json"),
        (status = 413, body = Problem, content_type = "application/problem+json"),
        (status = 415, body = Problem, content_type = "application/problem+json"),
        (status = 422, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
        (status = 502, body = Problem, content_type = "application/problem+json"),
        (status = 503, body = Problem, content_type = "application/problem+json"),
        (status = 504, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["read"]), ())
)]
pub async fn ground_many(
    State(app): State<App>,
    Extension(caller): CallerExtension,
    headers: HeaderMap,
    Json(request): Json<ManyGroundRequest>,
) -> Result<axum::Json<ManyAnswers>, ProblemResponse> {
    // Better than to pay twice for who believes that it is heeded.
    if headers.contains_key("idempotency-key") {
        return Err(ProblemResponse::invalid(
            "Idempotency-Key",
            "questions about many scenes take none: what was answered is in /v1/answers",
        ));
    }
    Ok(axum::Json(app.services.grounding.ground_many(request, caller).await?))
}

/// The candidates for a query, without reasoning over relations.
///
/// By appearance where an encoder has seen the scene, by names and attributes otherwise.
#[utoipa::path(
    post, path = "/v1/scenes/{scene_id}/shortlist", operation_id = "shortlist", tag = "grounding", params(("scene_id" = String, Path)), request_body = ShortlistRequest,
    responses(
        (status = 200, body = Shortlisted),
        (status = 400, body = Problem, content_type = "application/problem+json"),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 409, body = Problem, content_type = "application/problem+json"),
        (status = 413, body = Problem, content_type = "application/problem+json"),
        (status = 415, body = Problem, content_type = "application/problem+json"),
        (status = 422, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["read"]), ())
)]
pub async fn shortlist(
    State(app): State<App>,
    Path(scene_id): Path<String>,
    Json(request): Json<ShortlistRequest>,
) -> Result<axum::Json<Shortlisted>, ProblemResponse> {
    Ok(axum::Json(app.services.grounding.shortlist(&scene_id, request).await?))
}
