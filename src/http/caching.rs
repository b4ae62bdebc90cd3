//! What a browser may keep: everything of a scene, for itself alone and never unasked. A scene's
//! address stays while its parse changes, so each answer has a mark (`ETag`), and whoever shows it
//! again is told when nothing has changed.

use super::problem::ProblemResponse;
use axum::body::{Body, to_bytes};
use axum::extract::Request;
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use camino::Utf8Path;
use http_body::Body as _;
use sha2::{Digest, Sha256};
use tower::ServiceExt;
use tower_http::services::ServeFile;
use uniground_service::FileDownload;
use uniground_service::error::Error;

/// For the caller alone, and to be asked about each time.
const REVALIDATE: HeaderValue = HeaderValue::from_static("private, no-cache");
/// Larger bodies are not marked here: files have marks of their own.
const MAX_ETAG_BYTES: u64 = 2 << 20;

/// A stored file, whole or the part that `asked` names (`Range`), or nothing where the caller has
/// it (`If-None-Match`).
pub async fn send_file(
    path: &Utf8Path,
    media_type: &'static str,
    request_headers: &HeaderMap,
) -> Result<Response, ProblemResponse> {
    let serve = async |names: &[HeaderName]| {
        let mut request = Request::new(Body::empty());
        for name in names {
            request
                .headers_mut()
                .extend(request_headers.get(name).map(|value| (name.clone(), value.clone())));
        }
        let Ok(served) = ServeFile::new(path).oneshot(request).await;
        served
    };
    let is_same = match request_headers.get(header::IF_RANGE) {
        Some(mark) => serve(&[]).await.headers().get(header::ETAG) == Some(mark),
        None => true,
    };
    // A part of another file than the caller has the rest of would be of no use.
    let served = match is_same {
        true => serve(&[header::RANGE, header::IF_NONE_MATCH, header::IF_MODIFIED_SINCE]).await,
        false => serve(&[]).await,
    };
    if served.status() == StatusCode::NOT_FOUND {
        return Err(Error::Io(std::io::ErrorKind::NotFound.into()).into());
    }
    let mut response = served.map(Body::new);
    response.headers_mut().insert(header::CONTENT_TYPE, HeaderValue::from_static(media_type));
    response.headers_mut().insert(header::CACHE_CONTROL, REVALIDATE);
    Ok(response)
}

/// A file that is here, or where else it is: only for now, so that nothing keeps the address.
pub async fn send_download(
    file: FileDownload,
    media_type: &'static str,
    request_headers: &HeaderMap,
) -> Result<Response, ProblemResponse> {
    match file {
        FileDownload::Local(file) => send_file(&file, media_type, request_headers).await,
        FileDownload::Redirect(link) => {
            let headers = [(header::LOCATION, link.as_str()), (header::CACHE_CONTROL, "no-store")];
            Ok((StatusCode::TEMPORARY_REDIRECT, headers).into_response())
        }
    }
}

/// What was made for the caller, whole, or nothing where the caller has it. The same bytes have the
/// same fingerprint, and others another.
pub fn send_bytes(
    bytes: Vec<u8>,
    fingerprint: &str,
    media_type: &'static str,
    request_headers: &HeaderMap,
) -> Response {
    let etag = format!("\"{fingerprint}\"");
    let known = request_headers.get(header::IF_NONE_MATCH).and_then(|known| known.to_str().ok());
    let mut response = match known.is_some_and(|known| etag_matches(known, &etag)) {
        true => StatusCode::NOT_MODIFIED.into_response(),
        false => ([(header::CONTENT_TYPE, media_type)], bytes).into_response(),
    };
    response.headers_mut().insert(header::CACHE_CONTROL, REVALIDATE);
    if let Ok(etag) = HeaderValue::from_str(&etag) {
        response.headers_mut().insert(header::ETAG, etag);
    }
    response
}

/// Marks what is small and read: the same bytes have the same mark, and are not sent to who has
/// them.
pub async fn add_etag(request: Request, next: Next) -> Response {
    let is_read = request.method() == Method::GET;
    let known = request.headers().get(header::IF_NONE_MATCH).cloned();
    let response = next.run(request).await;
    let is_small = response.body().size_hint().exact().is_some_and(|bytes| bytes <= MAX_ETAG_BYTES);
    let is_marked = response.headers().contains_key(header::ETAG)
        || response.headers().contains_key(header::CACHE_CONTROL);
    if !is_read || response.status() != StatusCode::OK || !is_small || is_marked {
        return response;
    }
    let (mut parts, body) = response.into_parts();
    let Ok(bytes) = to_bytes(body, MAX_ETAG_BYTES as usize).await else {
        return ProblemResponse::internal().into_response();
    };
    let hash: String =
        Sha256::digest(&bytes).iter().take(12).map(|byte| format!("{byte:02x}")).collect();
    let etag = format!("W/\"{hash}\"");
    parts.headers.insert(header::CACHE_CONTROL, REVALIDATE);
    let is_known = known
        .as_ref()
        .and_then(|known| known.to_str().ok())
        .is_some_and(|known| etag_matches(known, &etag));
    if let Ok(etag) = HeaderValue::from_str(&etag) {
        parts.headers.insert(header::ETAG, etag);
    }
    if is_known {
        parts.status = StatusCode::NOT_MODIFIED;
        parts.headers.remove(header::CONTENT_LENGTH);
        return Response::from_parts(parts, Body::empty());
    }
    Response::from_parts(parts, Body::from(bytes))
}

/// Whether `If-None-Match` names a mark.
fn etag_matches(known: &str, etag: &str) -> bool {
    known.trim() == "*"
        || known
            .split(',')
            .any(|known| known.trim().trim_start_matches("W/") == etag.trim_start_matches("W/"))
}

/// A file's mark is of its own bytes: of what was compressed on the way it says the same thing, not
/// the same bytes.
pub async fn weaken_etag(mut response: Response) -> Response {
    let headers = response.headers_mut();
    let strong = headers
        .get(header::ETAG)
        .and_then(|etag| etag.to_str().ok())
        .filter(|etag| !etag.starts_with("W/"));
    let weak = strong.and_then(|etag| HeaderValue::from_str(&format!("W/{etag}")).ok());
    if let Some(weak) = weak.filter(|_| headers.contains_key(header::CONTENT_ENCODING)) {
        headers.insert(header::ETAG, weak);
    }
    response
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn etags_are_compared_weakly() {
        assert!(
            etag_matches("W/\"a\"", "W/\"a\"")
                && etag_matches("\"b\", \"a\"", "W/\"a\"")
                && etag_matches("*", "W/\"a\"")
        );
        assert!(!etag_matches("\"b\"", "W/\"a\"") && !etag_matches("", "W/\"a\""));
    }
}
