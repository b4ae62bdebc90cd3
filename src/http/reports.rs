//! `/v1/scenes/{scene_id}/report`

use super::App;
use super::Binary;
use super::caching::send_file;
use super::extract::ScenePath;
use super::problem::ProblemResponse;
use super::problems;
use axum::Json;
use axum::extract::State;
use axum::http::HeaderMap;
use axum::response::Response;
use uniground_service::error::Error;
use uniground_types::scenes::SceneReport;

/// Returns the report of the current parse: counts, seconds and memory per stage, warnings,
/// settings, and pictures of every step.
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}/report", operation_id = "get_report", tag = "scenes", params(("scene_id" = String, Path)),
    responses(
        (status = 200, body = SceneReport),
        problems::Common, problems::NotFound, problems::Conflict,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn get(
    State(app): State<App>,
    ScenePath(scene_id): ScenePath<String>,
) -> Result<Json<SceneReport>, ProblemResponse> {
    Ok(Json(app.services.parses.scene_report(&scene_id).await?))
}

/// Returns a picture of the current parse.
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}/report/{picture}", operation_id = "get_report_picture", tag = "scenes",
    params(("scene_id" = String, Path), ("picture" = String, Path, description = "`{name}.jpg` as listed in the report")),
    responses(
        (status = 200, body = Binary, content_type = "image/jpeg"),
        problems::Common, problems::NotFound, problems::Conflict,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn picture(
    State(app): State<App>,
    ScenePath((scene_id, picture)): ScenePath<(String, String)>,
    request_headers: HeaderMap,
) -> Result<Response, ProblemResponse> {
    let name = picture
        .strip_suffix(".jpg")
        .ok_or_else(|| Error::ReportPictureNotFound { name: picture.clone() })?;
    let file = app.services.parses.report_picture(&scene_id, name).await?;
    send_file(&file, "image/jpeg", &request_headers).await
}
