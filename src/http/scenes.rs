//! `/v1/scenes`

use super::Binary;
use super::caching::send_download;
use super::extract::{IdempotencyKey, Json, Query, ScenePath};
use super::paging::{DEFAULT_LIMIT, validate};
use super::problem::ProblemResponse;
use super::problems;
use super::{App, CallerExtension};
use axum::Extension;
use axum::body::BodyDataStream;
use axum::extract::{Request, State};
use axum::http::{HeaderMap, StatusCode};
use axum::response::Response;
use futures::StreamExt;
use multer::{Field, Multipart, parse_boundary};
use serde::Deserialize;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use uniground_core::models::with_causes;
use uniground_jobs::Job;
use uniground_service::error::Error;
use uniground_service::{NewScene, ParseFile};
use uniground_types::geometry::up_axis::UpAxis;
use uniground_types::labels::read_labels;
use uniground_types::scenes::{
    Created, ImportRequest, ParseRequest, Scene, SceneChange, SceneList,
};
use uniground_types::settings::{
    ImportSettings, LevellingChoice, ParsePreset, ParseSettings, check_metres_per_unit,
};
use utoipa::IntoParams;

#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct CreateParameters {
    /// Name of the scene. Default: the name in the archive.
    #[param(max_length = 200)]
    name: Option<String>,
    /// `false` stores the scan without parsing it. Default: `true`.
    #[serde(default = "yes")]
    #[param(default = true)]
    parse: bool,
    /// Axis of the files that points up, for archives that do not state it. Default: the axis that
    /// the cameras hold up.
    #[param(inline)]
    up: Option<UpAxis>,
    /// Length of one unit of the files' clouds and poses, meters. Default: estimated from their
    /// size.
    metres_per_unit: Option<f64>,
    /// Whether to level a tilted world.
    #[serde(default)]
    #[param(inline)]
    levelling: LevellingChoice,
    /// Preset of the parse settings.
    #[serde(default)]
    #[param(inline)]
    preset: ParsePreset,
}

fn yes() -> bool {
    true
}

/// Uploads a scan.
///
/// The body is the scan itself, streamed: an archive (zip, tar, tar.zst), a point cloud or a mesh;
/// or a form with one of these as its file. The format is detected from the bytes, regardless of
/// the content type. The scan is checked before it is stored, then parsed in a job. The same bytes
/// with the same settings are parsed only once.
#[utoipa::path(
    post, path = "/v1/scenes", operation_id = "create_scene", tag = "scenes",
    params(CreateParameters, ("Idempotency-Key" = Option<String>, Header, description = "A repeated key returns the scene of the first request")),
    request_body(
        content((Binary = "application/zip"), (Binary = "application/x-tar"), (Binary = "application/zstd"), (Binary = "application/octet-stream")),
        description = "An archive in a supported layout, a point cloud or a mesh"
    ),
    responses(
        (status = 202, body = Created),
        problems::Common, problems::BadRequest, problems::Forbidden, problems::TooLarge,
        problems::Unprocessable,
    ),
    security(("key" = ["write"]), ())
)]
pub async fn create(
    State(app): State<App>,
    Query(CreateParameters { name, parse, up, metres_per_unit, levelling, preset }): Query<
        CreateParameters,
    >,
    Extension(caller): CallerExtension,
    IdempotencyKey(idempotency_key): IdempotencyKey,
    headers: HeaderMap,
    request: Request,
) -> Result<(StatusCode, axum::Json<Created>), ProblemResponse> {
    check_metres_per_unit("metres_per_unit", metres_per_unit).map_err(Error::from)?;
    let header = |name: &str| headers.get(name).and_then(|v| v.to_str().ok());
    let mut settings = ParseSettings::from_request(preset, None).map_err(Error::from)?;
    settings.import = ImportSettings { up, metres_per_unit, levelling, ..settings.import };
    let announced_bytes =
        header("content-length").and_then(|bytes| bytes.parse().ok()).unwrap_or(0);
    let new = NewScene {
        name,
        file_name: None,
        parse: parse.then_some(settings),
        idempotency_key,
        announced_bytes,
    };
    let body = request.into_body().into_data_stream();
    let (scene, job) = match header("content-type")
        .and_then(|media_type| parse_boundary(media_type).ok())
    {
        Some(boundary) => {
            let (file_name, file) = first_form_file(body, boundary).await?;
            app.services.imports.create_scene(NewScene { file_name, ..new }, file, &caller).await?
        }
        None => app.services.imports.create_scene(new, body, &caller).await?,
    };
    Ok((StatusCode::ACCEPTED, axum::Json(Created { scene, job })))
}

/// Imports a scan from the server's disk, from the folder configured with `--import-root`.
///
/// Works like an upload of the same file. A folder is packed first; links that lead out of it are
/// not followed.
#[utoipa::path(
    post, path = "/v1/scenes/import", operation_id = "import_scene", tag = "scenes", request_body = ImportRequest,
    params(("Idempotency-Key" = Option<String>, Header, description = "A repeated key returns the scene of the first request")),
    responses(
        (status = 202, body = Created),
        problems::Common, problems::BadRequest, problems::Forbidden, problems::NotFound,
        problems::TooLarge, problems::UnsupportedMediaType, problems::Unprocessable,
        problems::StorageFull,
    ),
    security(("key" = ["write"]), ())
)]
pub async fn import(
    State(app): State<App>,
    Extension(caller): CallerExtension,
    IdempotencyKey(key): IdempotencyKey,
    Json(request): Json<ImportRequest>,
) -> Result<(StatusCode, axum::Json<Created>), ProblemResponse> {
    let (scene, job) = app.services.imports.import_scene(request, key, &caller).await?;
    Ok((StatusCode::ACCEPTED, axum::Json(Created { scene, job })))
}

/// Maximum number of bytes in a form before its file.
const BEFORE_FILE_BYTES: usize = 64 << 10;

/// Returns the first file of a form: its name and its bytes.
pub(super) async fn first_form_file(
    body: BodyDataStream,
    boundary: String,
) -> Result<(Option<String>, Field<'static>), ProblemResponse> {
    const NO_FILE: &str =
        "the form contains no file: send one, for example with curl -F scan=@room.zip";
    let refused =
        |detail: &str| ProblemResponse::new(StatusCode::BAD_REQUEST, "malformed_form", detail);
    let is_found = Arc::new(AtomicBool::new(false));
    let (found, mut before) = (is_found.clone(), 0);
    let bounded = body.map(move |chunk| {
        let chunk = chunk.map_err(std::io::Error::other)?;
        if !found.load(Ordering::Relaxed) && before > BEFORE_FILE_BYTES {
            return Err(std::io::Error::other(format!(
                "no file within the first {BEFORE_FILE_BYTES} bytes"
            )));
        }
        before += chunk.len();
        Ok(chunk)
    });
    let mut form = Multipart::new(bounded, boundary);
    while let Some(field) =
        form.next_field().await.map_err(|error| refused(&with_causes(&error)))?
    {
        if let Some(file_name) = field.file_name().map(str::to_owned) {
            is_found.store(true, Ordering::Relaxed);
            return Ok((Some(file_name), field));
        }
    }
    Err(refused(NO_FILE))
}

/// Creates a scene from the sample scan that is embedded in the server, and parses it.
#[utoipa::path(
    post, path = "/v1/scenes/sample", operation_id = "create_sample_scene", tag = "scenes",
    responses(
        (status = 202, body = Created),
        problems::Common, problems::Forbidden,
    ),
    security(("key" = ["write"]), ())
)]
pub async fn create_sample(
    State(app): State<App>,
    Extension(caller): CallerExtension,
) -> Result<(StatusCode, axum::Json<Created>), ProblemResponse> {
    let (scene, job) = app.services.imports.create_sample(&caller).await?;
    Ok((StatusCode::ACCEPTED, axum::Json(Created { scene, job })))
}

/// Filters of the list.
#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct ListParameters {
    /// Scenes with all of these labels.
    #[param(example = "building=A,floor=2")]
    labels: Option<String>,
    /// Number of entries per page.
    #[param(minimum = 1, maximum = 100, default = 20)]
    limit: Option<u32>,
    /// `next_cursor` of the previous page.
    cursor: Option<String>,
}

/// Lists scenes, newest first, without their settings and reports.
#[utoipa::path(
    get, path = "/v1/scenes", operation_id = "list_scenes", tag = "scenes", params(ListParameters),
    responses(
        (status = 200, body = SceneList),
        problems::Common, problems::Unprocessable,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn list(
    State(app): State<App>,
    Query(parameters): Query<ListParameters>,
) -> Result<axum::Json<SceneList>, ProblemResponse> {
    let ListParameters { limit, cursor, labels } = parameters;
    let (limit, cursor) = validate(limit.unwrap_or(DEFAULT_LIMIT), cursor)?;
    let labels =
        labels.map(|labels| read_labels("labels", &labels)).transpose().map_err(Error::from)?;
    Ok(axum::Json(
        app.services.scenes.scenes(limit, cursor.as_deref(), labels.unwrap_or_default()).await?,
    ))
}

/// Returns a scene.
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}", operation_id = "get_scene", tag = "scenes", params(("scene_id" = String, Path)),
    responses(
        (status = 200, body = Scene),
        problems::Common, problems::NotFound,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn get(
    State(app): State<App>,
    ScenePath(scene_id): ScenePath<String>,
) -> Result<axum::Json<Scene>, ProblemResponse> {
    Ok(axum::Json(app.services.scene_lookup.scene(&scene_id).await?))
}

/// Changes a scene's name, labels, or map transform.
#[utoipa::path(
    patch, path = "/v1/scenes/{scene_id}", operation_id = "change_scene", tag = "scenes", params(("scene_id" = String, Path)), request_body = SceneChange,
    responses(
        (status = 200, body = Scene),
        problems::Common, problems::BadRequest, problems::Forbidden, problems::NotFound,
        problems::TooLarge, problems::UnsupportedMediaType, problems::Unprocessable,
    ),
    security(("key" = ["write"]), ())
)]
pub async fn change(
    State(app): State<App>,
    ScenePath(scene_id): ScenePath<String>,
    Json(change): Json<SceneChange>,
) -> Result<axum::Json<Scene>, ProblemResponse> {
    Ok(axum::Json(app.services.scenes.change_scene(&scene_id, change).await?))
}

/// Deletes a scene and its answers.
#[utoipa::path(
    delete, path = "/v1/scenes/{scene_id}", operation_id = "delete_scene", tag = "scenes", params(("scene_id" = String, Path)),
    responses(
        (status = 204, description = "Gone"),
        problems::Common, problems::Forbidden, problems::NotFound,
    ),
    security(("key" = ["write"]), ())
)]
pub async fn delete(
    State(app): State<App>,
    ScenePath(scene_id): ScenePath<String>,
) -> Result<StatusCode, ProblemResponse> {
    app.services.scenes.delete_scene(&scene_id).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// Parses a scene again as a new version. Questions use the previous version until the new one is
/// ready.
#[utoipa::path(
    post, path = "/v1/scenes/{scene_id}/parse", operation_id = "parse_scene", tag = "scenes", params(("scene_id" = String, Path)), request_body = ParseRequest,
    responses(
        (status = 202, body = Job),
        problems::Common, problems::BadRequest, problems::Forbidden, problems::NotFound,
        problems::TooLarge, problems::UnsupportedMediaType, problems::Unprocessable,
    ),
    security(("key" = ["write"]), ())
)]
pub async fn parse(
    State(app): State<App>,
    ScenePath(scene_id): ScenePath<String>,
    Extension(caller): CallerExtension,
    Json(ParseRequest { preset, settings }): Json<ParseRequest>,
) -> Result<(StatusCode, axum::Json<Job>), ProblemResponse> {
    Ok((
        StatusCode::ACCEPTED,
        axum::Json(app.services.parses.reparse(&scene_id, preset, settings, &caller).await?),
    ))
}

/// Starts a job in which the vision-language model names every object of the current parse.
///
/// Names do not depend on questions and are stored. Objects that have a name are not sent to the
/// model again. Questions with `evidence: "cached_names"` use the names.
#[utoipa::path(
    post, path = "/v1/scenes/{scene_id}/names", operation_id = "name_instances", tag = "scenes", params(("scene_id" = String, Path)),
    responses(
        (status = 202, body = Job),
        problems::Common, problems::Forbidden, problems::NotFound, problems::Conflict,
    ),
    security(("key" = ["write"]), ())
)]
pub async fn name(
    State(app): State<App>,
    ScenePath(scene_id): ScenePath<String>,
    Extension(caller): CallerExtension,
) -> Result<(StatusCode, axum::Json<Job>), ProblemResponse> {
    Ok((
        StatusCode::ACCEPTED,
        axum::Json(app.services.naming.start_naming(&scene_id, &caller).await?),
    ))
}

/// Returns the cloud with its original colors as PLY.
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}/cloud.ply", operation_id = "get_cloud", tag = "scenes", params(("scene_id" = String, Path)),
    responses(
        (status = 200, body = Binary, content_type = "application/octet-stream"),
        (status = 307, description = "Redirect to the object store, if the server is configured for it", headers(("location" = String))),
        problems::Common, problems::NotFound, problems::Conflict,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn cloud(
    State(app): State<App>,
    ScenePath(scene_id): ScenePath<String>,
    request_headers: HeaderMap,
) -> Result<Response, ProblemResponse> {
    let file = app.services.parses.parse_file(&scene_id, ParseFile::Cloud).await?;
    send_download(file, "application/octet-stream", &request_headers).await
}

/// Returns the cloud colored by instance as PLY, with the instance id of each point.
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}/instances.ply", operation_id = "get_instances_cloud", tag = "scenes", params(("scene_id" = String, Path)),
    responses(
        (status = 200, body = Binary, content_type = "application/octet-stream"),
        (status = 307, description = "Redirect to the object store, if the server is configured for it", headers(("location" = String))),
        problems::Common, problems::NotFound, problems::Conflict,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn instances_cloud(
    State(app): State<App>,
    ScenePath(scene_id): ScenePath<String>,
    request_headers: HeaderMap,
) -> Result<Response, ProblemResponse> {
    let file = app.services.parses.parse_file(&scene_id, ParseFile::Instances).await?;
    send_download(file, "application/octet-stream", &request_headers).await
}

/// Returns the embeddings of the instances: a numpy array of half floats, one unit vector per
/// instance ordered by id, zero for instances that no frame shows. The scene's `models` name the
/// encoder.
#[utoipa::path(
    get, path = "/v1/scenes/{scene_id}/embeddings.npy", operation_id = "get_embeddings", tag = "scenes", params(("scene_id" = String, Path)),
    responses(
        (status = 200, body = Binary, content_type = "application/octet-stream"),
        (status = 307, description = "Redirect to the object store, if the server is configured for it", headers(("location" = String))),
        problems::Common, problems::NotFound, problems::Conflict,
    ),
    security(("key" = ["read"]), ())
)]
pub async fn embeddings(
    State(app): State<App>,
    ScenePath(scene_id): ScenePath<String>,
    request_headers: HeaderMap,
) -> Result<Response, ProblemResponse> {
    let file = app.services.parses.parse_file(&scene_id, ParseFile::Embeddings).await?;
    send_download(file, "application/octet-stream", &request_headers).await
}
