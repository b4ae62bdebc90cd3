//! Reads ids with names, in all notations of models: "7 -> beige wall section, 22 -> window".

use super::{DECORATION, normalize_script, without_thoughts, words};
use std::collections::BTreeMap;

/// Returns ids and names anywhere in a reply to a request for names alone.
#[must_use]
pub fn names_in(text: &str) -> BTreeMap<u32, String> {
    let text = normalize_script(text);
    let text = without_thoughts(&text);
    let mut found = BTreeMap::new();
    for line in text.lines() {
        let of_line = names(line);
        match of_line.is_empty() {
            false => found.extend(of_line),
            true => found.extend(listed(line)),
        }
    }
    found.retain(|_, name| name.chars().any(char::is_alphabetic));
    found
}

/// Reads a list item or table row: `7. red sofa`, `| 7 | red sofa |`.
fn listed(line: &str) -> Option<(u32, String)> {
    let line = line.trim_start_matches([' ', '|', '*', '-']);
    let digits = line.find(|c: char| !c.is_ascii_digit())?;
    let (id, rest) = line.split_at(digits);
    let name = ['.', ')', '|']
        .into_iter()
        .find_map(|sign| rest.trim_start().strip_prefix(sign))
        .filter(|name| name.starts_with(' '))?;
    Some((id.parse().ok()?, words(name.split('|').next().unwrap_or_default())?))
}

/// Reads `7 -> beige wall section, 22 -> window`: ids and the text between them; also one per line,
/// with colons, dashes and bullets. An id begins a line or follows a comma, unless an arrow marks
/// it: "white 2-seat sofa" has no second id.
pub(super) fn names(value: &str) -> BTreeMap<u32, String> {
    let mut found: Vec<(u32, usize, usize)> = Vec::new();
    let bytes = value.as_bytes();
    let mut at = 0;
    while at < bytes.len() {
        if !bytes[at].is_ascii_digit()
            || at > 0 && (bytes[at - 1].is_ascii_alphanumeric() || bytes[at - 1] == b'.')
        {
            at += 1;
            continue;
        }
        let digits = bytes[at..].iter().take_while(|b| b.is_ascii_digit()).count();
        let (start, begins) = entry_start(value, at);
        let entry =
            after_sign(&value[at + digits..], begins).zip(value[at..at + digits].parse().ok());
        at += digits;
        if let Some((name, id)) = entry {
            found.push((id, start, value.len() - name.len()));
            at = at.max(value.len() - name.len());
        }
    }
    let ends = found.iter().skip(1).map(|(_, start, _)| *start).chain([value.len()]);
    found
        .iter()
        .zip(ends)
        .filter_map(|(&(id, _, start), end)| Some((id, words(value.get(start..end)?)?)))
        .map(|(id, name)| (id, name.trim_end_matches(['.', '}', ']', '>']).trim().to_owned()))
        .filter(|(_, name)| !name.is_empty())
        .collect()
}

/// Returns the text after the sign between an id and its name. Only an arrow is accepted where the
/// id does not begin an entry.
fn after_sign(after: &str, begins: bool) -> Option<&str> {
    if let Some(name) = after.trim_start().strip_prefix("->") {
        return Some(name);
    }
    let rest = after.trim_start_matches(|c: char| c == ' ' || DECORATION.contains(&c));
    let arrow = ["->", "=>"].into_iter().find_map(|sign| rest.strip_prefix(sign));
    let sign = || [":", "="].into_iter().find_map(|sign| rest.strip_prefix(sign));
    // A separating dash is followed by a space; others belong to words.
    let dash = || rest.strip_prefix("- ").filter(|_| !after.starts_with('-'));
    arrow.or_else(|| begins.then(|| sign().or_else(dash)).flatten())
}

/// Returns where an id begins (before its "ID", its bracket, its bullet or number), and whether
/// that begins an entry.
fn entry_start(value: &str, digits: usize) -> (usize, bool) {
    let trimmed = |text: &str| {
        text.trim_end_matches(|c: char| c == ' ' || c == '-' || DECORATION.contains(&c)).len()
    };
    let before = &value[..trimmed(&value[..digits])];
    let without = |word: &str| {
        let cut = before.len().checked_sub(word.len())?;
        before.get(cut..).filter(|tail| tail.eq_ignore_ascii_case(word)).map(|_| cut)
    };
    let start = without("id")
        .or_else(|| without("object"))
        .or_else(|| without("candidate"))
        .unwrap_or(before.len());
    let mut start = trimmed(&value[..start]);
    // "3. ID 22": the line number is not part of the previous name.
    let line = value[..start].rfind('\n').map_or(0, |at| at + 1);
    let numbered = value[line..start]
        .trim()
        .strip_suffix(['.', ')'])
        .is_some_and(|n| !n.is_empty() && n.bytes().all(|b| b.is_ascii_digit()));
    if numbered {
        start = line;
    }
    let begins = value[..start].is_empty()
        || value[..start].ends_with(['\n', ',', ';', '/', ':'])
        || numbered;
    (start, begins)
}
