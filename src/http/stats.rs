//! `/metrics` and `/v1/stats`, and the layer that counts requests.

use super::App;
use super::problem::ProblemResponse;
use super::problems;
use axum::Json;
use axum::extract::{MatchedPath, Request, State};
use axum::http::header;
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use uniground_telemetry::metrics::MEDIA_TYPE;
use uniground_types::stats::Stats;

/// Returns statistics of the server: stored data, jobs, spending, disk usage and retention.
#[utoipa::path(
    get, path = "/v1/stats", operation_id = "get_stats", tag = "service",
    responses(
        (status = 200, body = Stats),
        problems::Common,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn stats(State(app): State<App>) -> Result<Json<Stats>, ProblemResponse> {
    Ok(Json(app.services.stats.stats().await?))
}

/// Returns metrics for Prometheus in the `OpenMetrics` text format.
#[utoipa::path(
    get, path = "/metrics", operation_id = "metrics", tag = "service",
    responses(
        (status = 200, body = String, content_type = "application/openmetrics-text"),
        problems::Common,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn metrics(State(app): State<App>) -> Response {
    app.metrics.requests.event_streams.set(app.event_streams.open() as i64);
    ([(header::CONTENT_TYPE, MEDIA_TYPE)], app.services.stats.scrape().await).into_response()
}

/// Counts a request and its outcome.
pub async fn count_request(State(app): State<App>, request: Request, next: Next) -> Response {
    let route = request.extensions().get::<MatchedPath>().map(MatchedPath::as_str);
    let underway = app.metrics.requests.begin(request.method().as_str(), route);
    let response = next.run(request).await;
    underway.finish(response.status().as_u16());
    response
}
