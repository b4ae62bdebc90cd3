//! Finds the fields in a reply.

use super::Field;
use std::collections::BTreeSet;

/// How models write the fields' names, in lower case. A longer one comes before its own prefix.
pub(super) const LABELS: &[(Field, &str)] = &[
    (Field::PredictedId, "predicted object id"),
    (Field::PredictedId, "predicted target id"),
    (Field::PredictedId, "predicted id"),
    (Field::PredictedId, "predicted_id"),
    (Field::PredictedId, "prediction id"),
    (Field::PredictedId, "final id"),
    (Field::PredictedId, "final object id"),
    (Field::Explanation, "explanation"),
    (Field::CandidateNames, "candidate names"),
    (Field::CandidateNames, "candidate_names"),
    (Field::CandidateNames, "candidates names"),
    (Field::TargetNameMatches, "target name matches"),
    (Field::TargetNameMatches, "target_name_matches"),
    (Field::TargetNameMatches, "target name match"),
    (Field::AnchorId, "anchor id"),
    (Field::AnchorId, "anchor_id"),
    (Field::RelationUsed, "relation used"),
    (Field::RelationUsed, "relation_used"),
    (Field::SeenAt, "seen at"),
    (Field::SeenAt, "seen_at"),
    (Field::Differs, "differs"),
];

struct Found {
    field: Field,
    start: usize,
    value: usize,
    /// Whether only bullets and Markdown precede it on its line.
    leads: bool,
}

/// Returns fields and their values, in the order of the reply. A label within a line counts only in
/// a reply that is one line, or after the end of another field's value there.
pub(super) fn fields(text: &str) -> Vec<(Field, &str)> {
    let mut found = find(text);
    // The reply has lines of fields, so a label within a line only mentions a field.
    let lines = leading(&found);
    let starts_with_id = found.iter().any(|f| f.leads && f.field == Field::PredictedId);
    if lines >= 3 || lines == 2 && starts_with_id {
        found.retain(|f| f.leads);
    } else {
        found.retain(|f| f.leads || separated(text, f.start));
    }
    // Bullets and numbers before a label are not part of the previous value.
    let begins = |f: &Found| {
        if f.leads { text[..f.start].rfind('\n').map_or(0, |at| at + 1) } else { f.start }
    };
    let ends: Vec<usize> = found.iter().skip(1).map(begins).chain([text.len()]).collect();
    found.iter().zip(ends).map(|(f, end)| (f.field, &text[f.value..end.max(f.value)])).collect()
}

/// Returns how many different fields begin a line.
pub(super) fn leading_fields(text: &str) -> usize {
    leading(&find(text))
}

fn leading(found: &[Found]) -> usize {
    found.iter().filter(|f| f.leads).map(|f| f.field).collect::<BTreeSet<_>>().len()
}

fn find(text: &str) -> Vec<Found> {
    // Same length, byte by byte, so positions are valid in both.
    let lower = text.to_ascii_lowercase();
    let mut found: Vec<Found> = Vec::new();
    for &(field, label) in LABELS {
        for (start, _) in lower.match_indices(label) {
            if let Some(value) = value_after(text, start + label.len())
                && !found.iter().any(|f| f.start <= start && start < f.value)
            {
                found.push(Found { field, start, value, leads: leads(text, start) });
            }
        }
    }
    found.sort_by_key(|f| f.start);
    found
}

/// Returns where the value of a label that ends at `end` begins; `None` when the label is only
/// mentioned.
fn value_after(text: &str, end: usize) -> Option<usize> {
    let rest = text[end..].trim_start_matches(['*', '_', '`', '?', '"', '\'', ' ']);
    // "Predicted ID (of the target): 22"
    let rest = rest
        .strip_prefix('(')
        .and_then(|inner| inner.split_once(')'))
        .filter(|(inner, _)| inner.len() < 40 && !inner.contains('\n'))
        .map_or(rest, |(_, after)| after.trim_start_matches(['*', '_', ' ']));
    let value =
        [":", "=>", "=", "->", "|", "- "].into_iter().find_map(|sign| rest.strip_prefix(sign));
    // A heading has its value on the next line.
    let value = value.or_else(|| rest.starts_with('\n').then_some(rest))?;
    Some(text.len() - value.len())
}

/// Returns whether only bullets, numbers and Markdown precede a label on its line.
fn leads(text: &str, start: usize) -> bool {
    let line = text[..start].rfind('\n').map_or(0, |at| at + 1);
    let before = text[line..start]
        .trim_matches(|c: char| c.is_whitespace() || "*_`#->|+\"'<[({".contains(c));
    // "Final Predicted ID", "Answer: Predicted ID".
    let lower = before.to_ascii_lowercase();
    let announced = ["final", "my", "the", "answer:", "final answer:"].contains(&lower.trim());
    let numbered = before
        .strip_suffix(['.', ')'])
        .is_some_and(|n| n.len() <= 2 && n.bytes().all(|b| b.is_ascii_digit()));
    before.is_empty() || numbered || announced
}

/// Returns whether a label within a line follows the end of a clause: `...; Anchor ID: 20`.
fn separated(text: &str, start: usize) -> bool {
    text[..start]
        .trim_end_matches(|c: char| c == ' ' || "*_`\"'<[({".contains(c))
        .ends_with([',', ';', '.', '|', '/', '\n', ':', '!', ')', ']', '}', '>'])
}
