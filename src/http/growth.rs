//! `/v1/scenes/{id}/frames` and `/v1/scenes/{id}/changes`: adding frames to a scene, and its
//! changes.

use super::Binary;
use super::extract::{IdempotencyKey, Query, ScenePath};
use super::problem::ProblemResponse;
use super::problems;
use super::scenes::first_form_file;
use super::{App, CallerExtension};
use axum::Extension;
use axum::extract::{Request, State};
use axum::http::{HeaderMap, StatusCode};
use multer::parse_boundary;
use serde::Deserialize;
use uniground_service::NewFrames;
use uniground_service::error::Error;
use uniground_types::changes::SceneChanges;
use uniground_types::placement::FrameChoice;
use uniground_types::scenes::Created;
use utoipa::IntoParams;

#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct AddParameters {
    /// Frame of the poses: that of the scene's original files (default), the scene's own, or that
    /// of its map.
    #[serde(default = "of_the_files")]
    #[param(default = "source", inline)]
    world: FrameChoice,
}

fn of_the_files() -> FrameChoice {
    FrameChoice::Source
}

/// Adds frames to a scene: color and depth pictures with poses, in any supported layout.
///
/// The frames are checked against the scene before they are stored, then parsed in the background;
/// results of earlier frames are reused. Points that the new frames see through are removed, and
/// new surfaces are added. Unchanged objects keep their ids, names and corrections. `GET
/// /v1/scenes/{scene_id}/changes` returns the changes. Until the parse is finished, questions use
/// the previous version.
#[utoipa::path(
    post, path = "/v1/scenes/{scene_id}/frames", operation_id = "add_frames", tag = "scenes",
    params(
        ("scene_id" = String, Path), AddParameters,
        ("Idempotency-Key" = Option<String>, Header, description = "A repeated key returns the result of the first request"),
    ),
    request_body(content = Binary, content_type = "application/octet-stream", description = "As for a new scene: an archive, or a form with an archive"),
    responses(
        (status = 202, body = Created),
        problems::Common, problems::BadRequest, problems::Forbidden, problems::NotFound,
        problems::Conflict, problems::TooLarge, problems::Unprocessable, problems::StorageFull,
    ),
    security(("key" = ["write"]), ())
)]
pub async fn add_frames(
    State(app): State<App>,
    ScenePath(scene_id): ScenePath<String>,
    Query(AddParameters { world }): Query<AddParameters>,
    Extension(caller): CallerExtension,
    IdempotencyKey(idempotency_key): IdempotencyKey,
    headers: HeaderMap,
    request: Request,
) -> Result<(StatusCode, axum::Json<Created>), ProblemResponse> {
    let header = |name: &str| headers.get(name).and_then(|v| v.to_str().ok());
    let announced_bytes =
        header("content-length").and_then(|bytes| bytes.parse().ok()).unwrap_or(0);
    let new = NewFrames { file_name: None, world, idempotency_key, announced_bytes };
    let body = request.into_body().into_data_stream();
    let (scene, job) =
        match header("content-type").and_then(|media_type| parse_boundary(media_type).ok()) {
            Some(boundary) => {
                let (file_name, file) = first_form_file(body, boundary).await?;
                app.services
                    .growth
                    .add_frames(&scene_id, NewFrames { file_name, ..new }, file, &caller)
                    .await?
            }
            None => app.services.growth.add_frames(&scene_id, new, body, &caller).await?,
        };
    Ok((StatusCode::ACCEPTED, axum::Json(Created { scene, job: Some(job) })))
}

#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct ChangesParameters {
    /// Earlier version of the scene to compare with. Default: the first.
    #[param(minimum = 1)]
    since: Option<u32>,
    /// Id of another scene of the same room to compare with. Cannot be combined with `since`.
    to: Option<String>,
    /// With `to`: whether to register the two clouds, starting from their shared map or world
    /// coordinates. Default: `true`.
    align: Option<bool>,
}

/// Returns the changes of a scene since an earlier version, or compared with another scan of the
/// same room.
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}/changes", operation_id = "get_changes", tag = "scenes",
    params(("scene_id" = String, Path), ChangesParameters),
    responses(
        (status = 200, body = SceneChanges),
        problems::Common, problems::NotFound, problems::Conflict, problems::Unprocessable,
        problems::GatewayTimeout,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn changes(
    State(app): State<App>,
    ScenePath(scene_id): ScenePath<String>,
    Query(ChangesParameters { since, to, align }): Query<ChangesParameters>,
) -> Result<axum::Json<SceneChanges>, ProblemResponse> {
    let changes = match (since, to) {
        (Some(_), Some(_)) => {
            return Err(Error::invalid("/to", "cannot be combined with since").into());
        }
        (None, Some(to)) => {
            app.services.changes.changes_to(&scene_id, &to, align.unwrap_or(true)).await?
        }
        (since, None) if align.is_none() => {
            app.services.changes.changes_since(&scene_id, since.unwrap_or(1)).await?
        }
        (_, None) => return Err(Error::invalid("/align", "requires to").into()),
    };
    Ok(axum::Json(changes))
}
