//! Questions about many scenes: in which room is it?

use crate::answer::Answer;
use crate::labels::{Labels, check_labels};
use crate::problem::FieldError;
use crate::question::{GroundRequest, ReasonerChoice};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Most scenes that are answered in full.
const MOST_ANSWERS: u32 = 20;
/// Most scenes that one question names, and that are looked into one by one.
pub const MOST_SCENES: usize = 1000;

/// A question about many scenes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct ManyGroundRequest {
    /// What to find, in plain English.
    #[cfg_attr(
        feature = "openapi",
        schema(min_length = 1, max_length = 1000, example = "the red mug")
    )]
    pub query: String,
    /// Ids of the scenes to look in; left out: all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(min_items = 1, max_items = 1000))]
    pub scenes: Option<Vec<String>>,
    /// Of those, only scenes with all of these labels.
    #[serde(default)]
    pub labels: BTreeMap<String, String>,
    /// How many scenes are answered in full: those that most likely have it.
    #[serde(default = "default_top_k")]
    #[cfg_attr(feature = "openapi", schema(minimum = 1, maximum = 20, default = 3))]
    pub top_k: u32,
    /// Who decides in those.
    #[serde(default)]
    pub reasoner: ReasonerChoice,
    /// Least belief for a `grounded` answer, as in a question about one scene.
    #[cfg_attr(feature = "openapi", schema(minimum = 0, maximum = 1))]
    pub min_confidence: Option<f32>,
    /// Most all of it may cost, US dollars. 0: no model is asked.
    #[cfg_attr(feature = "openapi", schema(minimum = 0))]
    pub max_cost_usd: Option<f64>,
    /// Give up after this many seconds.
    #[cfg_attr(feature = "openapi", schema(exclusive_minimum = 0, maximum = 3600))]
    pub timeout_s: Option<f32>,
}

fn default_top_k() -> u32 {
    3
}

impl ManyGroundRequest {
    /// A question about all scenes, with everything else at its default.
    #[must_use]
    pub fn new(query: impl Into<String>) -> Self {
        Self {
            query: query.into(),
            scenes: None,
            labels: Labels::default(),
            top_k: default_top_k(),
            reasoner: ReasonerChoice::default(),
            min_confidence: None,
            max_cost_usd: None,
            timeout_s: None,
        }
    }

    /// What one scene is asked.
    #[must_use]
    pub fn to_ground_request(&self) -> GroundRequest {
        GroundRequest {
            reasoner: self.reasoner,
            min_confidence: self.min_confidence,
            max_cost_usd: self.max_cost_usd,
            timeout_s: self.timeout_s,
            // Scenes of today and of a year ago are looked into together.
            allow_builtin: true,
            ..GroundRequest::new(&self.query)
        }
    }

    /// # Errors
    /// A [`FieldError`] naming the field.
    pub fn check(&self) -> Result<(), FieldError> {
        self.to_ground_request().check()?;
        check_labels("/labels", &self.labels)?;
        if !(1..=MOST_ANSWERS).contains(&self.top_k) {
            return Err(FieldError::new("/top_k", format!("must be 1 to {MOST_ANSWERS}")));
        }
        match self.scenes.as_ref().map(Vec::len) {
            Some(0) => {
                Err(FieldError::new("/scenes", "must name a scene; leave it out to look in all"))
            }
            Some(named) if named > MOST_SCENES => Err(FieldError::new(
                "/scenes",
                format!("names {named} scenes, at most {MOST_SCENES}"),
            )),
            _ => Ok(()),
        }
    }
}
/// What came of a question about many scenes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ManyAnswers {
    /// As asked.
    pub query: String,
    /// How many scenes were looked into.
    pub looked_into: u32,
    /// More than 1,000 scenes were meant: those were looked into that most likely have it, by what
    /// their things are called.
    #[serde(default)]
    pub narrowed: bool,
    /// Best first: what is grounded before what is ambiguous, uncertain, or not there; then by
    /// confidence.
    pub answers: Vec<SceneAnswer>,
    /// Scenes that could not be asked, and why: those that are not parsed yet, for the most part.
    pub not_asked: Vec<NotAsked>,
}

/// The answer of one of many scenes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct SceneAnswer {
    /// Name of the scene; its id is in the answer.
    pub scene_name: String,
    /// Its labels.
    pub labels: BTreeMap<String, String>,
    /// As a question about that scene alone is answered; kept, as any.
    pub answer: Answer,
}

/// A scene that could not be asked.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct NotAsked {
    /// UUIDv7 of the scene.
    pub scene_id: String,
    /// The code that a question about this scene alone gets.
    pub code: String,
    /// What that means.
    pub detail: String,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_makes_no_sense_is_named() {
        let asked = || ManyGroundRequest::new("the red mug");
        assert!(asked().check().is_ok());
        let named = |request: ManyGroundRequest| request.check().unwrap_err().to_string();
        assert!(named(ManyGroundRequest { top_k: 0, ..asked() }).contains("/top_k"));
        assert!(
            named(ManyGroundRequest { scenes: Some(Vec::new()), ..asked() }).contains("/scenes")
        );
        assert!(named(ManyGroundRequest { query: " ".into(), ..asked() }).contains("/query"));
        assert!(
            named(ManyGroundRequest { scenes: Some(vec![String::new(); 1001]), ..asked() })
                .contains("/scenes")
        );
        let labels = Labels::from([("two words".into(), "x".into())]);
        assert!(named(ManyGroundRequest { labels, ..asked() }).contains("/labels"));
    }
}
