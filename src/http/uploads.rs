//! `/v1/uploads`: scans that come in parts, in the words of tus 1.0.

use super::extract::{IdempotencyKey, Path, Query};
use super::problem::ProblemResponse;
use super::{App, CallerExtension, tus};
use axum::Extension;
use axum::body::Body;
use axum::extract::{Request, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::middleware::from_fn;
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use uniground_service::{Caller, NewUpload, UploadPart};
use uniground_storage::SceneRequest;
use uniground_types::geometry::up_axis::UpAxis;
use uniground_types::problem::Problem;
use uniground_types::settings::ParsePreset;
use uniground_types::uploads::Upload;
use utoipa::IntoParams;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

pub fn routes() -> OpenApiRouter<App> {
    OpenApiRouter::new()
        .routes(routes!(create, capabilities))
        .routes(routes!(get, head, append, post, delete))
        .layer(from_fn(tus::check_version))
}

/// What is to be made of an upload. `Upload-Metadata` says the same under the same names; where
/// both do, this counts.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct UploadParameters {
    /// Name of the scene; default: what the archive calls itself.
    #[param(max_length = 200)]
    name: Option<String>,
    /// What the file is called; its ending tells what its bytes do not.
    #[param(max_length = 200)]
    filename: Option<String>,
    /// `false` only stores the scan.
    #[param(default = true)]
    parse: Option<bool>,
    /// The axis that points up in the files, for archives that do not say; default: the axis the
    /// cameras hold up.
    #[param(inline)]
    up: Option<UpAxis>,
    /// Settings to parse with.
    #[param(inline)]
    preset: Option<ParsePreset>,
}

impl UploadParameters {
    fn from_pairs(pairs: Vec<(String, String)>) -> Result<Self, ProblemResponse> {
        let mut parameters = Self::default();
        for (key, text) in pairs {
            match key.as_str() {
                "name" => parameters.name = Some(text),
                "filename" => parameters.filename = Some(text),
                "parse" => {
                    parameters.parse =
                        Some(text.parse().map_err(|_| {
                            ProblemResponse::invalid("parse", "\"true\" or \"false\"")
                        })?);
                }
                "up" => parameters.up = Some(parse_word("up", text)?),
                "preset" => parameters.preset = Some(parse_word("preset", text)?),
                // For whoever sends it.
                _ => {}
            }
        }
        Ok(parameters)
    }

    fn or(self, other: Self) -> Self {
        Self {
            name: self.name.or(other.name),
            filename: self.filename.or(other.filename),
            parse: self.parse.or(other.parse),
            up: self.up.or(other.up),
            preset: self.preset.or(other.preset),
        }
    }
}

fn parse_word<T: DeserializeOwned>(key: &str, text: String) -> Result<T, ProblemResponse> {
    serde_json::from_value(text.into())
        .map_err(|error| ProblemResponse::invalid(key, error.to_string()))
}

/// Begins an upload that comes in parts.
///
/// In the words of [tus 1.0](https://tus.io/protocols/resumable-upload), for its clients. `Location` is the upload; its bytes go there with
/// `PATCH`, from the offset that `HEAD` tells. The first of them may come with this request, as
/// `application/offset+octet-stream`. When all are there it becomes a scene, exactly as `POST
/// /v1/scenes` makes one.
#[utoipa::path(
    post, path = "/v1/uploads", operation_id = "create_upload", tag = "uploads",
    params(
        UploadParameters,
        ("Tus-Resumable" = inline(tus::Version), Header, description = "The version of tus"),
        ("Upload-Length" = u64, Header, description = "Bytes of the whole"),
        ("Upload-Metadata" = Option<String>, Header, description = "`filename`, `name`, `parse`, `up`, `preset`, their texts in base64"),
        ("Upload-Checksum" = Option<String>, Header, description = "Of the bytes that come with it: `sha1` or `sha256`, a space, base64"),
        ("Idempotency-Key" = Option<String>, Header, description = "Uploads under the same key become one scene"),
    ),
    responses(
        (status = 201, body = Upload, headers(
            ("Location" = String, description = "The upload"),
            ("Upload-Offset" = u64, description = "Bytes that are there"),
            ("Upload-Expires" = String, description = "When it is removed unless more of it comes"),
        )),
        (status = 400, body = Problem, content_type = "application/problem+json"),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 403, body = Problem, content_type = "application/problem+json"),
        (status = 408, body = Problem, content_type = "application/problem+json"),
        (status = 412, body = Problem, content_type = "application/problem+json"),
        (status = 413, body = Problem, content_type = "application/problem+json"),
        (status = 422, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
        (status = 460, body = Problem, content_type = "application/problem+json"),
        (status = 507, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["write"]), ())
)]
pub async fn create(
    State(app): State<App>,
    Query(parameters): Query<UploadParameters>,
    Extension(caller): CallerExtension,
    IdempotencyKey(idempotency_key): IdempotencyKey,
    headers: HeaderMap,
    request: Request,
) -> Result<Response, ProblemResponse> {
    let length = tus::parse_byte_count(&headers, &tus::LENGTH)?;
    let tus::Metadata { header: note, pairs } = tus::metadata(&headers)?;
    let UploadParameters { name, filename, parse, up, preset } =
        parameters.or(UploadParameters::from_pairs(pairs)?);
    let (parse, preset) = (parse.unwrap_or(true), preset.unwrap_or_default());
    let wanted =
        SceneRequest { name, file_name: filename, parse, up, preset, idempotency_key, note };
    // Before there is an upload that nobody hears of.
    let checksum = tus::checksum(&headers)?;
    let upload = app.services.uploads.begin_upload(NewUpload { length, wanted }, &caller).await?;
    let location = format!("/v1/uploads/{}", upload.id);
    let mut response = match tus::is_part(&headers) {
        true => {
            let part = UploadPart {
                offset: 0,
                announced_bytes: content_length(&headers),
                checksum,
                body: request.into_body().into_data_stream(),
            };
            match app.services.uploads.append(&upload.id, part, caller).await {
                Ok(upload) => upload_response(StatusCode::CREATED, upload),
                Err(error) => ProblemResponse::from(error).into_response(),
            }
        }
        false => upload_response(StatusCode::CREATED, upload),
    };
    response
        .headers_mut()
        .extend(HeaderValue::from_str(&location).ok().map(|location| (header::LOCATION, location)));
    Ok(response)
}

/// Tells what of tus this server can do.
#[utoipa::path(
    options, path = "/v1/uploads", operation_id = "upload_capabilities", tag = "uploads",
    responses(
        (status = 204, description = "Versions, extensions and the largest upload, in headers", headers(
            ("Tus-Version" = String, description = "Versions of tus"),
            ("Tus-Extension" = String, description = "Its extensions that are known here"),
            ("Tus-Max-Size" = u64, description = "Bytes of the largest upload"),
            ("Tus-Checksum-Algorithm" = String, description = "Checksums that are known here"),
        )),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 403, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["write"]), ())
)]
pub async fn capabilities(State(app): State<App>) -> Response {
    tus::capabilities(app.services.uploads.max_upload_bytes())
}

/// An upload as it stands: how much of it is there, the scene it has become, or why there is none.
#[utoipa::path(
    get, path = "/v1/uploads/{upload_id}", operation_id = "get_upload", tag = "uploads", params(("upload_id" = String, Path)),
    responses(
        (status = 200, body = Upload),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 403, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 410, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["write"]), ())
)]
pub async fn get(
    State(app): State<App>,
    Path(upload_id): Path<String>,
    Extension(caller): CallerExtension,
) -> Result<axum::Json<Upload>, ProblemResponse> {
    Ok(axum::Json(app.services.uploads.upload(&upload_id, &caller).await?))
}

/// How much of an upload is there, in headers.
#[utoipa::path(
    head, path = "/v1/uploads/{upload_id}", operation_id = "get_upload_offset", tag = "uploads",
    params(("upload_id" = String, Path), ("Tus-Resumable" = inline(tus::Version), Header, description = "The version of tus")),
    responses(
        (status = 200, description = "Where to go on", headers(
            ("Upload-Offset" = u64, description = "Bytes that are there"),
            ("Upload-Length" = u64, description = "Bytes of the whole"),
            ("Upload-Metadata" = String, description = "As it came"),
            ("Upload-Expires" = String, description = "When it is removed unless more of it comes"),
            ("uniground-scene-id" = String, description = "The scene it has become"),
            ("uniground-job-id" = String, description = "The job that parses the scene"),
        )),
        (status = 401, description = "No key, or one that is not known (any more)"),
        (status = 403, description = "The key may not do this"),
        (status = 404, description = "There is no such upload"),
        (status = 410, description = "It was not gone on with for too long"),
        (status = 412, description = "Another version of tus"),
        (status = 429, description = "Too much at once: again after `Retry-After`"),
    ),
    security(("key" = ["write"]), ())
)]
pub async fn head(
    State(app): State<App>,
    Path(upload_id): Path<String>,
    Extension(caller): CallerExtension,
) -> Result<Response, ProblemResponse> {
    let upload = app.services.uploads.upload(&upload_id, &caller).await?;
    let note = app.services.uploads.upload_note(&upload_id, &caller).await?;
    let mut headers = tus::state_headers(&upload);
    headers.insert(tus::LENGTH, upload.length.into());
    headers.extend(
        note.and_then(|note| HeaderValue::from_str(&note).ok()).map(|note| (tus::METADATA, note)),
    );
    Ok(headers.into_response())
}

/// Goes on with an upload, from the offset it is at.
///
/// With its last bytes it becomes a scene, which `uniground-scene-id` names; content that is no
/// scan is refused with what is wrong with it. What came of a part that breaks off is kept; of one
/// with a checksum, which can not be checked then, nothing.
#[utoipa::path(
    patch, path = "/v1/uploads/{upload_id}", operation_id = "append_to_upload", tag = "uploads",
    params(
        ("upload_id" = String, Path),
        ("Tus-Resumable" = inline(tus::Version), Header, description = "The version of tus"),
        ("Upload-Offset" = u64, Header, description = "Bytes that are there already"),
        ("Upload-Checksum" = Option<String>, Header, description = "Of this part: `sha1` or `sha256`, a space, base64"),
    ),
    request_body(content = super::Binary, content_type = "application/offset+octet-stream"),
    responses(
        (status = 204, description = "It is on the disk", headers(
            ("Upload-Offset" = u64, description = "Bytes that are there"),
            ("Upload-Expires" = String, description = "When it is removed unless more of it comes"),
            ("uniground-scene-id" = String, description = "The scene it has become"),
            ("uniground-job-id" = String, description = "The job that parses the scene"),
        )),
        (status = 400, body = Problem, content_type = "application/problem+json"),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 403, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 408, body = Problem, content_type = "application/problem+json"),
        (status = 409, body = Problem, content_type = "application/problem+json", headers(
            ("Upload-Offset" = u64, description = "Where to go on"),
        )),
        (status = 410, body = Problem, content_type = "application/problem+json"),
        (status = 412, body = Problem, content_type = "application/problem+json"),
        (status = 413, body = Problem, content_type = "application/problem+json"),
        (status = 415, body = Problem, content_type = "application/problem+json"),
        (status = 422, body = Problem, content_type = "application/problem+json"),
        (status = 423, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
        (status = 460, body = Problem, content_type = "application/problem+json"),
        (status = 507, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["write"]), ())
)]
pub async fn append(
    State(app): State<App>,
    Path(upload_id): Path<String>,
    Extension(caller): CallerExtension,
    headers: HeaderMap,
    request: Request,
) -> Result<Response, ProblemResponse> {
    append_part(&app, &upload_id, caller, &headers, request.into_body()).await
}

/// The same as `PATCH` or `DELETE`, for those whose network lets neither through:
/// `X-HTTP-Method-Override` says which.
#[utoipa::path(
    post, path = "/v1/uploads/{upload_id}", operation_id = "append_to_upload_by_post", tag = "uploads",
    params(
        ("upload_id" = String, Path),
        ("Tus-Resumable" = inline(tus::Version), Header, description = "The version of tus"),
        ("X-HTTP-Method-Override" = String, Header, description = "`PATCH` or `DELETE`"),
        ("Upload-Offset" = Option<u64>, Header, description = "Bytes that are there already"),
        ("Upload-Checksum" = Option<String>, Header, description = "Of this part: `sha1` or `sha256`, a space, base64"),
    ),
    request_body(content = super::Binary, content_type = "application/offset+octet-stream"),
    responses(
        (status = 204, description = "As that method answers"),
        (status = 400, body = Problem, content_type = "application/problem+json"),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 403, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 408, body = Problem, content_type = "application/problem+json"),
        (status = 409, body = Problem, content_type = "application/problem+json"),
        (status = 410, body = Problem, content_type = "application/problem+json"),
        (status = 412, body = Problem, content_type = "application/problem+json"),
        (status = 413, body = Problem, content_type = "application/problem+json"),
        (status = 415, body = Problem, content_type = "application/problem+json"),
        (status = 422, body = Problem, content_type = "application/problem+json"),
        (status = 423, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
        (status = 460, body = Problem, content_type = "application/problem+json"),
        (status = 507, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["write"]), ())
)]
pub async fn post(
    State(app): State<App>,
    Path(upload_id): Path<String>,
    Extension(caller): CallerExtension,
    headers: HeaderMap,
    request: Request,
) -> Result<Response, ProblemResponse> {
    match headers.get(tus::METHOD_OVERRIDE).map(HeaderValue::as_bytes) {
        Some(b"PATCH") => {
            append_part(&app, &upload_id, caller, &headers, request.into_body()).await
        }
        Some(b"DELETE") => {
            app.services.uploads.delete_upload(&upload_id, &caller).await?;
            Ok(StatusCode::NO_CONTENT.into_response())
        }
        _ => Err(ProblemResponse::new(
            StatusCode::BAD_REQUEST,
            "header_wrong",
            "x-http-method-override: PATCH or DELETE is wanted",
        )),
    }
}

/// Gives an upload up, or forgets one that is over; its scene stays.
#[utoipa::path(
    delete, path = "/v1/uploads/{upload_id}", operation_id = "delete_upload", tag = "uploads",
    params(("upload_id" = String, Path), ("Tus-Resumable" = inline(tus::Version), Header, description = "The version of tus")),
    responses(
        (status = 204, description = "Gone"),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 403, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 410, body = Problem, content_type = "application/problem+json"),
        (status = 412, body = Problem, content_type = "application/problem+json"),
        (status = 423, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["write"]), ())
)]
pub async fn delete(
    State(app): State<App>,
    Path(upload_id): Path<String>,
    Extension(caller): CallerExtension,
) -> Result<StatusCode, ProblemResponse> {
    app.services.uploads.delete_upload(&upload_id, &caller).await?;
    Ok(StatusCode::NO_CONTENT)
}

async fn append_part(
    app: &App,
    upload_id: &str,
    caller: Caller,
    headers: &HeaderMap,
    body: Body,
) -> Result<Response, ProblemResponse> {
    tus::check_part(headers)?;
    let (offset, checksum) =
        (tus::parse_byte_count(headers, &tus::OFFSET)?, tus::checksum(headers)?);
    let part = UploadPart {
        offset,
        announced_bytes: content_length(headers),
        checksum,
        body: body.into_data_stream(),
    };
    match app.services.uploads.append(upload_id, part, caller).await {
        Ok(upload) => Ok(upload_response(StatusCode::NO_CONTENT, upload)),
        Err(uniground_service::error::Error::WrongOffset { offset }) => {
            let refused =
                ProblemResponse::from(uniground_service::error::Error::WrongOffset { offset });
            Ok(([(tus::OFFSET, offset.to_string())], refused).into_response())
        }
        Err(error) => Err(error.into()),
    }
}

/// How far an upload is; why there is no scene, where it was refused.
fn upload_response(status: StatusCode, upload: Upload) -> Response {
    let headers = tus::state_headers(&upload);
    match (&upload.problem, status) {
        (Some(problem), _) => (headers, ProblemResponse::from(problem.clone())).into_response(),
        (None, StatusCode::CREATED) => (status, headers, axum::Json(upload)).into_response(),
        (None, status) => (status, headers).into_response(),
    }
}

fn content_length(headers: &HeaderMap) -> u64 {
    headers
        .get(header::CONTENT_LENGTH)
        .and_then(|bytes| bytes.to_str().ok()?.parse().ok())
        .unwrap_or(0)
}
