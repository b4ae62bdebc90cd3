//! Reads replies in JSON: bare, fenced, or among words.

use super::{
    Choice, Field, Reply, anchor, choice, difference, is_nothing, join_choices, names,
    read_seen_at, read_truth, words,
};
use serde_json::{Map, Value};
use std::collections::BTreeMap;

/// Number of opening braces that are tried before a reply counts as not JSON.
const MAX_TRIES: usize = 64;

/// Reads the objects in a reply that have one of the six fields, merged. Two ids contradict each
/// other.
pub(super) fn read(text: &str) -> Option<Reply> {
    let mut from = 0;
    let mut replies = Vec::new();
    for (at, _) in text.match_indices('{').take(MAX_TRIES) {
        if at < from {
            continue;
        }
        let mut values = serde_json::Deserializer::from_str(&text[at..]).into_iter::<Value>();
        if let Some(Ok(Value::Object(object))) = values.next() {
            // Nested objects belong to the outer one.
            from = at + values.byte_offset();
            replies.extend(of_object(&object));
        }
    }
    let predicted =
        replies.iter().map(|reply: &Reply| reply.predicted).fold(Choice::Missing, join_choices);
    let fullest = replies.into_iter().min_by_key(|reply| reply.not_read.len())?;
    Some(Reply { predicted, ..fullest })
}

fn of_object(object: &Map<String, Value>) -> Option<Reply> {
    let mut reply = Reply::default();
    let mut told = Vec::new();
    for (key, value) in object {
        let Some(field) = field(key) else { continue };
        told.push(field);
        match field {
            Field::PredictedId => reply.predicted = id(value),
            Field::Explanation => reply.explanation = value.as_str().and_then(words),
            Field::CandidateNames => reply.candidate_names = names_of(value),
            Field::TargetNameMatches => {
                reply.target_name_matches =
                    value.as_bool().or_else(|| value.as_str().and_then(read_truth));
            }
            Field::AnchorId => {
                reply.anchor_id = match value {
                    Value::Array(ids) => ids.first().and_then(|first| anchor(&plain(first))),
                    value => anchor(&plain(value)),
                }
            }
            Field::SeenAt => reply.seen_at = value.as_str().and_then(read_seen_at),
            Field::Differs => reply.differs = value.as_str().and_then(difference),
            Field::RelationUsed => {
                reply.relation_used = value.as_str().and_then(words).filter(|w| !is_nothing(w));
            }
        }
    }
    if told.is_empty() {
        // Some models wrap the object once more.
        return object.values().filter_map(Value::as_object).find_map(of_object);
    }
    reply.note_unread(|field| told.contains(&field));
    Some(reply)
}

/// Returns the field of a key, in any case, with underscores, blanks or nothing between its words.
fn field(key: &str) -> Option<Field> {
    let letters: String =
        key.chars().filter(char::is_ascii_alphanumeric).map(|c| c.to_ascii_lowercase()).collect();
    match letters.as_str() {
        "predictedid" | "predictedobjectid" | "predictiontargetid" | "prediction" => {
            Some(Field::PredictedId)
        }
        "explanation" => Some(Field::Explanation),
        "candidatenames" => Some(Field::CandidateNames),
        "targetnamematches" | "targetnamematch" => Some(Field::TargetNameMatches),
        "anchorid" => Some(Field::AnchorId),
        "relationused" => Some(Field::RelationUsed),
        "seenat" => Some(Field::SeenAt),
        "differs" => Some(Field::Differs),
        _ => None,
    }
}

fn plain(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        Value::Null => "none".into(),
        other => other.to_string(),
    }
}

fn id(value: &Value) -> Choice {
    match value {
        Value::Array(ids) => match ids.iter().map(id).collect::<Vec<_>>().as_slice() {
            [one] => *one,
            [Choice::Id(a), Choice::Id(b), ..] => Choice::Contradiction(*a, *b),
            _ => Choice::Missing,
        },
        value => choice(&plain(value)),
    }
}

fn names_of(value: &Value) -> BTreeMap<u32, String> {
    let one = |id: &str, name: &Value| Some((anchor(id)?, name.as_str().and_then(words)?));
    match value {
        Value::Object(by_id) => by_id.iter().filter_map(|(id, name)| one(id, name)).collect(),
        Value::Array(items) => items
            .iter()
            .flat_map(|item| match item {
                Value::Object(item) => item
                    .get("id")
                    .zip(item.get("name"))
                    .and_then(|(id, name)| one(&plain(id), name))
                    .into_iter()
                    .collect(),
                item => names(&plain(item)),
            })
            .collect(),
        value => names(&plain(value)),
    }
}
