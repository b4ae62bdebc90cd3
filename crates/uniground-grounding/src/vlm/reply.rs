//! Reads a model's reply as six fields (docs/METHOD.md, section 4, "Parser").
//!
//! Models are asked for six lines and send lines in another order, in one line, in Markdown, as a
//! list, as a table, as JSON. All of these are read. An id is only ever taken from the field that
//! holds it, or from a reply that is nothing but an id, never from an explanation.

mod json;
mod labels;
mod names;

use names::names;
pub use names::names_in;
use std::collections::BTreeMap;
use uniground_models::chat::after_thoughts;

/// What a reply says about the requested object.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Choice {
    /// This id, which need not be a candidate's.
    Id(u32),
    /// The model says that no candidate fits.
    Nothing,
    /// The model sees the object, but not among the candidates.
    NotListed,
    /// Two ids that contradict each other.
    Contradiction(u32, u32),
    /// No id could be read.
    #[default]
    Missing,
}

/// The six fields of a model's reply, and two optional ones. Fields that could not be read are empty
/// and listed in `not_read`.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Reply {
    /// "Predicted ID".
    pub predicted: Choice,
    /// "Explanation", on one line.
    pub explanation: Option<String>,
    /// "Candidate Names", by id; the ids need not be candidates'.
    pub candidate_names: BTreeMap<u32, String>,
    /// "Target name matches?", for the chosen candidate.
    pub target_name_matches: Option<bool>,
    /// "Anchor ID"; `None` for "unknown" as well.
    pub anchor_id: Option<u32>,
    /// "Relation used"; `None` for "none" as well.
    pub relation_used: Option<String>,
    /// "Seen at": where the model sees the object that is not listed.
    pub seen_at: Option<SeenAt>,
    /// "Differs": what the question says of the chosen object and is not so.
    pub differs: Option<String>,
    /// Fields that could not be read.
    pub not_read: Vec<&'static str>,
}

/// A place in a picture that a model was shown.
#[derive(Debug, Clone, PartialEq)]
pub struct SeenAt {
    /// Number of the picture, from 1, in the order they were sent.
    pub image: usize,
    /// Distance from the left and the upper edge as the model wrote it, in its
    /// [`PointForm`](super::PointForm).
    pub at: [f32; 2],
    /// Left, upper, right and lower rim of the object, in the same form. `None` if the model gave
    /// only a point.
    pub area: Option<[f32; 4]>,
    /// Name of the object seen there.
    pub name: String,
}

/// One of the six fields, the place that accompanies "not listed", or what differs from the
/// question.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(in crate::vlm) enum Field {
    PredictedId,
    Explanation,
    CandidateNames,
    TargetNameMatches,
    AnchorId,
    RelationUsed,
    SeenAt,
    Differs,
}

impl Field {
    /// The six that every reply has.
    pub const ALL: [Self; 6] = [
        Self::PredictedId,
        Self::Explanation,
        Self::CandidateNames,
        Self::TargetNameMatches,
        Self::AnchorId,
        Self::RelationUsed,
    ];

    /// Returns the paper's name of the field.
    pub fn title(self) -> &'static str {
        match self {
            Self::PredictedId => "Predicted ID",
            Self::Explanation => "Explanation",
            Self::CandidateNames => "Candidate Names",
            Self::TargetNameMatches => "Target name matches?",
            Self::AnchorId => "Anchor ID",
            Self::RelationUsed => "Relation used",
            Self::SeenAt => "Seen at",
            Self::Differs => "Differs",
        }
    }
}

/// Reads a reply to a question. Repetitions of the question in the reply are not answers. JSON
/// among words is searched only where JSON was asked for (`json`). Never fails: absent fields are
/// missing.
#[must_use]
pub fn read_answer(text: &str, query: &str, json: bool) -> Reply {
    let text = without_query(&normalize_script(text), &normalize_script(query));
    let told = without_thoughts(&text);
    let lines = labels::leading_fields(told);
    if lines > 1 && !json && !is_all_json(told) {
        return read_labels(told);
    }
    read(told)
}

/// Reads a reply. Never fails: absent fields are missing.
#[must_use]
pub fn read(text: &str) -> Reply {
    let text = normalize_script(text);
    let text = without_thoughts(&text);
    json::read(text).unwrap_or_else(|| read_labels(text))
}

/// Returns whether a reply is JSON and nothing else, except for a fence around it.
fn is_all_json(text: &str) -> bool {
    let text = text.trim().trim_matches('`').trim();
    let text = strip_word(text, "json").unwrap_or(text).trim();
    text.starts_with('{') && text.ends_with('}')
}

/// Removes repetitions of a question that could be mistaken for an answer. Others stay, because
/// their words may be a candidate's name.
fn without_query(text: &str, query: &str) -> String {
    let could_be_read = query.contains(['{', '\n'])
        || !labels::fields(query).is_empty()
        || !names(query).is_empty()
        || read_bare_id(query) != Choice::Missing;
    if !could_be_read {
        return text.to_owned();
    }
    // Unchanged, on one line, and with its quotes escaped as in the prompt.
    let one_line = query.split_whitespace().collect::<Vec<_>>().join(" ");
    let quoted = serde_json::Value::from(one_line.as_str()).to_string();
    let escaped = &quoted[1..quoted.len() - 1];
    [query, &one_line, escaped].into_iter().filter(|shape| !shape.trim().is_empty()).fold(
        text.to_owned(),
        |text, shape| {
            if text.trim() == shape { text } else { text.replace(shape, "(the query)") }
        },
    )
}

fn read_labels(text: &str) -> Reply {
    let fields = labels::fields(text);
    if fields.is_empty() {
        return Reply {
            predicted: read_bare_id(text),
            not_read: Field::ALL[1..].iter().map(|f| f.title()).collect(),
            ..Reply::default()
        };
    }
    let mut reply = Reply::default();
    for (field, value) in &fields {
        match field {
            Field::PredictedId => reply.predicted = join_choices(reply.predicted, choice(value)),
            Field::Explanation => reply.explanation = reply.explanation.or_else(|| words(value)),
            Field::CandidateNames => reply.candidate_names.extend(names(value)),
            Field::TargetNameMatches => {
                reply.target_name_matches = reply.target_name_matches.or_else(|| read_truth(value));
            }
            Field::AnchorId => reply.anchor_id = reply.anchor_id.or_else(|| anchor(value)),
            Field::RelationUsed => {
                reply.relation_used =
                    reply.relation_used.or_else(|| words(value).filter(|w| !is_nothing(w)));
            }
            Field::SeenAt => reply.seen_at = reply.seen_at.or_else(|| read_seen_at(value)),
            Field::Differs => reply.differs = reply.differs.or_else(|| difference(value)),
        }
    }
    let told = |field: Field| fields.iter().any(|(f, _)| *f == field);
    reply.note_unread(told);
    reply
}

impl Reply {
    /// Lists fields that are missing or unreadable.
    fn note_unread(&mut self, told: impl Fn(Field) -> bool) {
        let read = |field| match field {
            Field::PredictedId => {
                !matches!(self.predicted, Choice::Missing | Choice::Contradiction(..))
            }
            Field::Explanation => self.explanation.is_some(),
            Field::CandidateNames => !self.candidate_names.is_empty(),
            Field::TargetNameMatches => self.target_name_matches.is_some(),
            // "unknown" is an answer.
            Field::AnchorId | Field::RelationUsed => told(field),
            // Most replies have no such fields.
            Field::SeenAt | Field::Differs => true,
        };
        self.not_read =
            Field::ALL.into_iter().filter(|field| !read(*field)).map(Field::title).collect();
    }
}

/// Converts punctuation and digits of other scripts to ASCII, so that the rest of this module sees
/// one kind only.
fn normalize_script(text: &str) -> String {
    let mut plain = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '\u{ff01}'..='\u{ff5e}' => plain.extend(char::from_u32(u32::from(c) - 0xfee0)),
            '\u{3002}' => plain.push('.'),
            '\u{3001}' => plain.push(','),
            '\u{201c}' | '\u{201d}' | '\u{201e}' | '\u{ab}' | '\u{bb}' => plain.push('"'),
            '\u{2018}' | '\u{2019}' => plain.push('\''),
            '\u{2192}' | '\u{21d2}' | '\u{27a1}' => plain.push_str("->"),
            '\u{2013}' | '\u{2014}' => plain.push('-'),
            '\u{2022}' | '\u{25cf}' | '\u{25aa}' => plain.push('*'),
            '\u{a0}' | '\u{3000}' | '\u{202f}' => plain.push(' '),
            '\r' | '\u{feff}' | '\u{200b}' => {}
            c => plain.push(c),
        }
    }
    // Marks that some models put around their answer.
    for mark in ["<|begin_of_box|>", "<|end_of_box|>"] {
        plain = plain.replace(mark, "");
    }
    plain
}

/// Returns the text after the model's thinking; empty if the reply broke off within it.
fn without_thoughts(text: &str) -> &str {
    after_thoughts(text).unwrap_or_default()
}

fn join_choices(before: Choice, now: Choice) -> Choice {
    match (before, now) {
        (Choice::Missing, now) => now,
        (Choice::Id(a), Choice::Id(b)) if a != b => Choice::Contradiction(a, b),
        (Choice::Id(a), Choice::Nothing | Choice::NotListed)
        | (Choice::Nothing | Choice::NotListed, Choice::Id(a)) => Choice::Contradiction(a, a),
        (before, _) => before,
    }
}

/// Maximum length of what differs, characters.
const MAX_DIFFERENCE: usize = 200;

const DECORATION: [char; 15] =
    ['*', '_', '`', '#', '<', '>', '[', ']', '(', ')', '{', '}', '"', '\'', '|'];

/// Reads the id of a field: `22`, `<22>`, `ID 22`, `22.`, `**22** (the window)`; or that there is
/// none.
pub(super) fn choice(value: &str) -> Choice {
    let line = value.lines().map(str::trim).find(|line| !line.is_empty()).unwrap_or_default();
    let line = line.replace("\\boxed", "").replace('$', "");
    let mut rest = strip_decoration(&line);
    // Words that may precede an id.
    while let Some(after) = [
        "the",
        "is",
        "object",
        "candidate",
        "instance",
        "id",
        "no.",
        "number",
        "answer",
        "=",
        ":",
        "- ",
    ]
    .into_iter()
    .find_map(|word| strip_word(rest, word))
    {
        rest = strip_decoration(after);
    }
    if is_not_listed(rest) {
        return Choice::NotListed;
    }
    if is_nothing(rest) {
        return Choice::Nothing;
    }
    let Some((id, after)) = leading_number(rest) else { return Choice::Missing };
    match another_number(after) {
        Some(other) if other != id => Choice::Contradiction(id, other),
        _ => Choice::Id(id),
    }
}

fn strip_decoration(text: &str) -> &str {
    text.trim_start_matches(|c: char| c.is_whitespace() || DECORATION.contains(&c))
}

/// Returns the text after a word, in any case, if the text begins with it.
fn strip_word<'a>(text: &'a str, word: &str) -> Option<&'a str> {
    let head = text.get(..word.len())?;
    let after = &text[word.len()..];
    let ends = !word.ends_with(|c: char| c.is_ascii_alphabetic())
        || !after.starts_with(|c: char| c.is_alphabetic());
    (head.eq_ignore_ascii_case(word) && ends).then_some(after)
}

/// Returns a whole number at the start and the text after it; "22.5" and "22nd" are none.
fn leading_number(text: &str) -> Option<(u32, &str)> {
    let digits = text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len());
    let (number, after) = text.split_at(digits);
    // Some models write whole numbers as 22.0.
    let after = after
        .strip_prefix(".0")
        .filter(|rest| !rest.starts_with(|c: char| c.is_ascii_digit()))
        .unwrap_or(after);
    let goes_on = after.starts_with(|c: char| c.is_alphanumeric())
        || after
            .strip_prefix('.')
            .is_some_and(|rest| rest.starts_with(|c: char| c.is_ascii_digit()));
    (!goes_on).then(|| number.parse().ok()).flatten().map(|number| (number, after))
}

/// Returns the 7 of "22 or 7", "22, 7", "22 / 7": another number right after an id contradicts it.
fn another_number(after: &str) -> Option<u32> {
    let after = after.trim_start_matches(|c: char| c == ' ' || DECORATION.contains(&c));
    let (word, after) = ["or", "and", "/", ",", "&", "vs."]
        .into_iter()
        .find_map(|word| Some((word, strip_word(after, word)?)))?;
    let after = strip_decoration(after);
    let after = strip_word(after, "id").map_or(after, strip_decoration);
    let (number, after) = leading_number(after)?;
    // "9, 2 metres left of it" has one id.
    let is_measure = word == "," && after.trim_start().starts_with(|c: char| c.is_alphabetic());
    (!is_measure).then_some(number)
}

/// Reads a reply that is nothing but an id (paper's fallback).
fn read_bare_id(text: &str) -> Choice {
    const LONGEST: usize = 40;
    let text = text.trim();
    let text = text
        .strip_prefix("<answer>")
        .and_then(|t| t.strip_suffix("</answer>"))
        .unwrap_or(text)
        .trim();
    let text =
        strip_word(text, "answer").map_or(text, |after| after.trim_start_matches([':', ' ']));
    if text.len() > LONGEST || text.lines().count() > 1 {
        return Choice::Missing;
    }
    let rest = strip_decoration(text);
    let rest = strip_word(rest, "id")
        .map_or(rest, |after| strip_decoration(after.trim_start_matches([':', '=', ' '])));
    match leading_number(rest) {
        Some((id, after))
            if after.chars().all(|c| c.is_whitespace() || c == '.' || DECORATION.contains(&c)) =>
        {
            Choice::Id(id)
        }
        _ => Choice::Missing,
    }
}

/// Returns whether a value says that there is none: "none", "None - no candidate is a fridge", "No
/// matching candidate".
fn is_nothing(value: &str) -> bool {
    let value = strip_decoration(value).trim_start_matches(['-', ' ']).to_ascii_lowercase();
    let word: String = value.chars().take_while(|c| c.is_ascii_alphabetic() || *c == '/').collect();
    let after = value[word.len()..].trim_start();
    match word.as_str() {
        "none" | "nothing" | "null" | "unknown" | "n/a" | "na" | "nil" => true,
        // "No. 22" is an id.
        "no" | "not" => {
            !after.trim_start_matches(['.', ' ', '#']).starts_with(|c: char| c.is_ascii_digit())
        }
        _ => false,
    }
}

/// Returns whether a value says that the object is seen, but not among the candidates.
fn is_not_listed(value: &str) -> bool {
    let value = value.to_ascii_lowercase();
    ["not listed", "not_listed", "unlisted", "visible, not listed", "visible but not listed"]
        .iter()
        .any(|words| value.starts_with(words))
}

/// Reads a picture, a place in it and a name: "Image 3, 512, 640, black alarm clock", or with the
/// corners of a box: "Image 3, 480, 600, 540, 680, black alarm clock".
pub(super) fn read_seen_at(value: &str) -> Option<SeenAt> {
    let line = value.lines().map(str::trim).find(|line| !line.is_empty())?;
    let (mut numbers, mut rest) = (Vec::new(), line);
    while numbers.len() < 3 {
        let (number, after) = next_number(rest)?;
        numbers.push(number.ok()?);
        rest = after;
    }
    let is_image = numbers[0] >= 1.0 && numbers[0].fract() == 0.0;
    let (image, from) = (numbers[0] as usize, [numbers[1], numbers[2]]);
    let (mut at, mut area) = (from, None);
    if let Some((to, after)) = other_corner(rest) {
        rest = after;
        at = [f32::midpoint(from[0], to[0]), f32::midpoint(from[1], to[1])];
        let (low, high) = ([0, 1].map(|i| from[i].min(to[i])), [0, 1].map(|i| from[i].max(to[i])));
        area = (low[0] < high[0] && low[1] < high[1]).then_some([low[0], low[1], high[0], high[1]]);
    }
    let name = words(rest.trim_start_matches(|c: char| !c.is_alphanumeric())).unwrap_or_default();
    is_image.then_some(SeenAt { image, at, area, name })
}

/// Returns the next number of a text, and the text after it. A minus is a sign unless it follows a
/// letter or a digit.
fn next_number(text: &str) -> Option<(Result<f32, std::num::ParseFloatError>, &str)> {
    let start = text.find(|c: char| c.is_ascii_digit())?;
    let end = text[start..]
        .find(|c: char| !c.is_ascii_digit() && c != '.')
        .map_or(text.len(), |length| start + length);
    let is_negative = text[..start]
        .strip_suffix('-')
        .is_some_and(|before| !before.ends_with(|c: char| c.is_alphanumeric()));
    let number = text[start..end].trim_end_matches('.').parse::<f32>();
    Some((number.map(|n| if is_negative { -n } else { n }), &text[end..]))
}

/// Reads the second corner of a box and returns the text after it. `None` if the text goes on with a
/// name: "8.03 door", "2 mugs".
fn other_corner(text: &str) -> Option<([f32; 2], &str)> {
    let before =
        |text: &str| text.chars().take_while(|c| !c.is_ascii_digit()).any(char::is_alphabetic);
    let (x, rest) = next_number(text)?;
    if before(text) || before(rest) || rest.trim_start().starts_with(char::is_alphabetic) {
        return None;
    }
    let (y, rest) = next_number(rest)?;
    Some(([x.ok()?, y.ok()?], rest))
}

/// Values that say that nothing differs, without the period at their end.
const NO_DIFFERENCE: [&str; 16] = [
    "none",
    "nothing",
    "nothing differs",
    "no",
    "no difference",
    "no differences",
    "null",
    "nil",
    "n/a",
    "na",
    "not applicable",
    "false",
    "same",
    "the same",
    "not different",
    "unknown",
];

/// Reads what differs: at most [`MAX_DIFFERENCE`] characters, as the end of a sentence, without a
/// period. `None` where the value says that nothing differs.
pub(super) fn difference(value: &str) -> Option<String> {
    let line = value.lines().map(str::trim).find(|line| !line.is_empty())?;
    let value = words(strip_decoration(line))?;
    let value = value.trim_end_matches(['.', '"', ')', '>', ' ']);
    let lower = value.to_lowercase();
    let is_none = NO_DIFFERENCE.contains(&lower.as_str())
        || [
            "does not differ",
            "doesn't differ",
            "matches the query",
            "it matches",
            "no difference ",
        ]
        .iter()
        .any(|start| {
            lower.trim_start_matches("it ").starts_with(start) || lower.starts_with(start)
        });
    if is_none || !value.contains(char::is_alphabetic) {
        return None;
    }
    let mut letters = value.chars();
    let first = letters.next()?;
    let is_abbreviation = letters.clone().next().is_some_and(char::is_uppercase);
    let first = if is_abbreviation { first.to_string() } else { first.to_lowercase().to_string() };
    Some(first.chars().chain(letters).take(MAX_DIFFERENCE).collect())
}

/// Returns words without the Markdown around them; `None` when there are none.
pub(super) fn words(value: &str) -> Option<String> {
    let ends = |c: char| c.is_whitespace() || matches!(c, '*' | '_' | '`' | '|' | '#' | ',' | ';');
    let trimmed = value.trim_matches(ends);
    let inner = trimmed.strip_prefix('"').and_then(|t| t.strip_suffix('"')).unwrap_or(trimmed);
    let joined = inner.split_whitespace().collect::<Vec<_>>().join(" ");
    (!joined.is_empty()).then_some(joined)
}

pub(super) fn read_truth(value: &str) -> Option<bool> {
    let word: String =
        strip_decoration(value).chars().take_while(char::is_ascii_alphabetic).collect();
    match word.to_ascii_lowercase().as_str() {
        "true" | "yes" | "y" | "matches" => Some(true),
        "false" | "no" | "n" => Some(false),
        _ => None,
    }
}

pub(super) fn anchor(value: &str) -> Option<u32> {
    match choice(value) {
        // "20, 31": the first of several anchors.
        Choice::Id(id) | Choice::Contradiction(id, _) => Some(id),
        Choice::Nothing | Choice::NotListed | Choice::Missing => None,
    }
}

/// Returns the values of labeled lines, or of a JSON object's members, by these labels in lower
/// case; `None` for absent ones. The last one counts.
#[must_use]
pub fn labeled(text: &str, labels: &[&str]) -> Vec<Option<String>> {
    let text = normalize_script(text);
    let text = without_thoughts(&text);
    let letters = |text: &str| {
        let kept = text.chars().filter(char::is_ascii_alphabetic);
        kept.map(|c| c.to_ascii_lowercase()).collect::<String>()
    };
    let mut found = vec![None; labels.len()];
    let mut keep = |key: &str, value: String| {
        let key = letters(key);
        if let Some(at) = labels.iter().position(|label| letters(label) == key) {
            found[at] = Some(value);
        }
    };
    let object = text.find('{').and_then(|at| {
        serde_json::Deserializer::from_str(&text[at..]).into_iter::<serde_json::Value>().next()
    });
    if let Some(Ok(serde_json::Value::Object(object))) = object {
        let plain = |value: &serde_json::Value| {
            value.as_str().map_or_else(|| value.to_string(), str::to_owned)
        };
        for (key, value) in object {
            let items = value.as_array().map(|items| items.iter().map(plain).collect::<Vec<_>>());
            keep(&key, items.map_or_else(|| plain(&value), |items| items.join(", ")));
        }
        return found;
    }
    for (key, value) in text.lines().filter_map(|line| line.split_once(':')) {
        keep(key, value.to_owned());
    }
    found
}

/// Returns the ids in a text, in order and each once, of those that may be in it.
#[must_use]
pub fn numbers(text: &str, may_be: impl Fn(u32) -> bool) -> Vec<u32> {
    let mut ids = Vec::new();
    for number in text.split(|c: char| !c.is_ascii_digit()).filter_map(|digits| digits.parse().ok())
    {
        if may_be(number) && !ids.contains(&number) {
            ids.push(number);
        }
    }
    ids
}

/// Returns the ids of a shortlist, in order and each once, of those that may be on it.
#[must_use]
pub fn shortlist(text: &str, is_candidate: impl Fn(u32) -> bool) -> Vec<u32> {
    let text = normalize_script(text);
    let text = without_thoughts(&text);
    let line = text
        .lines()
        .rev()
        .find(|line| line.to_ascii_lowercase().contains("shortlist"))
        .unwrap_or(text);
    numbers(line, is_candidate)
}

/// Returns the one id written as "ID 7" in a reply without a requested format; `None` when there
/// are several, or none.
#[must_use]
pub fn only_id(text: &str, is_candidate: impl Fn(u32) -> bool) -> Option<u32> {
    let text = normalize_script(text);
    let text = without_thoughts(&text);
    let lower = text.to_ascii_lowercase();
    let mut ids: Vec<u32> = lower
        .match_indices("id")
        .filter(|(at, _)| !lower[..*at].ends_with(|c: char| c.is_ascii_alphanumeric()))
        .filter_map(|(at, _)| {
            leading_number(strip_decoration(
                text[at + 2..].trim_start_matches([':', ' ', '#', '*']),
            ))
        })
        .map(|(id, _)| id)
        .filter(|id| is_candidate(*id))
        .collect();
    ids.dedup();
    match ids.as_slice() {
        [id] => Some(*id),
        _ => None,
    }
}

#[cfg(test)]
mod tests;
