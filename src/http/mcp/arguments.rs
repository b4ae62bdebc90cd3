//! Arguments of tools that a client has sent as text: some models write the object as a JSON string.

use serde_json::{Value, json};

/// Replaces arguments in a string by the object in it. Messages that are no call of a tool stay as
/// they are.
///
/// # Errors
/// The JSON-RPC error for arguments that are no object.
pub(super) fn parse_arguments(message: &[u8]) -> Result<Option<Vec<u8>>, Value> {
    let Ok(mut message) = serde_json::from_slice::<Value>(message) else { return Ok(None) };
    if message.get("method").and_then(Value::as_str) != Some("tools/call") {
        return Ok(None);
    }
    let id = message.get("id").cloned().unwrap_or(Value::Null);
    let Some(arguments) = message.pointer_mut("/params/arguments") else { return Ok(None) };
    let text = match arguments {
        Value::Object(_) | Value::Null => return Ok(None),
        Value::String(text) if text.trim().is_empty() => "{}",
        Value::String(text) => text,
        _ => "",
    };
    match serde_json::from_str(text) {
        Ok(object @ Value::Object(_)) => {
            *arguments = object;
            Ok(Some(message.to_string().into_bytes()))
        }
        _ => Err(json!({
            "jsonrpc": "2.0",
            "id": id,
            "error": {"code": -32602, "message": "arguments: expected an object"},
        })),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn call(arguments: &Value) -> Vec<u8> {
        json!({"id": 3, "method": "tools/call", "params": {"name": "ground", "arguments": arguments}})
            .to_string()
            .into_bytes()
    }

    #[test]
    fn text_with_an_object_becomes_the_object_and_other_arguments_are_refused() {
        let parsed = parse_arguments(&call(&json!("{\"query\": \"mug\"}"))).unwrap().unwrap();
        let parsed: Value = serde_json::from_slice(&parsed).unwrap();
        assert_eq!(parsed["params"]["arguments"], json!({"query": "mug"}));
        assert!(parse_arguments(&call(&json!({"query": "mug"}))).unwrap().is_none());
        assert!(parse_arguments(b"not json").unwrap().is_none());
        assert!(parse_arguments(b"{\"method\": \"tools/list\"}").unwrap().is_none());
        for wrong in [json!("a mug"), json!("[1]"), json!(7), json!(["mug"])] {
            let error = parse_arguments(&call(&wrong)).unwrap_err();
            assert_eq!((&error["id"], &error["error"]["code"]), (&json!(3), &json!(-32602)));
        }
    }
}
