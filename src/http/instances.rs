//! `/v1/scenes/{scene_id}/instances`

use super::App;
use super::Binary;
use super::extract::{Path, Query};
use super::problem::ProblemResponse;
use super::scene_media::send_picture;
use axum::Json;
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use axum::response::Response;
use serde::Deserialize;
use uniground_types::instances::{InstanceList, InstanceView, Levels, ViewPicture};
use uniground_types::problem::Problem;
use uniground_types::scene::InstanceId;
use utoipa::IntoParams;

#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct ListParameters {
    /// Instances per page.
    #[serde(default = "default_limit")]
    #[param(minimum = 1, maximum = 1000, default = 100)]
    limit: u32,
    /// `next_cursor` of the page before.
    #[serde(default)]
    cursor: u32,
    /// Things alone, their parts, wholes of several, or all of them.
    #[serde(default)]
    #[param(inline)]
    level: Levels,
}

fn default_limit() -> u32 {
    100
}

/// The instances of a scene's current parse, in order of id: the largest first, then parts and
/// wholes where these are asked for.
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}/instances", operation_id = "list_instances", tag = "instances", params(("scene_id" = String, Path), ListParameters),
    responses(
        (status = 200, body = InstanceList),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 409, body = Problem, content_type = "application/problem+json"),
        (status = 422, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["read"]), ())
)]
pub async fn list(
    State(app): State<App>,
    Path(scene_id): Path<String>,
    Query(ListParameters { limit, cursor, level }): Query<ListParameters>,
) -> Result<Json<InstanceList>, ProblemResponse> {
    if !(1..=1000).contains(&limit) {
        return Err(ProblemResponse::invalid("limit", "must be 1 to 1000"));
    }
    Ok(Json(app.services.instances.instances(&scene_id, level, limit, cursor).await?))
}

/// One instance.
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}/instances/{instance_id}", operation_id = "get_instance", tag = "instances",
    params(("scene_id" = String, Path), ("instance_id" = u32, Path)),
    responses(
        (status = 200, body = InstanceView),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 409, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["read"]), ())
)]
pub async fn get(
    State(app): State<App>,
    Path((scene_id, instance_id)): Path<(String, u32)>,
) -> Result<Json<InstanceView>, ProblemResponse> {
    Ok(Json(app.services.instances.instance(&scene_id, InstanceId(instance_id)).await?))
}

#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct ViewParameters {
    /// The full frame with the object outlined in a red box, or a crop of it with darker
    /// surroundings.
    #[serde(default)]
    #[param(inline)]
    picture: ViewPicture,
}

/// A picture that shows the instance: the best view is `0.jpg`.
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}/instances/{instance_id}/views/{view}", operation_id = "get_instance_view", tag = "instances",
    params(("scene_id" = String, Path), ("instance_id" = u32, Path), ("view" = String, Path, description = "`{k}.jpg`, k from 0"), ViewParameters),
    responses(
        (status = 200, body = Binary, content_type = "image/jpeg"),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 409, body = Problem, content_type = "application/problem+json"),
        (status = 422, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["read"]), ())
)]
pub async fn view(
    State(app): State<App>,
    Path((scene_id, instance_id, view)): Path<(String, u32, String)>,
    Query(ViewParameters { picture }): Query<ViewParameters>,
    request_headers: HeaderMap,
) -> Result<Response, ProblemResponse> {
    let number = view.strip_suffix(".jpg").and_then(|k| k.parse().ok());
    let number = number.ok_or_else(|| {
        ProblemResponse::new(
            StatusCode::NOT_FOUND,
            "view_not_found",
            format!("views are 0.jpg, 1.jpg, ...; not {view:?}"),
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
