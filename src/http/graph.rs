//! `/v1/scenes/{scene_id}/graph`

use super::App;
use super::extract::{Path, Query};
use super::problem::ProblemResponse;
use axum::extract::State;
use axum::http::header;
use axum::response::IntoResponse;
use serde::Deserialize;
use uniground_service::write_graph;
use uniground_types::graph::{GraphFormat, SceneGraph};
use uniground_types::instances::Levels;
use uniground_types::problem::Problem;
use uniground_types::scene::InstanceId;
use utoipa::IntoParams;

#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct GraphParameters {
    /// JSON, `GraphML`, or lines of text for a language model.
    #[serde(default)]
    #[param(inline)]
    format: GraphFormat,
    /// Things and the building; besides these parts, wholes, or all of them.
    #[serde(default)]
    #[param(inline)]
    level: Levels,
    /// An instance: it and what it stands in a relation to, alone, its parts and wholes among them
    /// whatever `level` says.
    around: Option<u32>,
}

/// What is in a scene and how it stands to each other: things, the building and zones, and what
/// carries, holds or stands beside what.
///
/// The relations are those that questions are answered by, as far as they do not depend on who
/// looks.
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}/graph", operation_id = "get_graph", tag = "instances", params(("scene_id" = String, Path), GraphParameters),
    responses(
        (status = 200, content((SceneGraph = "application/json"), (String = "application/graphml+xml"), (String = "text/plain"))),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 409, body = Problem, content_type = "application/problem+json"),
        (status = 422, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
        (status = 503, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["read"]), ())
)]
pub async fn get(
    State(app): State<App>,
    Path(scene_id): Path<String>,
    Query(GraphParameters { format, level, around }): Query<GraphParameters>,
) -> Result<impl IntoResponse, ProblemResponse> {
    let graph = app.services.instances.graph(&scene_id, level, around.map(InstanceId)).await?;
    let (media_type, body) = write_graph(&graph, format)?;
    Ok(([(header::CONTENT_TYPE, media_type)], body))
}
