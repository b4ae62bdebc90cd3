//! Answers: the six fields of the paper, boxes, status, and what led there.

use crate::geometry::boxes::{Aabb, OrientedBox};
use crate::placement::InFrame;
use crate::scene::{InstanceId, Support};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Whether the question has an answer in this room.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Status {
    /// One object fits, or several were asked for and are there: see `targets`.
    Grounded,
    /// One object (or several) fits best, with less belief than the question's `min_confidence`: a
    /// guess, with its box. Not to be acted on unasked.
    Uncertain,
    /// Several objects fit alike: see `alternatives`.
    Ambiguous,
    /// Nothing in the room fits.
    NoMatch,
}

/// Why nothing was chosen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum NoMatchReason {
    /// Nothing that was found in the room is such a thing, or has the colour asked for.
    Absent,
    /// The word for the thing means nothing to the parts that answered: whether it is there is not
    /// known.
    NotRecognised,
    /// Most words are of another language, and the built-in parser reads English only.
    NotEnglish,
    /// There is such a thing, but not where the question says.
    Elsewhere,
    /// A vision-language model looked and found none.
    NoneSeen,
    /// A vision-language model sees it, but it is none of the instances: `seen` tells where.
    NotListed,
}

/// The paper's six fields.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct SixFields {
    /// Id of the chosen instance; `null` unless `grounded` or `uncertain`.
    pub predicted_id: Option<InstanceId>,
    /// Why, in words a person can check.
    pub explanation: String,
    /// What each candidate is called, by id, without regard to the question.
    #[cfg_attr(feature = "openapi", schema(value_type = BTreeMap<String, String>))]
    pub candidate_names: BTreeMap<u32, String>,
    /// Whether the chosen candidate's own name means what the question asks for; `null` when
    /// nothing was chosen.
    pub target_name_matches: Option<bool>,
    /// The anchor the decision used.
    pub anchor_id: Option<InstanceId>,
    /// The relation the decision used, in the question's words.
    pub relation_used: Option<String>,
}

/// Where a vision-language model sees what is asked for, though no instance is it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Seen {
    /// The picture it is seen in, one of the answer's evidence: `candidate-7`, `global`.
    pub picture: String,
    /// From the left and the upper rim, shares of the picture's width and height, `0..=1`.
    pub at: [f32; 2],
    /// What the model calls it.
    pub name: String,
}

/// Another instance the question may mean.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Alternative {
    /// Numbered from 1 within the parse the answer comes from.
    pub id: InstanceId,
    /// What it is called, without regard to the question; empty in answers given before this was
    /// told.
    #[serde(default)]
    pub name: String,
    /// Share of the belief, `0..=1`.
    pub confidence: f32,
    /// Axis-aligned box, stray points left out; metres, world frame (Z up).
    #[serde(rename = "box")]
    pub aabb: Aabb,
    /// Box turned about the vertical to fit it; absent in answers given before this was told.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub oriented_box: Option<OrientedBox>,
    /// Path of the picture that shows it best, a crop; `null` where no frame shows it, and where
    /// there is no service.
    #[serde(default)]
    pub view: Option<String>,
}

/// A thing the question means.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Target {
    /// Numbered from 1 within the parse the answer comes from.
    pub id: InstanceId,
    /// What it is called, without regard to the question.
    pub name: String,
    /// Belief that it is meant, `0..=1`.
    pub confidence: f32,
    /// Axis-aligned box, stray points left out; metres, world frame (Z up).
    #[serde(rename = "box")]
    pub aabb: Aabb,
    /// Box turned about the vertical to fit it; metres, world frame (Z up).
    pub oriented_box: OrientedBox,
    /// What it stands on or hangs on; absent in answers given before this was told.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub support: Option<Support>,
    /// The thing it is a part of; `null` for what is no part.
    #[serde(default)]
    pub parent: Option<InstanceId>,
}

/// How the question was understood.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ParsedQuerySummary {
    /// The noun asked for, as the question says it.
    pub target: String,
    /// What it is to be like: "red", "small", "not blue", "with 2 drawers", "tallest". Empty when
    /// only a noun was asked for.
    pub attributes: Vec<String>,
    /// Other things the question tells the place by: "round table", "door".
    pub anchors: Vec<String>,
    /// How the target stands to the anchors, as the question says it; after "not" where it was
    /// denied.
    pub relations: Vec<String>,
    /// Words that could not be used.
    pub not_understood: Vec<String>,
}

/// Wall-clock milliseconds per step.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Timings {
    /// Reading the question, the call included where a model reads.
    pub parse_query: f64,
    /// Getting the instances ready to be compared with the question.
    pub shortlist: f64,
    /// Pictures for a vision-language model; the built-in reasoner needs none.
    pub evidence: f64,
    /// Deciding: geometry, and the calls of a vision-language model where one reviews.
    pub reason: f64,
    /// From reading the question to the decision.
    pub total: f64,
}

/// An instance that may be meant.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Candidate {
    /// Numbered from 1 within the parse; instances with more points come first.
    pub id: InstanceId,
    /// What it is called, without regard to the question; empty in answers given before this was
    /// told.
    #[serde(default)]
    pub name: String,
    /// From 1.
    pub rank: u32,
    /// Fit to the question, `0..=1`.
    pub score: f32,
    /// Axis-aligned box, stray points left out; metres, world frame (Z up).
    #[serde(rename = "box")]
    pub aabb: Aabb,
    /// Box turned about the vertical to fit it; absent in answers given before this was told.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub oriented_box: Option<OrientedBox>,
    /// Path of the picture that shows it best, a crop; `null` where no frame shows it, and where
    /// there is no service.
    #[serde(default)]
    pub view: Option<String>,
}

/// Name and version of the parts an answer came from.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Models {
    /// Cut pictures into masks when the scene was parsed: a model as `name@fingerprint`, or the
    /// built-in part, like `rgbd-2`.
    pub masks: String,
    /// Compared words with instances: a model as `name@fingerprint`, or built-in names and
    /// measures, like `attributes-2`.
    pub encoder: String,
    /// Empty in answers given before this was recorded.
    #[serde(default)]
    pub parser: String,
    /// Named the scene's things without having heard a question, and answers used its names: a
    /// model with the version of its prompt; `null` where no model has named them all.
    #[serde(default)]
    pub names: Option<String>,
    /// Decided: a vision-language model with the version of its prompt, or the built-in reasoner,
    /// like `builtin-3`.
    pub reasoner: String,
}

/// The frame all coordinates are in.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct CoordinateFrame {
    /// The axis that points up, always `z`: scans are turned when they are imported.
    #[cfg_attr(feature = "openapi", schema(example = "z"))]
    pub up: String,
    /// Unit of lengths, always `m` (metres).
    #[cfg_attr(feature = "openapi", schema(example = "m"))]
    pub units: String,
}

impl Default for CoordinateFrame {
    fn default() -> Self {
        Self { up: "z".into(), units: "m".into() }
    }
}

/// One call of a vision-language model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Call {
    /// `parse`, `naming`, `spatial`, or what was wrong before: `out_of_set`, `unreadable`,
    /// `inconsistent`.
    pub purpose: String,
    /// How often the endpoint was tried; 0 when nothing was sent.
    pub attempts: u32,
    /// Wall-clock milliseconds over all attempts, waits between them included.
    pub latency_ms: f64,
    /// Tokens of the prompt as the endpoint counts them, estimated where it does not; 0 without a
    /// reply.
    pub prompt_tokens: u64,
    /// Tokens of the reply, counted alike; 0 without a reply.
    pub completion_tokens: u64,
    /// Why there was no reply.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<String>,
}

/// What happened on the way; empty when nothing was asked of a model and nothing went wrong.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Trace {
    /// In the order they were made, reading the question included; at most three.
    pub calls: Vec<Call>,
    /// What was wrong and what was done about it, a sentence each, in order.
    pub corrections: Vec<String>,
}

/// What an answer took of a vision-language model; all zero when none was asked.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Usage {
    /// Calls that got a reply.
    pub vlm_calls: u32,
    /// Tokens of all prompts that got a reply.
    pub prompt_tokens: u64,
    /// Tokens of all replies.
    pub completion_tokens: u64,
    /// US dollars, at the prices the server was given; 0 where it was given none.
    pub cost_usd: f64,
}

/// Answers of before this was said were kept.
fn default_stored() -> bool {
    true
}

/// A page of answers, newest first.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct AnswerList {
    /// Newest first, each as it was given.
    pub answers: Vec<Answer>,
    /// `cursor` of the next page; `null` on the last.
    pub next_cursor: Option<String>,
}

/// The answer to a question. `box` is set when the status is `grounded`, or `uncertain`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Answer {
    /// UUIDv7; in order of time.
    pub id: String,
    /// UUIDv7 of the scene that was asked about.
    pub scene_id: String,
    /// Number of the scene's parse that was asked, from 1; instance ids belong to it.
    pub parse_version: u32,
    /// The question, word for word.
    pub query: String,
    /// Whether one object fits, surely or not, several or none.
    pub status: Status,
    /// Why nothing was chosen; absent unless `no_match`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub no_match_reason: Option<NoMatchReason>,
    /// Where a vision-language model sees what is asked for, though no instance is it; `null`
    /// unless the reason is `not_listed`.
    #[serde(default)]
    pub seen: Option<Seen>,
    /// The six fields.
    pub answer: SixFields,
    /// Axis-aligned box of the answer, metres, world frame (Z up); `null` unless `grounded` or
    /// `uncertain`.
    #[serde(rename = "box")]
    pub aabb: Option<Aabb>,
    /// Box of the answer turned about the vertical to fit it; `null` unless `grounded` or
    /// `uncertain`.
    pub oriented_box: Option<OrientedBox>,
    /// Belief in the answer, `0..=1`; for `no_match`, that nothing fits: 0.5 where it is not known
    /// what is asked for.
    pub confidence: f32,
    /// Best first, at most `top_k`. Things a model was shown for their place have score 0. Absent
    /// where `include` leaves it out.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub candidates: Option<Vec<Candidate>>,
    /// Other instances that may be meant, likeliest first: where `ambiguous`, the tied ones lead.
    /// Empty for `no_match`.
    pub alternatives: Vec<Alternative>,
    /// All things the question means, best first: several where it asks for several ("the chairs",
    /// "how many mugs"), else the answer's own; empty unless `grounded` or `uncertain`, and in
    /// answers given before this was told.
    #[serde(default)]
    pub targets: Vec<Target>,
    /// How many there are; absent where the question asks for one thing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub count: Option<u32>,
    /// How the question was understood.
    pub parsed_query: ParsedQuerySummary,
    /// Who found, compared, read and decided.
    pub models: Models,
    /// A built-in part took the place of a model that could not be used, or that never chose a
    /// candidate; `trace.corrections` says why.
    #[serde(default)]
    pub degraded: bool,
    /// `false`: the server could not keep this answer (its disk is full, say). It is given here
    /// and can not be asked for again.
    #[serde(default = "default_stored")]
    pub stored: bool,
    /// Convention for left, right, front and back: `paper`, `viewer` or `observer`. "Facing the
    /// door" in the question comes before it.
    pub direction_convention: String,
    /// The frame of all boxes here, but for those of `in_frame`.
    pub frame: CoordinateFrame,
    /// The boxes of `targets` in the coordinates the question asked for; absent where it asked for
    /// the scene's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub in_frame: Option<InFrame>,
    /// Paths of the pictures that go with the answer.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub evidence: Option<Vec<String>>,
    /// Calls and corrections on the way; absent where `include` leaves it out.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub trace: Option<Trace>,
    /// What the calls took and cost.
    pub usage: Usage,
    /// What each step took, milliseconds.
    pub timings_ms: Timings,
}

/// Candidates without reasoning over relations: by appearance where an encoder has seen the scene,
/// by names and attributes otherwise.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Shortlisted {
    /// The query, word for word.
    pub query: String,
    /// Best first; instances that do not fit at all are left out.
    pub candidates: Vec<Candidate>,
    /// Compared words with instances: a model as `name@fingerprint`, or built-in names and
    /// measures, like `attributes-2`.
    pub encoder: String,
    /// The sentence is longer than the encoder reads: its end does not count.
    pub cut: bool,
}
