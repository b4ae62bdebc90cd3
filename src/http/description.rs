//! The OpenAPI description: what is true of every operation is said here once.

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
            Lengths are metres in a right-handed world with Z up; boxes are centre and full extent. \
            Errors are RFC 9457 problem details with a stable `code`."
    ),
    servers((url = "/", description = "The server that tells this")),
    tags(
        (name = "scenes", description = "Scans and their parses"),
        (name = "uploads", description = "Scans that come in parts"),
        (name = "instances", description = "Objects found in a scene"),
        (name = "grounding", description = "Questions and answers"),
        (name = "agents", description = "The same for language models"),
        (name = "batches", description = "Lists of questions, asked in the background"),
        (name = "jobs", description = "Work in the background"),
        (name = "keys", description = "Who may ask, and what was done"),
        (name = "service", description = "Health and numbers")
    ),
    modifiers(&BearerAuth)
)]
pub struct Description;

/// Most entries of any list: of a batch, its questions.
const MAX_ITEMS: usize = 1_000_000;
const PROBLEM: &str = "application/problem+json";
const FILE: &str = "application/octet-stream";

/// What a status means wherever it is met, with a code as an example; problems without one here are
/// described where they stand.
fn status_meaning(status: &str) -> Option<(&'static str, Option<(&'static str, &'static str)>)> {
    let problem = |description, code, detail| Some((description, Some((code, detail))));
    match status {
        "200" => Some(("As asked for", None)),
        "201" => Some(("Made", None)),
        "202" => Some(("Taken; the work goes on in the background", None)),
        "204" => Some(("Done; there is nothing to tell", None)),
        "206" => Some(("The part that `Range` names", None)),
        "304" => Some(("Nothing has changed since the `ETag` that `If-None-Match` shows", None)),
        "400" => problem(
            "The body can not be read",
            "malformed_json",
            "expected `,` or `}` at line 1 column 17",
        ),
        "401" => problem(
            "No key, or one that is not known (any more)",
            "unauthorized",
            "this server wants a key: Authorization: Bearer <key>",
        ),
        "402" => problem(
            "The money for it is spent",
            "budget_spent",
            "the question's budget does not pay for another call",
        ),
        "403" => problem(
            "The key may not do this",
            "scope_missing",
            "this key may \"read\", this needs a key that may \"write\"",
        ),
        "404" => problem(
            "There is no such thing",
            "scene_not_found",
            "there is no scene 01a1ff70-0000-7000-8000-000000000001",
        ),
        "408" => {
            problem("The body comes too slowly", "body_too_slow", "a JSON body is sent within 20 s")
        }
        "409" => problem(
            "Not as things are now",
            "scene_not_ready",
            "scene 01a1ff70-0000-7000-8000-000000000001 has not been parsed yet",
        ),
        "410" => problem(
            "It is over",
            "upload_expired",
            "upload 01a1ff70-0000-7000-8000-000000000001 was not gone on with for too long: begin a new one",
        ),
        "412" => problem(
            "Another version of tus",
            "tus_version_unknown",
            "uploads in parts speak tus 1.0: send the header Tus-Resumable: 1.0.0",
        ),
        "413" => problem(
            "The body is too large",
            "body_too_large",
            "a JSON body has at most 1048576 bytes",
        ),
        "415" => problem(
            "Another content type is wanted",
            "unsupported_media_type",
            "the body must be application/json, not \"text/plain\"",
        ),
        "416" => Some(("The file has no such part", None)),
        "421" => problem(
            "The server is called by a name that is not its own",
            "host_not_allowed",
            "this server is not evil.example",
        ),
        "422" => problem(
            "A field or parameter makes no sense",
            "invalid_request",
            "/top_k: must be 1 to 100",
        ),
        "423" => problem(
            "Somebody is at work on it",
            "upload_busy",
            "somebody is sending to upload 01a1ff70-0000-7000-8000-000000000001, or it is being made a scene: ask for its offset when that is over",
        ),
        "429" => problem(
            "Too much at once: again after `Retry-After`",
            "rate_limited",
            "this key asks too often: try again in 12 s",
        ),
        "460" => problem(
            "The checksum is of other bytes",
            "checksum_mismatch",
            "the checksum does not match the bytes received: send this part again",
        ),
        "502" => problem(
            "A model failed",
            "vlm_unavailable",
            "the vision-language model could not be asked, in 5 attempts: it answered 500",
        ),
        "503" => problem(
            "Not now: again after `Retry-After`",
            "vlm_down",
            "the vision-language model's server is down: it is tried again in 20 s",
        ),
        "504" => problem(
            "It took longer than was allowed",
            "question_timed_out",
            "the question took longer than 5 s",
        ),
        "507" => problem(
            "The disk is full",
            "storage_full",
            "the server's disk is full: delete scenes, or ask its operator",
        ),
        _ => None,
    }
}

/// Says of every operation what its own attributes leave out: what its statuses mean, with
/// examples, and what any request may meet.
pub fn complete_description(openapi: &mut utoipa::openapi::OpenApi) {
    for (path, item) in &mut openapi.paths.paths {
        let PathItem { get, post, patch, delete, head, options, .. } = item;
        // What tells headers only is never 304.
        for (operation, changes) in [
            (get, false),
            (post, true),
            (patch, true),
            (delete, true),
            (head, true),
            (options, true),
        ] {
            if let Some(operation) = operation {
                add_common_responses(operation, path, changes);
                operation
                    .responses
                    .responses
                    .iter_mut()
                    .for_each(|(status, response)| describe(status, response));
                // Said, and not left out: anybody may.
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

/// What any request may be answered, whatever it is about.
fn add_common_responses(operation: &mut Operation, path: &str, changes: bool) {
    let responses = &mut operation.responses.responses;
    let sends_file = match responses.get("200") {
        // What comes in several formats is made when it is asked for, and whole.
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
    // A body that comes too slowly.
    let refused_bodies = operation.request_body.is_some().then_some(StatusCode::REQUEST_TIMEOUT);
    // A page of another origin; a name that is not the server's.
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

/// No list is without an end.
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
