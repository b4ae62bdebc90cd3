//! `/mcp`: the API as tools of the Model Context Protocol for language models. Streamable HTTP
//! without sessions, with the same keys, host names and origins as all other routes. Also over
//! stdio for a local data folder.

mod arguments;
mod resources;
mod schema;
mod tools;
mod values;

use super::App;
use super::problem::ProblemResponse;
use crate::http::problems;
use axum::body::{Body, to_bytes};
use axum::extract::{Request, State};
use axum::http::request::Parts;
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use rmcp::model::{
    CallToolRequestParams, CallToolResponse, ErrorData, Implementation, InitializeResult,
    ListResourceTemplatesResult, ListResourcesResult, ListToolsResult, PaginatedRequestParams,
    ReadResourceRequestParams, ReadResourceResponse, ReadResourceResult, ServerCapabilities,
};
use rmcp::service::RequestContext;
use rmcp::transport::streamable_http_server::session::never::NeverSessionManager;
use rmcp::transport::streamable_http_server::{StreamableHttpServerConfig, StreamableHttpService};
use rmcp::{RoleServer, ServerHandler, ServiceExt};
use std::sync::Arc;
use tokio_util::sync::CancellationToken;
use uniground_service::error::Error;
use uniground_service::{Caller, Services};
use uniground_types::problem::Problem;

const INSTRUCTIONS: &str = "Finds objects in scanned rooms. Start with list_scenes. ground answers \
    a question with a 3D box. find_in_scenes finds the scenes that contain an object. Lengths are \
    in meters, Z is up, boxes have a center and a full extent. Instance ids belong to one scene. \
    With a status other than grounded, the result is not certain: ask the user, or check with \
    render_view.";

/// Maximum size of a message, bytes. Unknown methods are echoed and logged.
const MAX_MESSAGE_BYTES: usize = 64 << 10;

/// Serves the API as MCP tools.
#[derive(Clone)]
pub struct Mcp {
    services: Services,
    /// The caller over stdio, which is the user who started the program.
    local: Option<Caller>,
}

/// MCP over HTTP.
pub type McpOverHttp = StreamableHttpService<Mcp, NeverSessionManager>;

impl Mcp {
    /// Creates the service for HTTP. Each request has its own caller.
    #[must_use]
    pub fn over_http(services: Services, shutdown: CancellationToken) -> McpOverHttp {
        let config = StreamableHttpServerConfig::default()
            .with_legacy_session_mode(false)
            .with_json_response(true)
            .with_max_request_body_bytes(MAX_MESSAGE_BYTES)
            .with_cancellation_token(shutdown)
            // Host names and origins are checked by the layers of the router.
            .disable_allowed_hosts()
            .disable_allowed_origins();
        let handler = Self { services, local: None };
        StreamableHttpService::new(
            move || Ok(handler.clone()),
            Arc::new(NeverSessionManager::default()),
            config,
        )
    }

    /// Serves over stdin and stdout until stdin ends. The caller has all scopes.
    ///
    /// # Errors
    /// Returns an error if the input is not MCP.
    pub async fn over_stdio(services: Services) -> anyhow::Result<()> {
        let handler = Self { services, local: Some(Caller::operator()) };
        Box::pin(handler.serve(rmcp::transport::io::stdio())).await?.waiting().await?;
        Ok(())
    }

    fn caller(&self, context: &RequestContext<RoleServer>) -> Result<Caller, ErrorData> {
        let asked =
            context.extensions.get::<Parts>().and_then(|parts| parts.extensions.get::<Caller>());
        asked
            .or(self.local.as_ref())
            .cloned()
            .ok_or_else(|| ErrorData::internal_error("the request has no caller", None))
    }
}

/// Converts a problem to an MCP error.
fn to_protocol_error(error: Error) -> ErrorData {
    let problem = ProblemResponse::from(error).problem();
    let message = format!("{} ({})", problem.detail, problem.code);
    match problem.status {
        404 => ErrorData::resource_not_found(message, None),
        400..=499 => ErrorData::invalid_params(message, None),
        _ => ErrorData::internal_error(message, None),
    }
}

impl ServerHandler for Mcp {
    fn get_info(&self) -> InitializeResult {
        let server = Implementation::new(env!("CARGO_PKG_NAME"), env!("CARGO_PKG_VERSION"));
        let capabilities = ServerCapabilities::builder().enable_tools().enable_resources().build();
        InitializeResult::new(capabilities).with_server_info(server).with_instructions(INSTRUCTIONS)
    }

    async fn list_tools(
        &self,
        _: Option<PaginatedRequestParams>,
        _: RequestContext<RoleServer>,
    ) -> Result<ListToolsResult, ErrorData> {
        Ok(ListToolsResult::with_all_items(tools::all()))
    }

    async fn call_tool(
        &self,
        request: CallToolRequestParams,
        context: RequestContext<RoleServer>,
    ) -> Result<CallToolResponse, ErrorData> {
        let caller = self.caller(&context)?;
        let called = tools::call(
            &self.services,
            caller,
            &request.name,
            request.arguments.unwrap_or_default(),
        )
        .await;
        let unknown = || {
            ErrorData::invalid_params(
                format!(
                    "there is no tool {:?}: tools/list lists the available tools",
                    request.name
                ),
                None,
            )
        };
        called.map(CallToolResponse::from).ok_or_else(unknown)
    }

    async fn list_resources(
        &self,
        request: Option<PaginatedRequestParams>,
        _: RequestContext<RoleServer>,
    ) -> Result<ListResourcesResult, ErrorData> {
        let cursor = request.and_then(|request| request.cursor);
        resources::list(&self.services, cursor).await.map_err(to_protocol_error)
    }

    async fn list_resource_templates(
        &self,
        _: Option<PaginatedRequestParams>,
        _: RequestContext<RoleServer>,
    ) -> Result<ListResourceTemplatesResult, ErrorData> {
        Ok(ListResourceTemplatesResult::with_all_items(resources::templates()))
    }

    async fn read_resource(
        &self,
        request: ReadResourceRequestParams,
        _: RequestContext<RoleServer>,
    ) -> Result<ReadResourceResponse, ErrorData> {
        let contents =
            resources::read(&self.services, &request.uri).await.map_err(to_protocol_error)?;
        let contents = contents.ok_or_else(|| {
            ErrorData::resource_not_found(
                "unknown resource: use uniground://scenes/{scene_id} or \
                 uniground://scenes/{scene_id}/report",
                None,
            )
        })?;
        Ok(ReadResourceResult::new(vec![contents]).into())
    }
}

/// A JSON-RPC 2.0 message.
#[derive(utoipa::ToSchema)]
#[schema(value_type = Object, example = json!({"jsonrpc": "2.0", "id": 1, "method": "tools/list"}))]
pub(super) struct Message(
    #[expect(dead_code, reason = "only its schema is used")] serde_json::Value,
);

/// The Model Context Protocol for agents. Tools: `list_scenes`, `ground`, `find_in_scenes`,
/// `list_objects`, `get_object`, `relations`, `approach` and `render_view`. Resources: scenes and
/// reports.
///
/// Streamable HTTP, revisions 2024-11-05 to 2026-07-28, without sessions. Each call is one POST
/// with a JSON response; the server sends no other messages.
#[utoipa::path(
    post, path = "/mcp", operation_id = "mcp", tag = "agents", request_body = Message,
    responses(
        (status = 200, description = "The response, or a protocol error", body = Message),
        (status = 202, description = "Notification accepted"),
        (status = 400, content((Problem = "application/problem+json"), (Message = "application/json"))),
        (status = 404, description = "Unknown method", body = Message),
        (status = 406, description = "`Accept` must name application/json and text/event-stream", body = Problem, content_type = "application/problem+json"),
        problems::Common, problems::TooLarge, problems::UnsupportedMediaType,
        problems::Unprocessable,
    ),
    security(("key" = ["read"]), ())
)]
pub(super) async fn answer(State(app): State<App>, request: Request) -> Response {
    let says_json = request.headers().get(header::CONTENT_TYPE).is_some_and(is_json);
    let request = match with_parsed_arguments(request).await {
        Ok(request) => request,
        Err(response) => return response,
    };
    let answered = app.mcp.handle(request).await.map(Body::new);
    if answered.status().is_success()
        || answered.headers().get(header::CONTENT_TYPE).is_some_and(is_json)
    {
        return answered;
    }
    // Converts plain-text errors of the transport to problems.
    let status = match answered.status() {
        // The body was not a valid message.
        StatusCode::UNSUPPORTED_MEDIA_TYPE if says_json => StatusCode::BAD_REQUEST,
        status => status,
    };
    let words = to_bytes(answered.into_body(), MAX_MESSAGE_BYTES).await.unwrap_or_default();
    let code = match status {
        StatusCode::BAD_REQUEST if says_json => "malformed_json",
        StatusCode::UNSUPPORTED_MEDIA_TYPE => "unsupported_media_type",
        StatusCode::PAYLOAD_TOO_LARGE => "body_too_large",
        StatusCode::NOT_ACCEPTABLE => "not_acceptable",
        _ => "mcp_refused",
    };
    ProblemResponse::new(status, code, String::from_utf8_lossy(&words)).into_response()
}

/// Returns the request with a tool's arguments as an object, or the response to arguments that are
/// none.
async fn with_parsed_arguments(request: Request) -> Result<Request, Response> {
    let (mut parts, body) = request.into_parts();
    let message = to_bytes(body, MAX_MESSAGE_BYTES).await.map_err(|_| {
        let detail = format!("a message must have at most {MAX_MESSAGE_BYTES} bytes");
        ProblemResponse::new(StatusCode::PAYLOAD_TOO_LARGE, "body_too_large", detail)
            .into_response()
    })?;
    match arguments::parse_arguments(&message) {
        Ok(None) => Ok(Request::from_parts(parts, message.into())),
        Ok(Some(parsed)) => {
            parts.headers.remove(header::CONTENT_LENGTH);
            Ok(Request::from_parts(parts, parsed.into()))
        }
        Err(error) => Err(axum::Json(error).into_response()),
    }
}

fn is_json(kind: &HeaderValue) -> bool {
    kind.as_bytes().starts_with(b"application/json")
}
