//! `/`, `/viewer` and `/assets/…`: the web page. It is built from `web/` (`make web`) and embedded
//! in the executable, so it works offline. It needs no key, because it contains no data and uses
//! the API like any client.

use super::problem::no_such_route;
use axum::Router;
use axum::body::Bytes;
use axum::extract::Path;
use axum::http::{HeaderMap, HeaderValue, StatusCode, Uri, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use flate2::Compression;
use flate2::write::GzEncoder;
use rust_embed::Embed;
use std::collections::BTreeMap;
use std::io::Write;
use std::sync::LazyLock;

#[derive(Embed)]
#[folder = "web/dist"]
#[exclude = "SOURCES"]
struct PageFiles;

/// Content security policy: only own files, nothing inline, no framing. Pictures are loaded with
/// `fetch`, which can send a key, and shown from memory (`blob:`).
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; \
    base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// The start page. It names the other files, so it is revalidated each time.
const INDEX: &str = "index.html";
const REVALIDATE: &str = "no-cache";

/// Cache policy of the other files, whose names contain a hash of their bytes.
const IMMUTABLE: &str = "public, max-age=31536000, immutable";

/// A file of the page, uncompressed and compressed.
struct File {
    media_type: &'static str,
    plain: Bytes,
    gzip: Bytes,
}

static FILES: LazyLock<BTreeMap<String, File>> = LazyLock::new(|| {
    let files = PageFiles::iter().filter_map(|name| {
        Some((name.to_string(), File::with_gzip(&name, PageFiles::get(&name)?.data.into_owned())))
    });
    files.collect()
});

impl File {
    fn with_gzip(name: &str, plain: Vec<u8>) -> Self {
        let media_type = match name.rsplit_once('.').map(|(_, end)| end) {
            Some("html") => "text/html; charset=utf-8",
            Some("js") => "text/javascript; charset=utf-8",
            Some("css") => "text/css; charset=utf-8",
            Some("svg") => "image/svg+xml",
            Some("txt") => "text/plain; charset=utf-8",
            _ => "application/octet-stream",
        };
        let gzip = gzip_bytes(&plain).unwrap_or_default();
        Self { media_type, plain: plain.into(), gzip: gzip.into() }
    }

    fn answer(&self, request_headers: &HeaderMap, cache_control: &'static str) -> Response {
        let headers = [
            (header::CONTENT_TYPE, self.media_type),
            (header::CACHE_CONTROL, cache_control),
            (header::CONTENT_SECURITY_POLICY, POLICY),
            (header::VARY, "accept-encoding"),
        ];
        let mut response = headers.into_response();
        if accepts_gzip(request_headers) && !self.gzip.is_empty() {
            response
                .headers_mut()
                .insert(header::CONTENT_ENCODING, HeaderValue::from_static("gzip"));
            *response.body_mut() = self.gzip.clone().into();
        } else {
            *response.body_mut() = self.plain.clone().into();
        }
        response
    }
}

fn gzip_bytes(plain: &[u8]) -> std::io::Result<Vec<u8>> {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::best());
    encoder.write_all(plain)?;
    encoder.finish()
}

fn accepts_gzip(request_headers: &HeaderMap) -> bool {
    let taken = request_headers
        .get_all(header::ACCEPT_ENCODING)
        .iter()
        .filter_map(|value| value.to_str().ok());
    taken.flat_map(|value| value.split(',')).any(|coding| {
        let (name, weight) = coding.split_once(';').unwrap_or((coding, "q=1"));
        name.trim().eq_ignore_ascii_case("gzip")
            && !matches!(weight.trim(), "q=0" | "q=0.0" | "q=0.00" | "q=0.000")
    })
}

/// Returns the routes of the page.
pub fn router<S: Clone + Send + Sync + 'static>() -> Router<S> {
    Router::new()
        .route("/", get(index))
        .route("/viewer", get(index))
        .route("/assets/{name}", get(asset))
}

async fn index(headers: HeaderMap) -> Response {
    FILES.get(INDEX).map_or_else(
        || StatusCode::NOT_FOUND.into_response(),
        |file| file.answer(&headers, REVALIDATE),
    )
}

async fn asset(Path(name): Path<String>, uri: Uri, headers: HeaderMap) -> Response {
    match FILES.get(&format!("assets/{name}")) {
        Some(file) => file.answer(&headers, IMMUTABLE),
        None => no_such_route(uri).await.into_response(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_asset_of_the_index_is_embedded() {
        let index = String::from_utf8(FILES[INDEX].plain.to_vec()).unwrap();
        let named: Vec<&str> = index
            .split('"')
            .filter_map(|text| text.strip_prefix("./"))
            .filter(|path| path.starts_with("assets/"))
            .collect();
        assert!(named.len() >= 2, "{index}");
        assert!(named.iter().all(|path| FILES.contains_key(*path)), "{named:?}");
    }

    #[test]
    fn the_page_has_no_inline_or_external_resources() {
        let index = String::from_utf8(FILES[INDEX].plain.to_vec()).unwrap();
        assert!(
            !index.contains("<style") && !index.contains("style=") && !index.contains("http"),
            "{index}"
        );
        assert!(
            index.split("<script").skip(1).all(|script| script.contains("src=\"./assets/")),
            "{index}"
        );
    }

    #[test]
    fn gzip_is_sent_only_when_accepted() {
        let request_headers = |coding: &'static str| {
            HeaderMap::from_iter([(header::ACCEPT_ENCODING, HeaderValue::from_static(coding))])
        };
        assert!(
            accepts_gzip(&request_headers("br, gzip;q=0.8"))
                && accepts_gzip(&request_headers("GZIP"))
        );
        assert!(
            !accepts_gzip(&request_headers("br"))
                && !accepts_gzip(&request_headers("gzip;q=0"))
                && !accepts_gzip(&HeaderMap::new())
        );
    }
}
