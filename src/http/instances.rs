//! `/v1/scenes/{scene_id}/instances`

use super::App;
use super::Binary;
use super::extract::{Query, ScenePath};
use super::problem::ProblemResponse;
use super::problems;
use super::scene_media::send_picture;
use axum::Json;
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use axum::response::Response;
use serde::Deserialize;
use uniground_types::instances::{InstanceList, InstanceView, Levels, ViewPicture};
use uniground_types::scene::InstanceId;
use utoipa::IntoParams;

#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct ListParameters {
    /// Number of instances per page.
    #[serde(default = "default_limit")]
    #[param(minimum = 1, maximum = 1000, default = 100)]
    limit: u32,
    /// `next_cursor` of the previous page.
    #[serde(default)]
    cursor: u32,
    /// Levels to list: objects (default), parts, wholes, or all.
    #[serde(default)]
    #[param(inline)]
    level: Levels,
}

fn default_limit() -> u32 {
    100
}

/// Lists the instances of a scene's current parse, ordered by id: the largest objects first, then
/// parts and wholes.
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}/instances", operation_id = "list_instances", tag = "instances", params(("scene_id" = String, Path), ListParameters),
    responses(
        (status = 200, body = InstanceList),
        problems::Common, problems::NotFound, problems::Conflict, problems::Unprocessable,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn list(
    State(app): State<App>,
    ScenePath(scene_id): ScenePath<String>,
    Query(ListParameters { limit, cursor, level }): Query<ListParameters>,
) -> Result<Json<InstanceList>, ProblemResponse> {
    if !(1..=1000).contains(&limit) {
        return Err(ProblemResponse::invalid("limit", "must be 1 to 1000"));
    }
    Ok(Json(app.services.instances.instances(&scene_id, level, limit, cursor).await?))
}

/// Returns an instance.
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}/instances/{instance_id}", operation_id = "get_instance", tag = "instances",
    params(("scene_id" = String, Path), ("instance_id" = u32, Path)),
    responses(
        (status = 200, body = InstanceView),
        problems::Common, problems::NotFound, problems::Conflict,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn get(
    State(app): State<App>,
    ScenePath((scene_id, instance_id)): ScenePath<(String, u32)>,
) -> Result<Json<InstanceView>, ProblemResponse> {
    Ok(Json(app.services.instances.instance(&scene_id, InstanceId(instance_id)).await?))
}

#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct ViewParameters {
    /// Kind of picture: the full frame with the object outlined and a red box (default), or a crop
    /// with darkened surroundings.
    #[serde(default)]
    #[param(inline)]
    picture: ViewPicture,
}

/// Returns a picture of an instance. `0.jpg` is the best view.
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}/instances/{instance_id}/views/{view}", operation_id = "get_instance_view", tag = "instances",
    params(("scene_id" = String, Path), ("instance_id" = u32, Path), ("view" = String, Path, description = "`{k}.jpg`, k from 0"), ViewParameters),
    responses(
        (status = 200, body = Binary, content_type = "image/jpeg"),
        problems::Common, problems::NotFound, problems::Conflict, problems::Unprocessable,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn view(
    State(app): State<App>,
    ScenePath((scene_id, instance_id, view)): ScenePath<(String, u32, String)>,
    Query(ViewParameters { picture }): Query<ViewParameters>,
    request_headers: HeaderMap,
) -> Result<Response, ProblemResponse> {
    let number = view.strip_suffix(".jpg").and_then(|k| k.parse().ok());
    let number = number.ok_or_else(|| {
        ProblemResponse::new(
            StatusCode::NOT_FOUND,
            "view_not_found",
            format!("there is no view {view:?}: views are named 0.jpg, 1.jpg, ..."),
        )
    })?;
    send_picture(
        app.services
            .instances
            .view_picture(&scene_id, InstanceId(instance_id), number, picture)
            .await?,
        &request_headers,
    )
    .await
}
