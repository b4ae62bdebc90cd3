//! `/v1/answers`

use super::App;
use super::Binary;
use super::extract::Path;
use super::problem::Refused;
use axum::Json;
use axum::extract::State;
use axum::http::header;
use axum::response::IntoResponse;
use uniground_types::answer::Answer;
use uniground_types::problem::Problem;
use uniground_types::transcript::{AnswerPrompt, AnswerReply};

/// An answer as it was given, whole.
#[utoipa::path(
    get, path = "/v1/answers/{answer_id}", tag = "grounding", params(("answer_id" = String, Path)),
    responses(
        (status = 200, body = Answer),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = []), ())
)]
pub async fn get(State(app): State<App>, Path(answer_id): Path<String>) -> Result<impl IntoResponse, Refused> {
    Ok(([(header::CONTENT_TYPE, "application/json")], app.service.answer(&answer_id).await?))
}

/// A picture that goes with an answer: `global.jpg`, and for answers of a model `candidate-7.jpg` or `names-1.jpg`, exactly as it was shown.
///
/// The room itself is always there: where no model was shown one, it is drawn from above with the answer's box (green), its anchor (red)
/// and the other candidates (blue).
#[utoipa::path(
    get, path = "/v1/answers/{answer_id}/evidence/{picture}", tag = "grounding",
    params(("answer_id" = String, Path), ("picture" = String, Path, description = "`global.jpg`, or as the answer's `evidence` names it")),
    responses(
        (status = 200, body = Binary, content_type = "image/jpeg"),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = []), ())
)]
pub async fn picture(State(app): State<App>, Path((answer_id, picture)): Path<(String, String)>) -> Result<impl IntoResponse, Refused> {
    Ok(([(header::CONTENT_TYPE, "image/jpeg")], app.service.answer_picture(&answer_id, &picture).await?))
}

/// What the model was asked for an answer: every message, in order. Kept for as long as the server's operator wants.
#[utoipa::path(
    get, path = "/v1/answers/{answer_id}/prompt", tag = "grounding", params(("answer_id" = String, Path)),
    responses(
        (status = 200, body = AnswerPrompt),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = []), ())
)]
pub async fn prompt(State(app): State<App>, Path(answer_id): Path<String>) -> Result<Json<AnswerPrompt>, Refused> {
    Ok(Json(app.service.answer_prompt(&answer_id).await?))
}

/// What the model said, word by word.
#[utoipa::path(
    get, path = "/v1/answers/{answer_id}/reply", tag = "grounding", params(("answer_id" = String, Path)),
    responses(
        (status = 200, body = AnswerReply),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = []), ())
)]
pub async fn reply(State(app): State<App>, Path(answer_id): Path<String>) -> Result<Json<AnswerReply>, Refused> {
    Ok(Json(app.service.answer_reply(&answer_id).await?))
}
