//! Parses a query with a chat model: the request, and the JSON reply as a [`ParsedQuery`].

use super::affordances;
use super::distances::LengthUnit;
use super::forms::{
    Aspect, Bound, Claim, ComparedBy, Comparison, Dimension, Form, Limit, Passage, Reference, Way,
};
use super::{
    Look, Measure, ParsedQuery, Phrase, Quantity, Relation, RelationKind, Superlative, Trait,
    Viewpoint, With, words,
};
use serde::Deserialize;
use serde_json::{Value, json};
use uniground_geometry::color::ColorName;
use uniground_geometry::scene::InstanceId;
use uniground_models::chat::{ChatRequest, Part};

/// Version of the prompt. Raise it when the prompt or the schema changes.
pub(super) const PROMPT_VERSION: u32 = 5;

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
    face. asks is what the question wants to know of the target: object (the default); list, all that match (\"what is on the desk\": \
    noun empty, on the desk; \"all chairs\"); count; size, height, width, depth, area or elevation (height above the floor) of it; its \
    distance to other, or to the person who asks where other is missing; exists (\"is there a piano\"); holds (\"is the mug on the \
    table\": target is the mug, other is the mug on the table; negated for \"is it not on the table\", of_all where it has to hold of all \
    of them, as in \"are all mugs on the table\"); within, whether a measure of it is above, below or about size_m (\"is the door wider \
    than 90 cm\": compare says by what measure, and for a distance from what; bound is above); compare (is it taller than other), choose (which of target and \
    other is taller) and difference (how much taller it is than other), with compare saying by what measure, whether more of it, and for a distance from what; fit, whether it fits way \
    other (size_m is its size in meters where it is not in the room, as a robot 60 cm wide; between has other and second); description (what is it); color; place (where is it). except are objects that a list must \
    not have; unit is the unit that the answer has to use, where the question names one; among are ids of instances that the target has to be \
    one of (\"which of the mugs #3 and #4\": noun mug, among [3, 4]), and a noun may be an id (\"#12\"); not_words are materials and other \
    words that must not describe a thing (\"not wooden\": wooden). List words you could not use in not_understood.";

/// What a question may ask, in the reply.
const ASKS: [&str; 20] = [
    "object",
    "list",
    "count",
    "size",
    "height",
    "width",
    "depth",
    "area",
    "elevation",
    "distance",
    "exists",
    "holds",
    "within",
    "compare",
    "choose",
    "difference",
    "fit",
    "description",
    "color",
    "place",
];
/// Measures of a comparison, in the reply.
const COMPARED: [&str; 6] = ["height", "width", "depth", "volume", "elevation", "distance"];
/// Sides of a limit, in the reply.
const BOUNDS: [(&str, Bound); 3] =
    [("above", Bound::Above), ("below", Bound::Below), ("about", Bound::About)];
/// Ways to fit, in the reply.
const WAYS: [(&str, Way); 5] = [
    ("through", Way::Through),
    ("under", Way::Under),
    ("in", Way::In),
    ("on", Way::On),
    ("between", Way::Between),
];

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
        "not_colours": names(colors()), "not_words": {"type": "array", "items": {"type": "string"}},
        "among": {"type": "array", "items": {"type": "integer", "minimum": 1}}, "traits": names(Trait::ALL.iter().map(|t| t.as_str()).collect()),
        "count": {"type": ["integer", "null"], "minimum": 0}, "with": phrases(), "without": phrases(),
        "relations": {"type": "array", "items": relation}, "superlative": superlative,
    }});
    let viewpoint = json!({"type": ["object", "null"], "additionalProperties": false, "required": ["look", "anchor"], "properties": {
        "look": {"type": "string", "enum": Look::ALL.map(Look::as_str)}, "anchor": {"$ref": "#/$defs/phrase"},
    }});
    let compare = json!({"type": ["object", "null"], "additionalProperties": false, "required": ["measure", "more"], "properties": {
        "measure": {"type": "string", "enum": COMPARED}, "more": {"type": "boolean"}, "word": {"type": "string"}, "from": {"$ref": "#/$defs/phrase"},
    }});
    let units: Vec<Value> = LengthUnit::ALL.iter().map(|unit| json!(unit.as_str())).collect();
    let units: Vec<Value> = units.into_iter().chain([Value::Null]).collect();
    json!({"type": "object", "additionalProperties": false, "required": ["target"], "$defs": {"phrase": phrase}, "properties": {
        "target": {"$ref": "#/$defs/phrase"}, "asks": {"type": "string", "enum": ASKS}, "other": {"$ref": "#/$defs/phrase"},
        "second": {"$ref": "#/$defs/phrase"}, "size_m": {"type": ["number", "null"]}, "compare": compare, "way": {"type": "string", "enum": WAYS.map(|(word, _)| word)},
        "negated": {"type": "boolean"}, "of_all": {"type": "boolean"}, "bound": {"type": "string", "enum": BOUNDS.map(|(word, _)| word)},
        "except": phrases(), "unit": {"type": ["string", "null"], "enum": units},
        "viewpoint": viewpoint, "not_understood": {"type": "array", "items": {"type": "string"}},
    }})
}

#[derive(Deserialize)]
struct QueryJson {
    target: PhraseJson,
    #[serde(default)]
    asks: String,
    other: Option<PhraseJson>,
    compare: Option<CompareJson>,
    way: Option<String>,
    second: Option<PhraseJson>,
    size_m: Option<f32>,
    #[serde(default)]
    negated: bool,
    #[serde(default)]
    of_all: bool,
    bound: Option<String>,
    #[serde(default)]
    except: Vec<PhraseJson>,
    unit: Option<String>,
    viewpoint: Option<ViewpointJson>,
    #[serde(default)]
    not_understood: Vec<String>,
}

#[derive(Deserialize)]
struct CompareJson {
    measure: String,
    more: bool,
    #[serde(default)]
    word: String,
    from: Option<PhraseJson>,
}

#[derive(Deserialize)]
struct ViewpointJson {
    look: String,
    anchor: PhraseJson,
}

#[derive(Clone, Default, Deserialize)]
#[serde(default)]
struct PhraseJson {
    noun: String,
    could_be: Vec<String>,
    uses: Vec<String>,
    #[serde(rename = "colours")]
    colors: Vec<String>,
    #[serde(rename = "not_colours")]
    not_colors: Vec<String>,
    not_words: Vec<String>,
    among: Vec<u32>,
    traits: Vec<String>,
    count: Option<u32>,
    with: Vec<PhraseJson>,
    without: Vec<PhraseJson>,
    relations: Vec<RelationJson>,
    superlative: Option<SuperlativeJson>,
}

#[derive(Clone, Deserialize)]
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

#[derive(Clone, Deserialize)]
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
    let other = query.other.map(|other| phrase(other, 0, &mut parts)).transpose()?;
    let second = query.second.map(|second| phrase(second, 0, &mut parts)).transpose()?;
    let from = query.compare.as_ref().and_then(|compare| compare.from.clone());
    let from = from.map(|from| phrase(from, 0, &mut parts)).transpose()?;
    let mut except = Vec::new();
    for excepted in query.except {
        except.push(phrase(excepted, 0, &mut parts)?);
    }
    let unit = query
        .unit
        .map(|unit| {
            let known = LengthUnit::ALL.into_iter().find(|known| known.as_str() == unit);
            known.ok_or_else(|| format!("the model's answer has an unknown unit {unit:?}"))
        })
        .transpose()?;
    let asks = query.asks.as_str();
    let means_several = query.of_all || matches!(asks, "list" | "count");
    let quantity = if means_several { Quantity::All } else { Quantity::One };
    let other_object = other.clone().filter(|other| !other.is_empty());
    let (target, form) =
        match fit(asks, &target, other.as_ref(), second, query.way.as_deref(), query.size_m) {
            Some(fit) => fit?,
            None if asks == "holds" => {
                let claimed =
                    other_object.ok_or("the model's answer asks for \"holds\" without other")?;
                let (is_negated, of_all) = (query.negated, query.of_all);
                let subject = Box::new(target);
                (claimed, Form::Holds(Claim { subject, is_negated, of_all }))
            }
            None if asks == "within" => {
                let compare = query
                    .compare
                    .ok_or("the model's answer asks for \"within\" without compare")?;
                let given_m = query
                    .size_m
                    .filter(|size| size.is_finite() && *size > 0.0)
                    .ok_or("the model's answer asks for \"within\" without size_m")?;
                let said = BOUNDS.iter().find(|(word, _)| Some(*word) == query.bound.as_deref());
                let bound = match said {
                    Some((_, bound)) => *bound,
                    None if compare.more => Bound::Above,
                    None => Bound::Below,
                };
                let by = compared_by(&compare.measure, from.or(other_object))?;
                // A length is no volume: the longest side counts.
                let by = match by {
                    ComparedBy::Dimension(Dimension::Volume) => {
                        ComparedBy::Dimension(Dimension::All)
                    }
                    by => by,
                };
                (target, Form::Limit(Limit { by, bound, given_m, of_all: query.of_all }))
            }
            None => form(asks, target, other_object, query.compare, from)?,
        };
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
        quantity,
        foreign: false,
        not_understood: query.not_understood,
        passed_over: Vec::new(),
        later: Vec::new(),
        form,
        except,
        unit,
    })
}

/// Returns the target and the form of a question about fitting; `None` for other questions.
fn fit(
    asks: &str,
    target: &Phrase,
    other: Option<&Phrase>,
    second: Option<Phrase>,
    way: Option<&str>,
    given_m: Option<f32>,
) -> Option<Result<(Phrase, Form), String>> {
    if asks != "fit" {
        return None;
    }
    let known = WAYS.iter().find(|(word, _)| Some(*word) == way).map(|(_, way)| *way);
    let (Some(mut way), Some(place)) = (known, other.filter(|other| !other.is_empty())) else {
        return Some(Err("the model's answer asks for a fit without other or way".into()));
    };
    let (mut place, mut second) = (place.clone(), second.filter(|second| !second.is_empty()));
    // A gap is also told as something between two objects.
    let between = |relation: &&Relation| relation.kind == RelationKind::Between;
    if second.is_none()
        && words::is_anything(&place.head)
        && let Some(Relation { anchors, .. }) = place.relations.iter().find(between)
        && let [a, b] = &anchors[..]
    {
        (second, place, way) = (Some(b.clone()), a.clone(), Way::Between);
    }
    let given_m = given_m.filter(|size| size.is_finite() && *size > 0.0);
    let target = if given_m.is_some() { place.clone() } else { target.clone() };
    let (place, second) = (Box::new(place), second.map(Box::new));
    Some(Ok((target, Form::Fit(Passage { way, place, second, given_m }))))
}

/// Returns the target and the form of a question. Some forms have the target of the grammar's
/// reading in `other`.
fn form(
    asks: &str,
    target: Phrase,
    other: Option<Phrase>,
    compare: Option<CompareJson>,
    from: Option<Phrase>,
) -> Result<(Phrase, Form), String> {
    let missing = |what: &str| format!("the model's answer asks for \"{asks}\" without {what}");
    let size = |dimension| Form::Size(dimension);
    let form = match asks {
        "" | "object" => Form::Object,
        "list" => Form::List,
        "count" => Form::Count,
        "size" => size(Dimension::All),
        "height" => size(Dimension::Height),
        "width" => size(Dimension::Width),
        "depth" => size(Dimension::Depth),
        "area" => size(Dimension::Area),
        "elevation" => size(Dimension::Elevation),
        "distance" => Form::Distance(
            other.map_or(Reference::Observer, |other| Reference::Object(Box::new(other))),
        ),
        "exists" => Form::Exists,
        "compare" | "choose" | "difference" => {
            let other = Box::new(other.ok_or_else(|| missing("other"))?);
            let CompareJson { measure, more, word, .. } =
                compare.ok_or_else(|| missing("compare"))?;
            let by = compared_by(&measure, from)?;
            let word = if word.is_empty() { measure } else { word };
            let comparison = Comparison { by, more, word, other };
            match asks {
                "compare" => Form::Comparison(comparison),
                "choose" => Form::Choice(comparison),
                _ => Form::Difference(comparison),
            }
        }
        "description" => Form::Description(Aspect::All),
        "color" => Form::Description(Aspect::Color),
        "place" => Form::Place,
        _ => return Err(format!("the model's answer asks for an unknown {asks:?}")),
    };
    Ok((target, form))
}

/// Returns what a comparison measures. `from` is the object that distances are measured from.
fn compared_by(measure: &str, from: Option<Phrase>) -> Result<ComparedBy, String> {
    Ok(match measure {
        "height" => ComparedBy::Dimension(Dimension::Height),
        "width" => ComparedBy::Dimension(Dimension::Width),
        "depth" => ComparedBy::Dimension(Dimension::Depth),
        "volume" => ComparedBy::Dimension(Dimension::Volume),
        "elevation" => ComparedBy::Dimension(Dimension::Elevation),
        "distance" => {
            let from = from.filter(|from| !from.is_empty());
            ComparedBy::Distance(
                from.map_or(Reference::Observer, |from| Reference::Object(Box::new(from))),
            )
        }
        _ => return Err(format!("the model's answer has an unknown measure {measure:?}")),
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
        excluded: json.not_words.iter().map(|word| word.trim().to_lowercase()).collect(),
        among: json.among.into_iter().map(InstanceId).collect(),
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
    fn forms_of_questions_are_decoded_like_the_grammar_result() {
        for (text, query) in [
            (
                r#"{"target": {"noun": "stool"}, "asks": "distance", "other": {"noun": "tv"}}"#,
                "how far is the stool from the tv",
            ),
            (
                r#"{"target": {"noun": "mug"}, "asks": "holds", "other": {"noun": "mug", "relations": [{"kind": "on", "words": "on", "anchors": [{"noun": "desk"}]}]}}"#,
                "is the mug on the desk",
            ),
            (
                r#"{"target": {"noun": "shelf"}, "asks": "difference", "other": {"noun": "desk"}, "compare": {"measure": "height", "more": true, "word": "taller"}}"#,
                "how much taller is the shelf than the desk",
            ),
            (
                r#"{"target": {"noun": "lamp"}, "asks": "choose", "other": {"noun": "shelf"}, "compare": {"measure": "height", "more": true, "word": "taller"}}"#,
                "which is taller, the lamp or the shelf",
            ),
            (
                r#"{"target": {"noun": "stool"}, "asks": "fit", "way": "under", "other": {"noun": "desk"}}"#,
                "does the stool fit under the desk",
            ),
            (r#"{"target": {"noun": "rug"}, "asks": "color"}"#, "what color is the rug"),
        ] {
            assert_eq!(decode(text).unwrap(), parse(query), "{query}");
        }
        for (text, query) in [
            (
                r#"{"target": {"noun": "mug"}, "asks": "holds", "negated": true, "other": {"noun": "mug", "relations": [{"kind": "on", "words": "on", "anchors": [{"noun": "desk"}]}]}}"#,
                "is the mug not on the desk",
            ),
            (
                r#"{"target": {"noun": "mugs"}, "asks": "holds", "of_all": true, "other": {"noun": "mugs", "colours": ["red"]}}"#,
                "are all mugs red",
            ),
            (
                r#"{"target": {"noun": "door"}, "asks": "within", "compare": {"measure": "width", "more": true}, "bound": "above", "size_m": 0.9}"#,
                "is the door wider than 90 cm",
            ),
            (
                r#"{"target": {"noun": "sofa"}, "asks": "within", "compare": {"measure": "distance", "more": false, "from": {"noun": "tv"}}, "size_m": 2}"#,
                "are the sofa and the tv less than 2 m apart",
            ),
            (
                r#"{"target": {"noun": "door"}, "asks": "width", "unit": "inches"}"#,
                "how wide is the door in inches",
            ),
            (
                r#"{"target": {"noun": "mugs", "among": [3, 4, 5], "colours": ["red"]}, "asks": "list"}"#,
                "which of the mugs #3, #4 and #5 are red",
            ),
            (
                r#"{"target": {"noun": "chairs", "not_words": ["wooden"]}, "asks": "list"}"#,
                "list all chairs that are not wooden",
            ),
            (
                r#"{"target": {"noun": "chairs"}, "asks": "list", "except": [{"noun": "armchair"}]}"#,
                "list all chairs except the armchair",
            ),
        ] {
            assert_eq!(decode(text).unwrap(), parse(query), "{query}");
        }
        let text = r#"{"target": {"noun": "lamp"}, "asks": "compare", "other": {"noun": "shelf"}}"#;
        assert!(decode(text).unwrap_err().contains("without compare"));
    }

    #[test]
    fn invalid_model_replies_are_rejected_with_the_reason() {
        for (text, expected) in [
            ("I can not help with that.", "no JSON object"),
            ("{\"goal\": 1}", "missing field `target`"),
            (r#"{"target": {"noun": ""}}"#, "names no target"),
            (r#"{"target": {"noun": "mug", "colours": ["mauve"]}}"#, "unknown colour \"mauve\""),
            (
                r#"{"target": {"noun": "mug"}, "asks": "within", "compare": {"measure": "height", "more": true}}"#,
                "without size_m",
            ),
            (r#"{"target": {"noun": "mug"}, "asks": "width", "unit": "cubits"}"#, "unknown unit"),
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
