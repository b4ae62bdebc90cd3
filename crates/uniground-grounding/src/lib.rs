//! Stage 2, Contextual Precision Grounding: turns instances and a question into six fields and a
//! box (paper, section 3.3; docs/METHOD.md, sections 2 to 4).
//!
//! [`pipeline`] is the whole way from words to an answer. No model is needed: the built-in reasoner
//! scores names, attributes and relations by geometry. A vision-language model, where one is
//! configured, reviews the result. Language never changes the geometry.

#![warn(missing_docs)]

mod answer;
mod answer_kinds;
mod appearance;
pub mod approach;
mod assess;
mod candidates;
mod choose_level;
mod choose_reading;
mod coverage;
pub mod direction;
mod find_in_photographs;
mod fit;
mod found_anchors;
pub mod graph;
mod kinds;
pub mod memory_scene;
mod names;
mod picture_cache;
pub mod pipeline;
mod readings;
pub mod reasoner;
mod recover_unlisted;
pub mod relations;
pub mod room;
pub mod room_index;
mod scene_source;
mod shortlist;
pub mod solid;
mod unfound_structure;
pub mod vlm;

pub use answer::Grounding;
pub use appearance::{Appearance, ShortlistScoring};
use assess::Assessor;
pub use choose_reading::choose_reading;
pub use coverage::unseen_regions;
use direction::{DirectionConvention, Directions, Observer};
pub use names::{GivenName, NameIndex};
pub use picture_cache::PictureCache;
use std::time::{Duration, Instant};
pub use uniground_types::answer::{
    Alternative, AnswerKind, AnswerValue, Candidate, NoMatchReason, ParsedQuerySummary, Seen,
    SixFields, Status, Target, Timings, Unit,
};
pub use uniground_types::question::{CandidateSource, QueryText, Region};

use uniground_geometry::boxes::Aabb;
use uniground_geometry::scene::Instance;

/// A parsed scene as stage 2 needs it.
#[derive(Debug, Clone, Copy)]
pub struct SceneView<'a> {
    /// In order of id; ids count from 1.
    pub instances: &'a [Instance],
    /// Box of all points, meters, world frame (Z up).
    pub extent: Aabb,
    /// The parsed names that a person or a vision-language model gave the instances.
    pub names: &'a NameIndex,
    /// Similarity of the question's words to the appearance of the instances; `None` where no
    /// encoder has embedded them.
    pub appearance: Option<&'a Appearance>,
}

/// A question.
#[derive(Debug, Clone, PartialEq)]
pub struct Question {
    /// What to find, in plain English.
    pub query: String,
    /// Number of candidates (paper: 5 for `ScanRefer`, 10 for `EmbodiedScan`).
    pub top_k: usize,
    /// Convention for left, right, front and back. An observer or the words ("facing the desk")
    /// override it.
    pub convention: DirectionConvention,
    /// The observer whose left, right, front and back are meant and who is "me"; overrides
    /// `convention`.
    pub observer: Option<Observer>,
    /// The target's class, where it is given with the question: only in an evaluation that follows
    /// the paper.
    pub target_name: Option<String>,
    /// How the candidates for a vision-language model are chosen.
    pub candidates: CandidateSource,
    /// Which words are compared with the instances' appearance.
    pub query_text: QueryText,
    /// Minimum confidence of an answer, `0..=1`; below it the answer is uncertain.
    pub min_confidence: f32,
    /// Region in which the target has to be, world frame.
    pub within: Option<Region>,
    /// Maximum confidence: that of the earlier answer that the question points at, else 1.
    pub most_confidence: f32,
}

impl Question {
    /// Returns a question with the paper's five candidates and directions.
    #[must_use]
    pub fn of(query: impl Into<String>) -> Self {
        Self {
            query: query.into(),
            top_k: 5,
            convention: DirectionConvention::default(),
            observer: None,
            target_name: None,
            candidates: CandidateSource::default(),
            query_text: QueryText::default(),
            min_confidence: 0.0,
            within: None,
            most_confidence: 1.0,
        }
    }
}

/// Returns the `top_k` best candidates for a question, without a decision (paper, section 3.2: by
/// the encoder).
#[must_use]
pub fn rank_candidates(
    scene: SceneView,
    parsed: &uniground_language::ParsedQuery,
    from: CandidateSource,
    top_k: usize,
) -> Vec<Candidate> {
    let mut assessor = Assessor::new(scene, DirectionConvention::Paper.into());
    if from == CandidateSource::Encoder {
        return shortlist::rank(
            scene,
            &candidates::appearance_scores(&assessor, &parsed.target),
            top_k,
        );
    }
    let scores = reasoner::builtin::decide(&mut assessor, parsed).scores;
    candidates::choose(&assessor, parsed, &scores, from, top_k)
}

/// Answers a question, parsed by the built-in grammar.
#[must_use]
pub fn ground(scene: SceneView, question: &Question) -> Grounding {
    let start = Instant::now();
    let parsed = uniground_language::parse(&question.query);
    ground_read(scene, question, parsed, start.elapsed())
}

/// Answers a question that is already parsed; `reading` is how long parsing took.
#[must_use]
pub fn ground_read(
    scene: SceneView,
    question: &Question,
    parsed: uniground_language::ParsedQuery,
    reading: Duration,
) -> Grounding {
    let parsed = choose_reading(scene, parsed);
    let mut grounding = decided(scene, question, parsed.clone(), reading).1;
    answer_kinds::complete(scene, question, &parsed, false, &mut grounding);
    grounding
}

/// Answers a question, and collects the context for a vision-language model that reviews the
/// answer. The answer has the `top_k` candidates that the question's [`CandidateSource`] chooses.
#[must_use]
pub fn ground_with_context(
    scene: SceneView,
    question: &Question,
    parsed: uniground_language::ParsedQuery,
    reading: Duration,
) -> (Grounding, vlm::PromptContext) {
    let (decided, mut grounding) = decided(scene, question, parsed, reading);
    let Decided { assessor, parsed, scores, beliefs } = decided;
    grounding.candidates =
        candidates::choose(&assessor, &parsed, &scores, question.candidates, question.top_k);
    for candidate in &grounding.candidates {
        let name = || answer::describe_instance(&scene.instances[candidate.id.0 as usize - 1]);
        grounding.answer.candidate_names.entry(candidate.id.0).or_insert_with(name);
    }
    let context = vlm::PromptContext::of(&assessor, &parsed, &grounding, &beliefs);
    (grounding, context)
}

/// The intermediate results of a decision.
struct Decided<'a> {
    assessor: Assessor<'a>,
    parsed: uniground_language::ParsedQuery,
    /// By instance index.
    scores: Vec<f32>,
    /// By instance index.
    beliefs: Vec<f32>,
}

fn decided<'a>(
    scene: SceneView<'a>,
    question: &Question,
    mut parsed: uniground_language::ParsedQuery,
    reading: Duration,
) -> (Decided<'a>, Grounding) {
    let start = Instant::now();
    if let Some(name) = &question.target_name {
        parsed.target.head.clone_from(name);
    }
    let mut assessor = assessor_of(scene, question);
    if question.observer.is_some() {
        let of_me = parsed.words_about_asker();
        parsed.not_understood.retain(|word| !of_me.contains(word));
    }
    let prepared = start.elapsed();
    let verdict = reasoner::builtin::decide(&mut assessor, &parsed);
    let total = start.elapsed();
    let timings_ms = answer::to_timings(reading, reading + prepared, reading + total);
    let (scores, beliefs) = (verdict.scores.clone(), verdict.beliefs.clone());
    let grounding = answer::assemble(scene, question, &parsed, verdict, timings_ms);
    (Decided { assessor, parsed, scores, beliefs }, grounding)
}

/// Returns the assessor of a scene with the directions and the observer of a question.
fn assessor_of<'a>(scene: SceneView<'a>, question: &Question) -> Assessor<'a> {
    let directions = question
        .observer
        .as_ref()
        .map_or_else(|| question.convention.into(), Directions::of_observer);
    let mut assessor = Assessor::new(scene, directions);
    assessor.observer = question.observer.as_ref().map(|observer| {
        Aabb {
            center: observer.position.map(|v| v as f32).into(),
            size: uniground_geometry::Vector3::zeros(),
        }
        .into()
    });
    assessor.within = question.within.as_ref().map(|region| {
        let is_within = |instance: &Instance| {
            region.contains(instance.aabb.center.coords.map(f64::from).into())
        };
        scene.instances.iter().map(is_within).collect()
    });
    assessor
}

#[cfg(test)]
mod driving;
