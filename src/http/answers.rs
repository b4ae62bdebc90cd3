//! `/v1/answers`

use super::App;
use super::Binary;
use super::batches::media_type_of;
use super::extract::{Path, Query};
use super::paging::validate;
use super::problem::ProblemResponse;
use super::problems;
use axum::Json;
use axum::body::Body;
use axum::extract::State;
use axum::http::header;
use axum::response::{IntoResponse, Response};
use jiff::Timestamp;
use serde::Deserialize;
use uniground_service::LineFormat;
use uniground_service::error::Error;
use uniground_storage::AnswerFilter;
use uniground_types::answer::{Answer, AnswerList, Status};
use uniground_types::transcript::{AnswerPrompt, AnswerReply};
use utoipa::IntoParams;

/// Filters of the list. Omitted filters match everything.
#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct ListParameters {
    /// Answers about this scene.
    scene_id: Option<String>,
    /// Answers to questions of this batch.
    batch_id: Option<String>,
    /// Answers with this status.
    #[param(inline)]
    status: Option<Status>,
    /// Answers from this time on, RFC 3339.
    #[param(format = DateTime)]
    since: Option<String>,
    /// Answers before this time, RFC 3339.
    #[param(format = DateTime)]
    until: Option<String>,
    /// Number of entries per page.
    #[param(minimum = 1, maximum = 100, default = 20)]
    limit: Option<u32>,
    /// `next_cursor` of the previous page.
    cursor: Option<String>,
    /// Streams all answers instead of one page: as JSONL or as CSV. Cannot be combined with `limit`
    /// and `cursor`.
    #[param(inline)]
    format: Option<LineFormat>,
}

/// Lists stored answers, newest first: one page, or with `format` all of them as a stream.
#[utoipa::path(
    get, path = "/v1/answers", operation_id = "list_answers", tag = "grounding", params(ListParameters),
    responses(
        (status = 200, content((AnswerList = "application/json"), (Answer = "application/jsonl"), (String = "text/csv"))),
        problems::Common, problems::Unprocessable,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn list(
    State(app): State<App>,
    Query(parameters): Query<ListParameters>,
) -> Result<Response, ProblemResponse> {
    let ListParameters { scene_id, batch_id, status, since, until, limit, cursor, format } =
        parameters;
    let status = status.map(serde_json::to_value).transpose().map_err(Error::from)?;
    let filter = AnswerFilter {
        scene_id,
        batch_id,
        status: status.and_then(|word| word.as_str().map(str::to_owned)),
        since: parse_time("since", since)?,
        until: parse_time("until", until)?,
    };
    if let Some(format) = format {
        if limit.is_some() || cursor.is_some() {
            return Err(ProblemResponse::invalid(
                "format",
                "cannot be combined with limit and cursor",
            ));
        }
        let shutdown = app.shutdown.clone().cancelled_owned();
        // Ends the stream on shutdown, so that a long download does not delay it.
        let lines = futures::StreamExt::take_until(
            app.services.answers.all_answers(filter, format),
            shutdown,
        );
        return Ok(([(header::CONTENT_TYPE, media_type_of(format))], Body::from_stream(lines))
            .into_response());
    }
    let (limit, cursor) = validate(limit.unwrap_or(super::paging::DEFAULT_LIMIT), cursor)?;
    let page = app.services.answers.answers(&filter, limit, cursor.as_deref()).await?;
    Ok(([(header::CONTENT_TYPE, "application/json")], page).into_response())
}

fn parse_time(parameter: &str, text: Option<String>) -> Result<Option<Timestamp>, Error> {
    let time = text.map(|text| text.parse()).transpose();
    time.map_err(|_| Error::invalid(parameter, "must be a time like 2026-11-22T18:00:00Z"))
}

/// Returns an answer.
#[utoipa::path(
    get, path = "/v1/answers/{answer_id}", operation_id = "get_answer", tag = "grounding", params(("answer_id" = String, Path)),
    responses(
        (status = 200, body = Answer),
        problems::Common, problems::NotFound,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn get(
    State(app): State<App>,
    Path(answer_id): Path<String>,
) -> Result<impl IntoResponse, ProblemResponse> {
    Ok((
        [(header::CONTENT_TYPE, "application/json")],
        app.services.answers.answer(&answer_id).await?,
    ))
}

/// Returns a picture of an answer's evidence: `global.jpg`, and for answers of a model
/// `candidate-7.jpg`, `marked-1.jpg`, `names-1.jpg`, or `call-1-images-1.jpg` where several were
/// combined in one, exactly as the model received it.
///
/// `global.jpg` always exists. If no model received one, it is drawn from above with the answer's
/// box (green), its anchor (red) and the other candidates (blue).
#[utoipa::path(
    get, path = "/v1/answers/{answer_id}/evidence/{picture}", operation_id = "get_answer_picture", tag = "grounding",
    params(("answer_id" = String, Path), ("picture" = String, Path, description = "`global.jpg`, or a name from the answer's `evidence`")),
    responses(
        (status = 200, body = Binary, content_type = "image/jpeg"),
        problems::Common, problems::NotFound,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn picture(
    State(app): State<App>,
    Path((answer_id, picture)): Path<(String, String)>,
) -> Result<impl IntoResponse, ProblemResponse> {
    Ok((
        [(header::CONTENT_TYPE, "image/jpeg")],
        app.services.answers.answer_picture(&answer_id, &picture).await?,
    ))
}

/// Returns the prompt of an answer: every message to the model, in order. Subject to the retention
/// of evidence.
#[utoipa::path(
    get, path = "/v1/answers/{answer_id}/prompt", operation_id = "get_answer_prompt", tag = "grounding", params(("answer_id" = String, Path)),
    responses(
        (status = 200, body = AnswerPrompt),
        problems::Common, problems::NotFound,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn prompt(
    State(app): State<App>,
    Path(answer_id): Path<String>,
) -> Result<Json<AnswerPrompt>, ProblemResponse> {
    Ok(Json(app.services.transcripts.answer_prompt(&answer_id).await?))
}

/// Returns the model's replies for an answer, unchanged. Subject to the retention of evidence.
#[utoipa::path(
    get, path = "/v1/answers/{answer_id}/reply", operation_id = "get_answer_reply", tag = "grounding", params(("answer_id" = String, Path)),
    responses(
        (status = 200, body = AnswerReply),
        problems::Common, problems::NotFound,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn reply(
    State(app): State<App>,
    Path(answer_id): Path<String>,
) -> Result<Json<AnswerReply>, ProblemResponse> {
    Ok(Json(app.services.transcripts.answer_reply(&answer_id).await?))
}
