//! What may be asked, and how.

use crate::numbers;
pub use crate::placement::{FrameChoice, Observer};
use crate::problem::FieldError;
use serde::{Deserialize, Serialize};

/// `min_confidence` where the request leaves it out: four of five grounded answers are right where
/// things were named by somebody who looked (docs/EVALUATION.md).
pub const DEFAULT_MIN_CONFIDENCE: f32 = 0.5;

const MAX_QUERY_CHARS: usize = 1000;

const MAX_TOP_K: u32 = 100;

const MAX_TIMEOUT_S: f32 = 3600.0;

/// Candidates that contact sheets show at least.
const ON_SHEETS: u32 = 24;

/// Who decides.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum ReasonerChoice {
    /// A vision-language model when one is configured, else the built-in reasoner.
    #[default]
    Auto,
    /// The configured vision-language model; where it can not be asked, the request fails.
    Vlm,
    /// Geometry, names and appearance: no call, no cost, unless a model is to read (`parser`).
    Builtin,
}

/// Who reads the question.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum ParserChoice {
    /// Grammar and lexicon; where they did not understand all of it and a model is configured, one
    /// call to that. Never a call where the built-in reasoner is asked to decide; the grammar's
    /// reading stands where the model can not be asked, told in the trace.
    #[default]
    Auto,
    /// Grammar and lexicon: no call, no cost.
    Builtin,
    /// One call to the configured model; the grammar where its answer can not be used, told in the
    /// trace.
    Vlm,
}

impl ParserChoice {
    /// Who reads where `reasoner` decides: who wants no model to decide gets none to read, unless
    /// they ask for one.
    #[must_use]
    pub fn resolve_for(self, reasoner: ReasonerChoice) -> Self {
        match (self, reasoner) {
            (Self::Auto, ReasonerChoice::Builtin) => Self::Builtin,
            (choice, _) => choice,
        }
    }
}

/// Parts of an answer that can be left out of the reply.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Include {
    /// The best instances, with rank, score and box.
    Candidates,
    /// Paths of the pictures that go with the answer.
    Evidence,
    /// Calls of models and what was corrected.
    Trace,
}

/// Parts of the paper's prompt left out; only a vision-language model has a prompt.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Ablation {
    /// Nothing is left out.
    #[default]
    Full,
    /// No render of the room from above.
    NoGlobal,
    /// No photographs of the candidates, and no names given from them.
    NoCandidate,
    /// Pictures, candidates and the question alone: no directions, anchors, steps or format.
    SimplePrompt,
    /// The simple prompt with one render of the room as it is, without boxes, words or photographs
    /// (the paper's naive diagnostic).
    RawRender,
    /// No closed loop: what the model says first is not asked about again.
    NoLoop,
}

/// Who chooses the candidates: what a vision-language model is shown and may choose from.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum CandidateSource {
    /// Names somebody gave, the encoder, measures and the geometry of relations together; no walls
    /// or floors unless asked for.
    #[default]
    Fused,
    /// The paper's: how alike an instance's looks and the question's words are (`query_text`), and
    /// nothing else.
    Encoder,
    /// The built-in reasoner: what fits the question as it was read, then what stands where it
    /// says.
    Reasoner,
}

impl CandidateSource {
    /// As requests write it.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Fused => "fused",
            Self::Encoder => "encoder",
            Self::Reasoner => "reasoner",
        }
    }
}

/// What a vision-language model is told.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum PromptVersion {
    /// The paper's blocks, with scores of candidates and anchors as predicted.
    Paper,
    /// No scores; anchors are shown, may be wrong and may be chosen; what is seen but not listed
    /// can be told.
    #[default]
    Revised,
}

/// What a vision-language model is shown of the candidates.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum EvidenceMode {
    /// Photographs of every candidate with every question, as in the paper.
    #[default]
    Full,
    /// Names that a model gave once, and a smaller render; photographs only of candidates the
    /// question can not tell apart by name.
    CachedNames,
    /// One photograph each of 24 candidates and more, on one or two contact sheets.
    Sheet,
    /// Contact sheets first; then, with another call, photographs of the three candidates that
    /// remain.
    TwoStep,
}

impl EvidenceMode {
    /// How many candidates are kept where `top_k` are asked for: as many as the contact sheets
    /// hold, where there are some.
    #[must_use]
    pub fn candidate_limit(self, top_k: u32) -> u32 {
        match self {
            Self::Full | Self::CachedNames => top_k,
            Self::Sheet | Self::TwoStep => top_k.max(ON_SHEETS),
        }
    }
}

/// Which words are compared with instances for the shortlist.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum QueryText {
    /// The whole sentence.
    Full,
    /// The target phrase alone: "red chair".
    Target,
    /// The mean of both, each of unit length: long captions are cut at the tower's context.
    #[default]
    Mean,
}

/// Named conventions. World frame, Z up.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum DirectionConvention {
    /// The paper's: left = +X, right = -X, front = -Y, back = +Y.
    #[default]
    Paper,
    /// Somebody at -Y who looks along +Y: right = +X, front (nearer) = -Y.
    Viewer,
}

impl DirectionConvention {
    /// As requests and answers write it: `paper` or `viewer`.
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
#[serde(deny_unknown_fields)]
pub struct GroundRequest {
    /// What to find, in plain English.
    #[cfg_attr(
        feature = "openapi",
        schema(min_length = 1, max_length = 1000, example = "the black chair closest to the door")
    )]
    pub query: String,
    /// Candidates to keep; contact sheets (`evidence`) show 24 at least.
    #[serde(default = "default_top_k")]
    #[cfg_attr(feature = "openapi", schema(minimum = 1, maximum = 100, default = 5))]
    pub top_k: u32,
    /// Who reads the question. `auto`, which it is when left out: the grammar, and the configured
    /// model where the grammar's reading leaves something open; never the model where
    /// `reasoner` is `builtin`.
    #[serde(default)]
    pub parser: ParserChoice,
    /// Who decides.
    #[serde(default)]
    pub reasoner: ReasonerChoice,
    /// Who chooses the candidates that a vision-language model is shown.
    #[serde(default)]
    pub candidates: CandidateSource,
    /// Which words are compared with the instances' looks, where an encoder has seen them.
    #[serde(default)]
    pub query_text: QueryText,
    /// What a vision-language model is told.
    #[serde(default)]
    pub prompt: PromptVersion,
    /// For experiments: what a vision-language model is not told.
    #[serde(default)]
    pub ablation: Ablation,
    /// What a vision-language model is shown of the candidates.
    #[serde(default)]
    pub evidence: EvidenceMode,
    /// What left, right, front and back mean; an `observer` comes before it.
    #[serde(default)]
    pub direction_convention: DirectionConvention,
    /// Left, right, front and back as seen by this observer, and who is meant by "me": "the chair
    /// closest to me". In the coordinates that `frame` names.
    pub observer: Option<Observer>,
    /// Whose coordinates `observer` is in, and boxes are told in beside the scene's own:
    /// `in_frame` of the answer.
    #[serde(default)]
    pub frame: FrameChoice,
    /// Where the encoder fails, or is not the one the scene was parsed with, answer by names and
    /// measures; the answer is marked `degraded`.
    #[serde(default)]
    pub allow_builtin: bool,
    /// Least belief for a `grounded` answer, `0..=1`: below it the answer is `uncertain`. Left
    /// out: 0.5, where four of five are right of what somebody named who looked, two of three
    /// of what only measures name. 0: nothing is uncertain.
    #[cfg_attr(feature = "openapi", schema(minimum = 0, maximum = 1))]
    pub min_confidence: Option<f32>,
    /// Optional parts to send back; all when left out.
    pub include: Option<Vec<Include>>,
    /// Most this question may cost, US dollars; the built-in reasoner costs nothing. 0: no model
    /// is asked.
    #[cfg_attr(feature = "openapi", schema(minimum = 0))]
    pub max_cost_usd: Option<f64>,
    /// Give up after this many seconds.
    #[cfg_attr(feature = "openapi", schema(exclusive_minimum = 0, maximum = 3600))]
    pub timeout_s: Option<f32>,
}

/// A query for candidates only.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct ShortlistRequest {
    /// What to find, in plain English.
    #[cfg_attr(
        feature = "openapi",
        schema(min_length = 1, max_length = 1000, example = "the black chair")
    )]
    pub query: String,
    /// Most candidates to send back; fewer when fewer fit.
    #[serde(default = "default_top_k")]
    #[cfg_attr(feature = "openapi", schema(minimum = 1, maximum = 100, default = 5))]
    pub top_k: u32,
    /// Which words are compared with the instances, where an encoder has seen them.
    #[serde(default)]
    pub query_text: QueryText,
    /// Who chooses. By default the encoder, where one has seen the scene.
    #[serde(default = "default_candidate_source")]
    #[cfg_attr(feature = "openapi", schema(default = "encoder"))]
    pub candidates: CandidateSource,
    /// Scores are likelihoods against a vocabulary instead of cosines.
    #[serde(default)]
    pub calibrated: bool,
    /// Where the encoder fails, or is not the one the scene was parsed with, rank by names and
    /// measures.
    #[serde(default)]
    pub allow_builtin: bool,
}

impl ShortlistRequest {
    /// # Errors
    /// A [`FieldError`] naming the field.
    pub fn check(&self) -> Result<(), FieldError> {
        check_query(&self.query)?;
        check_top_k(self.top_k)
    }

    /// A query with everything else at its default.
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
    /// A question with everything else at its default.
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
        }
    }

    /// # Errors
    /// A [`FieldError`] naming the field.
    pub fn check(&self) -> Result<(), FieldError> {
        check_query(&self.query)?;
        check_top_k(self.top_k)?;
        if let Some(Observer { position, yaw_rad }) = &self.observer {
            numbers::check_coordinates("/observer/position", position)?;
            numbers::check_finite("/observer/yaw_rad", f64::from(*yaw_rad))?;
        }
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
            format!("has {characters} characters, at most {MAX_QUERY_CHARS} are read"),
        ));
    }
    if query.contains('\0') {
        return Err(FieldError::new("/query", "holds a NUL character, which no text has"));
    }
    Ok(())
}

fn check_top_k(top_k: u32) -> Result<(), FieldError> {
    match top_k {
        1..=MAX_TOP_K => Ok(()),
        _ => Err(FieldError::new("/top_k", format!("must be 1 to {MAX_TOP_K}"))),
    }
}
