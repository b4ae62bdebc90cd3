//! The HTTP layer: decodes requests, authorizes them, calls one service function and encodes the
//! result. One file per resource.

mod answers;
mod approach;
mod auth;
mod batches;
mod body_rate;
mod caching;
mod connections;
mod content_encoding;
mod corrections;
mod description;
mod export;
mod extract;
mod graph;
mod grounding;
mod growth;
mod health;
mod hosts;
mod instances;
mod jobs;
mod keys;
mod links;
mod mcp;
mod origins;
mod page;
mod paging;
mod problem;
mod problems;
mod reports;
mod scene_media;
mod scenes;
mod scopes;
mod stats;
mod tus;
mod uploads;

use auth::CallerExtension;
pub use auth::scopes;
pub use connections::serve;
use description::Description;
pub use hosts::AllowedHosts;
pub use mcp::{Mcp, McpOverHttp};
pub use origins::Origins;
use problem::ProblemResponse;
pub use problem::to_problem;
pub use scopes::Scopes;

use axum::extract::{MatchedPath, Request};
use axum::http::{HeaderName, HeaderValue, header};
use axum::middleware::map_response;
use axum::response::{IntoResponse, Response};
use axum::{Router, middleware};
use std::sync::Arc;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio_util::sync::CancellationToken;
use tower::util::MapRequestLayer;
use tower_http::CompressionLevel;
use tower_http::catch_panic::CatchPanicLayer;
use tower_http::compression::CompressionLayer;
use tower_http::compression::predicate::{DefaultPredicate, NotForContentType, Predicate};
use tower_http::decompression::RequestDecompressionLayer;
use tower_http::request_id::{MakeRequestUuid, PropagateRequestIdLayer, SetRequestIdLayer};
use tower_http::set_header::SetResponseHeaderLayer;
use tower_http::trace::{DefaultOnResponse, TraceLayer};
use tracing::{Level, Span};
use uniground_service::Services;
use uniground_service::error::Error;
use uniground_telemetry::metrics::Metrics;
use uniground_telemetry::trace_context;
use utoipa::OpenApi;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;
use utoipa_swagger_ui::{Config, SwaggerUi};

/// State shared by all handlers.
#[derive(Clone)]
pub struct App {
    pub services: Services,
    /// Required scopes of the routes.
    pub scopes: Arc<Scopes>,
    /// Cancelled on shutdown, so that open event streams end.
    pub shutdown: CancellationToken,
    /// Metrics of the requests.
    pub metrics: Arc<Metrics>,
    /// Allowed host names. `None` allows any.
    pub allowed_hosts: Option<Arc<AllowedHosts>>,
    /// Allowed origins of web pages.
    pub origins: Origins,
    pub event_streams: EventStreams,
    /// The MCP service.
    pub mcp: McpOverHttp,
}

/// Permits for event streams. An idle stream costs only its connection, so streams may use half of
/// the connections.
#[derive(Clone)]
pub struct EventStreams {
    places: Arc<Semaphore>,
    most: usize,
}

impl EventStreams {
    /// Creates the permits for a server with this maximum number of connections.
    #[must_use]
    pub fn for_connections(connections: usize) -> Self {
        let most = connections / 2;
        Self { places: Arc::new(Semaphore::new(most)), most }
    }

    /// Takes a permit.
    ///
    /// # Errors
    /// Returns [`Error::TooMany`] if all permits are taken.
    pub fn acquire(&self) -> Result<OwnedSemaphorePermit, Error> {
        let place = self.places.clone().try_acquire_owned();
        place.map_err(|_| Error::TooMany { what: "event streams", most: self.most })
    }

    /// Returns the number of open streams.
    #[must_use]
    pub fn open(&self) -> usize {
        self.most.saturating_sub(self.places.available_permits())
    }
}

/// The bytes of a file.
#[derive(utoipa::ToSchema)]
#[schema(value_type = String, format = Binary)]
struct Binary(#[expect(dead_code, reason = "only its schema is used")] Vec<u8>);

const REQUEST_ID: HeaderName = HeaderName::from_static("x-request-id");

/// All routes with their descriptions, which cannot diverge.
fn routes() -> OpenApiRouter<App> {
    OpenApiRouter::with_openapi(Description::openapi())
        .routes(routes!(scenes::create, scenes::list))
        .routes(routes!(scenes::create_sample))
        .routes(routes!(scenes::import))
        .merge(uploads::routes())
        .routes(routes!(scenes::get, scenes::change, scenes::delete))
        .routes(routes!(scenes::parse))
        .routes(routes!(growth::changes))
        .routes(routes!(scenes::name))
        .routes(routes!(scenes::cloud))
        .routes(routes!(scenes::instances_cloud))
        .routes(routes!(scenes::embeddings))
        .routes(routes!(scene_media::points))
        .routes(routes!(scene_media::thumbnail))
        .routes(routes!(scene_media::frames, growth::add_frames))
        .routes(routes!(scene_media::photograph))
        .routes(routes!(export::export))
        .routes(routes!(reports::get))
        .routes(routes!(reports::picture))
        .routes(routes!(instances::list))
        .routes(routes!(instances::get))
        .routes(routes!(instances::view))
        .routes(routes!(graph::get))
        .routes(routes!(corrections::create, corrections::list))
        .routes(routes!(corrections::undo))
        .routes(routes!(corrections::annotations))
        .routes(routes!(jobs::list))
        .routes(routes!(jobs::get, jobs::cancel))
        .routes(routes!(jobs::events))
        .routes(routes!(grounding::ground))
        .routes(routes!(grounding::ground_many))
        .routes(routes!(grounding::shortlist))
        .routes(routes!(approach::approach))
        .routes(routes!(approach::floor))
        .routes(routes!(approach::floor_picture))
        .routes(routes!(mcp::answer))
        .routes(routes!(batches::create, batches::list))
        .routes(routes!(batches::get))
        .routes(routes!(batches::results))
        .routes(routes!(batches::pause))
        .routes(routes!(batches::resume))
        .routes(routes!(batches::cancel))
        .routes(routes!(answers::list))
        .routes(routes!(answers::get))
        .routes(routes!(answers::picture))
        .routes(routes!(answers::prompt))
        .routes(routes!(answers::reply))
        .routes(routes!(keys::create, keys::list))
        .routes(routes!(keys::revoke))
        .routes(routes!(keys::audit))
        .routes(routes!(links::create))
        .routes(routes!(stats::stats))
        .routes(routes!(stats::metrics))
        .routes(routes!(health::models))
        .routes(routes!(health::healthz))
        .routes(routes!(health::readyz))
}

/// Returns the OpenAPI description, as served at `/openapi.json`.
#[must_use]
pub fn openapi() -> utoipa::openapi::OpenApi {
    build_routes().1
}

/// Returns the routes and their description.
fn build_routes() -> (Router<App>, utoipa::openapi::OpenApi) {
    let (router, mut openapi) = routes().split_for_parts();
    description::complete_description(&mut openapi);
    (router, openapi)
}

/// Returns the router of the complete application.
pub fn router(app: App) -> Router {
    let (router, openapi) = build_routes();
    // The online validator is disabled.
    let description = SwaggerUi::new("/docs")
        .url("/openapi.json", openapi)
        .config(Config::from("../openapi.json").validator_url("none"));
    // Health, the description and the page need no key. Keys protect scans and questions.
    with_layers(app, router, Router::from(description).merge(page::router()))
}

/// Returns the router of a worker process: health checks and metrics only.
pub fn worker_router(app: App) -> Router {
    let routes = OpenApiRouter::new()
        .routes(routes!(stats::metrics))
        .routes(routes!(health::healthz))
        .routes(routes!(health::readyz));
    with_layers(app, routes.into(), Router::new())
}

/// Adds all layers to the routes. `open` routes need no key.
fn with_layers(app: App, routes: Router<App>, open: Router) -> Router {
    routes
        .layer(RequestDecompressionLayer::new().pass_through_unaccepted(true))
        .layer(middleware::from_fn(content_encoding::check))
        // Only the handlers of these routes read bodies.
        .layer(middleware::from_fn(body_rate::limit))
        .layer(middleware::from_fn(caching::add_etag))
        .layer(middleware::from_fn_with_state(app.clone(), auth::check))
        .with_state(app.clone())
        .merge(open)
        .fallback(problem::no_such_route)
        .method_not_allowed_fallback(problem::method_not_allowed)
        .layer(app.origins.protection())
        .layer(middleware::from_fn_with_state(app.origins.cors(), origins::answer))
        .layer(middleware::from_fn_with_state(app.clone(), hosts::check))
        .layer(CatchPanicLayer::custom(panic_response))
        .layer(middleware::from_fn(problem::name_request))
        .layer(
            CompressionLayer::new()
                .quality(CompressionLevel::Fastest)
                .compress_when(compression_predicate()),
        )
        .layer(map_response(caching::weaken_etag))
        .layer(header_layer(header::X_CONTENT_TYPE_OPTIONS, "nosniff"))
        .layer(header_layer(header::X_FRAME_OPTIONS, "DENY"))
        .layer(header_layer(header::REFERRER_POLICY, "no-referrer"))
        // Scans of homes are private: no shared cache may store them.
        .layer(header_layer(header::CACHE_CONTROL, "no-store"))
        .layer(PropagateRequestIdLayer::new(REQUEST_ID))
        .layer(
            TraceLayer::new_for_http()
                .make_span_with(request_span)
                .on_request(())
                .on_response(DefaultOnResponse::new().level(Level::DEBUG))
                // Errors are logged where they occur.
                .on_failure(()),
        )
        .layer(SetRequestIdLayer::new(REQUEST_ID, MakeRequestUuid))
        .layer(middleware::from_fn_with_state(app, stats::count_request))
        .layer(MapRequestLayer::new(remove_invalid_request_id))
}

/// Skips pictures, which are already compressed, and growing lists, which would be delayed by
/// compression blocks.
fn compression_predicate() -> impl Predicate {
    DefaultPredicate::new()
        .and(NotForContentType::const_new("application/jsonl"))
        .and(NotForContentType::const_new("text/csv"))
}

fn header_layer(name: HeaderName, value: &'static str) -> SetResponseHeaderLayer<HeaderValue> {
    SetResponseHeaderLayer::if_not_present(name, HeaderValue::from_static(value))
}

/// Keeps a request id from the caller only if it is short and safe to log.
fn remove_invalid_request_id(mut request: Request) -> Request {
    const MAX_ID_CHARS: usize = 128;
    let fits = |id: &[u8]| {
        (1..=MAX_ID_CHARS).contains(&id.len())
            && id.iter().all(|b| b.is_ascii_alphanumeric() || b"-_.:/+=".contains(b))
    };
    if request.headers().get(REQUEST_ID).is_some_and(|id| !fits(id.as_bytes())) {
        request.headers_mut().remove(REQUEST_ID);
    }
    request
}

/// Creates the span of a request with its id, method and route for all log lines.
fn request_span(request: &Request) -> Span {
    let id = request.headers().get(REQUEST_ID).and_then(|id| id.to_str().ok()).unwrap_or_default();
    let route = request
        .extensions()
        .get::<MatchedPath>()
        .map_or_else(|| request.uri().path(), MatchedPath::as_str);
    let span = tracing::info_span!("request", id, method = %request.method(), route, path = request.uri().path());
    trace_context::adopt(&span, request.headers());
    span
}

/// Logs the ids of a request whose handler panicked. The panic message itself is on stderr.
fn panic_response(_: Box<dyn std::any::Any + Send>) -> Response {
    tracing::error!(code = "internal", "request handler panicked");
    ProblemResponse::internal().into_response()
}
