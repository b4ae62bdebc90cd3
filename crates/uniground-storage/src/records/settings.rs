//! Settings of a stored parse.

use serde_json::Value;
use uniground_types::settings::{ParseSettings, rename_deprecated_settings};

/// Reads settings, and translates old names of fields. A value that is not valid today is left at
/// its default. Stored settings are shown to people, and used to parse the scenes of a retired
/// parse again.
pub(super) fn read(mut stored: Value) -> ParseSettings {
    rename_deprecated_settings(&mut stored);
    remove_steps_without_settings(&mut stored);
    if let Ok(settings) = serde_json::from_value(stored.clone()) {
        return settings;
    }
    let Ok(mut whole) = serde_json::to_value(ParseSettings::default()) else {
        return ParseSettings::default();
    };
    overlay(&mut whole, &stored, &mut Vec::new());
    serde_json::from_value(whole).unwrap_or_default()
}

/// A parse whose settings lack the switch of a newer step of stage 1 was made without that step,
/// whatever the default is today.
fn remove_steps_without_settings(stored: &mut Value) {
    let young = [
        ("/parsing", "refine_borders", Value::Bool(false)),
        ("/parsing/merging", "keep_planes_apart", Value::Bool(false)),
        ("/parsing/merging", "split_at_depth_edges", Value::Bool(false)),
        ("/parsing/sam_masks", "prompts", Value::from("grid")),
        ("/parsing/sam_masks", "wholes", Value::Bool(false)),
        ("/parsing/correction", "known_agreement", Value::Null),
        ("/parsing/appearance", "frames", Value::from(0)),
        ("/parsing/instances", "min_agreement", Value::from(0.0)),
        ("/parsing/instances", "min_points", Value::from(0)),
        ("/parsing/instances", "parts_and_wholes", Value::from(0.0)),
    ];
    for (place, name, absent) in young {
        if let Some(settings) = stored.pointer_mut(place).and_then(Value::as_object_mut) {
            settings.entry(name).or_insert(absent);
        }
    }
}

/// Copies known, readable values one by one. `path` is the position of `stored` within `whole`.
fn overlay(whole: &mut Value, stored: &Value, path: &mut Vec<String>) {
    let pointer: String = path.iter().map(|key| format!("/{key}")).collect();
    let Some(known) = whole.pointer(&pointer) else { return };
    if let (Value::Object(_), Value::Object(fields)) = (known, stored) {
        for (key, value) in fields {
            path.push(key.clone());
            overlay(whole, value, path);
            path.pop();
        }
        return;
    }
    let before = known.clone();
    let set = |whole: &mut Value, value: Value| {
        if let Some(place) = whole.pointer_mut(&pointer) {
            *place = value;
        }
    };
    set(whole, stored.clone());
    if serde_json::from_value::<ParseSettings>(whole.clone()).is_err() {
        set(whole, before);
    }
}
