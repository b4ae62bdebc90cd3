//! The prompt, block by block in the paper's order (appendix, "Details of Textual Prompt Design").
//! A block whose input is absent is left out; the ablations do nothing else.

use super::prompt_context::{PromptAnchor, PromptCandidate, PromptContext, axis};
use super::reply::Field;
use super::visual_evidence::VisualEvidence;
use super::{Conversation, Options, PromptVersion};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::fmt::Write;
use uniground_geometry::boxes::Aabb;
use uniground_models::chat::{ChatRequest, Part};

/// Returns the name of a model as it reasons, with the number of its prompt, recorded with answers.
/// Raise the number of a prompt when its text changes.
#[must_use]
pub fn reasoner_name(model: &str, prompt: PromptVersion) -> String {
    let number = match prompt {
        PromptVersion::Paper => 2,
        PromptVersion::Revised => 10,
    };
    format!("{model} (prompt {number})")
}

pub(super) const SYSTEM: &str =
    "You are a helpful assistant designed to identify objects based on images and descriptions.";
const SIMPLE_SYSTEM: &str =
    "You are a helpful assistant. Identify the object ID that matches the description.";

/// Candidates that remain after the first of the two steps.
pub const REMAINING: usize = 3;

/// Why a model is asked once more.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Correction {
    /// The id belongs to no candidate.
    OutOfSet { id: u32 },
    /// The reply has no id, or two.
    Unreadable { why: String },
    /// The name of the chosen candidate contradicts the question.
    Inconsistent { id: u32, why: String },
}

/// Returns the first request of a question.
pub(super) fn first_request(
    conversation: &Conversation,
    shown: &VisualEvidence,
    names: &BTreeMap<u32, String>,
) -> ChatRequest {
    request(conversation, shown, names, None)
}

/// Returns the repeated request, with what was wrong.
pub(super) fn corrected_request(
    conversation: &Conversation,
    shown: &VisualEvidence,
    names: &BTreeMap<u32, String>,
    correction: &Correction,
) -> ChatRequest {
    request(conversation, shown, names, Some(correction))
}

fn request(
    conversation: &Conversation,
    shown: &VisualEvidence,
    names: &BTreeMap<u32, String>,
    correction: Option<&Correction>,
) -> ChatRequest {
    let context = conversation.context;
    let (prompt, sheets) =
        (conversation.options.prompt, shown.sheets.iter().map(|(sheet, _)| sheet));
    let photographs = shown.photographs.iter().map(|photograph| &photograph.picture);
    let pictures =
        shown.global.iter().chain(shown.collages.values()).chain(sheets).chain(photographs);
    let mut user: Vec<Part> = pictures.cloned().map(Part::Picture).collect();
    let images_sent = user.len();
    if conversation.options.is_simple() {
        let mut text = format!(
            "Query: {}\nCandidate Objects: {}\nPlease identify which object ID best matches the query and explain why.",
            quoted(&context.query),
            candidates(context, names, prompt, "; ")
        );
        if let Some(correction) = correction {
            let _ = write!(text, "\n{}", describe_error(context, correction));
        }
        user.push(Part::Text(text));
        return ChatRequest { system: SIMPLE_SYSTEM.into(), user, schema: None };
    }
    let blocks = [
        Some(images(context, shown, prompt)),
        Some(directions(context, prompt)),
        anchors(context, prompt),
        Some(format!(
            "Candidates (metres, world frame, Z up):\n{}",
            candidates(context, names, prompt, "\n")
        )),
        Some(naming(shown, names)),
        Some(protocol(shown, prompt)),
        correction.map(|correction| describe_error(context, correction)),
        Some(format(conversation.options, images_sent)),
        Some(format!("Query: {}", quoted(&context.query))),
    ];
    let text = blocks
        .into_iter()
        .flatten()
        .filter(|block| !block.is_empty())
        .collect::<Vec<_>>()
        .join("\n\n");
    user.push(Part::Text(text));
    let schema = conversation.options.json.then(|| ("grounding", schema(prompt)));
    ChatRequest { system: SYSTEM.into(), user, schema }
}

/// Returns a question as one line between quotes, so that it cannot imitate lines of the prompt.
pub(super) fn quoted(query: &str) -> String {
    Value::from(query.split_whitespace().collect::<Vec<_>>().join(" ")).to_string()
}

/// Lists what each picture shows.
fn images(context: &PromptContext, shown: &VisualEvidence, prompt: PromptVersion) -> String {
    let mut text = String::new();
    let mut next = 1;
    if shown.global.is_some() {
        let _ = writeln!(
            text,
            "Image 1 is a global render of the scene: views of the same room from above, {} from different sides. Candidates are \
             boxes with their IDs{}; dashed edges lie behind other things. Direction words at the rims and the axes show where \
             each direction lies in each view.",
            if prompt == PromptVersion::Paper { "side by side," } else { "in two rows," },
            if context.anchors.is_empty() { "" } else { ", predicted anchors are red" }
        );
        next += 1;
    }
    let of = |id: &u32| {
        if context.is_shown_anchor(*id) {
            format!("ID {id} (a predicted anchor)")
        } else {
            format!("ID {id}")
        }
    };
    let ids: Vec<String> = shown.collages.keys().map(of).collect();
    if let Some(first) = ids.first() {
        let _ = match ids.len() {
            1 => write!(text, "Image {next} shows the candidate {first}"),
            n => write!(
                text,
                "Images {next} to {} show one candidate each, in this order: {}",
                next + n - 1,
                ids.join(", ")
            ),
        };
        let _ = text.write_str(". Above: close crops of the object from up to three viewpoints, a yellow line around it and its surroundings darker. Below: the pictures they come from, with the object in a red box.");
        next += ids.len();
    }
    for ((_, ids), number) in shown.sheets.iter().zip(next..) {
        let ids = ids.iter().map(of).collect::<Vec<_>>().join(", ");
        let _ = write!(
            text,
            "\nImage {number} is a contact sheet: one photograph of each candidate under its ID, a yellow line around it, row by row: {ids}."
        );
    }
    next += shown.sheets.len();
    if let count @ 1.. = shown.photographs.len() {
        let (numbers, verb) = match count {
            1 => (format!("Image {next}"), "is a photograph"),
            n => (format!("Images {next} to {}", next + n - 1), "are photographs"),
        };
        let _ = write!(
            text,
            "\n{numbers} {verb} of the room with nothing drawn in, in case no candidate is what the query asks for: it may be seen \
             there without being listed."
        );
    }
    text.trim().to_owned()
}

/// Returns the convention in force, in the same words as in the render.
fn directions(context: &PromptContext, prompt: PromptVersion) -> String {
    let meaning =
        |(word, direction): (&str, uniground_geometry::Vector3<f32>)| match axis(direction) {
            Some(axis) => format!("{word} = {axis}"),
            None => {
                format!("{word} = ({:+.2}, {:+.2}, {:+.2})", direction.x, direction.y, direction.z)
            }
        };
    let towards = match prompt {
        PromptVersion::Revised if context.is_of_a_viewer() => {
            " They are a viewer's: in front of a thing is on the viewer's side of it, behind it is the far side."
        }
        _ => "",
    };
    format!(
        "Directions {}: {}. Read left, right, front and back in the query in this way, from whichever side a picture is taken.{towards}",
        context.seen_by,
        context.words().map(meaning).join(", ")
    )
}

fn anchors(context: &PromptContext, prompt: PromptVersion) -> Option<String> {
    // Only what the model can look at.
    let others = |a: &PromptAnchor| {
        let shown = a.alternatives.iter().filter(|id| context.is_candidate(id.0));
        let ids: Vec<String> = shown.map(|id| format!("ID {id}")).collect();
        match ids.is_empty() || prompt == PromptVersion::Paper {
            true => String::new(),
            false => format!("; it may also be {}", ids.join(" or ")),
        }
    };
    let told = context
        .anchors
        .iter()
        .map(|a| format!("\"{}\" -> ID {}, {}{}", a.words, a.id, place(&a.aabb), others(a)));
    let told = told.collect::<Vec<_>>().join("\n");
    let warning = match prompt {
        PromptVersion::Paper => "predicted by geometry, not certain",
        PromptVersion::Revised => {
            "predicted by geometry, may be wrong: look whether the pictures agree. What is shown here may itself be what the query asks for, \
             and may be chosen"
        }
    };
    (!told.is_empty()).then(|| format!("Anchors in the query ({warning}):\n{told}"))
}

fn candidates(
    context: &PromptContext,
    names: &BTreeMap<u32, String>,
    prompt: PromptVersion,
    separator: &str,
) -> String {
    let line = |c: &PromptCandidate| {
        let name = names.get(&c.id.0).map_or(String::new(), |name| format!(", \"{name}\""));
        // A model that sees a candidate should not be influenced by the geometry's score.
        let score = if prompt == PromptVersion::Paper {
            format!("score {:.2}, ", c.score)
        } else {
            String::new()
        };
        format!("ID {}: {score}{}{name}", c.id, place(&c.aabb))
    };
    context.candidates.iter().map(line).collect::<Vec<_>>().join(separator)
}

fn place(aabb: &Aabb) -> String {
    let (c, s) = (aabb.center, aabb.size);
    format!(
        "center ({:.2}, {:.2}, {:.2}), size ({:.2}, {:.2}, {:.2})",
        c.x, c.y, c.z, s.x, s.y, s.z
    )
}

fn naming(shown: &VisualEvidence, names: &BTreeMap<u32, String>) -> String {
    let mut text = String::new();
    if !shown.collages.is_empty() || !shown.sheets.is_empty() {
        text.push_str(
            "Name first: before anything else give each candidate that has an image a descriptive name of three to eight words, from its \
             own image only, without regard to the query.",
        );
    }
    if !names.is_empty() {
        text.push_str(if text.is_empty() { "" } else { " " });
        text.push_str(
            "Names in quotation marks were given by somebody who has looked at the object alone; use them for candidates without an image.",
        );
    }
    text
}

fn protocol(shown: &VisualEvidence, prompt: PromptVersion) -> String {
    let verify = if shown.global.is_some() {
        "the global render and the 3D coordinates"
    } else {
        "the 3D coordinates"
    };
    format!(
        "Decide in this order:\n\
         1. Match the candidates' names with the object the query asks for.\n\
         2. Verify the relations in the query with {verify}.\n\
         3. If no name matches, or several remain plausible, find the anchor first and resolve the target by the stated relation.\n\
         {}",
        match prompt {
            PromptVersion::Paper =>
                "4. Choose one candidate. Only if it is certain that no candidate can be meant, answer none.",
            PromptVersion::Revised => {
                "4. Choose one candidate. One of another kind than the query says is not meant, nor one of plainly another colour (but see 6), nor \
                 one of whose outline less than half is the object. Where several are pieces of the object, choose the one that holds most \
                 of it.\n\
                 5. If no candidate is meant, look for the object in the images: where you see it, answer not listed and say where, in any \
                 image, rather in a photograph than in the render.\n\
                 6. If it is nowhere, but something of its kind is there that only differs in what else the query says of it (its colour, its \
                 place, what it is next to), choose that, or answer not listed and say where, and in both cases say what differs. Of several, \
                 take the one of which most is as the query says. Else answer none."
            }
        }
    )
}

fn format(options: Options, images: usize) -> String {
    let Options { prompt, json, points, limits, .. } = options;
    let revised = prompt == PromptVersion::Revised;
    let place = points.describe(limits.describe_whole(images, "that whole image"));
    let matches = match prompt {
        PromptVersion::Paper => "does the chosen candidate's name mean what the query asks for",
        PromptVersion::Revised => {
            "does the chosen candidate's name mean the kind of thing that the query asks for, whatever its colour"
        }
    };
    if json {
        let optional = if revised { optional_as_json(&place) } else { String::new() };
        return format!(
            "Answer with one JSON object with the fields \"Predicted ID\" (a candidate's ID or null), \"Explanation\", \"Candidate Names\" \
             (list of \"ID -> short name\"), \"Target name matches?\" (true or false: {matches}), \"Anchor ID\" (an ID or null), \"Relation \
             used\" (words of the query or null).{optional}"
        );
    }
    let (or_not_listed, anchor, optional) = match revised {
        true => {
            (", or not listed", "ID, of several the first, or unknown", optional_as_lines(&place))
        }
        false => ("", "ID or unknown", String::new()),
    };
    format!(
        "Answer with exactly these six lines:\n\
     Predicted ID: <a candidate's ID, or none{or_not_listed}>\n\
     Explanation: <appearance and spatial cues, short>\n\
     Candidate Names: <ID -> short name, ID -> short name, ...>\n\
     Target name matches?: <true or false: {matches}>\n\
     Anchor ID: <{anchor}>\n\
     Relation used: <the relation in the words of the query, or none>{optional}"
    )
}

/// Returns the instructions for a model that sees the object, but not among the candidates, for one
/// that chooses a candidate which is a piece of the object or more than it, and for one that sees a
/// candidate which is not quite what the query says.
fn optional_as_lines(place: &str) -> String {
    format!(
        "\nOnly if it is not listed, or if the outline of the chosen candidate leaves out much of the object or holds much else, a seventh \
         line:\nSeen at: <number of an image that shows the whole object, left, top, right and bottom of the box around it, short name; {place}>\n\
         Only if something that the query says of the object is not so, one more line:\n\
         Differs: <what it is instead, as in: it is black, not white>"
    )
}

fn optional_as_json(place: &str) -> String {
    format!(
        " Where the object is seen but not listed, \"Predicted ID\" is \"not listed\". There, and where the outline of the chosen candidate \
         leaves out much of the object or holds much else, \"Seen at\" is \"image number, left, top, right, bottom, short name\" (of the box \
         around the whole object; {place}); else \"Seen at\" is null. Where something that the query says of the object is not so, \
         \"Differs\" is what it is instead, as in \"it is black, not white\"; else \"Differs\" is null."
    )
}

fn schema(prompt: PromptVersion) -> Value {
    let id = || json!({"type": ["integer", "null"]});
    let properties = json!({
        "Predicted ID": id(), "Explanation": {"type": "string"}, "Candidate Names": {"type": "array", "items": {"type": "string"}},
        "Target name matches?": {"type": "boolean"}, "Anchor ID": id(), "Relation used": {"type": ["string", "null"]},
    });
    let (mut properties, mut required) = (properties, Field::ALL.map(Field::title).to_vec());
    if prompt == PromptVersion::Revised {
        properties[Field::PredictedId.title()] = json!({"type": ["integer", "string", "null"]});
        for optional in [Field::SeenAt, Field::Differs] {
            properties[optional.title()] = json!({"type": ["string", "null"]});
            required.push(optional.title());
        }
    }
    json!({"type": "object", "additionalProperties": false, "required": required, "properties": properties})
}

fn describe_error(context: &PromptContext, correction: &Correction) -> String {
    let ids = context.shown().map(|id| id.to_string()).collect::<Vec<_>>().join(", ");
    let wrong = match correction {
        Correction::OutOfSet { id } => format!("ID {id}, which is no candidate"),
        Correction::Unreadable { why } => format!("something of which {why}"),
        Correction::Inconsistent { id, why } => {
            format!("ID {id}, but {why}. Look again at its image, the relations and the render")
        }
    };
    let relations = match context.summary.relations.is_empty() {
        true => String::new(),
        false => format!(
            " Relations in the query: {}; anchors: {}.",
            context.summary.relations.join(", "),
            context.summary.anchors.join(", ")
        ),
    };
    format!("You answered before with {wrong}. Candidates are {ids} and no others.{relations}")
}

/// Returns the first of two requests: contact sheets of all candidates, of which at most three
/// remain.
#[must_use]
pub fn narrowing(context: &PromptContext, evidence: &VisualEvidence) -> ChatRequest {
    let mut user: Vec<Part> =
        evidence.sheets.iter().map(|(sheet, _)| Part::Picture(sheet.clone())).collect();
    let blocks = [
        images(
            context,
            &VisualEvidence { sheets: evidence.sheets.clone(), ..VisualEvidence::default() },
            PromptVersion::Revised,
        ),
        anchors(context, PromptVersion::Revised).unwrap_or_default(),
        format!(
            "Candidates (metres, world frame, Z up):\n{}",
            candidates(context, &BTreeMap::new(), PromptVersion::Revised, "\n")
        ),
        format!(
            "Which candidates may the query mean? Go by what they look like first, by where they are second. Answer with one line, at most \
             {REMAINING} of the IDs, the likeliest first:\nShortlist: <ID, ID, ID, or none>"
        ),
        format!("Query: {}", quoted(&context.query)),
    ];
    user.push(Part::Text(
        blocks.into_iter().filter(|block| !block.is_empty()).collect::<Vec<_>>().join("\n\n"),
    ));
    ChatRequest { system: SYSTEM.into(), user, schema: None }
}
