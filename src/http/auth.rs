//! Authentication and authorization: bearer tokens, scopes, rate limits and the audit log.

use super::problem::{ProblemResponse, request_id};
use super::{App, Scopes};
use axum::extract::{Request, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, Uri, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use jiff::Timestamp;
use uniground_service::{AuditedRequest, Caller, KeyRejection, LINK_PARAMETER, RateLimitStatus};
use uniground_types::keys::Scope;
use utoipa::Modify;
use utoipa::openapi::security::{Http, HttpAuthScheme, SecurityScheme};

/// The `RateLimit` header of the IETF draft "`RateLimit` header fields for HTTP".
pub(super) const RATE_LIMIT: HeaderName = HeaderName::from_static("ratelimit");
pub(super) const RATE_LIMIT_POLICY: HeaderName = HeaderName::from_static("ratelimit-policy");

/// Checks that the caller may use the route, and records requests that change data in the audit
/// log.
pub async fn check(State(app): State<App>, mut request: Request, next: Next) -> Response {
    let Some(wanted) = app.scopes.required_scope(&request) else { return next.run(request).await };
    let link = remove_link_token(request.uri_mut());
    let (keys, shown) = (&app.services.keyring, bearer_token(request.headers()));
    // A signed link replaces a missing key for reading only. It must not allow questions, which may
    // cost money.
    let caller = match &link {
        Some(link) if shown.is_none() && keys.has_keys() && request.method().is_safe() => {
            keys.caller_of_link(link, request.uri().path(), Timestamp::now())
        }
        _ => keys.caller(shown),
    };
    let caller = match caller {
        Ok(caller) => caller,
        Err(denied) => return unauthorized(denied),
    };
    let allowance = match &caller.key {
        Some(key) => {
            app.services.keyring.note_use(key);
            match app.services.keyring.count_request(key).await {
                Ok(allowance) => allowance,
                Err((wait_s, allowance)) => {
                    return with_rate_limit_headers(too_many_requests(wait_s), Some(allowance));
                }
            }
        }
        None => None,
    };
    if caller.scope < wanted {
        let detail = format!(
            "this key has the scope {:?}, but this request requires {:?}",
            caller.scope.as_str(),
            wanted.as_str()
        );
        return with_rate_limit_headers(
            ProblemResponse::new(StatusCode::FORBIDDEN, "scope_missing", detail).into_response(),
            allowance,
        );
    }
    // Requests with a scope above read change data or return admin data. Creating links is recorded
    // too, because links give access to others.
    let is_noted = wanted > Scope::Read || request.uri().path() == "/v1/links";
    let begin_audit = (is_noted && !request.method().is_safe()).then(|| {
        let (method, path) = (request.method().to_string(), request.uri().path().to_owned());
        let done =
            AuditedRequest { method, path, status: 0, request_id: request_id(request.headers()) };
        app.services.keyring.begin_audit(caller.clone(), done)
    });
    request.extensions_mut().insert(caller);
    let response = next.run(request).await;
    if let Some(begin_audit) = begin_audit {
        begin_audit.record_status(response.status().as_u16()).await;
    }
    with_rate_limit_headers(response, allowance)
}

/// Removes the link token from the query and returns it.
fn remove_link_token(uri: &mut Uri) -> Option<String> {
    let query = uri.query()?;
    let is_link =
        |pair: &&str| pair.split_once('=').is_some_and(|(name, _)| name == LINK_PARAMETER);
    let link = query.split('&').find(is_link)?.split_once('=')?.1.to_owned();
    let rest: Vec<&str> = query.split('&').filter(|pair| !is_link(pair)).collect();
    let path = if rest.is_empty() {
        uri.path().to_owned()
    } else {
        format!("{}?{}", uri.path(), rest.join("&"))
    };
    *uri = path.parse().ok()?;
    Some(link)
}

/// Returns the bearer token of the request.
fn bearer_token(headers: &HeaderMap) -> Option<&str> {
    let shown = headers.get(header::AUTHORIZATION)?.to_str().ok()?;
    let (scheme, token) = shown.split_once(' ')?;
    scheme.eq_ignore_ascii_case("bearer").then_some(token.trim())
}

fn unauthorized(denied: KeyRejection) -> Response {
    let detail = match denied {
        KeyRejection::NoKey => {
            "this server requires an API key: send the header Authorization: Bearer <key>"
        }
        KeyRejection::UnknownKey => {
            "this server does not know the API key in the header Authorization"
        }
        KeyRejection::Expired => "this key has expired",
        KeyRejection::Revoked => "this key was revoked",
        KeyRejection::BadLink => "this link was not signed by this server, or covers another path",
        KeyRejection::LinkExpired => "this link has expired: create another with POST /v1/links",
    };
    let mut refused =
        ProblemResponse::new(StatusCode::UNAUTHORIZED, "unauthorized", detail).into_response();
    refused.headers_mut().insert(header::WWW_AUTHENTICATE, HeaderValue::from_static("Bearer"));
    refused
}

fn too_many_requests(wait_s: u64) -> Response {
    ProblemResponse::new(
        StatusCode::TOO_MANY_REQUESTS,
        "rate_limited",
        format!("this key has reached its rate limit: try again in {wait_s} s"),
    )
    .retry_after(u32::try_from(wait_s).unwrap_or(u32::MAX))
    .into_response()
}

/// Adds the remaining requests of the key to the response.
fn with_rate_limit_headers(mut response: Response, allowance: Option<RateLimitStatus>) -> Response {
    if let Some(RateLimitStatus { per_minute, left, reset_s }) = allowance {
        let told = [
            (RATE_LIMIT_POLICY, format!("\"key\";q={per_minute};w=60")),
            (RATE_LIMIT, format!("\"key\";r={left};t={reset_s}")),
        ];
        for (name, value) in told {
            if let Ok(value) = HeaderValue::from_str(&value) {
                response.headers_mut().insert(name, value);
            }
        }
    }
    response
}

/// Returns the scopes of all routes.
#[must_use]
pub fn scopes() -> Scopes {
    Scopes::from_description(&super::openapi())
}

/// The caller of a request, for handlers.
pub type CallerExtension = axum::Extension<Caller>;

/// Adds the bearer scheme to the OpenAPI description.
pub struct BearerAuth;

impl Modify for BearerAuth {
    fn modify(&self, openapi: &mut utoipa::openapi::OpenApi) {
        let components = openapi.components.get_or_insert_default();
        let mut scheme = Http::new(HttpAuthScheme::Bearer);
        scheme.description =
            Some("The scope that an operation requires: read, write or admin.".into());
        components.add_security_scheme("key", SecurityScheme::Http(scheme));
    }
}
