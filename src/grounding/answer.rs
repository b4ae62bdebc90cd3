//! The answer: six fields, both boxes, status, and what led there.

use super::query::{Meaning, ParsedQuery, Phrase, Superlative};
use super::reasoner::Verdict;
use super::shortlist::{self, Candidate};
use super::{Question, SceneView};
use crate::geometry::boxes::{Aabb, OrientedBox};
use crate::scene::{Instance, InstanceId};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::time::Duration;
use utoipa::ToSchema;

/// Whether the question has an answer in this room.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Status {
    /// One object fits.
    Grounded,
    /// Several objects fit alike: see `alternatives`.
    Ambiguous,
    /// Nothing in the room fits.
    NoMatch,
}

/// The paper's six fields.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct SixFields {
    /// Id of the chosen instance; `null` unless grounded.
    pub predicted_id: Option<InstanceId>,
    /// Why, in words a person can check.
    pub explanation: String,
    /// What each candidate is called, by id, without regard to the question.
    #[schema(value_type = BTreeMap<String, String>)]
    pub candidate_names: BTreeMap<u32, String>,
    /// Whether the chosen candidate's own name means what the question asks for; `null` when nothing was chosen.
    pub target_name_matches: Option<bool>,
    /// The anchor the decision used.
    pub anchor_id: Option<InstanceId>,
    /// The relation the decision used, in the question's words.
    pub relation_used: Option<String>,
}

/// Another instance the question may mean.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Alternative {
    pub id: InstanceId,
    /// Share of the belief, `0..=1`.
    pub confidence: f32,
    #[serde(rename = "box")]
    pub aabb: Aabb,
}

/// How the question was understood.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ParsedQuerySummary {
    /// The noun asked for, as the question says it.
    pub target: String,
    pub attributes: Vec<String>,
    pub anchors: Vec<String>,
    pub relations: Vec<String>,
    /// Words that could not be used.
    pub not_understood: Vec<String>,
}

/// Wall-clock milliseconds per step.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Timings {
    pub parse_query: f64,
    pub shortlist: f64,
    /// Pictures for a vision-language model; the built-in reasoner needs none.
    pub evidence: f64,
    pub reason: f64,
    pub total: f64,
}

impl Timings {
    pub(super) fn from_marks(parsed: Duration, shortlisted: Duration, total: Duration) -> Self {
        let ms = |d: Duration| (d.as_secs_f64() * 1e6).round() / 1e3;
        Self {
            parse_query: ms(parsed),
            shortlist: ms(shortlisted.saturating_sub(parsed)),
            evidence: 0.0,
            reason: ms(total.saturating_sub(shortlisted)),
            total: ms(total),
        }
    }
}

/// Everything stage 2 has to say about a question.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Grounding {
    pub query: String,
    pub status: Status,
    pub answer: SixFields,
    /// Axis-aligned box of the answer; `null` unless grounded.
    #[serde(rename = "box")]
    pub aabb: Option<Aabb>,
    /// Yaw-oriented box of the answer; `null` unless grounded.
    pub oriented_box: Option<OrientedBox>,
    /// Belief in the answer, `0..=1`; for `no_match`, that nothing fits.
    pub confidence: f32,
    /// The best candidates, best first.
    pub candidates: Vec<Candidate>,
    /// Instances nearly as good; for `ambiguous`, the tied ones, best first.
    pub alternatives: Vec<Alternative>,
    pub parsed_query: ParsedQuerySummary,
    /// Convention in force for left, right, front and back: `paper`, `viewer`, or `observer` when the request has one.
    pub direction_convention: String,
    pub timings_ms: Timings,
}

/// How many alternatives are told.
const MAX_ALTERNATIVES: usize = 5;
/// Alternatives below this share of the belief are not worth telling.
const MIN_ALTERNATIVE: f32 = 0.05;

pub(super) fn assemble(scene: SceneView, question: &Question, parsed: &ParsedQuery, verdict: Verdict, timings_ms: Timings) -> Grounding {
    let Verdict { status, scores, beliefs, explanation, anchor, relation_used, target_name_matches } = verdict;
    let candidates = shortlist::rank(scene, &scores, question.top_k);
    let chosen = candidates
        .first()
        .filter(|_| status == Status::Grounded)
        .map(|c| &scene.instances[c.id.0 as usize - 1]);
    let confidence = match (status, candidates.first()) {
        (Status::NoMatch, Some(best)) => 1.0 - best.score,
        (Status::NoMatch, None) => 1.0,
        (_, Some(best)) => beliefs[best.id.0 as usize - 1],
        (_, None) => 0.0,
    };
    let mut rivals: Vec<&Instance> = match status {
        Status::NoMatch => Vec::new(),
        _ => scene.instances.iter().filter(|i| chosen.is_none_or(|c| c.id != i.id)).collect(),
    };
    let belief = |i: &Instance| beliefs[i.id.0 as usize - 1];
    rivals.retain(|i| belief(i) >= MIN_ALTERNATIVE);
    rivals.sort_by(|a, b| belief(b).total_cmp(&belief(a)).then(a.id.cmp(&b.id)));
    Grounding {
        query: question.query.clone(),
        status,
        answer: SixFields {
            predicted_id: chosen.map(|i| i.id),
            explanation,
            candidate_names: candidates.iter().map(|c| (c.id.0, described(&scene.instances[c.id.0 as usize - 1]))).collect(),
            target_name_matches: chosen.and(target_name_matches),
            anchor_id: anchor,
            relation_used,
        },
        aabb: chosen.map(|i| i.aabb),
        oriented_box: chosen.map(|i| i.oriented_box),
        confidence,
        candidates,
        alternatives: rivals
            .iter()
            .take(MAX_ALTERNATIVES)
            .map(|i| Alternative { id: i.id, confidence: belief(i), aabb: i.aabb })
            .collect(),
        parsed_query: summarise(parsed),
        direction_convention: if question.observer.is_some() { "observer".into() } else { question.convention.name().into() },
        timings_ms,
    }
}

/// "red sofa": dominant colour and best name, as somebody would say who has not heard the question.
pub(super) fn described(instance: &Instance) -> String {
    match instance.colours.dominant().first() {
        Some((colour, _)) => format!("{} {}", colour.word(), instance.label()),
        None => instance.label().to_owned(),
    }
}

fn summarise(parsed: &ParsedQuery) -> ParsedQuerySummary {
    let target = &parsed.target;
    let traits = target.traits.iter().map(|s| s.word().to_owned());
    let colours = target.colours.iter().map(|c| c.word().to_owned());
    let other_than = target.other_than.iter().map(|c| format!("not {}", c.word()));
    let with = target.with.iter().map(|w| {
        let count = w.phrase.count.map_or_else(String::new, |n| format!("{n} "));
        format!("{} {count}{}", if w.absent { "without" } else { "with" }, w.phrase.text())
    });
    let uses = target.uses.iter().map(|spoken| format!("to {spoken}"));
    let superlative = target.superlative.map(|s| superlative_words(&s));
    let mut summary = ParsedQuerySummary {
        target: if target.meaning() == Meaning::Anything && target.head.is_empty() { "thing".into() } else { target.head.clone() },
        attributes: traits.chain(colours).chain(other_than).chain(with).chain(uses).chain(superlative).collect(),
        anchors: Vec::new(),
        relations: Vec::new(),
        not_understood: parsed.not_understood.clone(),
    };
    collect_anchors(target, &mut summary);
    summary.anchors.extend(parsed.viewpoint.iter().map(|v| v.anchor.text()));
    summary
}

/// Anchors and relations, those of anchors after those of the thing itself.
fn collect_anchors(phrase: &Phrase, summary: &mut ParsedQuerySummary) {
    for relation in &phrase.relations {
        summary
            .relations
            .push(if relation.negated { format!("not {}", relation.text) } else { relation.text.clone() });
        summary.anchors.extend(relation.anchors.iter().map(Phrase::text));
    }
    let within = phrase.relations.iter().flat_map(|r| &r.anchors).chain(phrase.with.iter().map(|w| &w.phrase));
    within.for_each(|inner| collect_anchors(inner, summary));
}

/// "tallest", "leftmost, number 2"
pub(super) fn superlative_words(superlative: &Superlative) -> String {
    match superlative.rank {
        0 | 1 => superlative.measure.word().to_owned(),
        rank => format!("{}, number {rank}", superlative.measure.word()),
    }
}
