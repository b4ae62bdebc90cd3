//! `/healthz`, `/readyz` and `/v1/models`

use super::App;
use axum::Json;
use axum::extract::State;
use axum::http::StatusCode;
use uniground_types::problem::Problem;
use uniground_types::service::{Health, ModelList, Readiness};

/// The models this server was started with; none when all parts are built in.
#[utoipa::path(
    get, path = "/v1/models", tag = "service",
    responses((status = 200, body = ModelList), (status = 401, body = Problem, content_type = "application/problem+json")),
    security(("key" = []), ())
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
pub async fn readyz(State(app): State<App>) -> (StatusCode, Json<Readiness>) {
    let store = app.service.store().clone();
    let database = store.ping().await.map_err(|error| error.to_string());
    let blobs = tokio::task::spawn_blocking(move || store.blobs.probe()).await;
    let blob_folder = blobs.map_err(std::io::Error::other).flatten().map_err(|error| error.to_string());
    let worker = if app.lane_ended.is_cancelled() { Err("stopped".to_owned()) } else { Ok(()) };
    let ready = database.is_ok() && blob_folder.is_ok() && worker.is_ok();
    let word = |check: Result<(), String>| check.err().unwrap_or_else(|| "ok".into());
    let models = app.service.parse_models();
    let readiness = Readiness {
        ready,
        database: word(database),
        blob_folder: word(blob_folder),
        worker: word(worker),
        masks: models.masks,
        encoder: models.encoder,
        models: app.service.loaded_models().to_vec(),
    };
    (if ready { StatusCode::OK } else { StatusCode::SERVICE_UNAVAILABLE }, Json(readiness))
}
