//! `/v1/keys` and `/v1/audit`

use super::App;
use super::extract::{Json, Path, Query};
use super::paging::Page;
use super::problem::ProblemResponse;
use super::problems;
use axum::extract::State;
use axum::http::StatusCode;
use uniground_types::keys::{AuditList, CreatedKey, Key, KeyList, NewKey};

/// Creates an API key. Its secret is returned only in this response.
///
/// Once a key exists, all requests require one.
#[utoipa::path(
    post, path = "/v1/keys", operation_id = "create_key", tag = "keys", request_body = NewKey,
    responses(
        (status = 201, body = CreatedKey),
        problems::Common, problems::BadRequest, problems::Forbidden, problems::TooLarge,
        problems::UnsupportedMediaType, problems::Unprocessable,
    ),
    security(("key" = ["admin"]), ())
)]
pub async fn create(
    State(app): State<App>,
    Json(new): Json<NewKey>,
) -> Result<(StatusCode, axum::Json<CreatedKey>), ProblemResponse> {
    // On an open server, a stranger could otherwise lock out everybody else.
    if app.allowed_hosts.is_none() && !app.services.keyring.has_keys() {
        let detail = "the first key of a publicly reachable server must be created on the command \
                      line: uniground key create --data-dir";
        return Err(ProblemResponse::new(StatusCode::FORBIDDEN, "first_key_by_hand", detail));
    }
    Ok((StatusCode::CREATED, axum::Json(app.services.keyring.create(new).await?)))
}

/// Lists keys, newest first, without their secrets.
#[utoipa::path(
    get, path = "/v1/keys", operation_id = "list_keys", tag = "keys", params(Page),
    responses(
        (status = 200, body = KeyList),
        problems::Common, problems::Forbidden, problems::Unprocessable,
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

/// Revokes a key. It is rejected from then on, and its batches pause. Its audit entries are kept.
#[utoipa::path(
    delete, path = "/v1/keys/{key_id}", operation_id = "revoke_key", tag = "keys", params(("key_id" = String, Path)),
    responses(
        (status = 200, body = Key),
        problems::Common, problems::Forbidden, problems::NotFound,
    ),
    security(("key" = ["admin"]), ())
)]
pub async fn revoke(
    State(app): State<App>,
    Path(key_id): Path<String>,
) -> Result<axum::Json<Key>, ProblemResponse> {
    Ok(axum::Json(app.services.keyring.revoke(&key_id).await?))
}

/// Lists the audit log, newest first: all authorized requests that could change data, including
/// failed ones.
#[utoipa::path(
    get, path = "/v1/audit", operation_id = "list_audit", tag = "keys", params(Page),
    responses(
        (status = 200, body = AuditList),
        problems::Common, problems::Forbidden, problems::Unprocessable,
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
