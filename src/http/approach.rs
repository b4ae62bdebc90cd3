//! `/v1/scenes/{scene_id}/approach` and `/floor`

use super::extract::{Json, Query, ScenePath};
use super::problem::ProblemResponse;
use super::problems;
use super::{App, Binary, CallerExtension};
use axum::Extension;
use axum::extract::State;
use axum::http::header;
use axum::response::IntoResponse;
use serde::Deserialize;
use uniground_types::approach::{Approach, ApproachRequest, FloorMap};
use utoipa::IntoParams;

/// Computes poses from which a robot can see or reach an object: on free floor, with a view of the
/// object and a path to it.
///
/// `none_possible` and `not_grounded` are results, not errors: `failed` names the condition that
/// excluded all positions, and `cells` counts what each condition left. The built-in reasoner
/// answers a `query`, and that answer is stored.
#[utoipa::path(
    post, path = "/v1/scenes/{scene_id}/approach", operation_id = "approach", tag = "grounding", params(("scene_id" = String, Path)), request_body = ApproachRequest,
    responses(
        (status = 200, body = Approach),
        problems::Common, problems::BadRequest, problems::NotFound, problems::Conflict,
        problems::TooLarge, problems::UnsupportedMediaType, problems::Unprocessable,
        problems::BadGateway, problems::Unavailable,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn approach(
    State(app): State<App>,
    ScenePath(scene_id): ScenePath<String>,
    Extension(caller): CallerExtension,
    Json(request): Json<ApproachRequest>,
) -> Result<axum::Json<Approach>, ProblemResponse> {
    Ok(axum::Json(app.services.approach.approach(&scene_id, request, caller).await?))
}

#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct FloorParameters {
    /// Height of the robot, meters. Anything higher is not an obstacle.
    #[serde(default = "default_height")]
    #[param(minimum = 0.1, maximum = 3, default = 1.8)]
    height_m: f32,
}

fn default_height() -> f32 {
    1.8
}

/// Returns the metadata of a scene's floor map in the format of the ROS `map_server`. The image is
/// `floor.png` next to it.
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}/floor", operation_id = "get_floor", tag = "scenes", params(("scene_id" = String, Path), FloorParameters),
    responses(
        (status = 200, body = FloorMap),
        problems::Common, problems::NotFound, problems::Conflict, problems::Unprocessable,
        problems::Unavailable,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn floor(
    State(app): State<App>,
    ScenePath(scene_id): ScenePath<String>,
    Query(FloorParameters { height_m }): Query<FloorParameters>,
) -> Result<axum::Json<FloorMap>, ProblemResponse> {
    Ok(axum::Json(app.services.approach.floor(&scene_id, height_m).await?))
}

/// Returns the floor map: white is free, black is occupied, gray is unknown. The left edge has the
/// smallest x, the first row the largest y.
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}/floor.png", operation_id = "get_floor_picture", tag = "scenes", params(("scene_id" = String, Path), FloorParameters),
    responses(
        (status = 200, body = Binary, content_type = "image/png"),
        problems::Common, problems::NotFound, problems::Conflict, problems::Unprocessable,
        problems::Unavailable,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn floor_picture(
    State(app): State<App>,
    ScenePath(scene_id): ScenePath<String>,
    Query(FloorParameters { height_m }): Query<FloorParameters>,
) -> Result<impl IntoResponse, ProblemResponse> {
    Ok((
        [(header::CONTENT_TYPE, "image/png")],
        app.services.approach.floor_picture(&scene_id, height_m).await?,
    ))
}
