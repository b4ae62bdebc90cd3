//! Who asks, and whether they may: keys as bearer tokens, scopes, rates. What was done is written
//! down.

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

/// As in the draft standard "`RateLimit` header fields for HTTP".
pub(super) const RATE_LIMIT: HeaderName = HeaderName::from_static("ratelimit");
pub(super) const RATE_LIMIT_POLICY: HeaderName = HeaderName::from_static("ratelimit-policy");

/// Lets a request past whose caller may do what its route does, and writes down what changed
/// something.
pub async fn check(State(app): State<App>, mut request: Request, next: Next) -> Response {
    let Some(wanted) = app.scopes.wanted_by(&request) else { return next.run(request).await };
    let link = take_link(request.uri_mut());
    let (keys, shown) = (&app.services.keyring, bearer(request.headers()));
    // A link stands in for a key where none is shown, to read what is there: asking may cost money.
    let caller = match &link {
        Some(link) if shown.is_none() && keys.is_wanted() && request.method().is_safe() => {
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
            match app.services.keyring.count(key).await {
                Ok(allowance) => allowance,
                Err((wait_s, allowance)) => return limited(too_fast(wait_s), Some(allowance)),
            }
        }
        None => None,
    };
    if caller.scope < wanted {
        let detail = format!(
            "this key may {:?}, this needs a key that may {:?}",
            caller.scope.as_str(),
            wanted.as_str()
        );
        return limited(
            ProblemResponse::new(StatusCode::FORBIDDEN, "scope_missing", detail).into_response(),
            allowance,
        );
    }
    // Whatever needs more than reading changes something, or looks at what only admins see. Links
    // are handed to others.
    let is_noted = wanted > Scope::Read || request.uri().path() == "/v1/links";
    let noting = (is_noted && !request.method().is_safe()).then(|| {
        let (method, path) = (request.method().to_string(), request.uri().path().to_owned());
        let done =
            AuditedRequest { method, path, status: 0, request_id: request_id(request.headers()) };
        app.services.keyring.noting(caller.clone(), done)
    });
    request.extensions_mut().insert(caller);
    let response = next.run(request).await;
    if let Some(noting) = noting {
        noting.answered(response.status().as_u16()).await;
    }
    limited(response, allowance)
}

/// What makes a link work; the rest of the query stays.
fn take_link(uri: &mut Uri) -> Option<String> {
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

/// The token somebody shows.
fn bearer(headers: &HeaderMap) -> Option<&str> {
    let shown = headers.get(header::AUTHORIZATION)?.to_str().ok()?;
    let (scheme, token) = shown.split_once(' ')?;
    scheme.eq_ignore_ascii_case("bearer").then_some(token.trim())
}

fn unauthorized(denied: KeyRejection) -> Response {
    let detail = match denied {
        KeyRejection::NoKey | KeyRejection::UnknownKey => {
            "this server wants a key: Authorization: Bearer <key>"
        }
        KeyRejection::Expired => "this key has expired",
        KeyRejection::Revoked => "this key was revoked",
        KeyRejection::BadLink => "this link was not signed by this server, or is for another path",
        KeyRejection::LinkOver => "this link has expired: POST /v1/links makes another",
    };
    let mut refused =
        ProblemResponse::new(StatusCode::UNAUTHORIZED, "unauthorized", detail).into_response();
    refused.headers_mut().insert(header::WWW_AUTHENTICATE, HeaderValue::from_static("Bearer"));
    refused
}

fn too_fast(wait_s: u64) -> Response {
    ProblemResponse::new(
        StatusCode::TOO_MANY_REQUESTS,
        "rate_limited",
        format!("this key asks too often: try again in {wait_s} s"),
    )
    .after(u32::try_from(wait_s).unwrap_or(u32::MAX))
    .into_response()
}

/// Tells what is left of the key's requests.
fn limited(mut response: Response, allowance: Option<RateLimitStatus>) -> Response {
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

/// The scopes of all routes.
#[must_use]
pub fn scopes() -> Scopes {
    Scopes::of(&super::openapi())
}

/// Who asks, for handlers.
pub type CallerExtension = axum::Extension<Caller>;

/// Declares the bearer scheme in the description.
pub struct BearerAuth;

impl Modify for BearerAuth {
    fn modify(&self, openapi: &mut utoipa::openapi::OpenApi) {
        let components = openapi.components.get_or_insert_default();
        let mut scheme = Http::new(HttpAuthScheme::Bearer);
        scheme.description = Some(
            "The scopes of an operation name what a key must allow: read, write or admin.".into(),
        );
        components.add_security_scheme("key", SecurityScheme::Http(scheme));
    }
}
