//! `/v1/jobs`

use super::App;
use super::extract::{Path, Query};
use super::paging::{DEFAULT_LIMIT, validate};
use super::problem::ProblemResponse;
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
use uniground_types::problem::Problem;
use utoipa::IntoParams;

/// One event of a job's stream.
#[derive(utoipa::ToSchema)]
#[expect(dead_code, reason = "the stream writes these fields as lines of text")]
pub struct JobEvent {
    /// Names the moment; send it back as `Last-Event-ID` to go on from there.
    id: String,
    /// `progress` or `done`.
    event: String,
    /// The job, as JSON.
    data: String,
}

/// Which jobs are wanted; what is not said is any.
#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct ListParameters {
    /// `parse`, `naming`, `batch`.
    kind: Option<String>,
    /// Where they stand.
    #[param(inline)]
    state: Option<JobState>,
    /// What they work on: the id of a scene, or of a batch.
    subject: Option<String>,
    /// Entries per page.
    #[param(minimum = 1, maximum = 100, default = 20)]
    limit: Option<u32>,
    /// `next_cursor` of the page before.
    cursor: Option<String>,
}

/// Lists jobs, newest first.
#[utoipa::path(
    get, path = "/v1/jobs", operation_id = "list_jobs", tag = "jobs", params(ListParameters),
    responses(
        (status = 200, body = JobList),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 422, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
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

/// A job as it stands.
#[utoipa::path(
    get, path = "/v1/jobs/{job_id}", operation_id = "get_job", tag = "jobs", params(("job_id" = String, Path)),
    responses(
        (status = 200, body = Job),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["read"]), ())
)]
pub async fn get(
    State(app): State<App>,
    Path(job_id): Path<String>,
) -> Result<Json<Job>, ProblemResponse> {
    Ok(Json(app.services.jobs.get(&job_id).await.map_err(Error::from)?))
}

/// Asks a job to stop. A finished job stays as it is.
#[utoipa::path(
    delete, path = "/v1/jobs/{job_id}", operation_id = "cancel_job", tag = "jobs", params(("job_id" = String, Path)),
    responses(
        (status = 202, body = Job, description = "Asked to stop; the job as it stands"),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 403, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["write"]), ())
)]
pub async fn cancel(
    State(app): State<App>,
    Path(job_id): Path<String>,
) -> Result<(StatusCode, Json<Job>), ProblemResponse> {
    Ok((StatusCode::ACCEPTED, Json(app.services.jobs.cancel(&job_id).await.map_err(Error::from)?)))
}

/// Follows a job: `progress` events while it goes on, then one `done`; data is the job.
///
/// `Last-Event-ID` resumes: progress the caller has seen is not sent again; the end is always told.
#[utoipa::path(
    get, path = "/v1/jobs/{job_id}/events", operation_id = "follow_job", tag = "jobs",
    params(("job_id" = String, Path), ("Last-Event-ID" = Option<String>, Header)),
    responses(
        (status = 200, body = JobEvent, content_type = "text/event-stream"),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["read"]), ())
)]
pub async fn events(
    State(app): State<App>,
    Path(job_id): Path<String>,
    headers: HeaderMap,
) -> Result<Sse<impl Stream<Item = Result<Event, Infallible>>>, ProblemResponse> {
    // First: who is turned away costs nothing.
    let place = app.event_streams.acquire()?;
    let job = app.services.jobs.follow(&job_id).await.map_err(Error::from)?;
    let seen = headers.get("last-event-id").and_then(|v| v.to_str().ok()).map(str::to_owned);
    let following = JobStream { job, seen, shutdown: app.shutdown };
    let stream = stream::unfold(Some(following), move |following| {
        // The place is the stream's: free when it ends.
        let _ = &place;
        async move { next_event(following?).await }
    });
    Ok(Sse::new(stream).keep_alive(KeepAlive::default()))
}

/// One who follows a job.
struct JobStream {
    job: watch::Receiver<Job>,
    /// The last moment told.
    seen: Option<String>,
    shutdown: CancellationToken,
}

/// The next event the caller has not seen, and who goes on to follow then; `None` ends the stream.
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

/// Names a moment of a job: equal ids, equal state.
fn event_id(job: &Job) -> String {
    let stage = job.stage.as_deref().unwrap_or("-");
    format!("{}.{:?}.{stage}.{:.0}", job.attempts, job.state, job.progress * 1000.0)
}
