//! The prompt, block by block in the paper's order (appendix, "Details of Textual Prompt Design"). A block whose input is absent is left
//! out; that is all the ablations do.

use super::prompt_context::{PromptContext, axis};
use super::reply::Field;
use super::visual_evidence::VisualEvidence;
use super::{Ablation, Conversation};
use crate::geometry::boxes::Aabb;
use crate::models::chat::{ChatRequest, Part};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::fmt::Write;

/// Raised when what models are told changes.
const PROMPT_VERSION: u32 = 2;

/// Name and version of a model as it reasons, recorded with answers.
#[must_use]
pub fn reasoner_name(model: &str) -> String {
    format!("{model} (prompt {PROMPT_VERSION})")
}

const SYSTEM: &str = "You are a helpful assistant designed to identify objects based on images and descriptions.";
const SIMPLE_SYSTEM: &str = "You are a helpful assistant. Identify the object ID that matches the description.";

/// Why a model is asked once more.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Correction {
    /// The id is none of the candidates'.
    OutOfSet { id: u32 },
    /// No id, or two.
    Unreadable { why: String },
    /// The name of the chosen candidate and the question disagree.
    Inconsistent { id: u32, why: String },
}

/// The first question about a scene.
pub(super) fn spatial(conversation: &Conversation, shown: &VisualEvidence, names: &BTreeMap<u32, String>) -> ChatRequest {
    request(conversation, shown, names, None)
}

/// The question again, saying what was wrong.
pub(super) fn corrected(
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
    let mut user: Vec<Part> = shown.global.iter().chain(shown.collages.values()).cloned().map(Part::Picture).collect();
    if conversation.options.ablation == Ablation::SimplePrompt {
        let mut text = format!(
            "Query: {}\nCandidate Objects: {}\nPlease identify which object ID best matches the query and explain why.",
            quoted(&context.query),
            candidates(context, names, "; ")
        );
        if let Some(correction) = correction {
            let _ = write!(text, "\n{}", what_was_wrong(context, correction));
        }
        user.push(Part::Text(text));
        return ChatRequest { system: SIMPLE_SYSTEM.into(), user, schema: None };
    }
    let blocks = [
        Some(images(context, shown)),
        Some(directions(context)),
        anchors(context),
        Some(format!("Candidates (metres, world frame, Z up):\n{}", candidates(context, names, "\n"))),
        Some(naming(shown, names)),
        Some(protocol(shown)),
        correction.map(|correction| what_was_wrong(context, correction)),
        Some(format(conversation.options.json)),
        Some(format!("Query: {}", quoted(&context.query))),
    ];
    let text = blocks.into_iter().flatten().filter(|block| !block.is_empty()).collect::<Vec<_>>().join("\n\n");
    user.push(Part::Text(text));
    let schema = conversation.options.json.then(|| ("grounding", schema()));
    ChatRequest { system: SYSTEM.into(), user, schema }
}

/// A question as one line between quotes: it can not pass for lines of the prompt.
fn quoted(query: &str) -> String {
    Value::from(query.split_whitespace().collect::<Vec<_>>().join(" ")).to_string()
}

/// What each picture is.
fn images(context: &PromptContext, shown: &VisualEvidence) -> String {
    let mut text = String::new();
    let mut next = 1;
    if shown.global.is_some() {
        let _ = writeln!(
            text,
            "Image 1 is a global render of the scene: views of the same room from above, side by side, from different sides. Candidates are \
             boxes with their IDs{}; dashed edges lie behind other things. Direction words at the rims and the axes show where \
             each direction lies in each view.",
            if context.anchors.is_empty() { "" } else { ", predicted anchors are red" }
        );
        next += 1;
    }
    let ids: Vec<u32> = shown.collages.keys().copied().collect();
    if let (Some(first), Some(last)) = (ids.first(), ids.last()) {
        let list = ids.iter().map(|id| format!("ID {id}")).collect::<Vec<_>>().join(", ");
        let _ = match ids.len() {
            1 => write!(text, "Image {next} shows the candidate ID {first}"),
            n => write!(text, "Images {next} to {} show one candidate each, in this order: {list}", next + n - 1),
        };
        let _ = (last, text.write_str(". Above: close crops of the object from up to three viewpoints. Below: the pictures they come from, with the object in a red box."));
    }
    text.trim_end().to_owned()
}

/// The convention in force, the same words as in the render.
fn directions(context: &PromptContext) -> String {
    let meaning = |(word, direction): (&str, crate::geometry::Vector3<f32>)| match axis(direction) {
        Some(axis) => format!("{word} = {axis}"),
        None => format!("{word} = ({:+.2}, {:+.2}, {:+.2})", direction.x, direction.y, direction.z),
    };
    format!(
        "Directions {}: {}. Read left, right, front and back in the query in this way, from whichever side a picture is taken.",
        context.seen_by,
        context.words().map(meaning).join(", ")
    )
}

fn anchors(context: &PromptContext) -> Option<String> {
    let told = context.anchors.iter().map(|a| format!("\"{}\" -> ID {}, {}", a.words, a.id, place(&a.aabb)));
    let told = told.collect::<Vec<_>>().join("\n");
    (!told.is_empty()).then(|| format!("Anchors in the query (predicted by geometry, not certain):\n{told}"))
}

fn candidates(context: &PromptContext, names: &BTreeMap<u32, String>, separator: &str) -> String {
    let line = |c: &super::PromptCandidate| {
        let name = names.get(&c.id.0).map_or(String::new(), |name| format!(", \"{name}\""));
        format!("ID {}: score {:.2}, {}{name}", c.id, c.score, place(&c.aabb))
    };
    context.candidates.iter().map(line).collect::<Vec<_>>().join(separator)
}

fn place(aabb: &Aabb) -> String {
    let (c, s) = (aabb.center, aabb.size);
    format!("center ({:.2}, {:.2}, {:.2}), size ({:.2}, {:.2}, {:.2})", c.x, c.y, c.z, s.x, s.y, s.z)
}

fn naming(shown: &VisualEvidence, names: &BTreeMap<u32, String>) -> String {
    let mut text = String::new();
    if !shown.collages.is_empty() {
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

fn protocol(shown: &VisualEvidence) -> String {
    let verify = if shown.global.is_some() { "the global render and the 3D coordinates" } else { "the 3D coordinates" };
    format!(
        "Decide in this order:\n\
         1. Match the candidates' names with the object the query asks for.\n\
         2. Verify the relations in the query with {verify}.\n\
         3. If no name matches, or several remain plausible, find the anchor first and resolve the target by the stated relation.\n\
         4. Choose one candidate. Only if it is certain that no candidate can be meant, answer none."
    )
}

fn format(json: bool) -> String {
    if json {
        return "Answer with one JSON object with the fields \"Predicted ID\" (a candidate's ID or null), \"Explanation\", \"Candidate Names\" \
                (list of \"ID -> short name\"), \"Target name matches?\" (true or false: does the chosen candidate's name mean what the query asks \
                for), \"Anchor ID\" (an ID or null), \"Relation used\" (words of the query or null)."
            .into();
    }
    "Answer with exactly these six lines:\n\
     Predicted ID: <a candidate's ID, or none>\n\
     Explanation: <appearance and spatial cues, short>\n\
     Candidate Names: <ID -> short name, ID -> short name, ...>\n\
     Target name matches?: <true or false: does the chosen candidate's name mean what the query asks for>\n\
     Anchor ID: <ID or unknown>\n\
     Relation used: <the relation in the words of the query, or none>"
        .into()
}

fn schema() -> Value {
    let id = || json!({"type": ["integer", "null"]});
    let properties = json!({
        "Predicted ID": id(), "Explanation": {"type": "string"}, "Candidate Names": {"type": "array", "items": {"type": "string"}},
        "Target name matches?": {"type": "boolean"}, "Anchor ID": id(), "Relation used": {"type": ["string", "null"]},
    });
    json!({"type": "object", "additionalProperties": false, "required": Field::ALL.map(Field::title), "properties": properties})
}

fn what_was_wrong(context: &PromptContext, correction: &Correction) -> String {
    let ids = context.candidates.iter().map(|c| c.id.to_string()).collect::<Vec<_>>().join(", ");
    let wrong = match correction {
        Correction::OutOfSet { id } => format!("ID {id}, which is no candidate"),
        Correction::Unreadable { why } => format!("something of which {why}"),
        Correction::Inconsistent { id, why } => format!("ID {id}, but {why}. Look again at its image, the relations and the render"),
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
