//! Questions about many scenes.

use crate::answer::Answer;
use crate::labels::{Labels, check_labels};
use crate::problem::FieldError;
use crate::question::{GroundRequest, ReasonerChoice};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Maximum number of scenes that are answered in full.
const MOST_ANSWERS: u32 = 20;
/// Maximum number of scenes that a question may name, and that are searched one by one.
pub const MOST_SCENES: usize = 1000;

/// A question about many scenes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "openapi", schema(example = json!({"query": "the red mug"})))]
#[serde(deny_unknown_fields)]
pub struct ManyGroundRequest {
    /// Description of the object in English, 1 to 1000 characters.
    #[cfg_attr(
        feature = "openapi",
        schema(min_length = 1, max_length = 1000, example = "the red mug")
    )]
    pub query: String,
    /// Ids of the scenes to search. If omitted, all scenes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(min_items = 1, max_items = 1000))]
    pub scenes: Option<Vec<String>>,
    /// Only search scenes with all of these labels.
    #[serde(default)]
    pub labels: BTreeMap<String, String>,
    /// Number of scenes answered in full, the most likely ones. 1 to 20. Default: 3.
    #[serde(default = "default_top_k")]
    #[cfg_attr(feature = "openapi", schema(minimum = 1, maximum = 20, default = 3))]
    pub top_k: u32,
    /// Reasoner for these answers.
    #[serde(default)]
    pub reasoner: ReasonerChoice,
    /// Minimum confidence of a `grounded` answer, as in a question about one scene.
    #[cfg_attr(feature = "openapi", schema(minimum = 0, maximum = 1))]
    pub min_confidence: Option<f32>,
    /// Spending limit for the whole search, US dollars. 0: no model is called.
    #[cfg_attr(feature = "openapi", schema(minimum = 0))]
    pub max_cost_usd: Option<f64>,
    /// Timeout, seconds, at most 3600.
    #[cfg_attr(feature = "openapi", schema(exclusive_minimum = 0, maximum = 3600))]
    pub timeout_s: Option<f32>,
}

fn default_top_k() -> u32 {
    3
}

impl ManyGroundRequest {
    /// Creates a question about all scenes with default options.
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

    /// Returns the question for a single scene.
    #[must_use]
    pub fn to_ground_request(&self) -> GroundRequest {
        GroundRequest {
            reasoner: self.reasoner,
            min_confidence: self.min_confidence,
            max_cost_usd: self.max_cost_usd,
            timeout_s: self.timeout_s,
            // Scenes may have been parsed with different encoders.
            allow_builtin: true,
            ..GroundRequest::new(&self.query)
        }
    }

    /// # Errors
    /// Returns a [`FieldError`] that names the field.
    pub fn check(&self) -> Result<(), FieldError> {
        self.to_ground_request().check()?;
        check_labels("/labels", &self.labels)?;
        if !(1..=MOST_ANSWERS).contains(&self.top_k) {
            return Err(FieldError::new("/top_k", format!("must be 1 to {MOST_ANSWERS}")));
        }
        match self.scenes.as_ref().map(Vec::len) {
            Some(0) => {
                Err(FieldError::new("/scenes", "must name a scene; omit it to search all scenes"))
            }
            Some(named) if named > MOST_SCENES => Err(FieldError::new(
                "/scenes",
                format!("names {named} scenes, must name at most {MOST_SCENES}"),
            )),
            _ => Ok(()),
        }
    }
}
/// Result of a question about many scenes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ManyAnswers {
    /// The query, unchanged.
    pub query: String,
    /// Number of searched scenes.
    pub looked_into: u32,
    /// Whether the search was limited to the 1,000 most likely scenes, selected by the names of
    /// their objects.
    #[serde(default)]
    pub narrowed: bool,
    /// Answers, best first: grounded, then ambiguous, uncertain and no match; within these by
    /// confidence.
    pub answers: Vec<SceneAnswer>,
    /// Scenes that could not be searched, with the reason. Most of them are not parsed yet.
    pub not_asked: Vec<NotAsked>,
}

/// Answer for one scene.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct SceneAnswer {
    /// Name of the scene; its id is in the answer.
    pub scene_name: String,
    /// Labels of the scene.
    pub labels: BTreeMap<String, String>,
    /// The answer, as for a question about this scene alone. It is stored like any answer.
    pub answer: Answer,
}

/// A scene that could not be searched.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct NotAsked {
    /// UUIDv7 of the scene.
    pub scene_id: String,
    /// Error code of a question about this scene alone.
    pub code: String,
    /// Description of the error.
    pub detail: String,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_of_invalid_questions_name_the_field() {
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
