//! What a system says to one expression.

use serde::{Deserialize, Serialize};
use uniground_geometry::boxes::{Aabb, OrientedBox};
use uniground_grounding::{Candidate, SixFields, Status};
use uniground_types::answer::{Models, Usage};

/// A finished answer, as far as measures need it. Boxes in metres, world frame (Z up).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Reply {
    pub status: Status,
    pub answer: SixFields,
    #[serde(rename = "box")]
    pub aabb: Option<Aabb>,
    pub oriented_box: Option<OrientedBox>,
    pub confidence: f32,
    /// What the reasoner chose from, best first: the asked `top_k`.
    pub candidates: Vec<Candidate>,
    /// Boxes as the shortlist has them, best first, up to [`SHORTLIST_DEPTH`] whatever `top_k`
    /// was.
    pub shortlist: Vec<Aabb>,
    pub models: Models,
    pub usage: Usage,
    /// Wall-clock of the question, with the way to the server and back where there is one.
    pub latency_ms: f64,
}

/// How deep the recall-at-k curve goes.
pub const SHORTLIST_DEPTH: u32 = 24;

impl Reply {
    /// No answer at all.
    pub(super) fn nothing() -> Self {
        let answer = SixFields {
            predicted_id: None,
            explanation: String::new(),
            candidate_names: std::collections::BTreeMap::new(),
            target_name_matches: None,
            anchor_id: None,
            relation_used: None,
        };
        let none = String::new;
        Self {
            status: Status::NoMatch,
            answer,
            aabb: None,
            oriented_box: None,
            confidence: 0.0,
            candidates: Vec::new(),
            shortlist: Vec::new(),
            models: Models {
                masks: none(),
                encoder: none(),
                parser: none(),
                names: None,
                reasoner: none(),
            },
            usage: Usage::default(),
            latency_ms: 0.0,
        }
    }
}
