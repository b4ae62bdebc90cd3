//! Parses a query with a chat model: the request, and the JSON reply as a [`ParsedQuery`].

use super::affordances;
use super::{
    Look, Measure, ParsedQuery, Phrase, Quantity, Relation, RelationKind, Superlative, Trait,
    Viewpoint, With, words,
};
use serde::Deserialize;
use serde_json::{Value, json};
use uniground_geometry::color::ColorName;
use uniground_models::chat::{ChatRequest, Part};

/// Version of the prompt. Raise it when the prompt or the schema changes.
pub(super) const PROMPT_VERSION: u32 = 2;

/// Maximum nesting; no sentence is deeper.
const MAX_DEPTH: u32 = 5;
/// Maximum number of parts; no sentence has more.
const MAX_PARTS: usize = 64;
/// Maximum number of nouns for one object.
const MAX_NOUNS: usize = 8;

const SYSTEM: &str = "You turn a question about an object in a room into JSON. Answer with the JSON object alone.\n\
    target is the object asked for; relations connect a thing to its anchors; a relation belongs to the thing it is said of, so an \
    anchor may have relations of its own. noun is the bare noun in singular, empty for \"one\" or \"thing\". uses are short verb \
    phrases when the object is named by its purpose (\"something to sit on\": noun empty, uses [\"sit on\"]). with and without are \
    things the object carries. rank counts for closest, farthest and superlatives: \"second from the left\" is leftmost, rank 2. \
    viewpoint is how somebody looks: facing X, from X, back_to X; \"as you walk in\" is from the door. words are the question's own \
    words for the relation. could_be are other plain nouns by which a list of the things in a room may call this one, the likeliest first, \
    at most eight: its synonyms and wider words where it has a noun; where the noun is missing or means nothing here, and the thing is \
    told by what it does, by a need or by a situation, the things that would answer to that (\"it wakes me every morning\": alarm clock, \
    clock, radio, phone); none where nothing is said of what it is (\"what is that on the shelf\"). What is on somebody's left or right \
    is the superlative leftmost or rightmost under a viewpoint; left_of and right_of are of another thing than the one they look from or \
    face. List words you could not use in not_understood.";

/// Returns the request to the model.
pub(super) fn request(query: &str) -> ChatRequest {
    ChatRequest {
        system: SYSTEM.into(),
        user: vec![Part::Text(format!("Question: {query}"))],
        schema: Some(("parsed_query", schema())),
    }
}

fn schema() -> Value {
    let names =
        |names: Vec<&str>| json!({"type": "array", "items": {"type": "string", "enum": names}});
    let phrases = || json!({"type": "array", "items": {"$ref": "#/$defs/phrase"}});
    let colors = || ColorName::ALL.iter().map(|c| c.as_str()).collect::<Vec<_>>();
    let relation = json!({"type": "object", "additionalProperties": false, "required": ["kind", "words", "anchors"], "properties": {
        "kind": {"type": "string", "enum": RelationKind::ALL.map(RelationKind::as_str)},
        "words": {"type": "string"}, "anchors": phrases(), "negated": {"type": "boolean"}, "rank": {"type": "integer", "minimum": 1},
    }});
    let superlative = json!({"type": ["object", "null"], "additionalProperties": false, "required": ["measure"], "properties": {
        "measure": {"type": "string", "enum": Measure::ALL.map(Measure::as_str)}, "rank": {"type": "integer", "minimum": 1},
    }});
    let phrase = json!({"type": "object", "additionalProperties": false, "required": ["noun"], "properties": {
        "noun": {"type": "string"}, "could_be": {"type": "array", "items": {"type": "string"}, "maxItems": MAX_NOUNS},
        "uses": {"type": "array", "items": {"type": "string"}}, "colours": names(colors()),
        "not_colours": names(colors()), "traits": names(Trait::ALL.iter().map(|t| t.as_str()).collect()),
        "count": {"type": ["integer", "null"], "minimum": 0}, "with": phrases(), "without": phrases(),
        "relations": {"type": "array", "items": relation}, "superlative": superlative,
    }});
    let viewpoint = json!({"type": ["object", "null"], "additionalProperties": false, "required": ["look", "anchor"], "properties": {
        "look": {"type": "string", "enum": Look::ALL.map(Look::as_str)}, "anchor": {"$ref": "#/$defs/phrase"},
    }});
    json!({"type": "object", "additionalProperties": false, "required": ["target"], "$defs": {"phrase": phrase}, "properties": {
        "target": {"$ref": "#/$defs/phrase"}, "viewpoint": viewpoint, "not_understood": {"type": "array", "items": {"type": "string"}},
    }})
}

#[derive(Deserialize)]
struct QueryJson {
    target: PhraseJson,
    viewpoint: Option<ViewpointJson>,
    #[serde(default)]
    not_understood: Vec<String>,
}

#[derive(Deserialize)]
struct ViewpointJson {
    look: String,
    anchor: PhraseJson,
}

#[derive(Deserialize)]
#[serde(default)]
#[derive(Default)]
struct PhraseJson {
    noun: String,
    could_be: Vec<String>,
    uses: Vec<String>,
    #[serde(rename = "colours")]
    colors: Vec<String>,
    #[serde(rename = "not_colours")]
    not_colors: Vec<String>,
    traits: Vec<String>,
    count: Option<u32>,
    with: Vec<PhraseJson>,
    without: Vec<PhraseJson>,
    relations: Vec<RelationJson>,
    superlative: Option<SuperlativeJson>,
}

#[derive(Deserialize)]
struct RelationJson {
    kind: String,
    #[serde(default)]
    words: String,
    #[serde(default)]
    anchors: Vec<PhraseJson>,
    #[serde(default)]
    negated: bool,
    rank: Option<u32>,
}

#[derive(Deserialize)]
struct SuperlativeJson {
    measure: String,
    rank: Option<u32>,
}

/// Validates the model's answer; the error says what is wrong with it.
pub(super) fn decode(text: &str) -> Result<ParsedQuery, String> {
    // Models tend to wrap JSON in a fence, or to write a word before it.
    let json =
        text.find('{').zip(text.rfind('}')).filter(|(a, b)| a < b).map(|(a, b)| &text[a..=b]);
    let json = json.ok_or("the model's answer holds no JSON object")?;
    let query: QueryJson = serde_json::from_str(json)
        .map_err(|error| format!("the model's answer is not the JSON asked for: {error}"))?;
    let mut parts = 0;
    let target = phrase(query.target, 0, &mut parts)?;
    if target.is_empty() {
        return Err("the model's answer names no target".into());
    }
    let viewpoint = match query.viewpoint {
        None => None,
        Some(ViewpointJson { look, anchor }) => {
            let known = Look::ALL.into_iter().find(|l| l.as_str() == look);
            let look =
                known.ok_or_else(|| format!("the model's answer has an unknown look {look:?}"))?;
            Some(Viewpoint { look, anchor: phrase(anchor, 0, &mut parts)? })
        }
    };
    Ok(ParsedQuery {
        target,
        other_reading: None,
        viewpoint,
        standpoint: None,
        quantity: Quantity::One,
        foreign: false,
        not_understood: query.not_understood,
        passed_over: Vec::new(),
        later: Vec::new(),
    })
}

fn phrase(json: PhraseJson, depth: u32, parts: &mut usize) -> Result<Phrase, String> {
    *parts += 1;
    if depth > MAX_DEPTH || *parts > MAX_PARTS {
        return Err("the model's answer nests too deep or names too much".into());
    }
    let named = |known: Option<ColorName>, word: &str| {
        known.ok_or_else(|| format!("the model's answer has an unknown colour {word:?}"))
    };
    let color =
        |word: &String| named(ColorName::ALL.into_iter().find(|c| c.as_str() == word), word);
    let seen = |word: &String| {
        let known = Trait::ALL.into_iter().find(|t| t.as_str() == word);
        known.ok_or_else(|| format!("the model's answer has an unknown trait {word:?}"))
    };
    let mut with = Vec::new();
    for (list, absent) in [(json.with, false), (json.without, true)] {
        for inner in list {
            with.push(With { phrase: phrase(inner, depth + 1, parts)?, absent });
        }
    }
    let mut relations = Vec::new();
    for RelationJson { kind, words, anchors, negated, rank } in json.relations {
        let kind = RelationKind::ALL
            .into_iter()
            .find(|k| k.as_str() == kind)
            .ok_or_else(|| format!("the model's answer has an unknown relation {kind:?}"))?;
        let anchors = anchors
            .into_iter()
            .map(|anchor| phrase(anchor, depth + 1, parts))
            .collect::<Result<_, _>>()?;
        let text = if words.is_empty() { kind.as_str().replace('_', " ") } else { words };
        relations.push(Relation { kind, text, anchors, negated, rank: rank.unwrap_or(1).max(1) });
    }
    let superlative = match json.superlative {
        None => None,
        Some(SuperlativeJson { measure, rank }) => {
            let known = Measure::ALL.into_iter().find(|m| m.as_str() == measure);
            let measure = known
                .ok_or_else(|| format!("the model's answer has an unknown measure {measure:?}"))?;
            Some(Superlative { measure, rank: rank.unwrap_or(1).max(1) })
        }
    };
    let nouns = json.could_be.iter().map(|noun| noun.trim().to_lowercase());
    let mut could_be: Vec<String> =
        nouns.filter(|noun| !words::is_anything(noun)).take(MAX_NOUNS).collect();
    let mut head = json.noun.trim().to_lowercase();
    // Nouns describe the target better than its purpose.
    if words::is_anything(&head) && !could_be.is_empty() {
        head = could_be.remove(0);
    }
    let (mut uses, mut purpose) = (Vec::new(), Vec::new());
    if words::is_anything(&head) {
        for said in &json.uses {
            if let Some(found) =
                affordances::find(&super::tokens::tokenize(&format!("something to {said}")))
            {
                uses.extend(found.uses);
                purpose.extend(found.words);
            }
        }
    }
    Ok(Phrase {
        indefinite: false,
        head,
        uses,
        could_be,
        other_things: Vec::new(),
        purpose,
        colors: json.colors.iter().map(color).collect::<Result<_, _>>()?,
        other_than: json.not_colors.iter().map(color).collect::<Result<_, _>>()?,
        roughly: false,
        traits: json.traits.iter().map(seen).collect::<Result<_, _>>()?,
        unchecked: Vec::new(),
        count: json.count,
        with,
        relations,
        superlative,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::parse;

    #[test]
    fn model_json_is_decoded_like_the_grammar_result() {
        let text = r#"Sure: ```json
            {"target": {"noun": "mug", "colours": ["red"], "relations": [{"kind": "on", "words": "on", "anchors": [{"noun": "coffee table"}]}]},
             "viewpoint": null, "not_understood": []}
        ```"#;
        assert_eq!(decode(text).unwrap(), parse("the red mug on the coffee table"));
        let text = r#"{"target": {"noun": "chair", "superlative": {"measure": "leftmost", "rank": 2}}, "viewpoint": {"look": "facing", "anchor": {"noun": "window"}}}"#;
        assert_eq!(
            decode(text).unwrap(),
            parse("facing the window, the second chair from the left")
        );
        let text = r#"{"target": {"noun": "", "uses": ["sit on"]}}"#;
        let target = decode(text).unwrap().target;
        assert_eq!(target.meaning(), parse("something to sit on").target.meaning());
    }

    #[test]
    fn invalid_model_replies_are_rejected_with_the_reason() {
        for (text, expected) in [
            ("I can not help with that.", "no JSON object"),
            ("{\"goal\": 1}", "missing field `target`"),
            (r#"{"target": {"noun": ""}}"#, "names no target"),
            (r#"{"target": {"noun": "mug", "colours": ["mauve"]}}"#, "unknown colour \"mauve\""),
            (
                r#"{"target": {"noun": "mug", "relations": [{"kind": "loves", "anchors": []}]}}"#,
                "unknown relation \"loves\"",
            ),
        ] {
            let error = decode(text).unwrap_err();
            assert!(error.contains(expected), "{text}: {error}");
        }
        let deep = format!(
            "{{\"target\": {}{{\"noun\": \"x\"}}{}}}",
            "{\"noun\": \"a\", \"with\": [".repeat(9),
            "]}".repeat(9)
        );
        assert!(decode(&deep).unwrap_err().contains("nests too deep"));
    }
}
