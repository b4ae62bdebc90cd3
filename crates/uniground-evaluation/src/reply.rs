//! The reply of a system to one expression.

use serde::{Deserialize, Serialize};
use uniground_geometry::boxes::{Aabb, OrientedBox};
use uniground_grounding::{Candidate, SixFields, Status};
use uniground_types::answer::{Models, Usage};

/// The parts of a finished answer that measures need. Boxes in meters, world frame (Z up).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Reply {
    pub status: Status,
    pub answer: SixFields,
    #[serde(rename = "box")]
    pub aabb: Option<Aabb>,
    pub oriented_box: Option<OrientedBox>,
    pub confidence: f32,
    /// The candidates of the reasoner, best first. Their number is the requested `top_k`.
    pub candidates: Vec<Candidate>,
    /// Boxes of the shortlist, best first, up to [`SHORTLIST_DEPTH`] independent of `top_k`.
    pub shortlist: Vec<Aabb>,
    pub models: Models,
    pub usage: Usage,
    /// Wall-clock time of the question, including the round trip to a server if there is one.
    pub latency_ms: f64,
}

/// Maximum k of the recall-at-k curve.
pub const SHORTLIST_DEPTH: u32 = 24;

impl Reply {
    /// Returns an empty reply.
    pub(super) fn empty() -> Self {
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
