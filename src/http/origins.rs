//! Which web pages may use this server from a browser. Its own may; others where they are named
//! (`--cors-origin`). Browsers ask before they send most things (CORS); what they send unasked, a
//! form or a plain POST, is refused when it comes from somewhere else.

use super::problem::ProblemResponse;
use super::{REQUEST_ID, auth, tus};
use axum::extract::{Request, State};
use axum::http::header::{self, HeaderName};
use axum::http::{HeaderValue, Method, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use std::time::Duration;
use tower::{Layer, ServiceExt};
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
            tus::RESUMABLE,
            tus::LENGTH,
            tus::METADATA,
            tus::OFFSET,
            tus::CHECKSUM,
            tus::METHOD_OVERRIDE,
            REQUEST_ID,
        ];
        let exposed = [
            header::ACCEPT_RANGES,
            header::CONTENT_DISPOSITION,
            header::CONTENT_RANGE,
            header::ETAG,
            header::LOCATION,
            header::RETRY_AFTER,
            HeaderName::from_static("idempotent-replayed"),
            auth::RATE_LIMIT,
            auth::RATE_LIMIT_POLICY,
            tus::RESUMABLE,
            tus::VERSION,
            tus::EXTENSION,
            tus::MAX_SIZE,
            tus::CHECKSUM_ALGORITHM,
            tus::LENGTH,
            tus::METADATA,
            tus::OFFSET,
            tus::EXPIRES,
            tus::SCENE_ID,
            tus::JOB_ID,
            REQUEST_ID,
        ];
        CorsLayer::new()
            .allow_origin(AllowOrigin::list(self.named.clone()))
            .allow_methods([
                Method::GET,
                Method::HEAD,
                Method::POST,
                Method::PATCH,
                Method::DELETE,
                Method::OPTIONS,
            ])
            .allow_headers(asked)
            .expose_headers(exposed)
            .max_age(REMEMBER)
    }

    /// Refuses what a page of another origin has a browser send.
    pub fn protection(&self) -> CsrfLayer<fn(ProtectionError) -> Response> {
        self.protection.clone().with_rejection_response(reject_foreign_origin)
    }
}

/// Answers browsers that ask whether their pages may. CORS takes every `OPTIONS` for that; one that
/// asks for something else goes its way.
pub async fn answer(State(cors): State<CorsLayer>, request: Request, next: Next) -> Response {
    if request.method() == Method::OPTIONS
        && !request.headers().contains_key(header::ACCESS_CONTROL_REQUEST_METHOD)
    {
        return next.run(request).await;
    }
    let Ok(response) = cors.layer(next).oneshot(request).await;
    response
}

fn reject_foreign_origin(_: ProtectionError) -> Response {
    let detail = "this comes from a page of another origin: start the server with --cors-origin and that origin, if it may";
    ProblemResponse::new(StatusCode::FORBIDDEN, "origin_not_allowed", detail).into_response()
}
