//! Yes-or-no questions about objects, and choices between two.

use super::measures::{length_error, measure, spoken};
use super::sentences::{be, capitalized};
use super::{AnswerValue, Grounding, NoMatchReason, Writer, value_of};
use crate::Unit;
use crate::fit::colors_fit;
use crate::reasoner::builtin::ALSO_MEANT;
use uniground_language::{ComparedBy, Comparison, Dimension, Meaning, Phrase, Reference};

/// A claim with at least this score holds.
const HOLDS: f32 = 0.5;

impl Writer<'_> {
    /// "Is the mug on the table": whether the claim of the target phrase holds of the subject.
    pub(super) fn holds(&mut self, subject: &Phrase, grounding: &mut Grounding) {
        let found = self.resolve_target(subject);
        let Some(best) = found.index else {
            return Self::choose_nothing_without(subject, &found, grounding);
        };
        let claim = match self.resolve_anchors(&self.parsed.target.clone()) {
            Ok((claim, confidence)) => {
                let found = self.claim_scores(subject, &claim);
                found.map(|scores| (scores, confidence))
            }
            Err(not_found) => {
                let (anchor, missing) = *not_found;
                let reason = missing.reason.unwrap_or(NoMatchReason::Absent);
                self.choose(best, subject, found.confidence.min(missing.confidence), grounding);
                grounding.text = Self::nothing(&anchor, Some(reason));
                return;
            }
        };
        let subject_name = |index: usize| capitalized(&self.spoken_name(subject, index));
        let Some((claim, anchor_confidence)) = claim else {
            self.choose(best, subject, found.confidence, grounding);
            grounding.text = format!(
                "I found {}, but I cannot check what you ask about it.",
                self.spoken_name(subject, best)
            );
            return;
        };
        let top = found.scores[best];
        let holds = (0..claim.len())
            .filter(|&i| found.scores[i] >= ALSO_MEANT * top)
            .max_by(|&a, &b| {
                let joint = |i: usize| claim[i] * found.scores[i];
                joint(a).total_cmp(&joint(b)).then(b.cmp(&a))
            })
            .filter(|&i| claim[i] >= HOLDS);
        let index = holds.unwrap_or(best);
        // A claim at the limit says little; one far from it much.
        let margin = 0.5 + (claim[index] - HOLDS).abs().min(0.5);
        let confidence = found.confidence.min(anchor_confidence) * margin;
        self.choose(index, subject, confidence, grounding);
        grounding.value = Some(AnswerValue {
            yes: Some(holds.is_some()),
            ..value_of(&[self.instances()[index].id])
        });
        let target = &self.parsed.target;
        let name = subject_name(index);
        let be = be(&name);
        let it = if be == "is" { "it is" } else { "they are" };
        let fact = if claims_a_place(subject, target) {
            self.names()
                .place(&self.assessor, index)
                .map_or_else(|| format!("{it} elsewhere"), |place| format!("{it} {place}"))
        } else {
            format!("{it} {}", self.names().a(index))
        };
        let claim = self.claim_words(subject);
        grounding.text = match holds {
            Some(_) => format!("Yes. {name} {be} {claim}."),
            None => format!("No. {name} {be} not {claim}; {fact}."),
        };
    }

    /// Returns how well a claim holds of every instance; `None` where nothing in it can be checked.
    fn claim_scores(&self, subject: &Phrase, claim: &Phrase) -> Option<Vec<f32>> {
        let assessed = self.assessor.assess(claim);
        let named = matches!(subject.meaning(), Meaning::Instance(_))
            && !matches!(claim.meaning(), Meaning::Instance(_) | Meaning::Anything);
        let said = !claim.colors.is_empty()
            || !claim.other_than.is_empty()
            || !claim.traits.is_empty()
            || !claim.relations.is_empty()
            || !claim.with.is_empty()
            || claim.superlative.is_some();
        if !named && !said {
            return None;
        }
        let of = |i: usize| {
            let mut score = if named { assessed.nouns[i] } else { 1.0 };
            if !claim.colors.is_empty() || !claim.other_than.is_empty() {
                score = score.min(colors_fit(self.assessor.scene, claim, i));
            }
            let is_described = !claim.traits.is_empty() || !claim.with.is_empty();
            if is_described && assessed.nouns[i] > 0.0 {
                score = score.min(assessed.own[i] / assessed.nouns[i]);
            }
            if claims_a_place(subject, claim) {
                for bonds in &assessed.bonds {
                    score = score.min(bonds[i].score);
                }
            }
            if claim.superlative.is_some() {
                score = score.min(assessed.total[i] / assessed.own[i].max(f32::EPSILON));
            }
            score
        };
        Some((0..self.instances().len()).map(of).collect())
    }

    /// Returns the claim in words: "on the coffee table", "red".
    fn claim_words(&self, subject: &Phrase) -> String {
        let target = &self.parsed.target;
        if matches!(subject.meaning(), Meaning::Instance(_)) && target.relations.is_empty() {
            return super::sentences::with_article(&super::sentences::spoken(target));
        }
        if claims_a_place(subject, target)
            && let Some(words) = crate::reasoner::relation_words(target)
        {
            return words;
        }
        let colors = target.colors.iter().map(|color| color.as_str().to_owned());
        let without = target.other_than.iter().map(|color| format!("not {}", color.as_str()));
        let traits = target.traits.iter().map(|seen| seen.as_str().to_owned());
        let with = target.with.iter().map(|with| {
            format!("{} {}", if with.absent { "without" } else { "with" }, with.phrase.text())
        });
        colors.chain(without).chain(traits).chain(with).collect::<Vec<_>>().join(" and ")
    }

    /// "Is the sofa longer than the rug"
    pub(super) fn comparison(&mut self, comparison: &Comparison, grounding: &mut Grounding) {
        let Some(compared) = self.compare(comparison, grounding) else { return };
        let yes = compared.first_wins;
        let word = &comparison.word;
        grounding.value = Some(AnswerValue { yes: Some(yes), ..value_of(&compared.ids) });
        let [first, second] = &compared.names;
        let [a, b] = &compared.measured;
        let answer = if yes { "Yes" } else { "No" };
        let not = if yes { "" } else { "not " };
        grounding.text = match &comparison.by {
            ComparedBy::Distance(_) => {
                format!("{answer}. {} is {a} away, {second} {b}.", capitalized(first))
            }
            ComparedBy::Dimension(_) => {
                format!("{answer}, {first} is {not}{word} than {second}: {a} against {b}.")
            }
        };
    }

    /// "Which is taller, the lamp or the shelf"
    pub(super) fn choice(&mut self, comparison: &Comparison, grounding: &mut Grounding) {
        let Some(compared) = self.compare(comparison, grounding) else { return };
        let confidence = grounding.confidence;
        let winner = usize::from(!compared.first_wins);
        let index = compared.ids[winner].0 as usize - 1;
        let phrase = if winner == 0 { &self.parsed.target } else { &*comparison.other };
        self.choose(index, phrase, confidence, grounding);
        if matches!(comparison.by, ComparedBy::Dimension(_)) {
            grounding.answer.anchor_id = Some(compared.ids[1 - winner]);
        }
        let [a, b] = &compared.measured;
        let (won, lost) = if winner == 0 { (a, b) } else { (b, a) };
        let name = capitalized(&compared.names[winner]);
        grounding.text = match &comparison.by {
            ComparedBy::Distance(_) => format!(
                "{name} is {}: {won} away, {} {lost}.",
                comparison.word,
                compared.names[1 - winner]
            ),
            ComparedBy::Dimension(_) => {
                format!("{name} is {}: {won} against {lost}.", comparison.word)
            }
        };
    }

    fn compare(&mut self, comparison: &Comparison, grounding: &mut Grounding) -> Option<Compared> {
        let target = self.parsed.target.clone();
        let (first, second) =
            (self.resolve_target(&target), self.resolve_target(&comparison.other));
        let (a, b) = match (first.index, second.index) {
            // Two descriptions of the same object: the next best is the other.
            (Some(a), Some(b)) if a == b => match (second.next_to(a), first.next_to(b)) {
                (Some(other), _) => (a, other),
                (None, Some(other)) => (other, b),
                (None, None) => {
                    self.choose(a, &target, first.confidence, grounding);
                    grounding.text = format!("I found only one of them: {}.", self.names().the(a));
                    return None;
                }
            },
            (Some(a), Some(b)) => (a, b),
            (a, _) => {
                let (phrase, missing) =
                    if a.is_none() { (&target, &first) } else { (&*comparison.other, &second) };
                Self::choose_nothing_without(phrase, missing, grounding);
                return None;
            }
        };
        let names = [self.spoken_name(&target, a), self.spoken_name(&comparison.other, b)];
        let mut confidence = first.confidence.min(second.confidence);
        let (values, error, unit) = match &comparison.by {
            ComparedBy::Dimension(dimension) => {
                let of = |i: usize| {
                    let solid = &self.assessor.solids[i];
                    match dimension {
                        // "The picture is higher than the shelf": by the middles.
                        Dimension::Elevation => (solid.center.z - self.floor_m(), Unit::Meters),
                        _ => measure(solid, *dimension, self.floor_m()),
                    }
                };
                let ((x, unit), (y, _)) = (of(a), of(b));
                let error = match unit {
                    Unit::Meters => {
                        length_error(&self.instances()[a], x)
                            + length_error(&self.instances()[b], y)
                    }
                    _ => 0.2 * x.max(y),
                };
                ([x, y], error, unit)
            }
            ComparedBy::Distance(reference) => {
                let from = match reference {
                    Reference::Observer => self.assessor.observer,
                    Reference::Object(phrase) => {
                        let found = self.resolve(phrase);
                        if found.index.is_none() {
                            Self::choose_nothing_without(phrase, &found, grounding);
                            return None;
                        }
                        confidence = confidence.min(found.confidence);
                        grounding.answer.anchor_id = found.index.map(|i| self.instances()[i].id);
                        found.index.map(|i| self.assessor.solids[i])
                    }
                };
                let Some(from) = from else {
                    grounding.text =
                        "I do not know where you are. Send your position as the observer.".into();
                    return None;
                };
                let gap = |i: usize| self.assessor.solids[i].gap(&from);
                ([gap(a), gap(b)], 0.05, Unit::Meters)
            }
        };
        let [x, y] = values;
        // Within the error of the measurement it is a guess.
        let sure = ((x - y).abs() / error.max(1e-3)).min(1.0);
        let ids = [self.instances()[a].id, self.instances()[b].id];
        self.choose(a, &target, confidence * (0.5 + 0.5 * sure), grounding);
        grounding.answer.anchor_id = grounding.answer.anchor_id.or(Some(ids[1]));
        let first_wins = if comparison.more { x > y } else { x < y };
        Some(Compared { ids, names, measured: [spoken(x, unit), spoken(y, unit)], first_wins })
    }
}

/// Returns whether a claim says where the subject is. The relations of "the armchair by the door",
/// of which something else is claimed, are its own.
fn claims_a_place(subject: &Phrase, claim: &Phrase) -> bool {
    claim.relations.len() > subject.relations.len()
}

/// Two objects and what was measured of them.
struct Compared {
    ids: [uniground_geometry::scene::InstanceId; 2],
    names: [String; 2],
    measured: [String; 2],
    first_wins: bool,
}
