//! Headers and version of tus 1.0, a protocol for resumable uploads
//! (<https://tus.io/protocols/resumable-upload>). The service implements the uploads independently
//! of the protocol.

use super::problem::ProblemResponse;
use axum::extract::Request;
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::{AppendHeaders, IntoResponse, Response};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use jiff::Timestamp;
use jiff::fmt::rfc2822::DateTimePrinter;
use uniground_service::{Checksum, ChecksumAlgorithm};
use uniground_types::uploads::Upload;

pub const RESUMABLE: HeaderName = HeaderName::from_static("tus-resumable");
pub const VERSION: HeaderName = HeaderName::from_static("tus-version");
pub const EXTENSION: HeaderName = HeaderName::from_static("tus-extension");
pub const MAX_SIZE: HeaderName = HeaderName::from_static("tus-max-size");
pub const CHECKSUM_ALGORITHM: HeaderName = HeaderName::from_static("tus-checksum-algorithm");
pub const OFFSET: HeaderName = HeaderName::from_static("upload-offset");
pub const LENGTH: HeaderName = HeaderName::from_static("upload-length");
pub const METADATA: HeaderName = HeaderName::from_static("upload-metadata");
pub const CHECKSUM: HeaderName = HeaderName::from_static("upload-checksum");
pub const EXPIRES: HeaderName = HeaderName::from_static("upload-expires");
pub const METHOD_OVERRIDE: HeaderName = HeaderName::from_static("x-http-method-override");
/// Header with the scene of an upload. Not part of tus.
pub const SCENE_ID: HeaderName = HeaderName::from_static("uniground-scene-id");
pub const JOB_ID: HeaderName = HeaderName::from_static("uniground-job-id");

const SUPPORTED_VERSION: HeaderValue = HeaderValue::from_static("1.0.0");
const EXTENSIONS: &str = "creation,creation-with-upload,checksum,expiration,termination";
const PART: &str = "application/offset+octet-stream";
/// Maximum length of the metadata, bytes.
const MAX_METADATA_CHARS: usize = 8 << 10;

/// The supported version of tus.
#[derive(utoipa::ToSchema)]
#[expect(dead_code, reason = "only its schema is used")]
pub enum Version {
    #[schema(rename = "1.0.0")]
    Spoken,
}

/// Rejects requests with another version of tus, and adds the version to responses.
pub async fn check_version(request: Request, next: Next) -> Response {
    let is_asked =
        matches!(*request.method(), Method::POST | Method::HEAD | Method::PATCH | Method::DELETE);
    let mut response =
        match is_asked && request.headers().get(RESUMABLE) != Some(&SUPPORTED_VERSION) {
            true => {
                let detail = "resumable uploads use tus 1.0: send the header Tus-Resumable: 1.0.0";
                let refused = ProblemResponse::new(
                    StatusCode::PRECONDITION_FAILED,
                    "tus_version_unknown",
                    detail,
                );
                ([(VERSION, SUPPORTED_VERSION)], refused).into_response()
            }
            false => next.run(request).await,
        };
    response.headers_mut().insert(RESUMABLE, SUPPORTED_VERSION);
    response
}

/// Returns the capabilities of this server.
pub fn capabilities(max_bytes: u64) -> Response {
    let algorithms = ChecksumAlgorithm::ALL.map(ChecksumAlgorithm::word).join(",");
    let told = [
        (VERSION, "1.0.0".to_owned()),
        (EXTENSION, EXTENSIONS.to_owned()),
        (MAX_SIZE, max_bytes.to_string()),
        (CHECKSUM_ALGORITHM, algorithms),
    ];
    (StatusCode::NO_CONTENT, AppendHeaders(told)).into_response()
}

/// Returns the state of an upload as headers.
pub fn state_headers(upload: &Upload) -> HeaderMap {
    let mut headers = HeaderMap::new();
    headers.insert(OFFSET, upload.offset.into());
    let expires = upload.expires_at.as_deref().and_then(|at| at.parse::<Timestamp>().ok());
    let expires =
        expires.and_then(|at| DateTimePrinter::new().timestamp_to_rfc9110_string(&at).ok());
    for (name, value) in
        [(EXPIRES, &expires), (SCENE_ID, &upload.scene_id), (JOB_ID, &upload.job_id)]
    {
        headers.extend(
            value
                .as_ref()
                .and_then(|value| HeaderValue::from_str(value).ok())
                .map(|value| (name, value)),
        );
    }
    headers
}

/// Returns whether the body is a part of an upload.
pub fn is_part(headers: &HeaderMap) -> bool {
    headers.get(header::CONTENT_TYPE).is_some_and(|media_type| media_type == PART)
}

/// # Errors
/// Returns an error for another content type.
pub fn check_part(headers: &HeaderMap) -> Result<(), ProblemResponse> {
    if is_part(headers) {
        return Ok(());
    }
    Err(ProblemResponse::new(
        StatusCode::UNSUPPORTED_MEDIA_TYPE,
        "unsupported_media_type",
        format!("a part of an upload must have the content type {PART}"),
    ))
}

/// Parses a header with a number of bytes.
///
/// # Errors
/// Returns an error if the header is missing or invalid.
pub fn parse_byte_count(headers: &HeaderMap, name: &HeaderName) -> Result<u64, ProblemResponse> {
    let value = headers
        .get(name)
        .and_then(|value| value.to_str().ok())
        .filter(|value| value.bytes().all(|byte| byte.is_ascii_digit()));
    // SQLite and many clients use signed 64-bit integers.
    let value =
        value.and_then(|value| value.parse().ok()).filter(|bytes| i64::try_from(*bytes).is_ok());
    value.ok_or_else(|| invalid_header(name, "must be a number of bytes"))
}

/// Parses the checksum of a part.
///
/// # Errors
/// Returns an error for an unknown or invalid checksum.
pub fn checksum(headers: &HeaderMap) -> Result<Option<Checksum>, ProblemResponse> {
    let Some(value) = headers.get(CHECKSUM) else { return Ok(None) };
    let read = || {
        let (word, sum) = value.to_str().ok()?.split_once(' ')?;
        let algorithm =
            ChecksumAlgorithm::ALL.into_iter().find(|algorithm| algorithm.word() == word)?;
        let sum = STANDARD.decode(sum.trim()).ok().filter(|sum| sum.len() == algorithm.bytes())?;
        Some(Checksum { algorithm, sum })
    };
    let known = ChecksumAlgorithm::ALL.map(ChecksumAlgorithm::word).join(" or ");
    read().map(Some).ok_or_else(|| {
        invalid_header(&CHECKSUM, &format!("must be {known}, a space, and the checksum in base64"))
    })
}

/// Metadata of an upload.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Metadata {
    /// The unchanged header.
    pub header: Option<String>,
    /// Keys and values.
    pub pairs: Vec<(String, String)>,
}

/// Parses the metadata of an upload.
///
/// # Errors
/// Returns an error if the header is invalid.
pub fn metadata(headers: &HeaderMap) -> Result<Metadata, ProblemResponse> {
    let Some(value) = headers.get(METADATA) else { return Ok(Metadata::default()) };
    let value = value.to_str().ok().filter(|value| value.len() <= MAX_METADATA_CHARS);
    let value = value.ok_or_else(|| {
        invalid_header(
            &METADATA,
            &format!("must have at most {MAX_METADATA_CHARS} visible characters"),
        )
    })?;
    let pairs = value.split(',').map(str::trim).filter(|pair| !pair.is_empty()).map(|pair| {
        let (key, coded) = pair.split_once(' ').unwrap_or((pair, ""));
        let text =
            STANDARD.decode(coded.trim()).ok().and_then(|bytes| String::from_utf8(bytes).ok());
        text.map(|text| (key.to_owned(), text))
    });
    let pairs: Option<Vec<_>> = pairs.collect();
    let pairs = pairs.ok_or_else(|| {
        invalid_header(&METADATA, "must be comma-separated pairs of a key and a base64 value")
    })?;
    Ok(Metadata { header: Some(value.to_owned()).filter(|value| !value.is_empty()), pairs })
}

fn invalid_header(name: &HeaderName, detail: &str) -> ProblemResponse {
    ProblemResponse::new(StatusCode::BAD_REQUEST, "header_wrong", format!("{name}: {detail}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(name: HeaderName, value: &'static str) -> HeaderMap {
        HeaderMap::from_iter([(name, HeaderValue::from_static(value))])
    }

    #[test]
    fn metadata_is_pairs_in_base64() {
        let read = |value| metadata(&of(METADATA, value)).map(|metadata| metadata.pairs);
        let pair = |key: &str, text: &str| (key.to_owned(), text.to_owned());
        let room = "filename cm9vbS56aXA=,name w6Rscw==, is_confidential";
        assert_eq!(
            read(room).unwrap(),
            [pair("filename", "room.zip"), pair("name", "äls"), pair("is_confidential", "")]
        );
        assert_eq!(read("").unwrap(), []);
        assert!(read("filename room.zip").is_err() && read("filename /w==").is_err());
        assert_eq!(metadata(&HeaderMap::new()).unwrap(), Metadata::default());
    }

    #[test]
    fn numbers_and_checksums_are_parsed_strictly() {
        for (value, read) in [
            ("0", Some(0)),
            ("17", Some(17)),
            ("+1", None),
            ("-1", None),
            ("", None),
            ("9223372036854775808", None),
        ] {
            assert_eq!(parse_byte_count(&of(OFFSET, value), &OFFSET).ok(), read, "{value:?}");
        }
        assert!(parse_byte_count(&HeaderMap::new(), &OFFSET).is_err());
        let read = |value| {
            checksum(&of(CHECKSUM, value)).ok().flatten().map(|checksum| checksum.algorithm)
        };
        assert_eq!(read("sha1 Kq5sNclPz7QV2+lfQIuc6R7oRu0="), Some(ChecksumAlgorithm::Sha1));
        for wrong in [
            "sha1 Kq5s",
            "md5 Kq5sNclPz7QV2+lfQIuc6R7oRu0=",
            "sha1",
            "sha256 Kq5sNclPz7QV2+lfQIuc6R7oRu0=",
        ] {
            assert_eq!(read(wrong), None, "{wrong:?}");
        }
    }
}
