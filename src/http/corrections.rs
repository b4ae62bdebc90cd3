//! `/v1/scenes/{scene_id}/corrections` and `/annotations`

use super::extract::{Json, ScenePath};
use super::problem::ProblemResponse;
use super::problems;
use super::{App, CallerExtension};
use axum::Extension;
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::IntoResponse;
use uniground_service::GroundTruth;
use uniground_types::corrections::{Change, Correction, CorrectionList};

/// Corrects the current parse: renames, dismisses, merges or splits instances.
///
/// Later answers use the correction. It belongs to the parse: scenes with the same bytes and
/// settings share it, and a new parse starts without corrections.
#[utoipa::path(
    post, path = "/v1/scenes/{scene_id}/corrections", operation_id = "correct_scene", tag = "instances", params(("scene_id" = String, Path)),
    request_body = Change,
    responses(
        (status = 201, body = Correction),
        problems::Common, problems::BadRequest, problems::Forbidden, problems::NotFound,
        problems::Conflict, problems::TooLarge, problems::UnsupportedMediaType,
        problems::Unprocessable,
    ),
    security(("key" = ["write"]), ())
)]
pub async fn create(
    State(app): State<App>,
    ScenePath(scene_id): ScenePath<String>,
    Extension(caller): CallerExtension,
    Json(change): Json<Change>,
) -> Result<(StatusCode, axum::Json<Correction>), ProblemResponse> {
    Ok((
        StatusCode::CREATED,
        axum::Json(app.services.corrections.correct(&scene_id, change, &caller).await?),
    ))
}

/// Lists the corrections of the current parse, newest first, with their authors, including undone
/// ones.
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}/corrections", operation_id = "list_corrections", tag = "instances", params(("scene_id" = String, Path)),
    responses(
        (status = 200, body = CorrectionList),
        problems::Common, problems::NotFound, problems::Conflict,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn list(
    State(app): State<App>,
    ScenePath(scene_id): ScenePath<String>,
) -> Result<axum::Json<CorrectionList>, ProblemResponse> {
    Ok(axum::Json(app.services.corrections.corrections(&scene_id).await?))
}

/// Undoes a correction. It stays in the list as undone.
#[utoipa::path(
    delete, path = "/v1/scenes/{scene_id}/corrections/{correction_id}", operation_id = "undo_correction", tag = "instances",
    params(("scene_id" = String, Path), ("correction_id" = String, Path)),
    responses(
        (status = 200, body = Correction),
        problems::Common, problems::Forbidden, problems::NotFound, problems::Conflict,
    ),
    security(("key" = ["write"]), ())
)]
pub async fn undo(
    State(app): State<App>,
    ScenePath((scene_id, correction_id)): ScenePath<(String, String)>,
) -> Result<axum::Json<Correction>, ProblemResponse> {
    Ok(axum::Json(app.services.corrections.undo_correction(&scene_id, &correction_id).await?))
}

/// Returns the corrected objects of the current parse as annotations for `uniground eval`, as
/// `<scene>.scene.json`.
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}/annotations", operation_id = "get_annotations", tag = "instances", params(("scene_id" = String, Path)),
    responses(
        (status = 200, body = GroundTruth),
        problems::Common, problems::NotFound, problems::Conflict,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn annotations(
    State(app): State<App>,
    ScenePath(scene_id): ScenePath<String>,
) -> Result<impl IntoResponse, ProblemResponse> {
    let truth = app.services.corrections.ground_truth(&scene_id).await?;
    let name = format!("attachment; filename=\"{}.scene.json\"", truth.scene_id);
    Ok(([(header::CONTENT_DISPOSITION, name)], axum::Json(truth)))
}
