//! Builds the answer: six fields, both boxes, the status, and what led to the decision.

use super::reasoner::{NamesFrom, Verdict};
use super::shortlist;
use super::vlm::PromptContext;
use super::{
    Alternative, AnswerKind, AnswerValue, Candidate, NoMatchReason, ParsedQuerySummary, Question,
    SceneView, Seen, SixFields, Status, Target, Timings,
};
use serde::{Deserialize, Serialize};
use std::time::Duration;
use uniground_geometry::boxes::{Aabb, OrientedBox};
use uniground_geometry::color::ColorName;
use uniground_geometry::scene::{Instance, Level};
use uniground_language::{Meaning, ParsedQuery, Phrase, Quantity, Superlative};
use uniground_types::coverage::Coverage;

/// Returns the duration of each step in milliseconds. The arguments are the times from the start to
/// the end of each step.
pub(super) fn to_timings(parsed: Duration, shortlisted: Duration, total: Duration) -> Timings {
    let ms = |d: Duration| (d.as_secs_f64() * 1e6).round() / 1e3;
    Timings {
        parse_query: ms(parsed),
        shortlist: ms(shortlisted.saturating_sub(parsed)),
        evidence: 0.0,
        reason: ms(total.saturating_sub(shortlisted)),
        total: ms(total),
    }
}

/// Everything stage 2 returns for a question.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Grounding {
    /// The text of the question.
    pub query: String,
    /// What kind of answer the question asks for.
    #[serde(default)]
    pub kind: AnswerKind,
    /// The answer as a sentence.
    #[serde(default)]
    pub text: String,
    /// The number, the measurement, or yes or no.
    #[serde(default)]
    pub value: Option<AnswerValue>,
    /// The status. Only `grounded` and `uncertain` have a box.
    pub status: Status,
    /// Why nothing was chosen; `None` unless the status is `no_match`.
    #[serde(default)]
    pub no_match_reason: Option<NoMatchReason>,
    /// Where a vision-language model sees an object that is not an instance; `None` unless the
    /// reason is `not_listed`.
    #[serde(default)]
    pub seen: Option<Seen>,
    /// How the object differs from the question, by a vision-language model: "it is black, not
    /// white".
    #[serde(default)]
    pub differs: Option<String>,
    /// Which part of the room was seen; `None` unless the object was not found, and for scans
    /// without frames.
    #[serde(default)]
    pub coverage: Option<Coverage>,
    /// The paper's six fields (App. B.1).
    pub answer: SixFields,
    /// Axis-aligned box of the answer; `None` unless the status is `grounded` or `uncertain`.
    #[serde(rename = "box")]
    pub aabb: Option<Aabb>,
    /// Yaw-oriented box of the answer; `None` unless the status is `grounded` or `uncertain`.
    pub oriented_box: Option<OrientedBox>,
    /// Belief in the answer, `0..=1`. For `no_match`, the belief that nothing fits; 0.5 if the
    /// requested noun is unknown.
    pub confidence: f32,
    /// The best candidates, best first.
    pub candidates: Vec<Candidate>,
    /// Other instances the question may mean, best first. For `ambiguous`, the tied ones are among
    /// them.
    pub alternatives: Vec<Alternative>,
    /// All instances the question means, best first: several where it asks for several, otherwise
    /// the answer itself or none.
    #[serde(default)]
    pub targets: Vec<Target>,
    /// Number of matching instances, where the question asks for several; 0 for `no_match`.
    #[serde(default)]
    pub count: Option<u32>,
    /// The parsed question.
    pub parsed_query: ParsedQuerySummary,
    /// The convention for left, right, front and back: `paper`, `viewer`, or `observer` when the
    /// request has one. Words of the question ("facing the desk") override it.
    pub direction_convention: String,
    /// Milliseconds per step. The time a model takes to review the answer counts as `reason`.
    pub timings_ms: Timings,
}

/// Belief that nothing fits, if the requested noun is unknown.
const NOBODY_KNOWS: f32 = 0.5;
/// Maximum number of alternatives in an answer.
const MAX_ALTERNATIVES: usize = 5;
/// Alternatives with a smaller share of the belief are left out.
const MIN_ALTERNATIVE: f32 = 0.05;

pub(super) fn assemble(
    scene: SceneView,
    question: &Question,
    parsed: &ParsedQuery,
    verdict: Verdict,
    timings_ms: Timings,
) -> Grounding {
    let Verdict {
        status,
        reason,
        scores,
        beliefs,
        several,
        explanation,
        anchor,
        relation_used,
        target_name_matches,
    } = verdict;
    let candidates = shortlist::rank(scene, &scores, question.top_k);
    let chosen = candidates
        .first()
        .filter(|_| status == Status::Grounded)
        .map(|c| &scene.instances[c.id.0 as usize - 1]);
    let confidence = match (status, candidates.first()) {
        (Status::NoMatch, _)
            if matches!(reason, Some(NoMatchReason::NotRecognised | NoMatchReason::NotEnglish)) =>
        {
            NOBODY_KNOWS
        }
        (Status::NoMatch, Some(best)) => {
            let names = NamesFrom::of(scene, &parsed.target, best.id.0 as usize - 1);
            let most = if names == NamesFrom::Given { 1.0 } else { NOBODY_KNOWS };
            (1.0 - best.score).min(most)
        }
        (Status::NoMatch, None) => 1.0,
        (_, Some(best)) => beliefs[best.id.0 as usize - 1],
        (_, None) => 0.0,
    };
    let asks_for_several = parsed.quantity != Quantity::One;
    let targets = match chosen {
        Some(_) if asks_for_several => {
            several.iter().map(|&i| to_target(&scene.instances[i], beliefs[i])).collect()
        }
        Some(chosen) => vec![to_target(chosen, confidence)],
        None => Vec::new(),
    };
    let mut rivals: Vec<&Instance> = match status {
        Status::NoMatch => Vec::new(),
        _ => scene.instances.iter().filter(|i| targets.iter().all(|t| t.id != i.id)).collect(),
    };
    let belief = |i: &Instance| beliefs[i.id.0 as usize - 1];
    rivals.retain(|i| belief(i) >= MIN_ALTERNATIVE);
    rivals.sort_by(|a, b| belief(b).total_cmp(&belief(a)).then(a.id.cmp(&b.id)));
    Grounding {
        query: question.query.clone(),
        kind: AnswerKind::Box,
        text: String::new(),
        value: None,
        status,
        no_match_reason: reason,
        seen: None,
        differs: None,
        coverage: None,
        answer: SixFields {
            predicted_id: chosen.map(|i| i.id),
            explanation,
            candidate_names: candidates
                .iter()
                .map(|c| (c.id.0, describe_instance(&scene.instances[c.id.0 as usize - 1])))
                .collect(),
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
            .map(|i| to_alternative(i, describe_instance(i), belief(i)))
            .collect(),
        count: asks_for_several.then_some(targets.len() as u32),
        targets,
        parsed_query: summarize(parsed),
        direction_convention: if question.observer.is_some() {
            "observer".into()
        } else {
            question.convention.name().into()
        },
        timings_ms,
    }
}

impl Grounding {
    /// Adds instances that the model was shown and that are not among the geometry's candidates.
    pub(super) fn add_shown(&mut self, context: &PromptContext, instances: &[Instance]) {
        for (shown, rank) in context.candidates.iter().zip(1..) {
            let Some(instance) = instances.get(shown.id.0 as usize - 1) else { continue };
            if self.candidates.iter().all(|c| c.id != shown.id) {
                self.candidates.push(to_candidate(instance, rank, shown.score));
                self.answer.candidate_names.insert(shown.id.0, describe_instance(instance));
            }
        }
    }
}

/// Converts an instance to a candidate.
pub(super) fn to_candidate(instance: &Instance, rank: u32, score: f32) -> Candidate {
    let &Instance { id, aabb, oriented_box, .. } = instance;
    Candidate {
        id,
        rank,
        score,
        name: describe_instance(instance),
        aabb,
        oriented_box: Some(oriented_box),
        view: None,
    }
}

/// Converts an instance to an alternative.
pub(super) fn to_alternative(instance: &Instance, name: String, confidence: f32) -> Alternative {
    let &Instance { id, aabb, oriented_box, .. } = instance;
    Alternative { id, name, confidence, aabb, oriented_box: Some(oriented_box), view: None }
}

/// Converts an instance to a target.
pub(super) fn to_target(instance: &Instance, confidence: f32) -> Target {
    let &Instance { id, aabb, oriented_box, support, level, .. } = instance;
    let parent = instance.things.first().copied().filter(|_| level == Level::Part);
    Target {
        id,
        name: describe_instance(instance),
        confidence,
        aabb,
        oriented_box,
        support: Some(support),
        parent,
        distance_m: None,
        last_seen: None,
    }
}

impl Grounding {
    /// Makes the answer uncertain if its confidence is below `least`, or if its sentence says that
    /// the object has other names. 0 disables both.
    pub(super) fn require_confidence(&mut self, least: f32) {
        let has_other_names = least > 0.0 && self.text.starts_with(NOTHING_CLEARLY);
        if self.status == Status::Grounded && (self.confidence < least || has_other_names) {
            self.status = Status::Uncertain;
            let says_so = ["I cannot", "I do not", "I know where", NOTHING_CLEARLY];
            if !says_so.iter().any(|start| self.text.starts_with(start)) {
                self.text = format!("I am not sure. {}", self.text);
            }
        }
    }
}

/// Start of the sentence about an object that has other names.
pub(super) const NOTHING_CLEARLY: &str = "I found nothing that is clearly";
/// Start of the sentence about an object that may not be there.
pub(super) const CANNOT_TELL_WHETHER: &str = "I cannot tell whether there is";

/// Returns dominant color and best name, such as "red sofa", whatever the question says.
pub(super) fn describe_instance(instance: &Instance) -> String {
    let says_color = |name: &String| {
        name.split_whitespace()
            .any(|word| ColorName::ALL.iter().any(|color| color.as_str() == word))
    };
    if let Some(name) = instance.given_name.as_ref().filter(|name| says_color(name)) {
        return name.clone();
    }
    match instance.colors.dominant().first() {
        Some((color, _)) => format!("{} {}", color.as_str(), instance.label()),
        None => instance.label().to_owned(),
    }
}

fn summarize(parsed: &ParsedQuery) -> ParsedQuerySummary {
    let target = &parsed.target;
    let traits = target.traits.iter().map(|s| s.as_str().to_owned());
    let colors = target.colors.iter().map(|c| c.as_str().to_owned());
    let other_than = target.other_than.iter().map(|c| format!("not {}", c.as_str()));
    let excluded = target.excluded.iter().map(|word| format!("not {word}"));
    let with = target.with.iter().map(|w| {
        let count = w.phrase.count.map_or_else(String::new, |n| format!("{n} "));
        format!("{} {count}{}", if w.absent { "without" } else { "with" }, w.phrase.text())
    });
    let uses = target.uses.iter().map(|spoken| format!("to {spoken}"));
    let superlative = target.superlative.map(|s| superlative_words(&s));
    let mut summary = ParsedQuerySummary {
        target: if target.meaning() == Meaning::Anything && target.head.is_empty() {
            "thing".into()
        } else {
            target.head.clone()
        },
        attributes: traits
            .chain(colors)
            .chain(other_than)
            .chain(excluded)
            .chain(with)
            .chain(uses)
            .chain(superlative)
            .collect(),
        anchors: Vec::new(),
        relations: Vec::new(),
        not_understood: parsed.not_understood.iter().chain(&parsed.passed_over).cloned().collect(),
    };
    collect_anchors(target, &mut summary);
    let looked_at = parsed.viewpoint.iter().map(|v| &v.anchor);
    let stands_at = parsed
        .standpoint
        .iter()
        .filter(|stands_at| parsed.viewpoint.as_ref().is_none_or(|v| v.anchor != **stands_at));
    summary.anchors.extend(looked_at.chain(stands_at).map(Phrase::text));
    summary
}

/// Adds the relations and anchors of a phrase, then those of the phrases within it.
fn collect_anchors(phrase: &Phrase, summary: &mut ParsedQuerySummary) {
    for relation in &phrase.relations {
        summary.relations.push(if relation.negated {
            format!("not {}", relation.text)
        } else {
            relation.text.clone()
        });
        summary.anchors.extend(relation.anchors.iter().map(Phrase::text));
    }
    let within = phrase
        .relations
        .iter()
        .flat_map(|r| &r.anchors)
        .chain(phrase.with.iter().map(|w| &w.phrase));
    within.for_each(|inner| collect_anchors(inner, summary));
}

/// Returns a superlative in words: "tallest", "leftmost, number 2".
pub(super) fn superlative_words(superlative: &Superlative) -> String {
    match superlative.rank {
        0 | 1 => superlative.measure.as_str().to_owned(),
        rank => format!("{}, number {rank}", superlative.measure.as_str()),
    }
}
