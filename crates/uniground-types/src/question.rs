//! Questions and their options.

use crate::numbers;
pub use crate::placement::{FrameChoice, Observer};
use crate::problem::FieldError;
use crate::scene::InstanceId;
use serde::{Deserialize, Serialize};

/// Default of `min_confidence`. docs/EVALUATION.md has the share of correct answers above it.
pub const DEFAULT_MIN_CONFIDENCE: f32 = 0.7;

const MAX_QUERY_CHARS: usize = 1000;

const MAX_TOP_K: u32 = 100;

const MAX_SESSION_CHARS: usize = 100;

const MAX_TIMEOUT_S: f32 = 3600.0;

/// Limits of the corners of a region.
const MIN_CORNERS: usize = 3;
const MAX_CORNERS: usize = 100;

/// Minimum number of candidates on contact sheets.
const ON_SHEETS: u32 = 24;

/// The reasoner that decides.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum ReasonerChoice {
    /// The vision-language model if one is configured, else the built-in reasoner.
    #[default]
    Auto,
    /// The configured vision-language model. The request fails if it cannot be called.
    Vlm,
    /// Geometry, names and appearance. No model calls and no cost, unless `parser` requests a
    /// model.
    Builtin,
}

/// The parser of the question.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum ParserChoice {
    /// The built-in grammar and lexicon. If they do not understand the whole question, one call to
    /// the configured model. No call if `reasoner` is `builtin`. If the call fails, the grammar's
    /// result is used and the trace records it.
    #[default]
    Auto,
    /// The built-in grammar and lexicon. No model calls and no cost.
    Builtin,
    /// One call to the configured model. If its reply cannot be used, the grammar's result is used
    /// and the trace records it.
    Vlm,
}

impl ParserChoice {
    /// Returns the effective parser. `auto` becomes `builtin` if the reasoner is `builtin`.
    #[must_use]
    pub fn resolve_for(self, reasoner: ReasonerChoice) -> Self {
        match (self, reasoner) {
            (Self::Auto, ReasonerChoice::Builtin) => Self::Builtin,
            (choice, _) => choice,
        }
    }
}

/// Optional parts of an answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Include {
    /// The best instances with rank, score and box.
    Candidates,
    /// Paths of the pictures used as evidence.
    Evidence,
    /// Model calls and corrections.
    Trace,
}

/// Parts of the paper's prompt to omit. Applies only to a vision-language model.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Ablation {
    /// Omits nothing.
    #[default]
    Full,
    /// Omits the render of the room from above.
    NoGlobal,
    /// Omits the photographs of the candidates and the names derived from them.
    NoCandidate,
    /// Keeps only pictures, candidates and the question. Omits directions, anchors, steps and the
    /// output format.
    SimplePrompt,
    /// The simple prompt with one plain render of the room, without boxes, labels or photographs
    /// (the paper's naive diagnostic).
    RawRender,
    /// Disables the closed loop: the first reply is final.
    NoLoop,
}

/// Source of the candidates that a vision-language model is shown and can choose from.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum CandidateSource {
    /// Combines given names, the encoder, measurements and spatial relations. Excludes walls and
    /// floors unless the question asks for them.
    #[default]
    Fused,
    /// The paper's method: similarity between the appearance of an instance and the words of the
    /// question (`query_text`) only.
    Encoder,
    /// The built-in reasoner: instances that match the parsed question, best location first.
    Reasoner,
}

impl CandidateSource {
    /// Returns the name in requests.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Fused => "fused",
            Self::Encoder => "encoder",
            Self::Reasoner => "reasoner",
        }
    }
}

/// Version of the prompt for a vision-language model.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum PromptVersion {
    /// The paper's prompt, with scores of candidates and predicted anchors.
    Paper,
    /// Without scores. Anchors are shown as suggestions and may be chosen, and the model may report
    /// an object that is not listed.
    #[default]
    Revised,
}

/// Pictures of the candidates that a vision-language model is shown.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum EvidenceMode {
    /// Photographs of every candidate with every question, as in the paper.
    #[default]
    Full,
    /// Cached names from a model and a smaller render. Photographs only of candidates that cannot
    /// be distinguished by name.
    CachedNames,
    /// One photograph of each of at least 24 candidates, on one or two contact sheets.
    Sheet,
    /// Contact sheets first, then photographs of the best three candidates in a second call.
    TwoStep,
    /// Up to eight photographs of the room with numbered instances first, in which the model finds
    /// the object and its anchors, then photographs of these in a second call. Also finds objects
    /// that are no instances. The first call is skipped if the built-in reasoner is sure.
    Photographs,
}

impl EvidenceMode {
    /// Returns the number of candidates for a `top_k`. With contact sheets it is at least their
    /// capacity.
    #[must_use]
    pub fn candidate_limit(self, top_k: u32) -> u32 {
        match self {
            Self::Full | Self::CachedNames | Self::Photographs => top_k,
            Self::Sheet | Self::TwoStep => top_k.max(ON_SHEETS),
        }
    }
}

/// Text that is compared with instances to select candidates.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum QueryText {
    /// The whole sentence.
    Full,
    /// Only the target phrase: "red chair".
    Target,
    /// The mean of both embeddings, normalized. Reduces the effect of truncated long sentences.
    #[default]
    Mean,
}

/// Convention for left, right, front and back. World frame, Z up.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum DirectionConvention {
    /// The paper's convention: left = +X, right = -X, front = -Y, back = +Y.
    #[default]
    Paper,
    /// A viewer at -Y who looks along +Y: right = +X, front (nearer) = -Y.
    Viewer,
}

impl DirectionConvention {
    /// Returns the name in requests and answers: `paper` or `viewer`.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Paper => "paper",
            Self::Viewer => "viewer",
        }
    }
}

/// A question about a scene.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "openapi", schema(example = json!({"query": "the mug on the coffee table"})))]
#[serde(deny_unknown_fields)]
pub struct GroundRequest {
    /// Description of the object in English, 1 to 1000 characters.
    #[cfg_attr(
        feature = "openapi",
        schema(min_length = 1, max_length = 1000, example = "the black chair closest to the door")
    )]
    pub query: String,
    /// Maximum number of candidates, 1 to 100. Contact sheets (`evidence`) use at least 24.
    /// Default: 5.
    #[serde(default = "default_top_k")]
    #[cfg_attr(feature = "openapi", schema(minimum = 1, maximum = 100, default = 5))]
    pub top_k: u32,
    /// Parser of the question. Default: `auto`, which uses the grammar, and the configured model
    /// for questions that the grammar does not fully understand. Never calls the model if
    /// `reasoner` is `builtin`.
    #[serde(default)]
    pub parser: ParserChoice,
    /// The reasoner that decides. Default: `auto`.
    #[serde(default)]
    pub reasoner: ReasonerChoice,
    /// Source of the candidates for a vision-language model. Default: `fused`.
    #[serde(default)]
    pub candidates: CandidateSource,
    /// Text that is compared with the appearance of instances, if an encoder has processed the
    /// scene. Default: `mean`.
    #[serde(default)]
    pub query_text: QueryText,
    /// Version of the prompt for a vision-language model. Default: `revised`.
    #[serde(default)]
    pub prompt: PromptVersion,
    /// For experiments: parts to omit from the prompt. Default: `full`, which omits nothing.
    #[serde(default)]
    pub ablation: Ablation,
    /// Pictures of the candidates that a vision-language model is shown. Default: `full`.
    #[serde(default)]
    pub evidence: EvidenceMode,
    /// Convention for left, right, front and back. An `observer` takes precedence. Default:
    /// `paper`.
    #[serde(default)]
    pub direction_convention: DirectionConvention,
    /// Observer for left, right, front and back, and for "me" in "the chair closest to me". In the
    /// coordinates of `frame`.
    pub observer: Option<Observer>,
    /// Frame of `observer`, and additional frame for the boxes (`in_frame` of the answer). Default:
    /// `scene`.
    #[serde(default)]
    pub frame: FrameChoice,
    /// Whether to answer by names and measurements if the encoder fails or is not the one of the
    /// parse. The answer is then marked as `degraded`. Default: `false`.
    #[serde(default)]
    pub allow_builtin: bool,
    /// Minimum confidence of a `grounded` answer, `0..=1`. Below it, the answer is `uncertain`.
    /// Default: 0.7. Names that are guessed from size, place and color, or by an encoder without a
    /// segmenter, do not reach it. 0 disables `uncertain`.
    #[cfg_attr(feature = "openapi", schema(minimum = 0, maximum = 1))]
    pub min_confidence: Option<f32>,
    /// Optional parts to return. Default: all.
    pub include: Option<Vec<Include>>,
    /// Spending limit for this question, US dollars. The built-in reasoner costs nothing. 0: no
    /// model is called.
    #[cfg_attr(feature = "openapi", schema(minimum = 0))]
    pub max_cost_usd: Option<f64>,
    /// Timeout, seconds, at most 3600.
    #[cfg_attr(feature = "openapi", schema(exclusive_minimum = 0, maximum = 3600))]
    pub timeout_s: Option<f32>,
    /// `full`: wait until the parse that is queued or running for this scene is done, at most
    /// `timeout_s`. By default, a scene that has a parse is asked at once, and one without is
    /// rejected with `scene_not_ready`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub wait: Option<WaitFor>,
    /// Context of a follow-up question: an earlier answer or a conversation ("and the blue one?",
    /// "how big is it?"), or an instance that is meant by "this".
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub context: Option<QuestionContext>,
    /// Version of the parse that the question is about. If the scene has another one, the question
    /// is rejected with `parse_changed`, because ids may mean other objects. By default, the
    /// current parse is asked.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub if_version: Option<u32>,
    /// Region in which the object has to be. Other objects of the question may be outside.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub within: Option<Region>,
}

/// Context of a follow-up question.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct QuestionContext {
    /// Id of an earlier answer about the same version of the scene. "It" is the object of that
    /// answer, and "one" has the noun of its question. The answer's own context counts too, so the
    /// id of the last answer is enough.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub answer_id: Option<String>,
    /// Id of a conversation, chosen by the client, 1 to 100 characters. The question follows the
    /// latest answer with this id about the same version of the scene, and the new answer joins the
    /// conversation. Without such an answer, the question begins it. Other API keys have their own
    /// conversations. Instead of `answer_id`; not in batches.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(min_length = 1, max_length = 100))]
    pub session: Option<String>,
    /// Index of an earlier item of the same batch and scene, from 0, whose answer the question
    /// follows. It is asked when that item is answered. Instead of `answer_id`; only in batches.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub item: Option<u32>,
    /// Id of the instance that is meant by "this", "that" and "it", for example the one that is
    /// selected in a viewer.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub instance: Option<InstanceId>,
}

impl QuestionContext {
    fn check(&self) -> Result<(), FieldError> {
        if *self == Self::default() {
            return Err(FieldError::new(
                "/context",
                "must have an answer_id, a session or an instance",
            ));
        }
        let earlier = [self.answer_id.is_some(), self.session.is_some(), self.item.is_some()];
        if earlier.into_iter().filter(|is_set| *is_set).count() > 1 {
            return Err(FieldError::new(
                "/context",
                "must have at most one of answer_id, session and item",
            ));
        }
        match &self.session {
            Some(id) if !(1..=MAX_SESSION_CHARS).contains(&id.chars().count()) => {
                let detail = format!("must have 1 to {MAX_SESSION_CHARS} characters");
                Err(FieldError::new("/context/session", detail))
            }
            Some(id) if id.chars().any(char::is_control) => {
                Err(FieldError::new("/context/session", "must not contain control characters"))
            }
            _ => Ok(()),
        }
    }
}

/// A part of the room: a polygon on the ground plan, a range of heights, or both. The center of an
/// object's box has to be in it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct Region {
    /// Corners `[x, y]` of a polygon on the ground plan, meters, 3 to 100. In the coordinates of
    /// `frame`, whose vertical axis has to be that of the scene.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(value_type = Option<Vec<Vec<f64>>>, min_items = 3, max_items = 100))]
    pub polygon: Option<Vec<[f64; 2]>>,
    /// Minimum z, meters, in the coordinates of `frame`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub min_z: Option<f64>,
    /// Maximum z, meters, in the coordinates of `frame`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_z: Option<f64>,
}

impl Region {
    /// Returns whether a point of the ground plan and its height are in the region.
    #[must_use]
    pub fn contains(&self, [x, y, z]: [f64; 3]) -> bool {
        let in_range =
            self.min_z.is_none_or(|min| z >= min) && self.max_z.is_none_or(|max| z <= max);
        in_range && self.polygon.as_ref().is_none_or(|corners| is_inside(corners, x, y))
    }

    fn check(&self) -> Result<(), FieldError> {
        if self.polygon.is_none() && self.min_z.is_none() && self.max_z.is_none() {
            return Err(FieldError::new("/within", "must have a polygon, min_z or max_z"));
        }
        if let Some(corners) = &self.polygon {
            if !(MIN_CORNERS..=MAX_CORNERS).contains(&corners.len()) {
                return Err(FieldError::new(
                    "/within/polygon",
                    format!("must have {MIN_CORNERS} to {MAX_CORNERS} corners"),
                ));
            }
            for [x, y] in corners {
                numbers::check_coordinates("/within/polygon", &[*x, *y, 0.0])?;
            }
        }
        for (pointer, z) in [("/within/min_z", self.min_z), ("/within/max_z", self.max_z)] {
            z.map_or(Ok(()), |z| numbers::check_coordinates(pointer, &[0.0, 0.0, z]))?;
        }
        match (self.min_z, self.max_z) {
            (Some(min), Some(max)) if min > max => {
                Err(FieldError::new("/within/max_z", "must not be less than min_z"))
            }
            _ => Ok(()),
        }
    }
}

/// Returns whether a point is inside a polygon, by the number of edges to its right.
fn is_inside(corners: &[[f64; 2]], x: f64, y: f64) -> bool {
    let mut inside = false;
    for (i, [ax, ay]) in corners.iter().enumerate() {
        let [bx, by] = corners[(i + 1) % corners.len()];
        if (*ay > y) != (by > y) && x < (bx - ax) * (y - ay) / (by - ay) + ax {
            inside = !inside;
        }
    }
    inside
}

/// The parse that a question waits for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum WaitFor {
    /// The full parse, also if a draft is ready.
    Full,
}

/// A query that returns only candidates.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "openapi", schema(example = json!({"query": "the mug on the coffee table"})))]
#[serde(deny_unknown_fields)]
pub struct ShortlistRequest {
    /// Description of the object in English, 1 to 1000 characters.
    #[cfg_attr(
        feature = "openapi",
        schema(min_length = 1, max_length = 1000, example = "the black chair")
    )]
    pub query: String,
    /// Maximum number of candidates, 1 to 100. Default: 5.
    #[serde(default = "default_top_k")]
    #[cfg_attr(feature = "openapi", schema(minimum = 1, maximum = 100, default = 5))]
    pub top_k: u32,
    /// Text that is compared with the instances, if an encoder has processed the scene. Default:
    /// `mean`.
    #[serde(default)]
    pub query_text: QueryText,
    /// Source of the candidates. Default: `encoder`, if one has processed the scene.
    #[serde(default = "default_candidate_source")]
    #[cfg_attr(feature = "openapi", schema(default = "encoder"))]
    pub candidates: CandidateSource,
    /// Whether scores are likelihoods against a vocabulary instead of cosines. Default: `false`.
    #[serde(default)]
    pub calibrated: bool,
    /// Whether to rank by names and measurements if the encoder fails or is not the one of the
    /// parse. Default: `false`.
    #[serde(default)]
    pub allow_builtin: bool,
}

impl ShortlistRequest {
    /// # Errors
    /// Returns a [`FieldError`] that names the field.
    pub fn check(&self) -> Result<(), FieldError> {
        check_query(&self.query)?;
        check_top_k(self.top_k)
    }

    /// Creates a query with default options.
    #[must_use]
    pub fn new(query: impl Into<String>) -> Self {
        let (query, top_k) = (query.into(), default_top_k());
        Self {
            query,
            top_k,
            query_text: QueryText::default(),
            candidates: default_candidate_source(),
            calibrated: false,
            allow_builtin: false,
        }
    }
}

fn default_candidate_source() -> CandidateSource {
    CandidateSource::Encoder
}

fn default_top_k() -> u32 {
    5
}

impl GroundRequest {
    /// Creates a question with default options.
    #[must_use]
    pub fn new(query: impl Into<String>) -> Self {
        Self {
            query: query.into(),
            top_k: default_top_k(),
            parser: ParserChoice::default(),
            reasoner: ReasonerChoice::default(),
            candidates: CandidateSource::default(),
            query_text: QueryText::default(),
            prompt: PromptVersion::default(),
            ablation: Ablation::default(),
            evidence: EvidenceMode::default(),
            direction_convention: DirectionConvention::default(),
            observer: None,
            frame: FrameChoice::default(),
            allow_builtin: false,
            min_confidence: None,
            include: None,
            max_cost_usd: None,
            timeout_s: None,
            wait: None,
            context: None,
            if_version: None,
            within: None,
        }
    }

    /// # Errors
    /// Returns a [`FieldError`] that names the field.
    pub fn check(&self) -> Result<(), FieldError> {
        check_query(&self.query)?;
        check_top_k(self.top_k)?;
        if let Some(Observer { position, yaw_rad }) = &self.observer {
            numbers::check_coordinates("/observer/position", position)?;
            numbers::check_finite("/observer/yaw_rad", f64::from(*yaw_rad))?;
        }
        self.context.as_ref().map_or(Ok(()), QuestionContext::check)?;
        self.within.as_ref().map_or(Ok(()), Region::check)?;
        self.min_confidence
            .map_or(Ok(()), |least| numbers::check_in_range("/min_confidence", least, 0.0..=1.0))?;
        self.max_cost_usd
            .map_or(Ok(()), |usd| numbers::check_zero_or_more("/max_cost_usd", usd))?;
        self.timeout_s.map_or(Ok(()), |seconds| {
            numbers::check_above_zero("/timeout_s", seconds, MAX_TIMEOUT_S)
        })
    }
}

pub(crate) fn check_query(query: &str) -> Result<(), FieldError> {
    let characters = query.chars().count();
    if query.trim().is_empty() {
        return Err(FieldError::new("/query", "must not be empty"));
    }
    if characters > MAX_QUERY_CHARS {
        return Err(FieldError::new(
            "/query",
            format!("has {characters} characters, must have at most {MAX_QUERY_CHARS}"),
        ));
    }
    if query.contains('\0') {
        return Err(FieldError::new("/query", "must not contain a NUL character"));
    }
    Ok(())
}

fn check_top_k(top_k: u32) -> Result<(), FieldError> {
    match top_k {
        1..=MAX_TOP_K => Ok(()),
        _ => Err(FieldError::new("/top_k", format!("must be 1 to {MAX_TOP_K}"))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_context_names_one_earlier_answer_at_most() {
        let check = |context: QuestionContext| {
            let request = GroundRequest { context: Some(context), ..GroundRequest::new("and it?") };
            request.check().map_err(|error| error.pointer)
        };
        let (answer_id, session) = (Some("a".to_owned()), Some("s".to_owned()));
        let none = QuestionContext::default();
        assert_eq!(check(none.clone()), Err("/context".into()));
        for context in [
            QuestionContext { answer_id: answer_id.clone(), ..none.clone() },
            QuestionContext { session: session.clone(), ..none.clone() },
            QuestionContext { item: Some(0), ..none.clone() },
            QuestionContext {
                session: session.clone(),
                instance: Some(InstanceId(1)),
                ..none.clone()
            },
        ] {
            assert_eq!(check(context), Ok(()));
        }
        let both = QuestionContext { answer_id, session, ..none.clone() };
        assert_eq!(check(both), Err("/context".into()));
        for session in [String::new(), "x".repeat(101), "a\u{7}".into()] {
            let context = QuestionContext { session: Some(session), ..none.clone() };
            assert_eq!(check(context), Err("/context/session".into()));
        }
    }
}
