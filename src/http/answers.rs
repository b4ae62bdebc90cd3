//! `/v1/answers`

use super::App;
use super::Binary;
use super::extract::Path;
use super::problem::Problem;
use crate::service::Answer;
use axum::Json;
use axum::extract::State;
use axum::http::header;
use axum::response::IntoResponse;

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
pub async fn get(State(app): State<App>, Path(answer_id): Path<String>) -> Result<Json<Answer>, Problem> {
    Ok(Json(app.service.answer(&answer_id).await?))
}

/// The room from above with the answer's box (green), its anchor (red) and the other candidates (blue).
#[utoipa::path(
    get, path = "/v1/answers/{answer_id}/evidence/global.jpg", tag = "grounding", params(("answer_id" = String, Path)),
    responses(
        (status = 200, body = Binary, content_type = "image/jpeg"),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = []), ())
)]
pub async fn picture(State(app): State<App>, Path(answer_id): Path<String>) -> Result<impl IntoResponse, Problem> {
    Ok(([(header::CONTENT_TYPE, "image/jpeg")], app.service.answer_picture(&answer_id).await?))
}
