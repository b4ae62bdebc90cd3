//! `/v1/jobs`

use super::App;
use super::extract::{Path, Query};
use super::paging::{DEFAULT_LIMIT, validate};
use super::problem::ProblemResponse;
use super::problems;
use axum::Json;
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use axum::response::sse::{Event, KeepAlive, Sse};
use futures::{Stream, stream};
use serde::Deserialize;
use std::convert::Infallible;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;
use uniground_jobs::{Job, JobList};
use uniground_service::error::Error;
use uniground_storage::{JobFilter, JobState};
use utoipa::IntoParams;

/// An event of a job's stream.
#[derive(utoipa::ToSchema)]
#[expect(dead_code, reason = "the stream writes these fields as lines of text")]
pub struct JobEvent {
    /// Event id. Send it as `Last-Event-ID` to resume the stream.
    id: String,
    /// Event type: `progress` or `done`.
    event: String,
    /// The job as JSON.
    data: String,
}

/// Filters of the list. Omitted filters match everything.
#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct ListParameters {
    /// Kind of job: `parse`, `full_parse`, `naming`, `batch`.
    kind: Option<String>,
    /// State of the job.
    #[param(inline)]
    state: Option<JobState>,
    /// Id of the scene or batch that the job works on.
    subject: Option<String>,
    /// Number of entries per page.
    #[param(minimum = 1, maximum = 100, default = 20)]
    limit: Option<u32>,
    /// `next_cursor` of the previous page.
    cursor: Option<String>,
}

/// Lists jobs, newest first.
#[utoipa::path(
    get, path = "/v1/jobs", operation_id = "list_jobs", tag = "jobs", params(ListParameters),
    responses(
        (status = 200, body = JobList),
        problems::Common, problems::Unprocessable,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn list(
    State(app): State<App>,
    Query(parameters): Query<ListParameters>,
) -> Result<Json<JobList>, ProblemResponse> {
    let ListParameters { kind, state, subject, limit, cursor } = parameters;
    let (limit, cursor) = validate(limit.unwrap_or(DEFAULT_LIMIT), cursor)?;
    let filter = JobFilter { kind, state, subject };
    Ok(Json(app.services.jobs.list(&filter, limit, cursor.as_deref()).await.map_err(Error::from)?))
}

/// Returns a job.
#[utoipa::path(
    get, path = "/v1/jobs/{job_id}", operation_id = "get_job", tag = "jobs", params(("job_id" = String, Path)),
    responses(
        (status = 200, body = Job),
        problems::Common, problems::NotFound,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn get(
    State(app): State<App>,
    Path(job_id): Path<String>,
) -> Result<Json<Job>, ProblemResponse> {
    Ok(Json(app.services.jobs.get(&job_id).await.map_err(Error::from)?))
}

/// Requests the cancellation of a job. A finished job is not changed.
#[utoipa::path(
    delete, path = "/v1/jobs/{job_id}", operation_id = "cancel_job", tag = "jobs", params(("job_id" = String, Path)),
    responses(
        (status = 202, body = Job, description = "Cancellation requested; returns the job"),
        problems::Common, problems::Forbidden, problems::NotFound,
    ),
    security(("key" = ["write"]), ())
)]
pub async fn cancel(
    State(app): State<App>,
    Path(job_id): Path<String>,
) -> Result<(StatusCode, Json<Job>), ProblemResponse> {
    Ok((StatusCode::ACCEPTED, Json(app.services.jobs.cancel(&job_id).await.map_err(Error::from)?)))
}

/// Streams the progress of a job: `progress` events, then one `done` event. Their data is the job.
///
/// With `Last-Event-ID`, progress that the client has received is not sent again. The `done` event
/// is always sent.
#[utoipa::path(
    get, path = "/v1/jobs/{job_id}/events", operation_id = "follow_job", tag = "jobs",
    params(("job_id" = String, Path), ("Last-Event-ID" = Option<String>, Header)),
    responses(
        (status = 200, body = JobEvent, content_type = "text/event-stream"),
        problems::Common, problems::NotFound,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn events(
    State(app): State<App>,
    Path(job_id): Path<String>,
    headers: HeaderMap,
) -> Result<Sse<impl Stream<Item = Result<Event, Infallible>>>, ProblemResponse> {
    // Checked first, so that a rejected request is cheap.
    let place = app.event_streams.acquire()?;
    let job = app.services.jobs.follow(&job_id).await.map_err(Error::from)?;
    let seen = headers.get("last-event-id").and_then(|v| v.to_str().ok()).map(str::to_owned);
    let following = JobStream { job, seen, shutdown: app.shutdown };
    let stream = stream::unfold(Some(following), move |following| {
        // The permit lives as long as the stream.
        let _ = &place;
        async move { next_event(following?).await }
    });
    Ok(Sse::new(stream).keep_alive(KeepAlive::default()))
}

/// State of an event stream.
struct JobStream {
    job: watch::Receiver<Job>,
    /// Id of the last sent event.
    seen: Option<String>,
    shutdown: CancellationToken,
}

/// Returns the next event and the new state of the stream. `None` ends the stream.
async fn next_event(
    mut following: JobStream,
) -> Option<(Result<Event, Infallible>, Option<JobStream>)> {
    loop {
        if following.shutdown.is_cancelled() {
            return None;
        }
        let job = following.job.borrow_and_update().clone();
        let id = event_id(&job);
        let over = job.state.is_final();
        if over || following.seen.as_deref() != Some(&id) {
            let event = Event::default()
                .id(id.clone())
                .event(if over { "done" } else { "progress" })
                .json_data(&job)
                .ok()?;
            following.seen = Some(id);
            return Some((Ok(event), (!over).then_some(following)));
        }
        tokio::select! {
            changed = following.job.changed() => changed.ok()?,
            () = following.shutdown.cancelled() => return None,
        }
    }
}

/// Returns the id of an event. Equal ids mean equal states.
fn event_id(job: &Job) -> String {
    let stage = job.stage.as_deref().unwrap_or("-");
    format!("{}.{:?}.{stage}.{:.0}", job.attempts, job.state, job.progress * 1000.0)
}
