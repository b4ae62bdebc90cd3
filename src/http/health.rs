//! `/healthz`, `/readyz` and `/v1/models`

use super::App;
use crate::store::StoreHealth;
use axum::Json;
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use uniground_types::problem::Problem;
use uniground_types::service::{Health, ModelList, Readiness};

/// The models this server was started with; none when all parts are built in.
#[utoipa::path(
    get, path = "/v1/models", tag = "service",
    responses((status = 200, body = ModelList), (status = 401, body = Problem, content_type = "application/problem+json"), (status = 429, body = Problem, content_type = "application/problem+json")),
    security(("key" = ["read"]), ())
)]
pub async fn models(State(app): State<App>) -> Json<ModelList> {
    Json(ModelList { models: app.service.loaded_models().to_vec(), vlm: app.service.vlm_model().map(str::to_owned) })
}

/// Whether the process is alive.
#[utoipa::path(get, path = "/healthz", tag = "service", responses((status = 200, body = Health)))]
pub async fn healthz() -> Json<Health> {
    Json(Health { status: "ok".into(), version: env!("CARGO_PKG_VERSION").into() })
}

/// Whether the service can do its work.
#[utoipa::path(get, path = "/readyz", tag = "service", responses((status = 200, body = Readiness), (status = 503, body = Readiness)))]
pub async fn readyz(State(app): State<App>) -> Response {
    let StoreHealth { database, blobs, disk } = app.service.store_health().await;
    let worker = app.lane_ended.is_cancelled().then(|| "stopped".to_owned());
    let ready = [&database, &blobs, &disk, &worker].iter().all(|trouble| trouble.is_none());
    let word = |trouble: Option<String>| trouble.unwrap_or_else(|| "ok".into());
    let models = app.service.parse_models();
    let readiness = Readiness {
        ready,
        database: word(database),
        blob_folder: word(blobs),
        disk: word(disk),
        worker: word(worker),
        masks: models.masks,
        encoder: models.encoder,
        models: app.service.loaded_models().to_vec(),
    };
    match ready {
        true => Json(readiness).into_response(),
        false => (StatusCode::SERVICE_UNAVAILABLE, [(header::RETRY_AFTER, "5")], Json(readiness)).into_response(),
    }
}
