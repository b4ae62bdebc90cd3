//! Completes the OpenAPI description with everything that applies to all operations.

use super::auth::BearerAuth;
use super::problem::title_of;
use axum::http::{StatusCode, header};
use serde_json::json;
use utoipa::OpenApi;
use utoipa::openapi::path::{Operation, PathItem};
use utoipa::openapi::{Content, Header, Ref, RefOr, Response, ResponseBuilder, Schema, security};

#[derive(OpenApi)]
#[openapi(
    info(
        title = "uniground",
        description = "3D visual grounding as a service: upload a scan of a room, ask in plain words, get the object's 3D box. \
            Lengths are in meters in a right-handed world frame with Z up. \
            Boxes have a center and a full extent. \
            Errors are RFC 9457 problem details with a stable `code`. \
            [Back to the rooms](/)."
    ),
    servers((url = "/", description = "This server")),
    tags(
        (name = "scenes", description = "Scenes and their parses"),
        (name = "uploads", description = "Resumable uploads"),
        (name = "instances", description = "Objects found in a scene"),
        (name = "grounding", description = "Questions and answers"),
        (name = "agents", description = "Tools for language models (MCP)"),
        (name = "batches", description = "Lists of questions that run in the background"),
        (name = "jobs", description = "Background jobs"),
        (name = "keys", description = "API keys and the audit log"),
        (name = "service", description = "Health and statistics")
    ),
    modifiers(&BearerAuth)
)]
pub struct Description;

/// Maximum number of entries of any list: the questions of a batch.
const MAX_ITEMS: usize = 1_000_000;
const PROBLEM: &str = "application/problem+json";
const FILE: &str = "application/octet-stream";

/// Returns the description of a status with an example problem. Operations may override it.
fn status_meaning(status: &str) -> Option<(&'static str, Option<(&'static str, &'static str)>)> {
    let problem = |description, code, detail| Some((description, Some((code, detail))));
    match status {
        "200" => Some(("Success", None)),
        "201" => Some(("Created", None)),
        "202" => Some(("Accepted; the work continues in the background", None)),
        "204" => Some(("Success, without content", None)),
        "206" => Some(("The part requested by `Range`", None)),
        "304" => Some(("Not modified since the `ETag` in `If-None-Match`", None)),
        "400" => problem(
            "The body cannot be parsed",
            "malformed_json",
            "expected `,` or `}` at line 1 column 17",
        ),
        "401" => problem(
            "The API key is missing or invalid",
            "unauthorized",
            "this server requires an API key: send the header Authorization: Bearer <key>",
        ),
        "402" => problem(
            "The spending limit is reached",
            "budget_spent",
            "the question's budget does not pay for another call",
        ),
        "403" => problem(
            "The key lacks the required scope",
            "scope_missing",
            "this key has the scope \"read\", but this request requires \"write\"",
        ),
        "404" => problem(
            "Not found",
            "scene_not_found",
            "there is no scene 01a1ff70-0000-7000-8000-000000000001",
        ),
        "408" => problem(
            "The body arrives too slowly",
            "body_too_slow",
            "a JSON body must arrive within 20 s",
        ),
        "409" => problem(
            "Conflict with the current state",
            "scene_not_ready",
            "scene 01a1ff70-0000-7000-8000-000000000001 has not been parsed yet",
        ),
        "410" => problem(
            "No longer available",
            "upload_expired",
            "upload 01a1ff70-0000-7000-8000-000000000001 has expired: begin a new one",
        ),
        "412" => problem(
            "Unsupported version of tus",
            "tus_version_unknown",
            "resumable uploads use tus 1.0: send the header Tus-Resumable: 1.0.0",
        ),
        "413" => problem(
            "The body is too large",
            "body_too_large",
            "a JSON body must have at most 1048576 bytes",
        ),
        "415" => problem(
            "Unsupported content type",
            "unsupported_media_type",
            "the body must be application/json, not \"text/plain\"",
        ),
        "416" => Some(("The requested range does not exist", None)),
        "421" => problem(
            "The Host header is not allowed",
            "host_not_allowed",
            "the host name evil.example is not allowed: start the server with --allowed-host, or \
             use an API key",
        ),
        "422" => problem(
            "A field or parameter is invalid",
            "invalid_request",
            "/top_k: must be 1 to 100",
        ),
        "423" => problem(
            "Locked by another request",
            "upload_busy",
            "upload 01a1ff70-0000-7000-8000-000000000001 is in use: another request sends to it, \
             or a scene is being made of it. Ask for its offset later",
        ),
        "429" => problem(
            "Too many requests: retry after `Retry-After`",
            "rate_limited",
            "this key has reached its rate limit: try again in 12 s",
        ),
        "460" => problem(
            "The checksum does not match",
            "checksum_mismatch",
            "the checksum does not match the bytes received: send this part again",
        ),
        "502" => problem(
            "A model failed",
            "vlm_unavailable",
            "the vision-language model gave no usable reply in 5 attempts: it answered 500",
        ),
        "503" => problem(
            "Temporarily unavailable: retry after `Retry-After`",
            "vlm_down",
            "the vision-language model's server is down: the next attempt is in 20 s",
        ),
        "504" => problem("Timeout", "question_timed_out", "the question took longer than 5 s"),
        "507" => problem(
            "The disk is full",
            "storage_full",
            "the server's disk is full: delete scenes, or ask its operator to free space",
        ),
        _ => None,
    }
}

/// Adds what the attributes of operations omit: descriptions and examples of statuses, and the
/// statuses that any request may get.
pub fn complete_description(openapi: &mut utoipa::openapi::OpenApi) {
    for (path, item) in &mut openapi.paths.paths {
        let PathItem { get, post, patch, delete, head, options, .. } = item;
        // Responses with headers only are never 304.
        for (operation, changes) in [
            (get, false),
            (post, true),
            (patch, true),
            (delete, true),
            (head, true),
            (options, true),
        ] {
            if let Some(operation) = operation {
                for parameter in operation.parameters.iter_mut().flatten() {
                    let RefOr::T(parameter) = parameter else { continue };
                    if parameter.name == "scene_id" && parameter.description.is_none() {
                        let text = "Id of the scene, or its name if no other scene has it";
                        parameter.description = Some(text.into());
                    }
                }
                add_common_responses(operation, path, changes);
                operation
                    .responses
                    .responses
                    .iter_mut()
                    .for_each(|(status, response)| describe(status, response));
                // Declares explicitly that no key is required.
                operation
                    .security
                    .get_or_insert_with(|| vec![security::SecurityRequirement::default()]);
            }
        }
    }
    for schema in
        openapi.components.iter_mut().flat_map(|components| components.schemas.values_mut())
    {
        bound_list(schema);
    }
}

/// Adds the responses that any request may get.
fn add_common_responses(operation: &mut Operation, path: &str, changes: bool) {
    let responses = &mut operation.responses.responses;
    let sends_file = match responses.get("200") {
        // Responses in several formats are generated on request, without ranges.
        Some(RefOr::T(response)) => {
            response.content.len() == 1 && response.content.contains_key(FILE)
        }
        _ => false,
    };
    let read = (!changes && path.starts_with("/v1/")).then_some(StatusCode::NOT_MODIFIED);
    let part = [StatusCode::PARTIAL_CONTENT, StatusCode::RANGE_NOT_SATISFIABLE]
        .into_iter()
        .filter(|_| sends_file);
    for status in read.into_iter().chain(part) {
        responses.entry(status.as_str().to_owned()).or_insert_with(|| Response::new("").into());
    }
    // A body that arrives too slowly.
    let refused_bodies = operation.request_body.is_some().then_some(StatusCode::REQUEST_TIMEOUT);
    // A web page of another origin, or a host name that is not allowed.
    let refused = changes
        .then_some(StatusCode::FORBIDDEN)
        .into_iter()
        .chain(refused_bodies)
        .chain([StatusCode::MISDIRECTED_REQUEST]);
    for status in refused {
        let problem = || {
            ResponseBuilder::new()
                .content(PROBLEM, Content::new(Some(Ref::from_schema_name("Problem"))))
                .build()
        };
        responses.entry(status.as_str().to_owned()).or_insert_with(|| problem().into());
    }
}

fn describe(status: &str, response: &mut RefOr<Response>) {
    let (RefOr::T(response), Some((description, example))) = (response, status_meaning(status))
    else {
        return;
    };
    if response.description.is_empty() {
        description.clone_into(&mut response.description);
    }
    if matches!(status, "429" | "503") {
        let mut seconds = Header::default();
        seconds.description = Some("Seconds to wait".into());
        response.headers.insert(header::RETRY_AFTER.to_string(), seconds.into());
    }
    let (Some((code, detail)), Some(RefOr::T(content))) =
        (example, response.content.get_mut(PROBLEM))
    else {
        return;
    };
    let number: u16 = status.parse().unwrap_or_default();
    let title = StatusCode::from_u16(number).ok().map(title_of);
    content.example.get_or_insert_with(|| {
        json!({"type": "about:blank", "title": title, "status": number, "detail": detail, "code": code, "request_id": "0d7a2f3e-6a51-4b5c-9d1f-2f0a64f4ad11", "errors": []})
    });
}

/// Sets a maximum length for all lists.
fn bound_list(schema: &mut RefOr<Schema>) {
    let RefOr::T(schema) = schema else { return };
    match schema {
        Schema::Array(array) => {
            array.max_items.get_or_insert(MAX_ITEMS);
        }
        Schema::Object(object) => object.properties.values_mut().for_each(bound_list),
        Schema::OneOf(one_of) => one_of.items.iter_mut().for_each(bound_list),
        Schema::AllOf(all_of) => all_of.items.iter_mut().for_each(bound_list),
        Schema::AnyOf(any_of) => any_of.items.iter_mut().for_each(bound_list),
        _ => {}
    }
}
