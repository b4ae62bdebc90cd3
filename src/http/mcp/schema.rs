//! JSON Schemas of the tools, generated from the types of the API.

use rmcp::model::JsonObject;
use serde_json::{Map, Value};
use std::sync::Arc;
use utoipa::ToSchema;

const COMPONENTS: &str = "#/components/schemas/";

/// Returns the complete schema of a type with its definitions.
pub(super) fn schema_of<T: ToSchema>() -> Arc<JsonObject> {
    let mut parts = Vec::new();
    T::schemas(&mut parts);
    let mut whole = to_object(&T::schema());
    let parts: Map<String, Value> =
        parts.into_iter().map(|(name, schema)| (name, Value::Object(to_object(&schema)))).collect();
    if !parts.is_empty() {
        whole.insert("$defs".into(), Value::Object(parts));
    }
    let mut whole = Value::Object(whole);
    inline_references(&mut whole);
    match whole {
        Value::Object(whole) => Arc::new(whole),
        _ => Arc::default(),
    }
}

fn to_object(schema: &impl serde::Serialize) -> Map<String, Value> {
    match serde_json::to_value(schema) {
        Ok(Value::Object(schema)) => schema,
        _ => Map::new(),
    }
}

/// Rewrites references to `$defs` and removes OpenAPI-only keywords.
fn inline_references(schema: &mut Value) {
    match schema {
        Value::Object(fields) => {
            if let Some(Value::String(reference)) = fields.get_mut("$ref")
                && let Some(name) = reference.strip_prefix(COMPONENTS)
            {
                *reference = format!("#/$defs/{name}");
            }
            // JSON Schema uses a list of examples. A field may have this name too; it is then an
            // object.
            if fields
                .get("example")
                .is_some_and(|example| !example.is_object() || fields.contains_key("type"))
            {
                fields.remove("example");
            }
            fields.values_mut().for_each(inline_references);
        }
        Value::Array(items) => items.iter_mut().for_each(inline_references),
        _ => {}
    }
}
