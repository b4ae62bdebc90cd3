//! `/v1/batches`

use super::extract::{IdempotencyKey, Json, Path, Query};
use super::paging::Page;
use super::problem::ProblemResponse;
use super::problems;
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
use utoipa::IntoParams;

/// Options of a batch sent as JSONL.
#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct CreateParameters {
    /// JSONL only: scene of items without one.
    scene_id: Option<String>,
    /// JSONL only: display name.
    #[param(max_length = 200)]
    label: Option<String>,
    /// JSONL only: number of questions answered in parallel.
    #[param(minimum = 1, maximum = 64)]
    concurrency: Option<u32>,
    /// JSONL only: spending limit for the whole batch, US dollars.
    #[param(minimum = 0)]
    max_cost_usd: Option<f64>,
}

/// Submits a batch of questions that run in the background.
///
/// The body is JSON, or JSONL (`application/jsonl`) with one question per line, which is streamed
/// and may have 100,000 lines. A first line `{"defaults": {…}}` applies to all items. An invalid
/// question only fails its item; a line that is not a JSON object rejects the batch. No question
/// runs twice, even after a restart, or when the same list is sent again with its
/// `Idempotency-Key`.
#[utoipa::path(
    post, path = "/v1/batches", operation_id = "create_batch", tag = "batches",
    params(CreateParameters, ("Idempotency-Key" = Option<String>, Header, description = "A repeated key returns the batch of the first request")),
    request_body(content((BatchRequest = "application/json"), (String = "application/jsonl"))),
    responses(
        (status = 202, body = Batch),
        problems::Common, problems::BadRequest, problems::Forbidden, problems::TooLarge,
        problems::UnsupportedMediaType, problems::Unprocessable,
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
                    "put these options into the JSON body: defaults.scene_id, label, concurrency, \
                     max_cost_usd",
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
            let detail =
                format!("a batch must be application/json or application/jsonl, not {other:?}");
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
        problems::Common, problems::Unprocessable,
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

/// Returns a batch with its progress, cost and estimated remaining time.
#[utoipa::path(
    get, path = "/v1/batches/{batch_id}", operation_id = "get_batch", tag = "batches", params(("batch_id" = String, Path)),
    responses(
        (status = 200, body = Batch),
        problems::Common, problems::NotFound,
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
    /// Index of the first item to return. Use it to resume an interrupted download.
    #[serde(default)]
    #[param(minimum = 0, default = 0)]
    from: u32,
    /// Format: `jsonl` or `csv`.
    #[serde(default)]
    #[param(inline)]
    format: LineFormat,
    /// Whether to wait for running items until the batch ends or pauses. If `false`, the results
    /// end before the first unfinished item.
    #[serde(default)]
    follow: bool,
}

/// Returns the results in the order of the items, one per line.
#[utoipa::path(
    get, path = "/v1/batches/{batch_id}/results", operation_id = "get_batch_results", tag = "batches", params(("batch_id" = String, Path), ResultParameters),
    responses(
        (status = 200, content((BatchResult = "application/jsonl"), (String = "text/csv"))),
        problems::Common, problems::NotFound, problems::Unprocessable,
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
    // Ends the stream on shutdown, so that a follower does not delay it.
    let results = futures::StreamExt::take_until(results, shutdown);
    Ok(([(header::CONTENT_TYPE, media_type_of(format))], Body::from_stream(results)))
}

/// Returns the media type of a line format.
pub(super) fn media_type_of(format: LineFormat) -> &'static str {
    match format {
        LineFormat::Jsonl => "application/jsonl",
        LineFormat::Csv => "text/csv; charset=utf-8",
    }
}

/// Pauses a batch. Running questions are finished.
#[utoipa::path(
    post, path = "/v1/batches/{batch_id}/pause", operation_id = "pause_batch", tag = "batches", params(("batch_id" = String, Path)),
    responses(
        (status = 200, body = Batch),
        problems::Common, problems::Forbidden, problems::NotFound, problems::Conflict,
    ),
    security(("key" = ["write"]), ())
)]
pub async fn pause(
    State(app): State<App>,
    Path(batch_id): Path<String>,
) -> Result<axum::Json<Batch>, ProblemResponse> {
    Ok(axum::Json(app.services.batches.pause_batch(&batch_id).await?))
}

/// Resumes a paused batch.
#[utoipa::path(
    post, path = "/v1/batches/{batch_id}/resume", operation_id = "resume_batch", tag = "batches", params(("batch_id" = String, Path)),
    responses(
        (status = 200, body = Batch),
        problems::Common, problems::Forbidden, problems::NotFound, problems::Conflict,
    ),
    security(("key" = ["write"]), ())
)]
pub async fn resume(
    State(app): State<App>,
    Path(batch_id): Path<String>,
) -> Result<axum::Json<Batch>, ProblemResponse> {
    Ok(axum::Json(app.services.batches.resume_batch(&batch_id).await?))
}

/// Cancels a batch. Existing answers are kept.
#[utoipa::path(
    post, path = "/v1/batches/{batch_id}/cancel", operation_id = "cancel_batch", tag = "batches", params(("batch_id" = String, Path)),
    responses(
        (status = 200, body = Batch),
        problems::Common, problems::Forbidden, problems::NotFound, problems::Conflict,
    ),
    security(("key" = ["write"]), ())
)]
pub async fn cancel(
    State(app): State<App>,
    Path(batch_id): Path<String>,
) -> Result<axum::Json<Batch>, ProblemResponse> {
    Ok(axum::Json(app.services.batches.cancel_batch(&batch_id).await?))
}
