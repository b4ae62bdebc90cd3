//! What may be asked, and how.

use crate::error::Error;
use crate::grounding::QueryText;
use crate::grounding::direction::{DirectionConvention, Observer};
use crate::grounding::vlm::{Ablation, EvidenceMode};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

const MAX_QUERY_CHARS: usize = 2000;
const MAX_TOP_K: u32 = 100;
const MAX_TIMEOUT_S: f32 = 3600.0;

/// Who decides.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
pub enum ReasonerChoice {
    /// A vision-language model when one is configured, else the built-in reasoner.
    #[default]
    Auto,
    Vlm,
    Builtin,
}

/// Who reads the question.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum ParserChoice {
    /// Grammar and lexicon: no call, no cost.
    #[default]
    Builtin,
    /// One call to the configured model; the grammar where its answer can not be used, told in the trace.
    Vlm,
}

/// Parts of an answer that can be left out of the reply.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Include {
    Candidates,
    Evidence,
    Trace,
}

/// A question about a scene.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct GroundRequest {
    /// What to find, in plain English.
    #[schema(min_length = 1, max_length = 2000, example = "the black chair closest to the door")]
    pub query: String,
    /// Candidates to keep.
    #[serde(default = "default_top_k")]
    #[schema(minimum = 1, maximum = 100, default = 5)]
    pub top_k: u32,
    #[serde(default)]
    pub parser: ParserChoice,
    #[serde(default)]
    pub reasoner: ReasonerChoice,
    #[serde(default)]
    pub ablation: Ablation,
    #[serde(default)]
    pub evidence: EvidenceMode,
    #[serde(default)]
    pub direction_convention: DirectionConvention,
    /// Left, right, front and back as seen by this observer.
    pub observer: Option<Observer>,
    /// Where the encoder fails, or is not the one the scene was parsed with, answer by names and measures; the answer is marked `degraded`.
    #[serde(default)]
    pub allow_builtin: bool,
    /// Optional parts to send back; all when left out.
    pub include: Option<Vec<Include>>,
    /// Most this question may cost, US dollars; the built-in reasoner costs nothing. 0: no model is asked.
    #[schema(minimum = 0)]
    pub max_cost_usd: Option<f64>,
    /// Give up after this many seconds.
    #[schema(exclusive_minimum = 0, maximum = 3600)]
    pub timeout_s: Option<f32>,
}

/// A query for candidates only.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ShortlistRequest {
    #[schema(min_length = 1, max_length = 2000, example = "the black chair")]
    pub query: String,
    #[serde(default = "default_top_k")]
    #[schema(minimum = 1, maximum = 100, default = 5)]
    pub top_k: u32,
    /// Which words are compared with the instances, where an encoder has seen them.
    #[serde(default)]
    pub query_text: QueryText,
    /// Scores are likelihoods against a vocabulary instead of cosines.
    #[serde(default)]
    pub calibrated: bool,
    /// Where the encoder fails, or is not the one the scene was parsed with, rank by names and measures.
    #[serde(default)]
    pub allow_builtin: bool,
}

impl ShortlistRequest {
    /// A query with everything else at its default.
    #[must_use]
    pub fn of(query: impl Into<String>) -> Self {
        let (query, top_k) = (query.into(), default_top_k());
        Self { query, top_k, query_text: QueryText::default(), calibrated: false, allow_builtin: false }
    }
}

fn default_top_k() -> u32 {
    5
}

impl GroundRequest {
    /// A question with everything else at its default.
    #[must_use]
    pub fn of(query: impl Into<String>) -> Self {
        Self {
            query: query.into(),
            top_k: default_top_k(),
            parser: ParserChoice::default(),
            reasoner: ReasonerChoice::default(),
            ablation: Ablation::default(),
            evidence: EvidenceMode::default(),
            direction_convention: DirectionConvention::default(),
            observer: None,
            allow_builtin: false,
            include: None,
            max_cost_usd: None,
            timeout_s: None,
        }
    }

    /// # Errors
    /// [`Error::Invalid`] naming the field.
    pub fn check(&self) -> Result<(), Error> {
        check_query(&self.query)?;
        check_top_k(self.top_k)?;
        if let Some(observer) = &self.observer
            && !observer.position.iter().chain([&observer.yaw_rad]).all(|v| v.is_finite())
        {
            return Err(Error::invalid("/observer", "position and yaw_rad must be finite"));
        }
        if self.max_cost_usd.is_some_and(|cost| !cost.is_finite() || cost < 0.0) {
            return Err(Error::invalid("/max_cost_usd", "must be 0 or more"));
        }
        if self.timeout_s.is_some_and(|t| !t.is_finite() || t <= 0.0 || t > MAX_TIMEOUT_S) {
            return Err(Error::invalid("/timeout_s", format!("must be above 0 and at most {MAX_TIMEOUT_S}")));
        }
        Ok(())
    }
}

pub(super) fn check_query(query: &str) -> Result<(), Error> {
    let characters = query.chars().count();
    if query.trim().is_empty() {
        return Err(Error::invalid("/query", "must not be empty"));
    }
    if characters > MAX_QUERY_CHARS {
        return Err(Error::invalid("/query", format!("has {characters} characters, at most {MAX_QUERY_CHARS} are read")));
    }
    Ok(())
}

pub(super) fn check_top_k(top_k: u32) -> Result<(), Error> {
    match top_k {
        1..=MAX_TOP_K => Ok(()),
        _ => Err(Error::invalid("/top_k", format!("must be 1 to {MAX_TOP_K}"))),
    }
}
