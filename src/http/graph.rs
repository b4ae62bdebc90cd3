//! `/v1/scenes/{scene_id}/graph`

use super::App;
use super::extract::{Query, ScenePath};
use super::problem::ProblemResponse;
use super::problems;
use axum::extract::State;
use axum::http::header;
use axum::response::IntoResponse;
use serde::Deserialize;
use uniground_service::write_graph;
use uniground_types::graph::{GraphFormat, SceneGraph};
use uniground_types::instances::Levels;
use uniground_types::scene::InstanceId;
use utoipa::IntoParams;

#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct GraphParameters {
    /// Format: JSON, `GraphML`, or lines of text for a language model.
    #[serde(default)]
    #[param(inline)]
    format: GraphFormat,
    /// Levels of the nodes: objects and building elements (default), additionally parts, wholes, or
    /// all.
    #[serde(default)]
    #[param(inline)]
    level: Levels,
    /// Id of an instance. Limits the graph to it and its related nodes, including its parts and
    /// wholes regardless of `level`.
    around: Option<u32>,
}

/// Returns the scene graph: objects, building elements and zones, and the relations between them.
///
/// The relations are those used for answering questions, except viewpoint-dependent ones.
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}/graph", operation_id = "get_graph", tag = "instances", params(("scene_id" = String, Path), GraphParameters),
    responses(
        (status = 200, content((SceneGraph = "application/json"), (String = "application/graphml+xml"), (String = "text/plain"))),
        problems::Common, problems::NotFound, problems::Conflict, problems::Unprocessable,
        problems::Unavailable,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn get(
    State(app): State<App>,
    ScenePath(scene_id): ScenePath<String>,
    Query(GraphParameters { format, level, around }): Query<GraphParameters>,
) -> Result<impl IntoResponse, ProblemResponse> {
    let graph = app.services.instances.graph(&scene_id, level, around.map(InstanceId)).await?;
    let (media_type, body) = write_graph(&graph, format)?;
    Ok(([(header::CONTENT_TYPE, media_type)], body))
}
