//! `/v1/scenes/{scene_id}/export`

use super::caching::send_bytes;
use super::extract::{Path, Query};
use super::problem::ProblemResponse;
use super::{App, Binary};
use axum::extract::State;
use axum::http::{HeaderMap, HeaderValue, header};
use axum::response::Response;
use serde::Deserialize;
use uniground_service::ExportFile;
use uniground_types::export::{DEFAULT_POINTS, ExportFormat, ExportedScene};
use uniground_types::problem::Problem;
use utoipa::IntoParams;

#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct ExportParameters {
    /// Kind of file.
    #[param(inline)]
    format: ExportFormat,
    /// Most points in the file: a larger cloud is thinned evenly, always to the same points. JSON
    /// has none.
    #[serde(default = "default_points")]
    #[param(minimum = 1, maximum = 2_000_000, default = 500_000)]
    points: u32,
}

fn default_points() -> u32 {
    DEFAULT_POINTS
}

/// The scene with what was found in it, for other programs: GLB, PLY, USDZ or JSON, as people have
/// corrected it.
///
/// Coordinates are metres in the frame of the scene (Z up); in GLB the node at the root turns them
/// into glTF's Y up. Sent as an attachment named after the scene.
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}/export", operation_id = "export_scene", tag = "scenes", params(("scene_id" = String, Path), ExportParameters),
    responses(
        (status = 200, content(
            (Binary = "model/gltf-binary"), (Binary = "model/vnd.usdz+zip"), (Binary = "application/octet-stream"),
            (ExportedScene = "application/json"),
        )),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 409, body = Problem, content_type = "application/problem+json"),
        (status = 422, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
        (status = 503, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["read"]), ())
)]
pub async fn export(
    State(app): State<App>,
    Path(scene_id): Path<String>,
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
