//! A scene for who looks at it: points, a small picture, photographs and where they were taken
//! from.

use super::caching::{send_download, send_file};
use super::extract::{Path, Query};
use super::problem::ProblemResponse;
use super::{App, Binary};
use axum::extract::State;
use axum::http::{HeaderMap, header};
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use uniground_service::EvidenceFile;
use uniground_types::problem::Problem;
use uniground_types::scene::FrameList;
use utoipa::IntoParams;

/// The cloud of the current parse for whoever looks at it over a network: twelve bytes a point, and
/// every beginning is an even sample of the whole, so that a part (`Range: bytes=0-2400031` for
/// 200,000 points) is a picture already.
///
/// Little endian: `UGP1`, number of points (u32), bytes per point (u32, 12), 0 (u32), origin (three
/// f32, metres), step (f32, metres); then for each point its position (three u16: origin + step x
/// number), red, green, blue (u8), and the id of its thing (three bytes, 0 for none).
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}/points.bin", operation_id = "get_points", tag = "scenes", params(("scene_id" = String, Path)),
    responses(
        (status = 200, body = Binary, content_type = "application/octet-stream"),
        (status = 206, description = "The part that `Range` names", body = Binary, content_type = "application/octet-stream"),
        (status = 307, description = "Where the object store has it, if the server sends callers there", headers(("location" = String))),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 409, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["read"]), ())
)]
pub async fn points(
    State(app): State<App>,
    Path(scene_id): Path<String>,
    request_headers: HeaderMap,
) -> Result<Response, ProblemResponse> {
    send_download(
        app.services.media.points(&scene_id).await?,
        "application/octet-stream",
        &request_headers,
    )
    .await
}

/// The room of the current parse from above, 320 x 240 pixels.
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}/thumbnail.jpg", operation_id = "get_thumbnail", tag = "scenes", params(("scene_id" = String, Path)),
    responses(
        (status = 200, body = Binary, content_type = "image/jpeg"),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 409, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["read"]), ())
)]
pub async fn thumbnail(
    State(app): State<App>,
    Path(scene_id): Path<String>,
    request_headers: HeaderMap,
) -> Result<Response, ProblemResponse> {
    send_picture(app.services.media.thumbnail(&scene_id).await?, &request_headers).await
}

/// The photographs of a scan: where each was taken from, and with what camera.
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}/frames", operation_id = "list_frames", tag = "scenes", params(("scene_id" = String, Path)),
    responses(
        (status = 200, body = FrameList),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 409, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["read"]), ())
)]
pub async fn frames(
    State(app): State<App>,
    Path(scene_id): Path<String>,
) -> Result<axum::Json<FrameList>, ProblemResponse> {
    Ok(axum::Json(app.services.media.frames(&scene_id).await?))
}

#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct PhotographParameters {
    /// With the instances it shows laid over it in their colours.
    #[serde(default)]
    #[param(default = false)]
    instances: bool,
}

/// A photograph of the scan, by its index in the list of frames: as it was taken, or with the
/// instances of the current parse over it.
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}/frames/{frame}/photograph.jpg", operation_id = "get_photograph", tag = "scenes",
    params(("scene_id" = String, Path), ("frame" = u32, Path), PhotographParameters),
    responses(
        (status = 200, content((Binary = "image/jpeg"), (Binary = "image/png"))),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 409, body = Problem, content_type = "application/problem+json"),
        (status = 422, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["read"]), ())
)]
pub async fn photograph(
    State(app): State<App>,
    Path((scene_id, frame)): Path<(String, u32)>,
    Query(PhotographParameters { instances }): Query<PhotographParameters>,
    request_headers: HeaderMap,
) -> Result<Response, ProblemResponse> {
    send_picture(
        app.services.media.frame_picture(&scene_id, frame, instances).await?,
        &request_headers,
    )
    .await
}

/// A picture from a file, or one that was drawn.
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
