//! Which web pages may use this server from a browser. Its own may; others where they are named (`--cors-origin`). Browsers ask before they
//! send most things (CORS); what they send unasked, a form or a plain POST, is refused when it comes from somewhere else.

use super::problem::Refused;
use super::{REQUEST_ID, auth};
use axum::http::header::{self, HeaderName};
use axum::http::{HeaderValue, Method, StatusCode};
use axum::response::{IntoResponse, Response};
use std::time::Duration;
use tower_http::cors::{AllowOrigin, CorsLayer};
use tower_http::csrf::{ConfigError, CsrfLayer, ProtectionError};

/// Origins as browsers write them: scheme, host, and port where it is not the scheme's own.
#[derive(Debug, Clone, Default)]
pub struct Origins {
    named: Vec<HeaderValue>,
    protection: CsrfLayer,
}

/// How long a browser remembers that it may ask.
const REMEMBER: Duration = Duration::from_mins(10);

impl Origins {
    /// # Errors
    /// What is no origin.
    pub fn new(origins: &[String]) -> Result<Self, ConfigError> {
        let mut all = Self::default();
        for origin in origins {
            let origin = origin.trim_end_matches('/');
            all.protection = all.protection.add_trusted_origin(origin)?;
            all.named.extend(HeaderValue::from_str(origin));
        }
        Ok(all)
    }

    /// Answers browsers that ask for pages of these origins.
    pub fn cors(&self) -> CorsLayer {
        let asked = [
            header::AUTHORIZATION,
            header::CONTENT_TYPE,
            header::IF_NONE_MATCH,
            header::RANGE,
            HeaderName::from_static("idempotency-key"),
            HeaderName::from_static("last-event-id"),
            HeaderName::from_static("mcp-protocol-version"),
            HeaderName::from_static("mcp-method"),
            HeaderName::from_static("mcp-name"),
            HeaderName::from_static("traceparent"),
            REQUEST_ID,
        ];
        let told = [
            header::ACCEPT_RANGES,
            header::CONTENT_DISPOSITION,
            header::CONTENT_RANGE,
            header::ETAG,
            header::RETRY_AFTER,
            HeaderName::from_static("idempotent-replayed"),
            auth::RATE_LIMIT,
            auth::RATE_LIMIT_POLICY,
            REQUEST_ID,
        ];
        CorsLayer::new()
            .allow_origin(AllowOrigin::list(self.named.clone()))
            .allow_methods([Method::GET, Method::HEAD, Method::POST, Method::PATCH, Method::DELETE])
            .allow_headers(asked)
            .expose_headers(told)
            .max_age(REMEMBER)
    }

    /// Refuses what a page of another origin has a browser send.
    pub fn protection(&self) -> CsrfLayer<fn(ProtectionError) -> Response> {
        self.protection.clone().with_rejection_response(foreign)
    }
}

fn foreign(_: ProtectionError) -> Response {
    let detail = "this comes from a page of another origin: start the server with --cors-origin and that origin, if it may";
    Refused::new(StatusCode::FORBIDDEN, "origin_not_allowed", detail).into_response()
}
