//! `/v1/keys` and `/v1/audit`

use super::App;
use super::extract::{Json, Path, Query};
use super::paging::Page;
use super::problem::ProblemResponse;
use axum::extract::State;
use axum::http::StatusCode;
use uniground_types::keys::{AuditList, CreatedKey, Key, KeyList, NewKey};
use uniground_types::problem::Problem;

/// Makes a key. Its secret is in this answer and nowhere else.
///
/// From the first key on, everybody needs one.
#[utoipa::path(
    post, path = "/v1/keys", operation_id = "create_key", tag = "keys", request_body = NewKey,
    responses(
        (status = 201, body = CreatedKey),
        (status = 400, body = Problem, content_type = "application/problem+json"),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 403, body = Problem, content_type = "application/problem+json"),
        (status = 413, body = Problem, content_type = "application/problem+json"),
        (status = 415, body = Problem, content_type = "application/problem+json"),
        (status = 422, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["admin"]), ())
)]
pub async fn create(
    State(app): State<App>,
    Json(new): Json<NewKey>,
) -> Result<(StatusCode, axum::Json<CreatedKey>), ProblemResponse> {
    // Where anybody may ask, a stranger would lock everybody else out.
    if app.allowed_hosts.is_none() && !app.services.keyring.has_keys() {
        let detail = "the first key of a server that others can reach is made by hand: uniground key create --data-dir";
        return Err(ProblemResponse::new(StatusCode::FORBIDDEN, "first_key_by_hand", detail));
    }
    Ok((StatusCode::CREATED, axum::Json(app.services.keyring.create(new).await?)))
}

/// Lists keys, newest first, without their secrets.
#[utoipa::path(
    get, path = "/v1/keys", operation_id = "list_keys", tag = "keys", params(Page),
    responses(
        (status = 200, body = KeyList),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 403, body = Problem, content_type = "application/problem+json"),
        (status = 422, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["admin"]), ())
)]
pub async fn list(
    State(app): State<App>,
    Query(page): Query<Page>,
) -> Result<axum::Json<KeyList>, ProblemResponse> {
    let (limit, cursor) = page.validate()?;
    Ok(axum::Json(app.services.keyring.list(limit, cursor.as_deref()).await?))
}

/// Revokes a key: it is refused from now on, and its batches pause. What was done with it stays
/// readable.
#[utoipa::path(
    delete, path = "/v1/keys/{key_id}", operation_id = "revoke_key", tag = "keys", params(("key_id" = String, Path)),
    responses(
        (status = 200, body = Key),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 403, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["admin"]), ())
)]
pub async fn revoke(
    State(app): State<App>,
    Path(key_id): Path<String>,
) -> Result<axum::Json<Key>, ProblemResponse> {
    Ok(axum::Json(app.services.keyring.revoke(&key_id).await?))
}

/// Lists what was done, newest first: every request that was let through to change something,
/// whatever came of it.
#[utoipa::path(
    get, path = "/v1/audit", operation_id = "list_audit", tag = "keys", params(Page),
    responses(
        (status = 200, body = AuditList),
        (status = 401, body = Problem, content_type = "application/problem+json"),
        (status = 403, body = Problem, content_type = "application/problem+json"),
        (status = 422, body = Problem, content_type = "application/problem+json"),
        (status = 429, body = Problem, content_type = "application/problem+json"),
    ),
    security(("key" = ["admin"]), ())
)]
pub async fn audit(
    State(app): State<App>,
    Query(page): Query<Page>,
) -> Result<axum::Json<AuditList>, ProblemResponse> {
    let (limit, cursor) = page.validate()?;
    Ok(axum::Json(app.services.keyring.audit(limit, cursor.as_deref()).await?))
}
