//! `/v1/batches`

use super::extract::{IdempotencyKey, Json, Path, Query};
use super::paging::Page;
use super::problem::ProblemResponse;
use super::{App, CallerExtension};
use axum::Extension;
use axum::body::{Body, BodyDataStream};
use axum::extract::{FromRequest, Request, State};
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::IntoResponse;
use serde::Deserialize;
use serde_json::{Map, Value};
use uniground_service::{BatchBody, LineFormat, ResultRequest, Submission};
use uniground_types::batch::{Batch, BatchList, BatchRequest, BatchResult};
use uniground_types::problem::Problem;
use utoipa::IntoParams;

/// What JSONL can not say beside its items.
#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct CreateParameters {
    /// JSONL only: the scene of lines without one.
    scene_id: Option<String>,
    /// JSONL only: for people.
    #[param(max_length = 200)]
    label: Option<String>,
    /// JSONL only: questions asked at once.
    #[param(minimum = 1, maximum = 64)]
    concurrency: Option<u32>,
    /// JSONL only: most that all questions together may cost, US dollars.
    #[param(minimum = 0)]
    max_cost_usd: Option<f64>,
}

/// Submits a list of questions, to be asked in the background.
///
/// As JSON, or streamed as JSONL (`application/jsonl`), a question a line: 100,000 lines are no
/// trouble. A first line `{"defaults": {…}}` holds for all. What is wrong with one question is that
/// item's failure; a line that is no JSON object refuses the whole. Nothing is ever asked
/// twice: not after a restart, not when the same list is sent again under its `Idempotency-Key`.
#[utoipa::path(
    post, path = "/v1/batches", operation_id = "create_batch", tag = "batches",
    params(CreateParameters, ("Idempotency-Key" = Option<String>, Header, description = "The same key again returns the batch it made")),
    request_body(content((BatchRequest = "application/json"), (String = "application/jsonl"))),
    responses(
        (status = 202, body = Batch),
        (status = 400, body = Problem, content_type = "application/problem+json"),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 403, body = Problem, content_type = "application/problem+json"),
        (status = 413, body = Problem, content_type = "application/problem+json"),
        (status = 415, body = Problem, content_type = "application/problem+json"),
        (status = 422, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["write"]), ())
)]
pub async fn create(
    State(app): State<App>,
    Query(CreateParameters { scene_id, label, concurrency, max_cost_usd }): Query<CreateParameters>,
    Extension(caller): CallerExtension,
    IdempotencyKey(idempotency_key): IdempotencyKey,
    headers: HeaderMap,
    request: Request,
) -> Result<(StatusCode, axum::Json<Batch>), ProblemResponse> {
    let media_type = headers
        .get(header::CONTENT_TYPE)
        .and_then(|v| v.to_str().ok())
        .unwrap_or_default()
        .split(';')
        .next()
        .unwrap_or_default()
        .trim()
        .to_ascii_lowercase();
    let batch = match media_type.as_str() {
        "application/jsonl" | "application/x-ndjson" => {
            let defaults: Map<String, Value> =
                scene_id.map(|id| ("scene_id".to_owned(), Value::String(id))).into_iter().collect();
            let submission =
                Submission { label, concurrency, max_cost_usd, idempotency_key, defaults };
            app.services
                .batches
                .create_batch(
                    submission,
                    BatchBody::Lines(request.into_body().into_data_stream()),
                    &caller,
                )
                .await?
        }
        "application/json" => {
            if scene_id.is_some()
                || label.is_some()
                || concurrency.is_some()
                || max_cost_usd.is_some()
            {
                return Err(ProblemResponse::invalid(
                    "query",
                    "a JSON body says all of this itself: defaults.scene_id, label, concurrency, max_cost_usd",
                ));
            }
            let Json(request) = Json::<BatchRequest>::from_request(request, &()).await?;
            let (submission, items) = Submission::from_request(request, idempotency_key);
            app.services
                .batches
                .create_batch(submission, BatchBody::<BodyDataStream>::Items(items), &caller)
                .await?
        }
        other => {
            let detail = format!("a batch is application/json or application/jsonl, not {other:?}");
            return Err(ProblemResponse::new(
                StatusCode::UNSUPPORTED_MEDIA_TYPE,
                "unsupported_media_type",
                detail,
            ));
        }
    };
    Ok((StatusCode::ACCEPTED, axum::Json(batch)))
}

/// Lists batches, newest first.
#[utoipa::path(
    get, path = "/v1/batches", operation_id = "list_batches", tag = "batches", params(Page),
    responses(
        (status = 200, body = BatchList),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 422, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["read"]), ())
)]
pub async fn list(
    State(app): State<App>,
    Query(page): Query<Page>,
) -> Result<axum::Json<BatchList>, ProblemResponse> {
    let (limit, cursor) = page.validate()?;
    Ok(axum::Json(app.services.batches.batches(limit, cursor.as_deref()).await?))
}

/// A batch as it stands: how far it is, what it cost, how long it will take.
#[utoipa::path(
    get, path = "/v1/batches/{batch_id}", operation_id = "get_batch", tag = "batches", params(("batch_id" = String, Path)),
    responses(
        (status = 200, body = Batch),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["read"]), ())
)]
pub async fn get(
    State(app): State<App>,
    Path(batch_id): Path<String>,
) -> Result<axum::Json<Batch>, ProblemResponse> {
    Ok(axum::Json(app.services.batches.batch(&batch_id).await?))
}

#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct ResultParameters {
    /// The first item wanted: who was cut off goes on here.
    #[serde(default)]
    #[param(minimum = 0, default = 0)]
    from: u32,
    /// `jsonl` or `csv`.
    #[serde(default)]
    #[param(inline)]
    format: LineFormat,
    /// Wait for items that are still asked, until the batch ends or pauses; else the results end
    /// at the first that is.
    #[serde(default)]
    follow: bool,
}

/// Results in the order of the items, a line each, as far as they are there.
#[utoipa::path(
    get, path = "/v1/batches/{batch_id}/results", operation_id = "get_batch_results", tag = "batches", params(("batch_id" = String, Path), ResultParameters),
    responses(
        (status = 200, content((BatchResult = "application/jsonl"), (String = "text/csv"))),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 422, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["read"]), ())
)]
pub async fn results(
    State(app): State<App>,
    Path(batch_id): Path<String>,
    Query(ResultParameters { from, format, follow }): Query<ResultParameters>,
) -> Result<impl IntoResponse, ProblemResponse> {
    let shutdown = app.shutdown.clone().cancelled_owned();
    let results = app
        .services
        .batches
        .batch_results(ResultRequest { batch_id, from, format, follow })
        .await?;
    // Who follows a batch does not keep the server from stopping.
    let results = futures::StreamExt::take_until(results, shutdown);
    Ok(([(header::CONTENT_TYPE, media_type_of(format))], Body::from_stream(results)))
}

/// Of things written one after the other.
pub(super) fn media_type_of(format: LineFormat) -> &'static str {
    match format {
        LineFormat::Jsonl => "application/jsonl",
        LineFormat::Csv => "text/csv; charset=utf-8",
    }
}

/// Stops asking until somebody resumes it. Questions under way are answered.
#[utoipa::path(
    post, path = "/v1/batches/{batch_id}/pause", operation_id = "pause_batch", tag = "batches", params(("batch_id" = String, Path)),
    responses(
        (status = 200, body = Batch),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 403, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 409, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["write"]), ())
)]
pub async fn pause(
    State(app): State<App>,
    Path(batch_id): Path<String>,
) -> Result<axum::Json<Batch>, ProblemResponse> {
    Ok(axum::Json(app.services.batches.pause_batch(&batch_id).await?))
}

/// Goes on with a batch that is paused.
#[utoipa::path(
    post, path = "/v1/batches/{batch_id}/resume", operation_id = "resume_batch", tag = "batches", params(("batch_id" = String, Path)),
    responses(
        (status = 200, body = Batch),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 403, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 409, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["write"]), ())
)]
pub async fn resume(
    State(app): State<App>,
    Path(batch_id): Path<String>,
) -> Result<axum::Json<Batch>, ProblemResponse> {
    Ok(axum::Json(app.services.batches.resume_batch(&batch_id).await?))
}

/// Stops asking for good. What is answered stays.
#[utoipa::path(
    post, path = "/v1/batches/{batch_id}/cancel", operation_id = "cancel_batch", tag = "batches", params(("batch_id" = String, Path)),
    responses(
        (status = 200, body = Batch),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 403, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 409, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["write"]), ())
)]
pub async fn cancel(
    State(app): State<App>,
    Path(batch_id): Path<String>,
) -> Result<axum::Json<Batch>, ProblemResponse> {
    Ok(axum::Json(app.services.batches.cancel_batch(&batch_id).await?))
}
