//! `/v1/scenes/{scene_id}/approach` and `/floor`

use super::extract::{Json, Path, Query};
use super::problem::ProblemResponse;
use super::{App, Binary, CallerExtension};
use axum::Extension;
use axum::extract::State;
use axum::http::header;
use axum::response::IntoResponse;
use serde::Deserialize;
use uniground_types::approach::{Approach, ApproachRequest, FloorMap};
use uniground_types::problem::Problem;
use utoipa::IntoParams;

/// Where a robot can stand to see a thing, or to reach it: free floor, a view of the thing, and a
/// way there.
///
/// `none_possible` and `not_grounded` are answers, not errors: `failed` says which condition left
/// no place, `cells` what each one left. A `query` is answered by the built-in reasoner and its
/// answer is kept.
#[utoipa::path(
    post, path = "/v1/scenes/{scene_id}/approach", operation_id = "approach", tag = "grounding", params(("scene_id" = String, Path)), request_body = ApproachRequest,
    responses(
        (status = 200, body = Approach),
        (status = 400, body = Problem, content_type = "application/problem+json"),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 409, body = Problem, content_type = "application/problem+json"),
        (status = 413, body = Problem, content_type = "application/problem+json"),
        (status = 415, body = Problem, content_type = "application/problem+json"),
        (status = 422, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
        (status = 502, body = Problem, content_type = "application/problem+json"),
        (status = 503, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["read"]), ())
)]
pub async fn approach(
    State(app): State<App>,
    Path(scene_id): Path<String>,
    Extension(caller): CallerExtension,
    Json(request): Json<ApproachRequest>,
) -> Result<axum::Json<Approach>, ProblemResponse> {
    Ok(axum::Json(app.services.approach.approach(&scene_id, request, caller).await?))
}

#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct FloorParameters {
    /// Height of the robot, metres: what is higher above the floor is no obstacle.
    #[serde(default = "default_height")]
    #[param(minimum = 0.1, maximum = 3, default = 1.8)]
    height_m: f32,
}

fn default_height() -> f32 {
    1.8
}

/// The map of a scene's floor as `map_server` of ROS reads it: this is the file beside the picture
/// `floor.png`.
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}/floor", operation_id = "get_floor", tag = "scenes", params(("scene_id" = String, Path), FloorParameters),
    responses(
        (status = 200, body = FloorMap),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 409, body = Problem, content_type = "application/problem+json"),
        (status = 422, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
        (status = 503, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["read"]), ())
)]
pub async fn floor(
    State(app): State<App>,
    Path(scene_id): Path<String>,
    Query(FloorParameters { height_m }): Query<FloorParameters>,
) -> Result<axum::Json<FloorMap>, ProblemResponse> {
    Ok(axum::Json(app.services.approach.floor(&scene_id, height_m).await?))
}

/// The floor from above: white is free, black occupied, grey never seen; left is the least x, the
/// first row the greatest y.
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}/floor.png", operation_id = "get_floor_picture", tag = "scenes", params(("scene_id" = String, Path), FloorParameters),
    responses(
        (status = 200, body = Binary, content_type = "image/png"),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 409, body = Problem, content_type = "application/problem+json"),
        (status = 422, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
        (status = 503, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["read"]), ())
)]
pub async fn floor_picture(
    State(app): State<App>,
    Path(scene_id): Path<String>,
    Query(FloorParameters { height_m }): Query<FloorParameters>,
) -> Result<impl IntoResponse, ProblemResponse> {
    Ok((
        [(header::CONTENT_TYPE, "image/png")],
        app.services.approach.floor_picture(&scene_id, height_m).await?,
    ))
}
