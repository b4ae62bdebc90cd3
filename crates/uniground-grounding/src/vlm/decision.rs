//! What came of a conversation, and the answer it makes.

use super::consistency::matches;
use super::reply::{Choice, Field, Reply, SeenAt};
use super::{PromptCandidate, PromptContext};
use crate::answer::{alternative, target};
use crate::{Alternative, Grounding, NoMatchReason, Seen, Status};
use std::collections::BTreeMap;
use uniground_geometry::scene::{Instance, InstanceId};
use uniground_models::chat::AskError;

/// What a model has decided.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Outcome {
    /// The model chose this candidate.
    Chosen(InstanceId),
    /// The model says that nothing fits.
    Nothing,
    /// The model sees the object, but not among what it may choose; the decision's `seen` says
    /// where, if it told.
    NotListed,
    /// The model never chose a candidate, however often it was asked; what it meant is taken for
    /// this one (Algorithm 1, line 13).
    Projected(InstanceId),
    /// The model never said anything that can be used: the geometry's answer stands.
    #[default]
    Unknown,
}

/// A decision and how it came about.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Decision {
    /// What was decided, and by whom.
    pub outcome: Outcome,
    /// The last reply that could be used, or the last one.
    pub reply: Reply,
    /// What each candidate is called, by id; later names replace earlier ones.
    pub names: BTreeMap<u32, String>,
    /// Names given without regard to the question, to be kept.
    pub new_names: BTreeMap<u32, String>,
    /// Where the object is seen that is not listed.
    pub seen: Option<Seen>,
    /// What was wrong on the way, in order.
    pub corrections: Vec<String>,
}

/// What a model's word weighs beside the geometry's in the confidence: when it held together at
/// once, and after a correction.
const SURE: f32 = 0.7;
const CORRECTED: f32 = 0.4;
/// Boxes that overlap by this much are the same thing.
const SAME_THING: f32 = 0.25;

impl Decision {
    /// Takes a reply in, if it says more than what is known.
    pub(super) fn take(&mut self, reply: Reply, context: &PromptContext, sent: &[String]) {
        let outcome = match reply.predicted {
            Choice::Id(id) if context.is_candidate(id) => Outcome::Chosen(InstanceId(id)),
            Choice::Nothing => Outcome::Nothing,
            Choice::NotListed => Outcome::NotListed,
            Choice::Id(_) | Choice::Contradiction(..) | Choice::Missing => Outcome::Unknown,
        };
        if outcome != Outcome::Unknown || self.outcome == Outcome::Unknown {
            let seen = |at: &SeenAt| {
                Some(Seen {
                    picture: sent.get(at.image - 1)?.clone(),
                    at: at.at,
                    name: at.name.clone(),
                })
            };
            self.seen = reply.seen_at.as_ref().and_then(seen);
            (self.outcome, self.reply) = (outcome, reply);
        }
    }

    /// What was seen, but not listed, is this instance of the scene.
    #[must_use]
    pub fn found(self, id: InstanceId, why: String) -> Self {
        Self { outcome: Outcome::Chosen(id), seen: None, ..self.noted(why) }
    }

    /// With one more thing that happened on the way.
    #[must_use]
    pub fn noted(mut self, why: String) -> Self {
        self.corrections.push(why);
        self
    }

    /// What was decided after this, and what was wrong on the way to both.
    #[must_use]
    pub fn replaced_by(self, mut later: Self) -> Self {
        later.corrections.splice(0..0, self.corrections);
        later.new_names = self.new_names;
        later
    }

    /// A further call failed: whether what was said before is enough.
    pub(super) fn settle(&mut self, error: &AskError) -> bool {
        let enough = self.outcome != Outcome::Unknown;
        if enough {
            self.corrections.push(format!("asking again failed: {error}"));
        }
        enough
    }

    /// Projects a choice outside of the candidates onto them (paper: PROJECTTOCANDIDATES): the same
    /// thing under another id, or the only candidate with a fitting name. Where there is
    /// neither, the geometry's own answer stands, and is not passed off as the model's.
    pub(super) fn project(&mut self, context: &PromptContext) {
        if self.outcome != Outcome::Unknown {
            return;
        }
        let named = || {
            let fits = |c: &&PromptCandidate| {
                self.names.get(&c.id.0).is_some_and(|name| matches(name, &context.target))
            };
            let mut fitting = context.candidates.iter().filter(fits);
            fitting.next().filter(|_| fitting.next().is_none())
        };
        let same_thing = || {
            let Choice::Id(id) = self.reply.predicted else { return None };
            let aabb = context.boxes.get((id as usize).checked_sub(1)?)?;
            let overlap = |c: &PromptCandidate| c.aabb.iou(aabb);
            let best = context.candidates.iter().max_by(|a, b| overlap(a).total_cmp(&overlap(b)));
            best.filter(|c| overlap(c) >= SAME_THING)
        };
        let found = same_thing().map(|c| (c.id, "has the box of what the model chose"));
        let found =
            found.or_else(|| named().map(|c| (c.id, "is the only candidate with a fitting name")));
        let what_then = match found {
            Some((id, why)) => {
                self.outcome = Outcome::Projected(id);
                format!("ID {id} {why}")
            }
            None => "the built-in reasoner answered".into(),
        };
        self.corrections.push(format!("the model never chose a candidate; {what_then}"));
        // The reply was about something else.
        self.reply = Reply::default();
    }

    /// Makes the decision the answer: fields, boxes, status, confidence.
    pub fn apply(
        &self,
        grounding: &mut Grounding,
        context: &PromptContext,
        instances: &[Instance],
    ) {
        let answer = &mut grounding.answer;
        for (id, name) in &self.names {
            if let Some(known) = answer.candidate_names.get_mut(id) {
                known.clone_from(name);
            }
        }
        for candidate in &mut grounding.candidates {
            if let Some(name) = answer.candidate_names.get(&candidate.id.0) {
                candidate.name.clone_from(name);
            }
        }
        let chosen = match self.outcome {
            Outcome::Chosen(id) | Outcome::Projected(id) => instances.get(id.0 as usize - 1),
            Outcome::Nothing | Outcome::NotListed => None,
            Outcome::Unknown => return,
        };
        let projected = matches!(self.outcome, Outcome::Projected(_));
        let told = |field: Field| !projected && !self.reply.not_read.contains(&field.title());
        let known = |id: u32| instances.get((id as usize).wrapping_sub(1)).map(|i| i.id);
        if told(Field::AnchorId) {
            // A thing is no anchor of itself.
            answer.anchor_id = self
                .reply
                .anchor_id
                .and_then(known)
                .filter(|id| chosen.is_none_or(|i| i.id != *id));
        }
        if told(Field::RelationUsed) {
            answer.relation_used.clone_from(&self.reply.relation_used);
        }
        answer.explanation = match (&self.reply.explanation, self.corrections.last()) {
            (_, Some(why)) if projected => why.clone(),
            (Some(explanation), _) => explanation.clone(),
            (None, _) => "The model gave no explanation.".into(),
        };
        let weight = match (projected, self.corrections.is_empty()) {
            (true, _) => 0.0,
            (false, true) => SURE,
            (false, false) => CORRECTED,
        };
        let belief = |id: InstanceId| {
            context.candidates.iter().find(|c| c.id == id).map_or(0.0, |c| c.belief)
        };
        answer.predicted_id = chosen.map(|i| i.id);
        answer.target_name_matches = chosen.and(self.reply.target_name_matches);
        let reason = if self.outcome == Outcome::NotListed {
            NoMatchReason::NotListed
        } else {
            NoMatchReason::NoneSeen
        };
        grounding.no_match_reason = chosen.is_none().then_some(reason);
        grounding.seen = self.seen.clone().filter(|_| self.outcome == Outcome::NotListed);
        grounding.status = if chosen.is_some() { Status::Grounded } else { Status::NoMatch };
        (grounding.aabb, grounding.oriented_box) =
            (chosen.map(|i| i.aabb), chosen.map(|i| i.oriented_box));
        grounding.confidence = match chosen {
            Some(instance) => weight + (1.0 - weight) * belief(instance.id),
            None => weight.max(1.0 - grounding.candidates.first().map_or(0.0, |best| best.score)),
        };
        // Several are told as they were found; the model chose the first of them.
        let own = chosen.map(|instance| target(instance, grounding.confidence));
        grounding.targets.retain(|target| {
            grounding.count.is_some() && own.as_ref().is_some_and(|own| own.id != target.id)
        });
        grounding.targets.splice(0..0, own);
        grounding.count = grounding.count.map(|_| grounding.targets.len() as u32);
        let meant = |id: InstanceId| grounding.targets.iter().any(|target| target.id == id);
        let rivals = grounding.candidates.iter().filter(|c| chosen.is_some() && !meant(c.id));
        let mut rivals: Vec<Alternative> = rivals
            .map(|c| {
                alternative(
                    &instances[c.id.0 as usize - 1],
                    c.name.clone(),
                    (1.0 - weight) * belief(c.id),
                )
            })
            .collect();
        rivals.sort_by(|a, b| b.confidence.total_cmp(&a.confidence).then(a.id.cmp(&b.id)));
        rivals.retain(|r| r.confidence > 0.0);
        grounding.alternatives = rivals;
    }
}
