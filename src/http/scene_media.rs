//! Media for viewing a scene: points, thumbnail, photographs and their poses.

use super::caching::{send_download, send_file};
use super::extract::{Query, ScenePath};
use super::problem::ProblemResponse;
use super::problems;
use super::{App, Binary};
use axum::extract::State;
use axum::http::{HeaderMap, header};
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use uniground_service::EvidenceFile;
use uniground_types::scene::FrameList;
use utoipa::IntoParams;

/// Whether a draft is accepted.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct PointsParameters {
    /// `true` returns the imported cloud while the first parse runs. Its points have no objects
    /// yet.
    #[serde(default)]
    #[param(default = false)]
    draft: bool,
}

/// Returns the cloud of the current parse in a compact format for viewers. Points are ordered so
/// that every prefix is an even sample: a part (`Range: bytes=0-2400031` for 200,000 points) can be
/// shown.
///
/// Little endian header: `UGP1`, number of points (u32), bytes per point (u32, 12), 0 (u32), origin
/// (three f32, meters), step (f32, meters). Then for each point: position (three u16, coordinate =
/// origin + step x number), red, green, blue (u8), and the id of its object (three bytes, 0 for
/// none).
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}/points.bin", operation_id = "get_points", tag = "scenes", params(("scene_id" = String, Path), PointsParameters),
    responses(
        (status = 200, body = Binary, content_type = "application/octet-stream"),
        (status = 206, description = "The part requested by `Range`", body = Binary, content_type = "application/octet-stream"),
        (status = 307, description = "Redirect to the object store, if the server is configured for it", headers(("location" = String))),
        problems::Common, problems::NotFound, problems::Conflict, problems::Unprocessable,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn points(
    State(app): State<App>,
    ScenePath(scene_id): ScenePath<String>,
    Query(PointsParameters { draft }): Query<PointsParameters>,
    request_headers: HeaderMap,
) -> Result<Response, ProblemResponse> {
    let media = &app.services.media;
    let points = match draft {
        true => media.points_or_draft(&scene_id).await?,
        false => media.points(&scene_id).await?,
    };
    send_download(points, "application/octet-stream", &request_headers).await
}

/// Returns a picture of the current parse from above, 320 x 240 pixels.
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}/thumbnail.jpg", operation_id = "get_thumbnail", tag = "scenes", params(("scene_id" = String, Path)),
    responses(
        (status = 200, body = Binary, content_type = "image/jpeg"),
        problems::Common, problems::NotFound, problems::Conflict,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn thumbnail(
    State(app): State<App>,
    ScenePath(scene_id): ScenePath<String>,
    request_headers: HeaderMap,
) -> Result<Response, ProblemResponse> {
    send_picture(app.services.media.thumbnail(&scene_id).await?, &request_headers).await
}

/// Lists the photographs of a scan with their poses and cameras.
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}/frames", operation_id = "list_frames", tag = "scenes", params(("scene_id" = String, Path)),
    responses(
        (status = 200, body = FrameList),
        problems::Common, problems::NotFound, problems::Conflict,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn frames(
    State(app): State<App>,
    ScenePath(scene_id): ScenePath<String>,
) -> Result<axum::Json<FrameList>, ProblemResponse> {
    Ok(axum::Json(app.services.media.frames(&scene_id).await?))
}

#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct PhotographParameters {
    /// Whether to overlay the visible instances in their colors.
    #[serde(default)]
    #[param(default = false)]
    instances: bool,
}

/// Returns a photograph of the scan by its index in the list of frames, optionally with the
/// instances of the current parse.
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}/frames/{frame}/photograph.jpg", operation_id = "get_photograph", tag = "scenes",
    params(("scene_id" = String, Path), ("frame" = u32, Path), PhotographParameters),
    responses(
        (status = 200, content((Binary = "image/jpeg"), (Binary = "image/png"))),
        problems::Common, problems::NotFound, problems::Conflict, problems::Unprocessable,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn photograph(
    State(app): State<App>,
    ScenePath((scene_id, frame)): ScenePath<(String, u32)>,
    Query(PhotographParameters { instances }): Query<PhotographParameters>,
    request_headers: HeaderMap,
) -> Result<Response, ProblemResponse> {
    send_picture(
        app.services.media.frame_picture(&scene_id, frame, instances).await?,
        &request_headers,
    )
    .await
}

/// Sends a picture from a file, or a generated one.
pub(super) async fn send_picture(
    picture: EvidenceFile,
    request_headers: &HeaderMap,
) -> Result<Response, ProblemResponse> {
    match picture {
        EvidenceFile::Stored(file) => {
            let is_png = file.extension().is_some_and(|end| end.eq_ignore_ascii_case("png"));
            send_file(&file, if is_png { "image/png" } else { "image/jpeg" }, request_headers).await
        }
        EvidenceFile::Drawn(jpeg) => {
            Ok(([(header::CONTENT_TYPE, "image/jpeg")], jpeg).into_response())
        }
    }
}
