//! `/v1/scenes/{id}/frames` to add to, and `/v1/scenes/{id}/changes`: scenes that grow.

use super::Binary;
use super::extract::{IdempotencyKey, Path, Query};
use super::problem::ProblemResponse;
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
use uniground_types::problem::Problem;
use uniground_types::scenes::Created;
use utoipa::IntoParams;

#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct AddParameters {
    /// Whose coordinates the poses are in: those of the files the scene was made of (default), the
    /// scene's, or those of the map it lies in.
    #[serde(default = "of_the_files")]
    #[param(default = "source", inline)]
    world: FrameChoice,
}

fn of_the_files() -> FrameChoice {
    FrameChoice::Source
}

/// Adds frames to a scene: colour and depth pictures with poses, in any layout that a scan may
/// have.
///
/// They are checked against the scene before anything is kept, and parsed in the background: what
/// was seen of frames before is used again. What the new frames look through is gone, surfaces they
/// find are new. What stays keeps its id, names and corrections; `GET /v1/scenes/{scene_id}/
/// changes` tells what came, went and moved. Questions are answered as before until then.
#[utoipa::path(
    post, path = "/v1/scenes/{scene_id}/frames", operation_id = "add_frames", tag = "scenes",
    params(
        ("scene_id" = String, Path), AddParameters,
        ("Idempotency-Key" = Option<String>, Header, description = "The same key again returns what it led to"),
    ),
    request_body(content = Binary, content_type = "application/octet-stream", description = "As for a new scene: an archive, or a form with one"),
    responses(
        (status = 202, body = Created),
        (status = 400, body = Problem, content_type = "application/problem+json"),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 403, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 409, body = Problem, content_type = "application/problem+json"),
        (status = 413, body = Problem, content_type = "application/problem+json"),
        (status = 422, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
        (status = 507, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["write"]), ())
)]
pub async fn add_frames(
    State(app): State<App>,
    Path(scene_id): Path<String>,
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
    /// A version of the scene: what changed after it, as frames were added. Default: its first.
    #[param(minimum = 1)]
    since: Option<u32>,
    /// Another scene of the same room: what is different there. Not together with `since`.
    to: Option<String>,
    /// With `to`: whether the two clouds are laid over each other, from their places in the same
    /// map or in one world. Default: yes.
    align: Option<bool>,
}

/// What changed in a scene since an earlier version of it, or from this scan to another one of the
/// same room.
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}/changes", operation_id = "get_changes", tag = "scenes",
    params(("scene_id" = String, Path), ChangesParameters),
    responses(
        (status = 200, body = SceneChanges),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 409, body = Problem, content_type = "application/problem+json"),
        (status = 422, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
        (status = 504, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["read"]), ())
)]
pub async fn changes(
    State(app): State<App>,
    Path(scene_id): Path<String>,
    Query(ChangesParameters { since, to, align }): Query<ChangesParameters>,
) -> Result<axum::Json<SceneChanges>, ProblemResponse> {
    let changes = match (since, to) {
        (Some(_), Some(_)) => {
            return Err(Error::invalid("/to", "ask for since or for to, not for both").into());
        }
        (None, Some(to)) => {
            app.services.changes.changes_to(&scene_id, &to, align.unwrap_or(true)).await?
        }
        (since, None) if align.is_none() => {
            app.services.changes.changes_since(&scene_id, since.unwrap_or(1)).await?
        }
        (_, None) => return Err(Error::invalid("/align", "it goes with to").into()),
    };
    Ok(axum::Json(changes))
}
