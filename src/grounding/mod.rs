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
pub mod vlm;

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
pub fn ground_read(scene: SceneView, question: &Question, parsed: query::ParsedQuery, reading: Duration) -> Grounding {
    decided(scene, question, parsed, reading).1
}

/// Answers a question, and tells a vision-language model what it needs to decide it better. Its candidates are as many as were asked for:
/// after those that fit follow things that stand where the question says, whatever they may be called.
#[must_use]
pub fn ground_and_brief(scene: SceneView, question: &Question, parsed: query::ParsedQuery, reading: Duration) -> (Grounding, vlm::Brief) {
    let (decided, mut grounding) = decided(scene, question, parsed, reading);
    let Decided { looked, parsed, beliefs } = decided;
    let placed = looked
        .assess(&query::Phrase { head: String::new(), uses: Vec::new(), ..parsed.target.clone() })
        .total;
    let known = |id| grounding.candidates.iter().any(|c| c.id == id);
    let others: Vec<Candidate> = shortlist::rank(scene, &placed, scene.instances.len())
        .into_iter()
        .filter(|c| !known(c.id))
        .collect();
    let room = question.top_k.saturating_sub(grounding.candidates.len());
    let first = grounding.candidates.len() as u32 + 1;
    let others = others.into_iter().take(room).zip(first..).map(|(c, rank)| Candidate { rank, score: 0.0, ..c });
    grounding.candidates.extend(others);
    for candidate in &grounding.candidates {
        let name = || answer::described(&scene.instances[candidate.id.0 as usize - 1]);
        grounding.answer.candidate_names.entry(candidate.id.0).or_insert_with(name);
    }
    let brief = vlm::Brief::of(&looked, &parsed, &grounding, &beliefs);
    (grounding, brief)
}

/// What led to a decision.
struct Decided<'a> {
    looked: Looked<'a>,
    parsed: query::ParsedQuery,
    /// By instance index.
    beliefs: Vec<f32>,
}

fn decided<'a>(scene: SceneView<'a>, question: &Question, mut parsed: query::ParsedQuery, reading: Duration) -> (Decided<'a>, Grounding) {
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
    let beliefs = verdict.beliefs.clone();
    let grounding = answer::assemble(scene, question, &parsed, verdict, timings_ms);
    (Decided { looked, parsed, beliefs }, grounding)
}
