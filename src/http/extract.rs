//! Extractors that fail with a [`Problem`] naming the field.

use super::App;
use super::problem::ProblemResponse;
use axum::body::to_bytes;
use axum::extract::{FromRequest, FromRequestParts, Request};
use axum::http::request::Parts;
use axum::http::{StatusCode, header};
use serde::de::DeserializeOwned;

/// Maximum size of a JSON body, bytes.
const MAX_JSON_BYTES: usize = 1 << 20;

/// A JSON body.
pub struct Json<T>(pub T);

impl<T: DeserializeOwned, S: Send + Sync> FromRequest<S> for Json<T> {
    type Rejection = ProblemResponse;

    async fn from_request(request: Request, _state: &S) -> Result<Self, ProblemResponse> {
        let media_type = request
            .headers()
            .get(header::CONTENT_TYPE)
            .and_then(|v| v.to_str().ok())
            .unwrap_or_default();
        let essence = media_type.split(';').next().unwrap_or_default().trim().to_ascii_lowercase();
        if essence != "application/json" {
            let detail = format!("the body must be application/json, not {essence:?}");
            return Err(ProblemResponse::new(
                StatusCode::UNSUPPORTED_MEDIA_TYPE,
                "unsupported_media_type",
                detail,
            ));
        }
        let bytes = to_bytes(request.into_body(), MAX_JSON_BYTES).await.map_err(|error| {
            // The limit, or a body that cannot be decompressed.
            match error.to_string().contains("limit") {
                true => ProblemResponse::new(
                    StatusCode::PAYLOAD_TOO_LARGE,
                    "body_too_large",
                    format!("a JSON body must have at most {MAX_JSON_BYTES} bytes"),
                ),
                false => ProblemResponse::new(
                    StatusCode::BAD_REQUEST,
                    "malformed_json",
                    format!("the body could not be read: {error}"),
                ),
            }
        })?;
        if contains_nul(&bytes) {
            return Err(ProblemResponse::invalid(
                "body",
                "a string contains a NUL character, which is not allowed",
            ));
        }
        let mut reader = serde_json::Deserializer::from_slice(&bytes);
        let value = serde_path_to_error::deserialize(&mut reader).map_err(|error| {
            let pointer: String = error
                .path()
                .iter()
                .map(|segment| format!("/{segment}"))
                .filter(|s| s != "/?")
                .collect();
            match error.inner().classify() {
                serde_json::error::Category::Data => {
                    ProblemResponse::invalid(pointer, error.inner().to_string())
                }
                _ => ProblemResponse::new(
                    StatusCode::BAD_REQUEST,
                    "malformed_json",
                    error.inner().to_string(),
                ),
            }
        })?;
        reader.end().map_err(|error| {
            ProblemResponse::new(StatusCode::BAD_REQUEST, "malformed_json", error.to_string())
        })?;
        Ok(Self(value))
    }
}

/// Returns whether a JSON string contains a NUL character. PostgreSQL cannot store them.
fn contains_nul(json: &[u8]) -> bool {
    const ESCAPED: &[u8] = b"u0000";
    let is_escape =
        |at: usize| json[..at].iter().rev().take_while(|byte| **byte == b'\\').count() % 2 == 1;
    json.windows(ESCAPED.len()).enumerate().any(|(at, window)| window == ESCAPED && is_escape(at))
}

/// Returns whether a URL contains a NUL character.
fn uri_contains_nul(parts: &Parts) -> bool {
    parts.uri.path_and_query().is_some_and(|address| address.as_str().contains("%00"))
}

/// Query parameters.
pub struct Query<T>(pub T);

impl<T: DeserializeOwned, S: Send + Sync> FromRequestParts<S> for Query<T> {
    type Rejection = ProblemResponse;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, ProblemResponse> {
        if uri_contains_nul(parts) {
            return Err(ProblemResponse::invalid("query", "must not contain a NUL character"));
        }
        match axum::extract::Query::<T>::from_request_parts(parts, state).await {
            Ok(axum::extract::Query(value)) => Ok(Self(value)),
            Err(rejection) => {
                let reason = std::error::Error::source(&rejection)
                    .map_or_else(|| rejection.body_text(), ToString::to_string);
                let (parameter, detail) = reason.split_once(": ").unwrap_or(("query", &reason));
                Err(ProblemResponse::invalid(parameter, detail))
            }
        }
    }
}

/// A path segment with an id or name. An invalid one gives 404.
pub struct Path<T>(pub T);

impl<T: DeserializeOwned + Send, S: Send + Sync> FromRequestParts<S> for Path<T> {
    type Rejection = ProblemResponse;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, ProblemResponse> {
        if uri_contains_nul(parts) {
            return Err(ProblemResponse::new(
                StatusCode::NOT_FOUND,
                "not_found",
                "a path cannot contain a NUL character",
            ));
        }
        match axum::extract::Path::<T>::from_request_parts(parts, state).await {
            Ok(axum::extract::Path(value)) => Ok(Self(value)),
            Err(rejection) => {
                Err(ProblemResponse::new(StatusCode::NOT_FOUND, "not_found", rejection.body_text()))
            }
        }
    }
}

/// The path of a route below a scene. The scene may be given by its id or by its name; handlers get
/// the id.
pub struct ScenePath<T>(pub T);

/// The parameters of a path that begins with a scene.
pub trait BeginsWithScene {
    fn scene_mut(&mut self) -> &mut String;
}

impl BeginsWithScene for String {
    fn scene_mut(&mut self) -> &mut String {
        self
    }
}

impl<A> BeginsWithScene for (String, A) {
    fn scene_mut(&mut self) -> &mut String {
        &mut self.0
    }
}

impl<A, B> BeginsWithScene for (String, A, B) {
    fn scene_mut(&mut self) -> &mut String {
        &mut self.0
    }
}

impl<T: BeginsWithScene + DeserializeOwned + Send> FromRequestParts<App> for ScenePath<T> {
    type Rejection = ProblemResponse;

    async fn from_request_parts(parts: &mut Parts, app: &App) -> Result<Self, ProblemResponse> {
        let Path(mut value) = Path::<T>::from_request_parts(parts, app).await?;
        let scene = value.scene_mut();
        *scene = app.services.scene_lookup.resolve(std::mem::take(scene)).await?;
        Ok(Self(value))
    }
}

/// Maximum length of an idempotency key, bytes.
const MAX_IDEMPOTENCY_KEY_BYTES: usize = 255;

/// The header `Idempotency-Key`, if present.
pub struct IdempotencyKey(pub Option<String>);

impl<S: Send + Sync> FromRequestParts<S> for IdempotencyKey {
    type Rejection = ProblemResponse;

    async fn from_request_parts(parts: &mut Parts, _state: &S) -> Result<Self, ProblemResponse> {
        let mut headers = parts.headers.get_all("idempotency-key").iter();
        let Some(key) = headers.next() else { return Ok(Self(None)) };
        let is_visible = |byte: &u8| byte.is_ascii_graphic() || *byte == b' ';
        let is_key = (1..=MAX_IDEMPOTENCY_KEY_BYTES).contains(&key.len())
            && key.as_bytes().iter().all(is_visible);
        match key.to_str() {
            Ok(key) if is_key && headers.next().is_none() => Ok(Self(Some(key.to_owned()))),
            _ => Err(ProblemResponse::invalid(
                "Idempotency-Key",
                format!(
                    "must be sent once and have 1 to {MAX_IDEMPOTENCY_KEY_BYTES} visible ASCII characters"
                ),
            )),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use axum::http::HeaderValue;

    async fn key_of(values: &[&[u8]]) -> Result<Option<String>, ProblemResponse> {
        let (mut parts, ()) = Request::new(()).into_parts();
        for value in values {
            parts.headers.append("idempotency-key", HeaderValue::from_bytes(value).unwrap());
        }
        IdempotencyKey::from_request_parts(&mut parts, &()).await.map(|key| key.0)
    }

    #[tokio::test]
    async fn an_idempotency_key_is_one_short_visible_header() {
        assert_eq!(key_of(&[]).await.unwrap(), None);
        let longest = [b'k'; MAX_IDEMPOTENCY_KEY_BYTES];
        for key in [b"monday, 8".as_slice(), &longest] {
            assert_eq!(key_of(&[key]).await.unwrap().unwrap().as_bytes(), key);
        }
        for keys in [
            &[b"".as_slice()][..],
            &[&[b'k'; MAX_IDEMPOTENCY_KEY_BYTES + 1]],
            &["\u{fc}".as_bytes()],
            &[b"a\tb"],
            &[b"a", b"a"],
        ] {
            let problem = key_of(keys).await.unwrap_err().problem();
            assert_eq!(
                (problem.status, problem.errors[0].pointer.as_str()),
                (422, "Idempotency-Key"),
                "{keys:?}"
            );
        }
    }

    #[test]
    fn nul_characters_are_detected_in_json() {
        for (json, expected) in [
            (r#"{"query": "a\u0000b"}"#, true),
            (r#"{"query": "a\\\u0000b"}"#, true),
            (r#"{"query": "a\\u0000b"}"#, false),
            (r#"{"query": "u0000"}"#, false),
            ("{}", false),
        ] {
            assert_eq!(contains_nul(json.as_bytes()), expected, "{json}");
        }
    }
}
