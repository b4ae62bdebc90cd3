//! Who decides among the candidates. Built in: names, attributes and relations scored by geometry.

pub mod builtin;
mod explanation;

use super::Status;
use crate::scene::InstanceId;

/// A decision, before it is dressed as an answer. Vectors are by instance index.
#[derive(Debug, Clone, PartialEq)]
pub struct Verdict {
    pub status: Status,
    /// Fit of each instance to the whole question, `0..=1`.
    pub scores: Vec<f32>,
    /// Share of the belief each instance carries.
    pub beliefs: Vec<f32>,
    pub explanation: String,
    pub anchor: Option<InstanceId>,
    pub relation_used: Option<String>,
    pub target_name_matches: Option<bool>,
}
