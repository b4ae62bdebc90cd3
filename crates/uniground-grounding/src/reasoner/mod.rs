//! Decides among the candidates. Built in: names, attributes and relations scored by geometry.

pub mod builtin;
mod confidence;
mod explanation;
mod views;

pub(super) use confidence::NamesFrom;
pub(super) use explanation::relation_words;

use super::{NoMatchReason, Status};
use uniground_geometry::scene::InstanceId;

/// A decision of a reasoner, from which the answer is built. Vectors are by instance index.
#[derive(Debug, Clone, PartialEq)]
pub struct Verdict {
    /// `ambiguous` when the best are tied.
    pub status: Status,
    /// Why nothing was chosen; `None` unless the status is `no_match`.
    pub reason: Option<NoMatchReason>,
    /// Fit of each instance to the whole question, `0..=1`.
    pub scores: Vec<f32>,
    /// Belief in each instance, `0..=1`. If the question asks for one, they share the belief; 0 for
    /// `no_match`.
    pub beliefs: Vec<f32>,
    /// Indices of all instances that a question for several means, best first; empty if it asks for
    /// one.
    pub several: Vec<usize>,
    /// The reason, in words that a person can check against the room.
    pub explanation: String,
    /// The first anchor of its relations, otherwise the viewpoint's; `None` without either, and for
    /// `no_match`.
    pub anchor: Option<InstanceId>,
    /// Relations and superlative in the question's words; `None` when it has none, and for
    /// `no_match`.
    pub relation_used: Option<String>,
    /// Whether a name of the best instance is one the question may mean; `None` for `no_match`.
    pub target_name_matches: Option<bool>,
}
