//! Stage 2, Contextual Precision Grounding: instances and a question to six fields and a box (paper, METHOD sections 2-4).
//!
//! `query -> shortlist -> reasoner -> answer`. No model is needed: the built-in reasoner scores names, attributes and
//! relations by geometry. The language never changes the geometry.

mod answer;
mod appearance;
mod assess;
pub mod direction;
mod fit;
pub mod query;
mod reasoner;
pub mod relations;
mod shortlist;
pub mod solid;

pub use answer::{Alternative, Grounding, ParsedQuerySummary, SixFields, Status, Timings};
pub use appearance::{Appearance, QueryText, ShortlistScoring};
use assess::Looked;
use direction::{DirectionConvention, Directions, Observer};
pub use shortlist::Candidate;
use std::time::{Duration, Instant};

use crate::geometry::boxes::Aabb;
use crate::scene::Instance;

/// A parsed scene as stage 2 needs it.
#[derive(Debug, Clone, Copy)]
pub struct SceneView<'a> {
    /// In order of id.
    pub instances: &'a [Instance],
    pub extent: Aabb,
    /// What the question's words look like beside the instances, where an encoder has seen them.
    pub appearance: Option<&'a Appearance>,
}

/// A question.
#[derive(Debug, Clone, PartialEq)]
pub struct Question {
    pub query: String,
    /// How many candidates to keep (paper: 5 for `ScanRefer`, 10 for `EmbodiedScan`).
    pub top_k: usize,
    pub convention: DirectionConvention,
    pub observer: Option<Observer>,
    /// What the target is called, where somebody else knows it: evaluation in the paper's way only.
    pub target_name: Option<String>,
}

/// The best candidates for a question (stage 1 of the question, paper: top-k by the encoder): by appearance where an encoder has seen
/// the scene and knows the words, by names and attributes otherwise.
#[must_use]
pub fn shortlist(scene: SceneView, parsed: &query::ParsedQuery, top_k: usize) -> Vec<Candidate> {
    if let Some(scores) = scene.appearance.and_then(Appearance::shortlist) {
        return shortlist::rank(scene, scores, top_k);
    }
    let looked = Looked::at(scene, DirectionConvention::Paper.into());
    shortlist::rank(scene, &looked.own_fits(&parsed.target).1, top_k)
}

/// Answers a question, read by the built-in grammar.
#[must_use]
pub fn ground(scene: SceneView, question: &Question) -> Grounding {
    let start = Instant::now();
    let parsed = query::parse(&question.query);
    ground_read(scene, question, parsed, start.elapsed())
}

/// Answers a question that somebody has read, which took `reading`.
#[must_use]
pub fn ground_read(scene: SceneView, question: &Question, mut parsed: query::ParsedQuery, reading: Duration) -> Grounding {
    let start = Instant::now();
    if let Some(name) = &question.target_name {
        parsed.target.head.clone_from(name);
    }
    let directions = question.observer.as_ref().map_or_else(|| question.convention.into(), Directions::of_observer);
    let mut looked = Looked::at(scene, directions);
    let prepared = start.elapsed();
    let verdict = reasoner::builtin::decide(&mut looked, &parsed);
    let total = start.elapsed();
    let timings_ms = Timings::from_marks(reading, reading + prepared, reading + total);
    answer::assemble(scene, question, &parsed, verdict, timings_ms)
}
