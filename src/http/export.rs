//! `/v1/scenes/{scene_id}/export`

use super::caching::send_bytes;
use super::extract::{Query, ScenePath};
use super::problem::ProblemResponse;
use super::problems;
use super::{App, Binary};
use axum::extract::State;
use axum::http::{HeaderMap, HeaderValue, header};
use axum::response::Response;
use serde::Deserialize;
use uniground_service::ExportFile;
use uniground_types::export::{DEFAULT_POINTS, ExportFormat, ExportedScene};
use utoipa::IntoParams;

#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct ExportParameters {
    /// File format.
    #[param(inline)]
    format: ExportFormat,
    /// Maximum number of points in the file. A larger cloud is thinned evenly and
    /// deterministically. Ignored for JSON.
    #[serde(default = "default_points")]
    #[param(minimum = 1, maximum = 2_000_000, default = 500_000)]
    points: u32,
}

fn default_points() -> u32 {
    DEFAULT_POINTS
}

/// Exports the scene with its corrected instances as GLB, PLY, USDZ or JSON.
///
/// Coordinates are in meters in the scene's frame (Z up). In GLB, the root node rotates them to
/// glTF's Y up. The response is an attachment named after the scene.
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}/export", operation_id = "export_scene", tag = "scenes", params(("scene_id" = String, Path), ExportParameters),
    responses(
        (status = 200, content(
            (Binary = "model/gltf-binary"), (Binary = "model/vnd.usdz+zip"), (Binary = "application/octet-stream"),
            (ExportedScene = "application/json"),
        )),
        problems::Common, problems::NotFound, problems::Conflict, problems::Unprocessable,
        problems::Unavailable,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn export(
    State(app): State<App>,
    ScenePath(scene_id): ScenePath<String>,
    Query(ExportParameters { format, points }): Query<ExportParameters>,
    request_headers: HeaderMap,
) -> Result<Response, ProblemResponse> {
    let ExportFile { name, bytes, fingerprint } =
        app.services.exports.export(&scene_id, format, points).await?;
    let mut response = send_bytes(bytes, &fingerprint, format.media_type(), &request_headers);
    if let Ok(named) = HeaderValue::from_str(&format!("attachment; filename=\"{name}\"")) {
        response.headers_mut().insert(header::CONTENT_DISPOSITION, named);
    }
    Ok(response)
}
