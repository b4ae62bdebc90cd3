//! What came of a conversation, and the answer it makes.

use super::Brief;
use super::reply::{Choice, Reply};
use crate::grounding::answer::{Alternative, Grounding, Status};
use crate::models::chat::AskError;
use crate::scene::{Instance, InstanceId};
use std::collections::BTreeMap;

/// What a model has decided.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Outcome {
    Chosen(InstanceId),
    /// The model says that nothing fits.
    Nothing,
    /// The model chose nothing that is there, however often it was asked: the geometry's best took its place.
    Projected(InstanceId),
    #[default]
    None,
}

/// A decision and how it came about.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Decision {
    pub outcome: Outcome,
    /// The last reply that could be used, or the last one.
    pub reply: Reply,
    /// What each candidate is called, by whoever said it last.
    pub names: BTreeMap<u32, String>,
    /// Names given without regard to the question, to be kept.
    pub new_names: BTreeMap<u32, String>,
    /// What was wrong on the way, in order.
    pub corrections: Vec<String>,
}

/// What a model's word weighs beside the geometry's in the confidence: when it held together at once, after a correction, and when the
/// geometry had to choose.
const SURE: f32 = 0.7;
const CORRECTED: f32 = 0.4;
/// Boxes that overlap by this much are the same thing.
const SAME_THING: f32 = 0.25;

impl Decision {
    /// Takes a reply in, if it says more than what is known.
    pub(super) fn take(&mut self, reply: Reply, brief: &Brief) {
        let outcome = match reply.predicted {
            Choice::Id(id) if brief.is_candidate(id) => Outcome::Chosen(InstanceId(id)),
            Choice::Nothing => Outcome::Nothing,
            Choice::Id(_) | Choice::Contradiction(..) | Choice::Missing => Outcome::None,
        };
        if outcome != Outcome::None || self.outcome == Outcome::None {
            (self.outcome, self.reply) = (outcome, reply);
        }
    }

    /// A further call failed: whether what was said before is enough.
    pub(super) fn settle(&mut self, error: &AskError) -> bool {
        let enough = self.outcome != Outcome::None;
        if enough {
            self.corrections.push(format!("asking again failed: {error}"));
        }
        enough
    }

    /// Projects a choice outside of the candidates onto them (paper: PROJECTTOCANDIDATES): the same thing under another id, the only
    /// candidate with a fitting name, or else the geometry's best.
    pub(super) fn project(&mut self, brief: &Brief) {
        if self.outcome != Outcome::None {
            return;
        }
        let named = || {
            let mut fitting = brief
                .candidates
                .iter()
                .filter(|c| self.names.get(&c.id.0).is_some_and(|n| super::consistency::matches(n, &brief.target)));
            fitting.next().filter(|_| fitting.next().is_none())
        };
        let same_thing = || {
            let Choice::Id(id) = self.reply.predicted else { return None };
            let aabb = brief.boxes.get((id as usize).checked_sub(1)?)?;
            let overlap = |c: &super::BriefCandidate| c.aabb.iou(aabb);
            brief
                .candidates
                .iter()
                .max_by(|a, b| overlap(a).total_cmp(&overlap(b)))
                .filter(|c| overlap(c) >= SAME_THING)
        };
        let found = [
            same_thing().map(|c| (c.id, "has the box of what the model chose")),
            named().map(|c| (c.id, "is the only candidate with a fitting name")),
            brief.candidates.first().map(|c| (c.id, "is what the geometry takes for it")),
        ];
        if let Some((id, why)) = found.into_iter().flatten().next() {
            self.outcome = Outcome::Projected(id);
            self.corrections.push(format!("the model never chose a candidate; ID {id} {why}"));
        }
    }

    /// Makes the decision the answer: fields, boxes, status, confidence.
    pub fn apply(&self, grounding: &mut Grounding, brief: &Brief, instances: &[Instance]) {
        let answer = &mut grounding.answer;
        for (id, name) in self.names.iter().filter(|(id, _)| answer.candidate_names.contains_key(id)).collect::<Vec<_>>() {
            answer.candidate_names.insert(*id, name.clone());
        }
        let known = |id: &u32| instances.get((*id as usize).wrapping_sub(1)).map(|i| i.id);
        answer.anchor_id = self
            .reply
            .anchor_id
            .as_ref()
            .and_then(known)
            .or(answer.anchor_id.filter(|_| self.reply.anchor_id.is_none()));
        answer.relation_used = self.reply.relation_used.clone().or(answer.relation_used.take());
        let chosen = match self.outcome {
            Outcome::Chosen(id) | Outcome::Projected(id) => instances.get(id.0 as usize - 1),
            Outcome::Nothing | Outcome::None => None,
        };
        let belief = |id: InstanceId| brief.candidates.iter().find(|c| c.id == id).map_or(0.0, |c| c.belief);
        let weight = match (self.outcome, self.corrections.is_empty()) {
            (Outcome::Projected(_) | Outcome::None, _) => 0.0,
            (_, true) => SURE,
            (_, false) => CORRECTED,
        };
        match self.outcome {
            // The built-in explanation stays: it is the geometry that chose.
            Outcome::Projected(_) | Outcome::None => {}
            _ => answer.explanation = self.reply.explanation.clone().unwrap_or_else(|| "The model gave no explanation.".into()),
        }
        answer.predicted_id = chosen.map(|i| i.id);
        answer.target_name_matches = chosen.and(self.reply.target_name_matches.or(answer.target_name_matches));
        grounding.status = if chosen.is_some() { Status::Grounded } else { Status::NoMatch };
        (grounding.aabb, grounding.oriented_box) = (chosen.map(|i| i.aabb), chosen.map(|i| i.oriented_box));
        grounding.confidence = match chosen {
            Some(instance) => weight + (1.0 - weight) * belief(instance.id),
            None => weight.max(1.0 - grounding.candidates.first().map_or(0.0, |best| best.score)),
        };
        let rivals = grounding.candidates.iter().filter(|c| chosen.is_some_and(|i| i.id != c.id));
        let mut rivals: Vec<Alternative> = rivals
            .map(|c| Alternative { id: c.id, confidence: (1.0 - weight) * belief(c.id), aabb: c.aabb })
            .collect();
        rivals.sort_by(|a, b| b.confidence.total_cmp(&a.confidence).then(a.id.cmp(&b.id)));
        rivals.retain(|r| r.confidence > 0.0);
        grounding.alternatives = rivals;
    }
}
