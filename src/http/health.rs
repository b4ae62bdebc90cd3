//! `/healthz`, `/readyz` and `/v1/models`

use super::App;
use super::problems;
use axum::Json;
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use uniground_service::Health;
use uniground_storage::StoreHealth;
use uniground_types::service::{Health as Alive, ModelList, Readiness};

/// Lists the models of this server. Empty if only built-in components are used.
#[utoipa::path(
    get, path = "/v1/models", operation_id = "list_models", tag = "service",
    responses((status = 200, body = ModelList), problems::Common),
    security(("key" = ["read"]), ())
)]
pub async fn models(State(app): State<App>) -> Json<ModelList> {
    Json(ModelList {
        models: app.services.loaded_models().to_vec(),
        vlm: app.services.vlm_model().map(str::to_owned),
    })
}

/// Returns whether the process is alive.
#[utoipa::path(get, path = "/healthz", operation_id = "healthz", tag = "service", responses((status = 200, body = Alive)))]
pub async fn healthz() -> Json<Alive> {
    Json(Alive { status: "ok".into(), version: env!("CARGO_PKG_VERSION").into() })
}

/// Returns whether the service is ready.
///
/// An unreachable vision-language model is reported in `vlm` but does not affect readiness, because
/// built-in components take over.
#[utoipa::path(get, path = "/readyz", operation_id = "readyz", tag = "service", responses((status = 200, body = Readiness), (status = 503, body = Readiness)))]
pub async fn readyz(State(app): State<App>) -> Response {
    let health = app.services.health.health().await;
    let ready = health.is_ready();
    let Health {
        store: StoreHealth { database, blobs, disk, is_damaged: _ },
        dead_lanes,
        inference,
        vlm,
    } = health;
    let word = |trouble: Option<String>| trouble.unwrap_or_else(|| "ok".into());
    let of_server =
        |condition: Option<Result<(), String>>| condition.map(|condition| word(condition.err()));
    let models = app.services.parses.parse_models();
    let readiness = Readiness {
        ready,
        database: word(database),
        blob_folder: word(blobs),
        disk: word(disk),
        worker: word(
            (!dead_lanes.is_empty()).then(|| format!("stopped: {}", dead_lanes.join(", "))),
        ),
        inference_server: of_server(inference),
        vlm: of_server(vlm),
        masks: models.masks,
        encoder: models.encoder,
        models: app.services.loaded_models().to_vec(),
    };
    match ready {
        true => Json(readiness).into_response(),
        false => (StatusCode::SERVICE_UNAVAILABLE, [(header::RETRY_AFTER, "5")], Json(readiness))
            .into_response(),
    }
}
