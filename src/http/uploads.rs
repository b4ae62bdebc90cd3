//! `/v1/uploads`: resumable uploads with tus 1.0.

use super::extract::{IdempotencyKey, Path, Query};
use super::problem::ProblemResponse;
use super::problems;
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

/// Options of the scene. `Upload-Metadata` accepts the same names; these parameters take
/// precedence.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct UploadParameters {
    /// Name of the scene. Default: the name in the archive.
    #[param(max_length = 200)]
    name: Option<String>,
    /// File name. Its extension identifies formats that the bytes do not.
    #[param(max_length = 200)]
    filename: Option<String>,
    /// `false` stores the scan without parsing it.
    #[param(default = true)]
    parse: Option<bool>,
    /// Axis of the files that points up, for archives that do not state it. Default: the axis that
    /// the cameras hold up.
    #[param(inline)]
    up: Option<UpAxis>,
    /// Preset of the parse settings.
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
                // Other keys are for the client's own use.
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

/// Begins a resumable upload.
///
/// Implements [tus 1.0](https://tus.io/protocols/resumable-upload). `Location` is the URL of the
/// upload. Send the bytes there with `PATCH`, from the offset that `HEAD` returns. The first bytes
/// may be sent with this request as `application/offset+octet-stream`. When the upload is complete,
/// a scene is created as with `POST /v1/scenes`.
#[utoipa::path(
    post, path = "/v1/uploads", operation_id = "create_upload", tag = "uploads",
    params(
        UploadParameters,
        ("Tus-Resumable" = inline(tus::Version), Header, description = "Version of tus"),
        ("Upload-Length" = u64, Header, description = "Total number of bytes"),
        ("Upload-Metadata" = Option<String>, Header, description = "`filename`, `name`, `parse`, `up`, `preset`, with values in base64"),
        ("Upload-Checksum" = Option<String>, Header, description = "Checksum of the body: `sha1` or `sha256`, a space, base64"),
        ("Idempotency-Key" = Option<String>, Header, description = "Uploads with the same key create one scene"),
    ),
    responses(
        (status = 201, body = Upload, headers(
            ("Location" = String, description = "URL of the upload"),
            ("Upload-Offset" = u64, description = "Number of received bytes"),
            ("Upload-Expires" = String, description = "Time when the upload expires without further bytes"),
        )),
        problems::Common, problems::BadRequest, problems::Forbidden, problems::Timeout,
        problems::PreconditionFailed, problems::TooLarge, problems::Unprocessable,
        problems::ChecksumMismatch, problems::StorageFull,
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
    // Checked before an upload is created, whose URL the client would not learn.
    let checksum = tus::checksum(&headers)?;
    let upload = app.services.uploads.begin_upload(NewUpload { length, wanted }, &caller).await?;
    let location = format!("{}/v1/uploads/{}", forwarded_prefix(&headers), upload.id);
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

/// What a proxy has removed from the beginning of the path.
const FORWARDED_PREFIX: &str = "x-forwarded-prefix";

/// Returns the prefix below which a proxy serves this server, without a slash at its end. Empty
/// without one, and for anything that is not a plain path.
fn forwarded_prefix(headers: &HeaderMap) -> &str {
    let prefix = headers.get(FORWARDED_PREFIX).and_then(|value| value.to_str().ok());
    let prefix = prefix.unwrap_or_default().trim_end_matches('/');
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "/-._~".contains(c);
    let is_path = prefix.starts_with('/') && !prefix.contains("//") && prefix.chars().all(is_plain);
    if is_path { prefix } else { "" }
}

/// Returns the tus capabilities of this server.
#[utoipa::path(
    options, path = "/v1/uploads", operation_id = "upload_capabilities", tag = "uploads",
    responses(
        (status = 204, description = "Versions, extensions and the maximum size, in headers", headers(
            ("Tus-Version" = String, description = "Supported versions of tus"),
            ("Tus-Extension" = String, description = "Supported extensions"),
            ("Tus-Max-Size" = u64, description = "Maximum size of an upload, bytes"),
            ("Tus-Checksum-Algorithm" = String, description = "Supported checksum algorithms"),
        )),
        problems::Common, problems::Forbidden,
    ),
    security(("key" = ["write"]), ())
)]
pub async fn capabilities(State(app): State<App>) -> Response {
    tus::capabilities(app.services.uploads.max_upload_bytes())
}

/// Returns an upload with its offset, its scene, or the reason why it was rejected.
#[utoipa::path(
    get, path = "/v1/uploads/{upload_id}", operation_id = "get_upload", tag = "uploads", params(("upload_id" = String, Path)),
    responses(
        (status = 200, body = Upload),
        problems::Common, problems::Forbidden, problems::NotFound, problems::Gone,
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

/// Returns the offset of an upload in headers.
#[utoipa::path(
    head, path = "/v1/uploads/{upload_id}", operation_id = "get_upload_offset", tag = "uploads",
    params(("upload_id" = String, Path), ("Tus-Resumable" = inline(tus::Version), Header, description = "Version of tus")),
    responses(
        (status = 200, description = "The current offset", headers(
            ("Upload-Offset" = u64, description = "Number of received bytes"),
            ("Upload-Length" = u64, description = "Total number of bytes"),
            ("Upload-Metadata" = String, description = "The unchanged metadata"),
            ("Upload-Expires" = String, description = "Time when the upload expires without further bytes"),
            ("uniground-scene-id" = String, description = "Id of the created scene"),
            ("uniground-job-id" = String, description = "Id of the parse job"),
        )),
        (status = 401, description = "The API key is missing or invalid"),
        (status = 403, description = "The key lacks the required scope"),
        (status = 404, description = "Upload not found"),
        (status = 410, description = "The upload has expired"),
        (status = 412, description = "Unsupported version of tus"),
        (status = 429, description = "Too many requests: retry after `Retry-After`"),
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

/// Appends bytes to an upload, at its current offset.
///
/// The last bytes complete the upload: a scene is created, and `uniground-scene-id` names it. An
/// invalid scan is rejected with a description of the problem. The received bytes of an interrupted
/// part are kept, unless the part has a checksum.
#[utoipa::path(
    patch, path = "/v1/uploads/{upload_id}", operation_id = "append_to_upload", tag = "uploads",
    params(
        ("upload_id" = String, Path),
        ("Tus-Resumable" = inline(tus::Version), Header, description = "Version of tus"),
        ("Upload-Offset" = u64, Header, description = "Current offset of the upload"),
        ("Upload-Checksum" = Option<String>, Header, description = "Checksum of this part: `sha1` or `sha256`, a space, base64"),
    ),
    request_body(content = super::Binary, content_type = "application/offset+octet-stream"),
    responses(
        (status = 204, description = "The bytes are stored", headers(
            ("Upload-Offset" = u64, description = "Number of received bytes"),
            ("Upload-Expires" = String, description = "Time when the upload expires without further bytes"),
            ("uniground-scene-id" = String, description = "Id of the created scene"),
            ("uniground-job-id" = String, description = "Id of the parse job"),
        )),
        (status = 409, body = Problem, content_type = "application/problem+json", headers(
            ("Upload-Offset" = u64, description = "The current offset"),
        )),
        problems::Common, problems::BadRequest, problems::Forbidden, problems::NotFound,
        problems::Timeout, problems::Gone, problems::PreconditionFailed, problems::TooLarge,
        problems::UnsupportedMediaType, problems::Unprocessable, problems::Locked,
        problems::ChecksumMismatch, problems::StorageFull,
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

/// Does the same as `PATCH` or `DELETE`, for networks that block these methods.
/// `X-HTTP-Method-Override` selects the method.
#[utoipa::path(
    post, path = "/v1/uploads/{upload_id}", operation_id = "append_to_upload_by_post", tag = "uploads",
    params(
        ("upload_id" = String, Path),
        ("Tus-Resumable" = inline(tus::Version), Header, description = "Version of tus"),
        ("X-HTTP-Method-Override" = String, Header, description = "`PATCH` or `DELETE`"),
        ("Upload-Offset" = Option<u64>, Header, description = "Current offset of the upload"),
        ("Upload-Checksum" = Option<String>, Header, description = "Checksum of this part: `sha1` or `sha256`, a space, base64"),
    ),
    request_body(content = super::Binary, content_type = "application/offset+octet-stream"),
    responses(
        (status = 204, description = "As for the selected method"),
        problems::Common, problems::BadRequest, problems::Forbidden, problems::NotFound,
        problems::Timeout, problems::Conflict, problems::Gone, problems::PreconditionFailed,
        problems::TooLarge, problems::UnsupportedMediaType, problems::Unprocessable,
        problems::Locked, problems::ChecksumMismatch, problems::StorageFull,
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
            "x-http-method-override: must be PATCH or DELETE",
        )),
    }
}

/// Cancels an upload, or removes the record of a finished one. Its scene is kept.
#[utoipa::path(
    delete, path = "/v1/uploads/{upload_id}", operation_id = "delete_upload", tag = "uploads",
    params(("upload_id" = String, Path), ("Tus-Resumable" = inline(tus::Version), Header, description = "Version of tus")),
    responses(
        (status = 204, description = "Gone"),
        problems::Common, problems::Forbidden, problems::NotFound, problems::Gone,
        problems::PreconditionFailed, problems::Locked,
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

/// Returns the state of an upload, or the reason why it was rejected.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_plain_prefixes_are_believed() {
        let prefix = |value: &'static str| {
            let headers = HeaderMap::from_iter([(
                header::HeaderName::from_static(FORWARDED_PREFIX),
                HeaderValue::from_static(value),
            )]);
            forwarded_prefix(&headers).to_owned()
        };
        assert_eq!(prefix("/rooms"), "/rooms");
        assert_eq!(prefix("/a/rooms/"), "/a/rooms");
        for wrong in ["", "/", "rooms", "//evil.example", "/a?b", "https://evil.example", "/a b"] {
            assert_eq!(prefix(wrong), "", "{wrong}");
        }
        assert_eq!(forwarded_prefix(&HeaderMap::new()), "");
    }
}
