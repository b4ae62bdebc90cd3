//! Allowed origins of web pages: the server's own page, and those given with `--cors-origin`.
//! Browsers ask before most requests (CORS). Requests that they send without asking, like forms and
//! plain POSTs, are rejected if they come from another origin.

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

/// Origins in the format of browsers: scheme, host, and the port if it is not the default.
#[derive(Debug, Clone, Default)]
pub struct Origins {
    named: Vec<HeaderValue>,
    protection: CsrfLayer,
}

/// Time for which browsers cache the CORS permission.
const REMEMBER: Duration = Duration::from_mins(10);

impl Origins {
    /// # Errors
    /// Returns an error for an invalid origin.
    pub fn new(origins: &[String]) -> Result<Self, ConfigError> {
        let mut all = Self::default();
        for origin in origins {
            let origin = origin.trim_end_matches('/');
            all.protection = all.protection.add_trusted_origin(origin)?;
            all.named.extend(HeaderValue::from_str(origin));
        }
        Ok(all)
    }

    /// Returns the CORS layer for these origins.
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

    /// Returns the layer that rejects requests from pages of other origins.
    pub fn protection(&self) -> CsrfLayer<fn(ProtectionError) -> Response> {
        self.protection.clone().with_rejection_response(reject_foreign_origin)
    }
}

/// Answers CORS preflight requests. Other `OPTIONS` requests go to their handlers.
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
    let detail = "this request comes from a web page of another origin: to allow it, start the \
                  server with --cors-origin and that origin";
    ProblemResponse::new(StatusCode::FORBIDDEN, "origin_not_allowed", detail).into_response()
}
