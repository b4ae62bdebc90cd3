//! The result of a conversation with a model, and how it changes the answer.

use super::consistency::matches;
use super::reply::{Choice, Field, Reply, SeenAt};
use super::{PointForm, PromptCandidate, PromptContext, SentPictures, Sighting};
use crate::answer::{to_alternative, to_target};
use crate::{Alternative, GivenName, Grounding, NoMatchReason, Status};
use std::collections::BTreeMap;
use uniground_geometry::scene::{Instance, InstanceId};
use uniground_models::chat::AskError;

/// The decision of a model.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Outcome {
    /// The model chose this candidate.
    Chosen(InstanceId),
    /// The model says that nothing fits.
    Nothing,
    /// The model sees the object, but not among the candidates. The decision's `seen` says where,
    /// if the model said so.
    NotListed,
    /// The model never chose a candidate, however often it was asked. Its choice was projected to
    /// this candidate (Algorithm 1, line 13).
    Projected(InstanceId),
    /// The model never gave a usable reply: the geometry's answer stands.
    #[default]
    Unknown,
}

/// A decision and its record.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Decision {
    /// The outcome, and whether the model or the projection chose it.
    pub outcome: Outcome,
    /// The last usable reply, or the last one.
    pub reply: Reply,
    /// The name of each candidate, by id; later names replace earlier ones.
    pub names: BTreeMap<u32, String>,
    /// Names given independently of the question, to be stored.
    pub new_names: BTreeMap<u32, String>,
    /// Where the model sees the object that is not listed, or that the chosen candidate does not
    /// fit.
    pub seen: Option<Sighting>,
    /// The candidate that the model chose, if a better fitting instance took its place.
    pub replaced: Option<InstanceId>,
    /// Problems on the way, in order.
    pub corrections: Vec<String>,
}

/// Weight of the model's decision against the geometry's in the confidence: when its first reply
/// was consistent, and after a correction.
const SURE: f32 = 0.7;
const CORRECTED: f32 = 0.4;
/// Maximum confidence in an object that differs from what the question says.
const DIFFERENT: f32 = 0.5;
/// Boxes with at least this overlap are the same object.
const SAME_THING: f32 = 0.25;

impl Decision {
    /// Applies a reply, unless it is unusable and an earlier one was usable.
    pub(super) fn take(
        &mut self,
        reply: Reply,
        context: &PromptContext,
        sent: &SentPictures,
        points: PointForm,
    ) {
        let outcome = match reply.predicted {
            Choice::Id(id) if context.is_candidate(id) => Outcome::Chosen(InstanceId(id)),
            Choice::Nothing => Outcome::Nothing,
            Choice::NotListed => Outcome::NotListed,
            Choice::Id(_) | Choice::Contradiction(..) | Choice::Missing => Outcome::Unknown,
        };
        if outcome != Outcome::Unknown || self.outcome == Outcome::Unknown {
            let seen = |seen: &SeenAt| sent.sighting(seen, points);
            self.seen = reply.seen_at.as_ref().and_then(seen);
            (self.outcome, self.reply) = (outcome, reply);
        }
    }

    /// Sets an instance of the scene as the choice: the object that was seen but not listed.
    #[must_use]
    pub fn found(self, id: InstanceId, why: String) -> Self {
        Self { outcome: Outcome::Chosen(id), seen: None, ..self.with_note(why) }
    }

    /// Sets an instance that fits the object better than the chosen candidate. It gets the
    /// candidate's name.
    #[must_use]
    pub fn with_replaced(mut self, chosen: InstanceId, better: InstanceId) -> Self {
        if let Some(name) = self.names.get(&chosen.0).cloned() {
            self.names.entry(better.0).or_insert(name);
        }
        Self { outcome: Outcome::Chosen(better), replaced: Some(chosen), ..self }
    }

    /// Returns the decision of a model that sees the geometry's choice in photographs, and nothing
    /// else that may be meant. What the geometry says about anchor and relation stays.
    #[must_use]
    pub fn confirmed(id: InstanceId, explanation: &str) -> Self {
        let reply = Reply {
            predicted: Choice::Id(id.0),
            explanation: Some(
                format!("The model sees no other in the photographs. {explanation}").trim().into(),
            ),
            target_name_matches: Some(true),
            not_read: vec![Field::AnchorId.title(), Field::RelationUsed.title()],
            ..Reply::default()
        };
        Self { outcome: Outcome::Chosen(id), reply, ..Self::default() }
    }

    /// Adds a note on what happened.
    #[must_use]
    pub fn with_note(mut self, why: String) -> Self {
        self.corrections.push(why);
        self
    }

    /// Returns the later decision, with the notes on both.
    #[must_use]
    pub fn merged_with_later(self, mut later: Self) -> Self {
        later.corrections.splice(0..0, self.corrections);
        later.new_names = self.new_names;
        later
    }

    /// Handles the failure of a further call. Returns whether the earlier replies are enough.
    pub(super) fn settle(&mut self, error: &AskError) -> bool {
        let enough = self.outcome != Outcome::Unknown;
        if enough {
            self.corrections.push(format!("asking again failed: {error}"));
        }
        enough
    }

    /// Projects a choice outside of the candidates onto them (paper: PROJECTTOCANDIDATES): the same
    /// object under another id, or the only candidate with a fitting name. Where there is neither,
    /// the geometry's own answer stands, and is not attributed to the model.
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
        // The reply was about another object.
        self.reply = Reply::default();
    }

    /// Writes the decision into the answer: fields, boxes, status, confidence.
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
            // An instance is not its own anchor.
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
        grounding.differs = self.reply.differs.clone().filter(|_| chosen.is_some());
        if let Some(differs) = &grounding.differs {
            answer.explanation = format!("{} Difference: {differs}.", answer.explanation);
        }
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
        let seen = self.seen.as_ref().filter(|_| self.outcome == Outcome::NotListed);
        grounding.seen = seen.map(|seen| seen.shown.clone());
        grounding.status = if chosen.is_some() { Status::Grounded } else { Status::NoMatch };
        (grounding.aabb, grounding.oriented_box) =
            (chosen.map(|i| i.aabb), chosen.map(|i| i.oriented_box));
        grounding.confidence = match chosen {
            Some(instance) => weight + (1.0 - weight) * belief(instance.id),
            None => weight.max(1.0 - grounding.candidates.first().map_or(0.0, |best| best.score)),
        };
        if grounding.differs.is_some() {
            grounding.confidence = grounding.confidence.min(DIFFERENT);
        }
        // Several targets stay as they were found; the model chose the first of them. Where its name
        // for that is the question's, those that it calls something else are none.
        let is_called = |id: InstanceId| {
            let name = self.names.get(&id.0).filter(|name| GivenName::read(name).is_some())?;
            Some(matches(name, &context.target))
        };
        let chosen_is_called_so = chosen.and_then(|i| is_called(i.id)) == Some(true);
        let is_other = |id: InstanceId| chosen_is_called_so && is_called(id) == Some(false);
        let own = chosen.map(|instance| to_target(instance, grounding.confidence));
        grounding.targets.retain(|target| {
            grounding.count.is_some()
                && self.replaced != Some(target.id)
                && own.as_ref().is_some_and(|own| own.id != target.id)
                && !is_other(target.id)
        });
        grounding.targets.splice(0..0, own);
        grounding.count = grounding.count.map(|_| grounding.targets.len() as u32);
        let meant = |id: InstanceId| grounding.targets.iter().any(|target| target.id == id);
        let rivals = grounding.candidates.iter().filter(|c| chosen.is_some() && !meant(c.id));
        let mut rivals: Vec<Alternative> = rivals
            .map(|c| {
                to_alternative(
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::answer::to_candidate;
    use crate::direction::DirectionConvention;
    use crate::vlm::reply;
    use crate::{ParsedQuerySummary, Seen, SixFields, Timings};
    use uniground_geometry::boxes::Aabb;
    use uniground_geometry::scene::Support;
    use uniground_geometry::{Point3, Vector3};
    use uniground_testing::thing;

    fn cube_at(x: f32) -> Aabb {
        Aabb { center: Point3::new(x, 0.0, 0.5), size: Vector3::repeat(1.0) }
    }

    fn summary() -> ParsedQuerySummary {
        ParsedQuerySummary {
            target: "chair".into(),
            attributes: Vec::new(),
            anchors: Vec::new(),
            relations: Vec::new(),
            not_understood: Vec::new(),
        }
    }

    /// Returns a context of cubes of 1 m, 10 m apart, with ids from 1 and these beliefs.
    fn context(beliefs: &[f32]) -> PromptContext {
        let candidates = beliefs.iter().zip(1..).map(|(belief, id)| PromptCandidate {
            id: InstanceId(id),
            score: 0.0,
            belief: *belief,
            aabb: cube_at(id as f32 * 10.0),
        });
        PromptContext {
            query: "the chair".into(),
            summary: summary(),
            target: uniground_language::parse("the chair").target,
            candidates: candidates.collect(),
            anchors: Vec::new(),
            shown_anchors: Vec::new(),
            boxes: (1..=9).map(|id| cube_at(id as f32 * 10.0)).collect(),
            oriented_boxes: Vec::new(),
            mentions_wall: false,
            directions: DirectionConvention::Paper.into(),
            seen_by: String::new(),
        }
    }

    fn instances() -> Vec<Instance> {
        (1..=9)
            .map(|id| thing(id, [id as f32 * 10.0, 0.0], [1.0; 3], 0.0, Support::Floor, [90; 3]))
            .collect()
    }

    /// Returns the geometric answer with this many candidates, the first with this score.
    fn grounding(candidates: u32, best_score: f32) -> Grounding {
        let of = |id: u32| to_candidate(&instances()[id as usize - 1], id, best_score / id as f32);
        Grounding {
            kind: crate::AnswerKind::Box,
            text: String::new(),
            value: None,
            query: "the chair".into(),
            status: Status::Ambiguous,
            no_match_reason: None,
            seen: None,
            differs: None,
            coverage: None,
            answer: SixFields {
                predicted_id: None,
                explanation: "by geometry".into(),
                candidate_names: (1..=candidates).map(|id| (id, "grey object".into())).collect(),
                target_name_matches: None,
                anchor_id: Some(InstanceId(9)),
                relation_used: Some("under".into()),
            },
            aabb: None,
            oriented_box: None,
            confidence: 0.123,
            candidates: (1..=candidates).map(of).collect(),
            alternatives: Vec::new(),
            targets: Vec::new(),
            count: None,
            parsed_query: summary(),
            direction_convention: "paper".into(),
            timings_ms: Timings::default(),
        }
    }

    fn sighting(seen: Seen) -> Sighting {
        Sighting { shown: seen.clone(), original: Some(seen) }
    }

    fn reply_with(predicted: Choice) -> Reply {
        Reply { predicted, ..Reply::default() }
    }

    fn chosen(id: u32) -> Decision {
        let reply = reply_with(Choice::Id(id));
        Decision { outcome: Outcome::Chosen(InstanceId(id)), reply, ..Decision::default() }
    }

    fn applied(decision: &Decision, beliefs: &[f32], mut grounding: Grounding) -> Grounding {
        decision.apply(&mut grounding, &context(beliefs), &instances());
        grounding
    }

    #[track_caller]
    fn assert_close(found: f32, by_hand: f32) {
        assert!((found - by_hand).abs() < 1e-5, "{found}, expected {by_hand}");
    }

    #[test]
    fn reply_decides_with_a_candidate_none_or_not_listed() {
        let context = context(&[0.5, 0.3]);
        for (said_first, expected) in [
            (Choice::Id(2), Outcome::Chosen(InstanceId(2))),
            (Choice::Id(3), Outcome::Unknown),
            (Choice::Nothing, Outcome::Nothing),
            (Choice::NotListed, Outcome::NotListed),
            (Choice::Contradiction(1, 2), Outcome::Unknown),
            (Choice::Missing, Outcome::Unknown),
        ] {
            let mut decision = Decision::default();
            decision.take(
                reply_with(said_first),
                &context,
                &SentPictures::default(),
                PointForm::default(),
            );
            assert_eq!(decision.outcome, expected, "{said_first:?}");
            assert_eq!(decision.reply.predicted, said_first);
        }
    }

    #[test]
    fn unusable_reply_does_not_replace_a_usable_one() {
        let context = context(&[0.5, 0.3]);
        let after = |replies: &[Choice]| {
            let mut decision = Decision::default();
            replies.iter().for_each(|choice| {
                decision.take(
                    reply_with(*choice),
                    &context,
                    &SentPictures::default(),
                    PointForm::default(),
                );
            });
            (decision.outcome, decision.reply.predicted)
        };
        let (one, two) = (Outcome::Chosen(InstanceId(1)), Outcome::Chosen(InstanceId(2)));
        assert_eq!(after(&[Choice::Id(1), Choice::Missing]), (one, Choice::Id(1)));
        assert_eq!(after(&[Choice::Id(1), Choice::Id(2)]), (two, Choice::Id(2)));
        assert_eq!(after(&[Choice::Missing, Choice::Id(2)]), (two, Choice::Id(2)));
        assert_eq!(after(&[Choice::Missing, Choice::Id(7)]), (Outcome::Unknown, Choice::Id(7)));
        assert_eq!(after(&[Choice::Id(1), Choice::Nothing]), (Outcome::Nothing, Choice::Nothing));
    }

    #[test]
    fn picture_numbers_start_at_one() {
        let context = context(&[0.5]);
        let sent = ["global", "candidate-1"].map(super::super::tests::picture_named);
        let sent = SentPictures::of(sent.to_vec());
        let seen = |image| {
            let seen_at =
                Some(reply::SeenAt { image, at: [250.0, 500.0], area: None, name: "clock".into() });
            let mut decision = Decision::default();
            decision.take(
                Reply { seen_at, ..reply_with(Choice::NotListed) },
                &context,
                &sent,
                PointForm::Thousandths,
            );
            decision.seen.map(|seen| seen.shown)
        };
        let at = |picture: &str| {
            Some(Seen {
                picture: picture.into(),
                at: [0.25, 0.5],
                area: None,
                name: "clock".into(),
            })
        };
        assert_eq!([1, 2, 3].map(seen), [at("global"), at("candidate-1"), None]);
    }

    #[test]
    fn corrections_are_kept_in_order() {
        let names = BTreeMap::from([(1, "chair".to_owned())]);
        let seen = Some(sighting(Seen {
            picture: "global".into(),
            at: [0.0; 2],
            area: None,
            name: "chair".into(),
        }));
        let first = Decision {
            outcome: Outcome::NotListed,
            new_names: names.clone(),
            seen,
            corrections: vec!["one".into()],
            ..Decision::default()
        };
        let found = first.clone().found(InstanceId(4), "two".into());
        assert_eq!((found.outcome, found.seen), (Outcome::Chosen(InstanceId(4)), None));
        assert_eq!(found.corrections, ["one", "two"]);
        assert_eq!(found.new_names, names);
        let noted = first.with_note("two".into());
        assert_eq!(
            (noted.outcome, &noted.corrections[..]),
            (Outcome::NotListed, &["one".to_owned(), "two".into()][..])
        );
        let later = Decision {
            new_names: BTreeMap::from([(2, "lamp".to_owned())]),
            ..chosen(7).with_note("three".into())
        };
        let both = noted.merged_with_later(later);
        assert_eq!(both.outcome, Outcome::Chosen(InstanceId(7)));
        assert_eq!(both.corrections, ["one", "two", "three"]);
        assert_eq!(both.new_names, names, "names of the first call are kept");
    }

    #[test]
    fn better_instance_takes_the_place_and_the_name_of_the_chosen_one() {
        let names = BTreeMap::from([(1, "red chair".to_owned()), (2, "lamp".into())]);
        let decision = Decision { names, ..chosen(1) }.with_replaced(InstanceId(1), InstanceId(5));
        let mut context = context(&[0.5, 0.3]);
        context.replace_candidate(InstanceId(1), InstanceId(5), &instances());
        let mut before = grounding(2, 0.8);
        let target = |id: u32| to_target(&instances()[id as usize - 1], 0.5);
        (before.count, before.targets) = (Some(2), vec![target(1), target(2)]);
        before.add_shown(&context, &instances());
        decision.apply(&mut before, &context, &instances());
        assert_eq!(before.answer.predicted_id, Some(InstanceId(5)));
        assert_eq!(before.aabb, Some(instances()[4].aabb));
        assert_eq!(before.answer.candidate_names[&5], "red chair");
        let targets: Vec<u32> = before.targets.iter().map(|target| target.id.0).collect();
        assert_eq!(targets, [5], "the lamp is no chair");
        assert!(before.alternatives.iter().all(|other| other.id != InstanceId(1)));
        assert_close(before.confidence, SURE + (1.0 - SURE) * 0.5);
    }

    #[test]
    fn failed_call_keeps_an_earlier_decision() {
        let error = AskError::CallsUsedUp { most: 3 };
        let mut nothing_said = Decision::default();
        assert!(!nothing_said.settle(&error));
        assert_eq!(nothing_said.corrections, [""; 0]);
        let mut decided = chosen(1);
        assert!(decided.settle(&error));
        assert_eq!(
            decided.corrections,
            ["asking again failed: the limit of 3 model calls per question is reached"]
        );
    }

    #[test]
    fn choice_is_projected_to_the_candidate_with_the_same_box() {
        // Two cubes of 1 m, d apart, share (1 - d) / (1 + d): a quarter at 0.6 m.
        let projected = |id: u32, apart: &[f32]| {
            let mut context = context(&vec![0.1; apart.len()]);
            for (candidate, apart) in context.candidates.iter_mut().zip(apart) {
                candidate.aabb = cube_at(70.0 + apart);
            }
            let mut decision =
                Decision { reply: reply_with(Choice::Id(id)), ..Decision::default() };
            decision.project(&context);
            assert_eq!(decision.reply, Reply::default(), "the reply was about another object");
            (decision.outcome, decision.corrections.join("; "))
        };
        let told = |what: &str| format!("the model never chose a candidate; {what}");
        let nothing = (Outcome::Unknown, told("the built-in reasoner answered"));
        let has_it = |id: u32| {
            let why = format!("ID {id} has the box of what the model chose");
            (Outcome::Projected(InstanceId(id)), told(&why))
        };
        assert_eq!(projected(7, &[0.59]), has_it(1));
        assert_eq!(projected(7, &[0.61]), nothing);
        assert_eq!(projected(7, &[0.5, 0.1, 0.3]), has_it(2));
        assert_eq!(projected(6, &[0.0]), nothing);
        // Ids of no instance.
        assert_eq!((projected(0, &[0.0]), projected(99, &[0.0])), (nothing.clone(), nothing));
    }

    #[test]
    fn choice_is_projected_to_the_only_candidate_with_a_matching_name() {
        let projected = |names: &[(u32, &str)], predicted| {
            let names = names.iter().map(|(id, name)| (*id, (*name).to_owned())).collect();
            let mut decision =
                Decision { names, reply: reply_with(predicted), ..Decision::default() };
            decision.project(&context(&[0.5, 0.3, 0.2]));
            (decision.outcome, decision.corrections)
        };
        let (outcome, why) =
            projected(&[(1, "lamp"), (2, "red chair"), (8, "chair")], Choice::Missing);
        assert_eq!(outcome, Outcome::Projected(InstanceId(2)));
        let told =
            "the model never chose a candidate; ID 2 is the only candidate with a fitting name";
        assert_eq!(why, [told]);
        let two = [(1, "chair"), (2, "red chair")];
        assert_eq!(projected(&two, Choice::Missing).0, Outcome::Unknown);
        assert_eq!(projected(&[(1, "lamp")], Choice::Missing).0, Outcome::Unknown);
        // The box takes precedence: ID 3 is the third candidate.
        let outcome = projected(&[(2, "chair")], Choice::Id(3)).0;
        assert_eq!(outcome, Outcome::Projected(InstanceId(3)));
    }

    #[test]
    fn decided_choices_are_not_projected() {
        for outcome in [Outcome::Chosen(InstanceId(1)), Outcome::Nothing, Outcome::NotListed] {
            let decision =
                Decision { outcome, reply: reply_with(Choice::Id(2)), ..Decision::default() };
            let mut after = decision.clone();
            after.project(&context(&[0.5, 0.3]));
            assert_eq!(after, decision);
        }
    }

    #[test]
    fn confidence_combines_the_model_weight_and_the_geometric_belief() {
        let beliefs = [0.5, 0.3];
        let of = |decision: &Decision| applied(decision, &beliefs, grounding(2, 0.9)).confidence;
        assert_close(of(&chosen(1)), 0.85); // 0.7 + 0.3 · 0.5
        assert_close(of(&chosen(2)), 0.79); // 0.7 + 0.3 · 0.3
        assert_close(of(&chosen(1).with_note("it was asked again".into())), 0.7); // 0.4 + 0.6 · 0.5
        let projected = Decision {
            outcome: Outcome::Projected(InstanceId(1)),
            ..chosen(1).with_note("it has the box".into())
        };
        assert_close(of(&projected), 0.5);
        // An instance that is not a candidate has no belief.
        assert_close(of(&chosen(5)), 0.7);
    }

    #[test]
    fn no_match_confidence_is_the_higher_of_model_and_geometry() {
        let nothing = Decision { outcome: Outcome::Nothing, ..Decision::default() };
        let of = |decision: &Decision, best, count| {
            applied(decision, &[0.5, 0.3], grounding(count, best)).confidence
        };
        assert_close(of(&nothing, 0.9, 2), 0.7);
        assert_close(of(&nothing, 0.2, 2), 0.8); // 1 - 0.2
        assert_close(of(&nothing, 0.2, 0), 1.0);
        assert_close(of(&nothing.with_note("it was asked again".into()), 0.9, 2), 0.4);
    }

    #[test]
    fn chosen_candidate_gets_its_box_and_alternatives_share_the_rest() {
        let beliefs = [0.5, 0.2, 0.0, 0.3, 0.2];
        let of = |decision: &Decision| applied(decision, &beliefs, grounding(5, 0.9));
        let rivals = |answer: &Grounding| {
            answer.alternatives.iter().map(|a| (a.id.0, a.confidence)).collect::<Vec<_>>()
        };
        let answer = of(&chosen(1));
        let own = &instances()[0];
        assert_eq!((answer.status, answer.answer.predicted_id), (Status::Grounded, Some(own.id)));
        assert_eq!((answer.aabb, answer.oriented_box), (Some(own.aabb), Some(own.oriented_box)));
        assert_eq!((answer.no_match_reason, answer.seen.clone(), answer.count), (None, None, None));
        assert_eq!(answer.targets.iter().map(|t| t.id.0).collect::<Vec<_>>(), [1]);
        assert_close(answer.targets[0].confidence, 0.85);
        // 0.3 of their beliefs, without those of zero; equal ones keep their order.
        let found = rivals(&answer);
        assert_eq!(found.iter().map(|rival| rival.0).collect::<Vec<_>>(), [4, 2, 5]);
        assert_close(found[0].1, 0.09);
        assert_close(found[1].1, 0.06);
        // 0.6 of them after a correction.
        assert_close(rivals(&of(&chosen(1).with_note("it was asked again".into())))[0].1, 0.18);
        let nothing = of(&Decision { outcome: Outcome::Nothing, ..Decision::default() });
        assert_eq!(
            (nothing.status, nothing.no_match_reason, nothing.answer.predicted_id),
            (Status::NoMatch, Some(NoMatchReason::NoneSeen), None)
        );
        assert_eq!((nothing.aabb, nothing.oriented_box), (None, None));
        assert_eq!((rivals(&nothing), nothing.targets.len()), (vec![], 0));
    }

    #[test]
    fn only_not_listed_decisions_have_a_picture_position() {
        let seen = Some(Seen {
            picture: "global".into(),
            at: [0.1, 0.2],
            area: None,
            name: "clock".into(),
        });
        let of = |outcome| {
            let seen = seen.clone().map(sighting);
            let decision = Decision { outcome, seen, ..Decision::default() };
            let answer = applied(&decision, &[0.5], grounding(1, 0.5));
            (answer.no_match_reason, answer.seen)
        };
        assert_eq!(of(Outcome::NotListed), (Some(NoMatchReason::NotListed), seen.clone()));
        assert_eq!(of(Outcome::Nothing), (Some(NoMatchReason::NoneSeen), None));
        assert_eq!(of(Outcome::Chosen(InstanceId(1))), (None, None));
    }

    #[test]
    fn choice_comes_first_among_targets_and_is_counted_once() {
        let several = |ids: &[usize], count: Option<u32>, decision: &Decision| {
            let targets = ids.iter().map(|id| to_target(&instances()[id - 1], 0.4)).collect();
            let before = Grounding { targets, count, ..grounding(3, 0.9) };
            let after = applied(decision, &[0.5, 0.3, 0.1], before);
            let ids = |ids: Vec<InstanceId>| ids.iter().map(|id| id.0).collect::<Vec<_>>();
            (
                ids(after.targets.iter().map(|t| t.id).collect()),
                after.count,
                ids(after.alternatives.iter().map(|a| a.id).collect()),
            )
        };
        assert_eq!(several(&[2, 3], Some(2), &chosen(1)), (vec![1, 2, 3], Some(3), vec![]));
        assert_eq!(several(&[2, 1], Some(2), &chosen(1)), (vec![1, 2], Some(2), vec![3]));
        assert_eq!(several(&[2, 3], None, &chosen(1)), (vec![1], None, vec![2, 3]));
        let nothing = Decision { outcome: Outcome::Nothing, ..Decision::default() };
        assert_eq!(several(&[2, 3], Some(2), &nothing), (vec![], Some(0), vec![]));
    }

    #[test]
    fn names_are_kept_only_for_candidates_of_the_answer() {
        let names = [(1, "red chair"), (7, "lamp")].map(|(id, name)| (id, name.to_owned()));
        let decision = Decision { names: BTreeMap::from(names), ..chosen(1) };
        let answer = applied(&decision, &[0.5, 0.3], grounding(2, 0.9));
        let told = [(1, "red chair"), (2, "grey object")].map(|(id, name)| (id, name.to_owned()));
        assert_eq!(answer.answer.candidate_names, BTreeMap::from(told));
        let names: Vec<&str> = answer.candidates.iter().map(|c| c.name.as_str()).collect();
        assert_eq!(names, ["red chair", "grey object"]);
    }

    #[test]
    fn unreadable_fields_keep_the_geometric_values() {
        let of = |outcome, reply: Reply| {
            let corrections = vec!["it has the box".to_owned()];
            let decision = Decision { outcome, reply, corrections, ..Decision::default() };
            let answer = applied(&decision, &[0.5, 0.3], grounding(2, 0.9)).answer;
            (
                answer.anchor_id.map(|id| id.0),
                answer.relation_used,
                answer.explanation,
                answer.target_name_matches,
            )
        };
        let reply = |anchor_id, not_read: &[Field]| Reply {
            anchor_id,
            relation_used: Some("above".into()),
            explanation: Some("it fits".into()),
            target_name_matches: Some(true),
            not_read: not_read.iter().map(|field| field.title()).collect(),
            ..reply_with(Choice::Id(1))
        };
        let one = Outcome::Chosen(InstanceId(1));
        let (above, under) = (Some("above".to_owned()), Some("under".to_owned()));
        let fits = || "it fits".to_owned();
        let yes = Some(true);
        assert_eq!(of(one, reply(Some(2), &[])), (Some(2), above.clone(), fits(), yes));
        let without = |field| of(one, reply(Some(2), &[field]));
        assert_eq!(without(Field::AnchorId), (Some(9), above.clone(), fits(), yes));
        assert_eq!(without(Field::RelationUsed), (Some(2), under.clone(), fits(), yes));
        // An instance is not its own anchor, and an id outside of the scene is none.
        for anchor in [None, Some(1), Some(0), Some(10), Some(4000)] {
            assert_eq!(of(one, reply(anchor, &[])).0, None, "{anchor:?}");
        }
        assert_eq!(of(Outcome::Nothing, reply(Some(1), &[])), (Some(1), above, fits(), None));
        // The fields of the reply do not apply to a projected choice.
        let projected = of(Outcome::Projected(InstanceId(1)), reply(Some(2), &[]));
        assert_eq!(projected, (Some(9), under, "it has the box".into(), yes));
        let silent = of(one, reply_with(Choice::Id(1)));
        assert_eq!(silent, (None, None, "The model gave no explanation.".into(), None));
    }

    #[test]
    fn undecided_reply_keeps_the_geometric_answer() {
        let before = grounding(2, 0.9);
        assert_eq!(applied(&Decision::default(), &[0.5, 0.3], before.clone()), before);
    }
}
