//! One key for the whole service, as a bearer token. Off on a loopback bind unless a key is set.

use super::App;
use super::problem::Refused;
use axum::extract::{Request, State};
use axum::http::{HeaderValue, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use sha2::{Digest, Sha256};
use utoipa::Modify;
use utoipa::openapi::security::{Http, HttpAuthScheme, SecurityScheme};

/// The key callers must show. Only its hash is kept in memory.
pub struct ApiKey([u8; 32]);

impl ApiKey {
    #[must_use]
    pub fn new(key: &str) -> Self {
        Self(Sha256::digest(key).into())
    }

    /// Compares hashes: how long that takes says nothing about the key.
    fn matches(&self, presented: &str) -> bool {
        let presented: [u8; 32] = Sha256::digest(presented).into();
        presented.iter().zip(self.0).fold(0, |difference, (a, b)| difference | (a ^ b)) == 0
    }
}

/// Lets nobody past without the key, where one is set; health stays open.
pub async fn require_key(State(app): State<App>, request: Request, next: Next) -> Response {
    let Some(key) = &app.api_key else { return next.run(request).await };
    if matches!(request.uri().path(), "/healthz" | "/readyz") {
        return next.run(request).await;
    }
    let presented = request
        .headers()
        .get(header::AUTHORIZATION)
        .and_then(|v| v.to_str().ok())
        .and_then(|v| v.split_once(' '))
        .filter(|(scheme, _)| scheme.eq_ignore_ascii_case("bearer"))
        .map(|(_, presented)| presented);
    if presented.is_some_and(|presented| key.matches(presented.trim())) {
        return next.run(request).await;
    }
    let mut refused =
        Refused::new(StatusCode::UNAUTHORIZED, "unauthorized", "this server wants a key: Authorization: Bearer <key>").into_response();
    refused.headers_mut().insert(header::WWW_AUTHENTICATE, HeaderValue::from_static("Bearer"));
    refused
}

/// Declares the bearer scheme in the description.
pub struct BearerAuth;

impl Modify for BearerAuth {
    fn modify(&self, openapi: &mut utoipa::openapi::OpenApi) {
        let components = openapi.components.get_or_insert_default();
        components.add_security_scheme("key", SecurityScheme::Http(Http::new(HttpAuthScheme::Bearer)));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_key_itself_matches() {
        let key = ApiKey::new("ug_secret");
        assert!(key.matches("ug_secret"));
        assert!(!key.matches("ug_secre") && !key.matches("") && !key.matches("ug_secret "));
    }
}
