//! Reads the body of a chat completion. Endpoints differ in where they put the text, errors and
//! token counts.

use super::detail;
use reqwest::StatusCode;
use serde_json::Value;
use uniground_models::chat::{ChatError, after_thoughts};

/// A reply with the token counts of its server, where these are readable.
#[derive(Debug, PartialEq)]
pub(super) struct EndpointReply {
    pub(super) text: String,
    pub(super) prompt_tokens: Option<u64>,
    pub(super) completion_tokens: Option<u64>,
}

/// Why a body holds no reply, and whether a retry may succeed.
#[derive(Debug)]
pub(super) struct NoReply {
    pub(super) error: ChatError,
    pub(super) again: bool,
}

/// Reads the body of a successful response.
pub(super) fn read(body: &str) -> Result<EndpointReply, NoReply> {
    let body = body.trim_start_matches('\u{feff}').trim();
    if body.starts_with("data:") {
        return Ok(read_stream(body));
    }
    if body.starts_with('<') {
        return Err(NoReply::undecodable(
            "it is a web page: check the address of --vlm-url",
            false,
        ));
    }
    let body: Value = serde_json::from_str(body)
        .map_err(|error| NoReply::undecodable(&error.to_string(), true))?;
    if let Some(error) = body.get("error").filter(|error| !error.is_null()) {
        return Err(NoReply::from_provider(error));
    }
    let choice = match body.get("choices").and_then(Value::as_array).map(Vec::as_slice) {
        Some([choice, ..]) => choice,
        Some([]) => return Err(NoReply::undecodable("it has no choices", true)),
        None => {
            let why = format!("it has no choices: {}", detail(&body.to_string()));
            return Err(NoReply::undecodable(&why, false));
        }
    };
    if let Some(error) = choice.get("error").filter(|error| !error.is_null()) {
        return Err(NoReply::from_provider(error));
    }
    let count = |name: &str| body.pointer(&format!("/usage/{name}")).and_then(read_count);
    Ok(EndpointReply {
        text: reply_text(choice)?,
        prompt_tokens: count("prompt_tokens"),
        completion_tokens: count("completion_tokens"),
    })
}

impl NoReply {
    fn undecodable(why: &str, again: bool) -> Self {
        Self { error: ChatError::Undecodable(why.into()), again }
    }

    fn no_answer(why: impl Into<String>) -> Self {
        Self { error: ChatError::NoAnswer(why.into()), again: false }
    }

    /// Builds the error from one that a provider sent in place of a reply, in its own words.
    fn from_provider(error: &Value) -> Self {
        let code = error.get("code").and_then(read_count).and_then(|code| u16::try_from(code).ok());
        let status = code.and_then(|code| StatusCode::from_u16(code).ok());
        let status = status.filter(|s| s.is_client_error() || s.is_server_error());
        let said = match error {
            Value::String(text) => text.clone(),
            error => detail(&error.to_string()),
        };
        let error = ChatError::Refused {
            status: status.unwrap_or(StatusCode::OK).as_u16(),
            reason: status.and_then(|s| s.canonical_reason()).unwrap_or("with an error"),
            detail: said,
        };
        Self { error, again: status.is_some_and(super::is_transient) }
    }
}

/// Returns the text of a choice, wherever the endpoint puts it. An empty text is a valid reply.
fn reply_text(choice: &Value) -> Result<String, NoReply> {
    let message = choice.get("message").unwrap_or(&Value::Null);
    let cut = choice.get("finish_reason").and_then(Value::as_str).unwrap_or_default();
    let called = message.pointer("/tool_calls/0/function/arguments").and_then(Value::as_str);
    let texts = [
        message.get("content").map(content_text),
        called.map(str::to_owned),
        choice.get("text").and_then(Value::as_str).map(str::to_owned),
    ];
    let text = texts.into_iter().flatten().find(|text| !text.trim().is_empty());
    let ended = "the reply ended at its limit of tokens before the answer (finish_reason length): \
                 raise the limit of the model's server, or lower its reasoning effort";
    match text {
        Some(text) if cut == "length" && after_thoughts(&text).is_none() => {
            Err(NoReply::no_answer(ended))
        }
        Some(text) => Ok(text),
        None => {
            let said = |name: &str| message.get(name).and_then(Value::as_str).map(str::trim);
            let thought = said("reasoning_content").or_else(|| said("reasoning"));
            match (said("refusal"), cut, thought) {
                (Some(refusal), ..) if !refusal.is_empty() => {
                    Err(NoReply::no_answer(format!("the model refused: {}", detail(refusal))))
                }
                (_, "length", _) => Err(NoReply::no_answer(ended)),
                (_, "content_filter", _) => Err(NoReply::no_answer(
                    "the provider's content filter removed it (finish_reason content_filter)",
                )),
                // Some servers take the whole reply for thoughts: the answer comes last.
                (_, _, Some(thought)) => {
                    Ok(thought.rsplit("\n\n").next().unwrap_or(thought).to_owned())
                }
                _ => Ok(String::new()),
            }
        }
    }
}

/// Returns the text of a message's content: a string, or parts of which some are thoughts.
fn content_text(content: &Value) -> String {
    match content {
        Value::String(text) => text.clone(),
        Value::Array(parts) => parts.iter().map(content_text).collect(),
        Value::Object(part) => {
            let kind = part.get("type").and_then(Value::as_str).unwrap_or("text");
            let text = part.get("text").and_then(Value::as_str).unwrap_or_default();
            if kind.contains("think") || kind.contains("reason") { "" } else { text }.to_owned()
        }
        _ => String::new(),
    }
}

/// Returns a count that may be written as a float or as text. Counts below zero are none.
fn read_count(value: &Value) -> Option<u64> {
    let number = value.as_f64().or_else(|| value.as_str()?.trim().parse().ok())?;
    (0.0..1e15).contains(&number).then_some(number as u64)
}

/// Joins the parts of a reply that was streamed although nobody asked for that.
fn read_stream(body: &str) -> EndpointReply {
    let events = body.lines().filter_map(|line| line.trim().strip_prefix("data:"));
    let text = events
        .filter_map(|event| serde_json::from_str::<Value>(event.trim()).ok())
        .filter_map(|event| {
            event.pointer("/choices/0/delta/content").and_then(Value::as_str).map(str::to_owned)
        })
        .collect();
    EndpointReply { text, prompt_tokens: None, completion_tokens: None }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use serde_json::json;

    fn body(choice: &Value) -> String {
        json!({"choices": [choice]}).to_string()
    }

    fn text(choice: &Value) -> String {
        read(&body(choice)).unwrap().text
    }

    fn failure(body: &Value) -> (String, bool) {
        let NoReply { error, again } = read(&body.to_string()).unwrap_err();
        (error.to_string(), again)
    }

    #[test]
    fn text_is_found_wherever_endpoints_put_it() {
        for choice in [
            json!({"message": {"content": "ID 7"}}),
            json!({"message": {"content": [{"type": "text", "text": "ID "}, {"type": "text", "text": "7"}]}}),
            json!({"message": {"content": ["ID 7"]}}),
            json!({"message": {"content": {"type": "text", "text": "ID 7"}}}),
            json!({"message": {"content": [{"type": "reasoning", "text": "ID 8?"}, {"type": "text", "text": "ID 7"}]}}),
            json!({"message": {"content": [{"type": "thinking", "thinking": "ID 8?", "text": null}, {"type": "text", "text": "ID 7"}]}}),
            json!({"message": {"content": null, "tool_calls": [{"function": {"name": "x", "arguments": "ID 7"}}]}}),
            json!({"message": {"content": "", "reasoning_content": "ID 8?\nNo.\n\nID 7"}}),
            json!({"text": "ID 7"}),
        ] {
            assert_eq!(text(&choice), "ID 7", "{choice}");
        }
        assert_eq!(text(&json!({"message": {"content": ""}, "finish_reason": "stop"})), "");
        let stream = "data: {\"choices\":[{\"delta\":{\"content\":\"ID \"}}]}\n\ndata: {\"choices\":[{\"delta\":{\"content\":\"7\"}}]}\n\ndata: [DONE]\n\n";
        assert_eq!(read(stream).unwrap().text, "ID 7");
    }

    #[test]
    fn token_counts_never_cost_a_reply() {
        for (count, expected) in [
            (json!(1000), Some(1000)),
            (json!(1000.0), Some(1000)),
            (json!("1000"), Some(1000)),
            (json!(-1), None),
            (json!({"text": 1}), None),
            (json!(null), None),
        ] {
            let body = json!({"choices": [{"message": {"content": "ID 7"}}], "usage": {"prompt_tokens": count}});
            let read = read(&body.to_string()).unwrap();
            assert_eq!((read.text.as_str(), read.prompt_tokens), ("ID 7", expected), "{body}");
        }
    }

    #[test]
    fn reasons_are_passed_on_and_hopeless_calls_are_not_repeated() {
        let choice = |choice: Value| json!({"choices": [choice]});
        for (body, expected, again) in [
            (
                json!({"error": {"message": "no image input", "code": 400}}),
                "400 Bad Request: no image input",
                false,
            ),
            (json!({"error": "quota used up"}), "200 with an error: quota used up", false),
            (
                choice(
                    json!({"error": {"code": 502, "message": "overloaded"}, "message": {"content": ""}}),
                ),
                "502 Bad Gateway: overloaded",
                true,
            ),
            (json!({"id": "x", "choices": null}), "no choices", false),
            (json!({"choices": []}), "no choices", true),
            (
                choice(json!({"message": {"content": null, "refusal": "I can not help."}})),
                "refused: I can not help.",
                false,
            ),
            (
                choice(json!({"message": {"content": null}, "finish_reason": "content_filter"})),
                "content filter",
                false,
            ),
            (
                choice(json!({"message": {"content": ""}, "finish_reason": "length"})),
                "limit of tokens",
                false,
            ),
            (
                choice(json!({"message": {"content": "<think>Let me"}, "finish_reason": "length"})),
                "limit of tokens",
                false,
            ),
        ] {
            let (said, retried) = failure(&body);
            assert!(said.contains(expected) && retried == again, "{body}: {said}, {retried}");
        }
        let page = read("<!doctype html><title>Login</title>").unwrap_err();
        assert!(page.error.to_string().contains("--vlm-url") && !page.again);
    }

    proptest! {
        #[test]
        fn any_body_is_read_or_refused(body in "[\\[\\]{}:,\"a-z0-9 .<-]{0,80}") {
            let _ = read(&body);
        }
    }
}
