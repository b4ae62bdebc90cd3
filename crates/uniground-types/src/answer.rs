//! Answers: the paper's six fields, boxes, status, and how the answer was found.

use crate::coverage::Coverage;
use crate::geometry::boxes::{Aabb, OrientedBox};
use crate::placement::InFrame;
use crate::scene::{InstanceId, Support};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Status of an answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Status {
    /// One object fits, or all requested objects were found. See `targets`.
    Grounded,
    /// The best match has a confidence below the question's `min_confidence`. The answer has a box,
    /// but should be confirmed before acting on it.
    Uncertain,
    /// Several objects fit equally well. See `alternatives`.
    Ambiguous,
    /// No object in the scene fits.
    NoMatch,
}

/// Why no object was chosen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum NoMatchReason {
    /// The scene has no object of this kind, or none with the requested color.
    Absent,
    /// The built-in components do not know the word for the object, so its presence is unknown.
    NotRecognised,
    /// Most words are not English, and the built-in parser supports only English.
    NotEnglish,
    /// The scene has such an object, but not at the described location.
    Elsewhere,
    /// A vision-language model looked and found no such object.
    NoneSeen,
    /// A vision-language model sees the object, but no instance covers it. `seen` gives its
    /// location.
    NotListed,
}

/// What kind of answer the question asks for.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum AnswerKind {
    /// One object: "the red mug".
    #[default]
    Box,
    /// All objects that match, in `targets`: "what is on the desk", "all chairs".
    List,
    /// Their number, in `value`: "how many chairs are there".
    Count,
    /// A length or an area, in `value`: "how tall is the shelf", "how far is the stool from the
    /// door".
    Measure,
    /// Yes or no, in `value`: "is there a piano", "is the mug on the table", "is the sofa longer
    /// than the rug".
    YesNo,
    /// What the object is and looks like, in `text`: "what is the thing on the shelf", "what color
    /// is the rug".
    Description,
    /// Where the object is, in `text`: "where is the remote".
    Relation,
}

/// Unit of a measured value.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub enum Unit {
    /// Meters.
    #[serde(rename = "m")]
    Meters,
    /// Square meters.
    #[serde(rename = "m2")]
    SquareMeters,
    /// Cubic meters.
    #[serde(rename = "m3")]
    CubicMeters,
}

/// A measured or counted value, or yes or no.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct AnswerValue {
    /// The answer to a yes-or-no question. Absent for other kinds, and if it cannot be told.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub yes: Option<bool>,
    /// The number: a count, or a measurement in `unit`. For the size of an object it is its longest
    /// side.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub number: Option<f32>,
    /// Unit of `number`. Absent for counts.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unit: Option<Unit>,
    /// Expected error of `number` in its unit, plus or minus.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<f32>,
    /// Width (the longer horizontal side), depth and height of the object, meters. Only for
    /// questions about its size.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(value_type = Option<Vec<f32>>))]
    pub size: Option<[f32; 3]>,
    /// Ids of the instances that were measured or compared. For a comparison, the one that the
    /// question names first comes first.
    #[serde(default)]
    pub instances: Vec<InstanceId>,
    /// Ends of the measured line, meters, world frame (Z up). Only for distances.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(value_type = Option<Vec<Vec<f32>>>))]
    pub line: Option<[[f32; 3]; 2]>,
}

/// The six output fields of the paper.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct SixFields {
    /// Id of the chosen instance. `null` unless the status is `grounded` or `uncertain`.
    pub predicted_id: Option<InstanceId>,
    /// Explanation of the decision for people.
    pub explanation: String,
    /// Names of the candidates by id, independent of the question.
    #[cfg_attr(feature = "openapi", schema(value_type = BTreeMap<String, String>))]
    pub candidate_names: BTreeMap<u32, String>,
    /// Whether the name of the chosen candidate matches the question. `null` if no candidate was
    /// chosen.
    pub target_name_matches: Option<bool>,
    /// Id of the anchor that the decision used.
    pub anchor_id: Option<InstanceId>,
    /// The relation that the decision used, in the question's words.
    pub relation_used: Option<String>,
}

/// Location in a picture where a vision-language model sees an object that is not an instance.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Seen {
    /// Name of the picture in the answer's evidence: `candidate-7`, `global`.
    pub picture: String,
    /// Position from the left and the top, as fractions of the picture's width and height, `0..=1`.
    pub at: [f32; 2],
    /// Left, upper, right and lower rim of the object, as fractions of the picture's width and
    /// height. Absent if the model gave only a point.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(value_type = Option<Vec<f32>>))]
    pub area: Option<[f32; 4]>,
    /// Name that the model gives the object.
    pub name: String,
}

/// Another instance that the question may refer to.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Alternative {
    /// Id within the parse of the answer, from 1.
    pub id: InstanceId,
    /// Name of the object, independent of the question. Empty in answers from older versions.
    #[serde(default)]
    pub name: String,
    /// Share of the total confidence, `0..=1`.
    pub confidence: f32,
    /// Axis-aligned box without outlier points; meters, world frame (Z up).
    #[serde(rename = "box")]
    pub aabb: Aabb,
    /// Box rotated about the vertical axis. Absent in answers from older versions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub oriented_box: Option<OrientedBox>,
    /// Path of a cropped picture with the best view of the object. `null` if no frame shows it, or
    /// without a server.
    #[serde(default)]
    pub view: Option<String>,
}

/// An object that the question refers to.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Target {
    /// Id within the parse of the answer, from 1.
    pub id: InstanceId,
    /// Name of the object, independent of the question.
    pub name: String,
    /// Confidence that the question refers to it, `0..=1`.
    pub confidence: f32,
    /// Axis-aligned box without outlier points; meters, world frame (Z up).
    #[serde(rename = "box")]
    pub aabb: Aabb,
    /// Box rotated about the vertical axis; meters, world frame (Z up).
    pub oriented_box: OrientedBox,
    /// What the object stands on or hangs on. Absent in answers from older versions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub support: Option<Support>,
    /// Id of the object that this instance is a part of. `null` if it is not a part.
    #[serde(default)]
    pub parent: Option<InstanceId>,
    /// Distance between its box and the object or the person that the question names, meters. Only
    /// in lists that are about another object: "what is within a meter of the sofa".
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub distance_m: Option<f32>,
    /// Time of the newest frame that shows the object, RFC 3339 UTC. `null` if the scan's frames
    /// have no times since 1970, and in answers from older versions.
    #[serde(default)]
    pub last_seen: Option<String>,
}

/// The parsed question.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ParsedQuerySummary {
    /// Noun of the target, in the question's words.
    pub target: String,
    /// Required attributes of the target: "red", "small", "not blue", "with 2 drawers", "tallest".
    /// May be empty.
    pub attributes: Vec<String>,
    /// Other objects that describe the location: "round table", "door".
    pub anchors: Vec<String>,
    /// Relations between the target and the anchors, in the question's words. A negated relation
    /// starts with "not".
    pub relations: Vec<String>,
    /// Words that were ignored because they were not understood.
    pub not_understood: Vec<String>,
}

/// Duration per step, wall-clock milliseconds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Timings {
    /// Parsing the question, including the model call if a model parses it.
    pub parse_query: f64,
    /// Loading the instances for comparison with the question.
    pub shortlist: f64,
    /// Preparing pictures for a vision-language model. 0 for the built-in reasoner.
    pub evidence: f64,
    /// Deciding: geometric reasoning, and the calls of a vision-language model if one is used.
    pub reason: f64,
    /// Total from parsing the question to the decision.
    pub total: f64,
}

/// An instance that the question may refer to.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Candidate {
    /// Id within the parse, from 1. Instances with more points have lower ids.
    pub id: InstanceId,
    /// Name of the object, independent of the question. Empty in answers from older versions.
    #[serde(default)]
    pub name: String,
    /// Rank, from 1.
    pub rank: u32,
    /// How well it fits the question, `0..=1`.
    pub score: f32,
    /// Axis-aligned box without outlier points; meters, world frame (Z up).
    #[serde(rename = "box")]
    pub aabb: Aabb,
    /// Box rotated about the vertical axis. Absent in answers from older versions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub oriented_box: Option<OrientedBox>,
    /// Path of a cropped picture with the best view of the object. `null` if no frame shows it, or
    /// without a server.
    #[serde(default)]
    pub view: Option<String>,
}

/// Names and versions of the components that produced an answer.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Models {
    /// Component that segmented the pictures of the scene: a model as `name@fingerprint`, or a
    /// built-in component like `rgbd-2`.
    pub masks: String,
    /// Component that compared words with instances: a model as `name@fingerprint`, or a built-in
    /// component like `attributes-2`.
    pub encoder: String,
    /// Component that parsed the question. Empty in answers from older versions.
    #[serde(default)]
    pub parser: String,
    /// Model that named all objects of the scene, with the version of its prompt. `null` if no
    /// model has named them.
    #[serde(default)]
    pub names: Option<String>,
    /// Component that decided: a vision-language model with the version of its prompt, or the
    /// built-in reasoner, like `builtin-3`.
    pub reasoner: String,
}

/// The coordinate frame of all coordinates.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct CoordinateFrame {
    /// The axis that points up. Always `z`, because scans are rotated during import.
    #[cfg_attr(feature = "openapi", schema(example = "z"))]
    pub up: String,
    /// Unit of lengths. Always `m` (meters).
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
    /// Purpose of the call: `parse`, `naming`, `spatial`, or the defect of the previous reply that
    /// it corrects: `out_of_set`, `unreadable`, `inconsistent`.
    pub purpose: String,
    /// Number of requests sent to the endpoint. 0 if none was sent.
    pub attempts: u32,
    /// Total duration in milliseconds, including all attempts and the delays between them.
    pub latency_ms: f64,
    /// Tokens of the prompt as reported by the endpoint, else estimated. 0 without a reply.
    pub prompt_tokens: u64,
    /// Tokens of the reply, counted the same way. 0 without a reply.
    pub completion_tokens: u64,
    /// Error if there was no reply.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<String>,
}

/// Model calls and corrections. Empty if no model was called and no error occurred.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Trace {
    /// Calls in order, including the one that parses the question. At most three.
    pub calls: Vec<Call>,
    /// Problems and how they were handled, one sentence each, in order.
    pub corrections: Vec<String>,
    /// Objects that had no number in the photographs that the model searched first. Absent unless
    /// it searched photographs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub left_out: Option<LeftOut>,
}

/// Numbers of objects that a model was not offered in photographs, by reason. It may still point at
/// them.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct LeftOut {
    /// Walls, floors and ceilings, unless the question asks for one.
    pub structure: u32,
    /// Objects that are hidden or too small to be recognized in every frame.
    pub too_small: u32,
    /// Objects that only other frames show.
    pub not_shown: u32,
    /// Objects that somebody has dismissed.
    pub dismissed: u32,
}

/// Usage of vision-language models. All values are 0 if none was called.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Usage {
    /// Number of calls that got a reply.
    pub vlm_calls: u32,
    /// Tokens of all prompts that got a reply.
    pub prompt_tokens: u64,
    /// Tokens of all replies.
    pub completion_tokens: u64,
    /// Cost in US dollars at the configured prices. 0 if no prices are configured.
    pub cost_usd: f64,
}

/// Default of `stored` for answers from older versions.
fn default_stored() -> bool {
    true
}

/// A page of answers, newest first.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct AnswerList {
    /// Answers, newest first.
    pub answers: Vec<Answer>,
    /// Cursor of the next page. `null` on the last page.
    pub next_cursor: Option<String>,
}

/// The answer to a question. `box` is set if the status is `grounded` or `uncertain`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Answer {
    /// UUIDv7, so ids sort by time.
    pub id: String,
    /// UUIDv7 of the scene.
    pub scene_id: String,
    /// Version of the scene's parse that was used, from 1. Instance ids belong to it.
    pub parse_version: u32,
    /// The question, unchanged.
    pub query: String,
    /// The question as it was understood in its context: "how big is it?" after an answer about
    /// instance 12 is "how big is #12". Absent if the context changes nothing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub understood_as: Option<String>,
    /// Id of the earlier answer that the question follows, from its `context`: the given one, the
    /// latest of the session, or that of the batch item. Absent if it follows none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub follows: Option<String>,
    /// Session of the question's `context`. Absent without one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub session: Option<String>,
    /// What kind of answer the question asks for. `box` in answers from older versions.
    #[serde(default)]
    pub kind: AnswerKind,
    /// The answer as a sentence that can be read aloud. Empty in answers from older versions.
    #[serde(default)]
    pub text: String,
    /// The number, the measurement, or yes or no. Absent for other kinds, and if the object was not
    /// found.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub value: Option<AnswerValue>,
    /// Whether an object was found: `grounded`, `uncertain`, `ambiguous` or `no_match`.
    pub status: Status,
    /// Why no object was chosen. Absent unless the status is `no_match`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub no_match_reason: Option<NoMatchReason>,
    /// Location where a vision-language model sees an object that is not an instance. `null` unless
    /// the reason is `not_listed`.
    #[serde(default)]
    pub seen: Option<Seen>,
    /// How the object differs from the question, in a vision-language model's words: "it is black,
    /// not white". The answer is then the closest object, with a confidence of at most 0.5. Questions
    /// about number or existence answer that there is none; `alternatives` has the closest object.
    /// Absent if nothing differs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub differs: Option<String>,
    /// Which part of the room was seen: whether the object is not there, or may be where no camera
    /// looked. `null` unless the status is `no_match` or `target_name_matches` is `false`, for scans
    /// without frames, and for parses from older versions.
    #[serde(default)]
    pub coverage: Option<Coverage>,
    /// The six output fields of the paper.
    pub answer: SixFields,
    /// Axis-aligned box of the answer; meters, world frame (Z up). `null` unless the status is
    /// `grounded` or `uncertain`.
    #[serde(rename = "box")]
    pub aabb: Option<Aabb>,
    /// Box of the answer rotated about the vertical axis. `null` unless the status is `grounded` or
    /// `uncertain`.
    pub oriented_box: Option<OrientedBox>,
    /// Confidence in the answer, `0..=1`. For `no_match`, confidence that no object fits; 0.5 if
    /// the question was not understood.
    pub confidence: f32,
    /// Candidates, best first, at most `top_k`. Objects shown to a model only for orientation have
    /// score 0. Absent if `include` omits them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub candidates: Option<Vec<Candidate>>,
    /// Other instances that the question may refer to, most likely first. If `ambiguous`, the tied
    /// instances come first. Empty for `no_match`.
    pub alternatives: Vec<Alternative>,
    /// All objects that the question refers to, best first. More than one if the question asks for
    /// several ("the chairs", "how many mugs"). Empty unless `grounded` or `uncertain`, and in
    /// answers from older versions.
    #[serde(default)]
    pub targets: Vec<Target>,
    /// Time of the newest frame that shows the object of the answer, RFC 3339 UTC: of the first of
    /// `targets`. `null` without one, and if the scan's frames have no times since 1970.
    #[serde(default)]
    pub last_seen: Option<String>,
    /// Number of matching objects. Absent if the question asks for a single object.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub count: Option<u32>,
    /// The parsed question.
    pub parsed_query: ParsedQuerySummary,
    /// Components that produced the answer.
    pub models: Models,
    /// Whether a built-in component replaced a model that failed or returned no valid candidate.
    /// `trace.corrections` gives the reason.
    #[serde(default)]
    pub degraded: bool,
    /// Whether the server stored this answer. If `false` (for example on a full disk), the answer
    /// cannot be fetched again.
    #[serde(default = "default_stored")]
    pub stored: bool,
    /// Convention for left, right, front and back: `paper`, `viewer` or `observer`; `photographs` if
    /// a vision-language model decided about a scan whose photographs all look one way. An
    /// orientation in the question, like "facing the door", takes precedence.
    pub direction_convention: String,
    /// The coordinate frame of all boxes except those in `in_frame`.
    pub frame: CoordinateFrame,
    /// Boxes of `targets` in the requested frame. Absent if the scene's own frame was requested.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub in_frame: Option<InFrame>,
    /// Paths of the pictures used as evidence.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub evidence: Option<Vec<String>>,
    /// Model calls and corrections. Absent if `include` omits them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub trace: Option<Trace>,
    /// Usage and cost of the model calls.
    pub usage: Usage,
    /// Duration of each step, milliseconds.
    pub timings_ms: Timings,
}

/// Candidates without spatial reasoning: ranked by appearance if an encoder has processed the
/// scene, else by names and attributes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Shortlisted {
    /// The query, unchanged.
    pub query: String,
    /// Candidates, best first. Instances that do not fit are omitted.
    pub candidates: Vec<Candidate>,
    /// Component that compared words with instances: a model as `name@fingerprint`, or a built-in
    /// component like `attributes-2`.
    pub encoder: String,
    /// Whether the query was truncated because it is longer than the encoder's input.
    pub cut: bool,
}
