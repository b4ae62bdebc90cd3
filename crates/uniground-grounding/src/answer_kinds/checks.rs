//! Yes-or-no questions about objects, and comparisons of two.

use super::measures::{length_error, measure, rounded};
use super::sentences::{be, capitalized, joined, spoken as spoken_phrase, with_article};
use super::{
    Anchors, AnswerValue, Grounding, MissingAnchor, NoMatchReason, Status, Writer, builtin,
    to_target, value_of,
};
use crate::Unit;
use crate::answer::superlative_words;
use crate::assess::carried::is_part;
use crate::fit::colors_fit;
use crate::reasoner::Verdict;
use crate::reasoner::builtin::ALSO_MEANT;
use uniground_geometry::scene::Support;
use uniground_language::{
    Claim, ComparedBy, Comparison, Dimension, Meaning, ParsedQuery, Phrase, Quantity, Reference,
    With, plural_of,
};

/// A claim with at least this score holds.
const HOLDS: f32 = 0.5;
/// Objects that a sentence names one by one.
const MOST_LISTED: usize = 6;

impl Writer<'_> {
    /// "Is the mug on the table": whether the claim of the target phrase holds of the subject.
    pub(super) fn holds(&mut self, claim: &Claim, grounding: &mut Grounding) {
        let subject = &*claim.subject;
        if claim.of_all
            && let Some(members) = self.members(subject).filter(|members| members.len() > 1)
        {
            return self.holds_of_all(claim, &members, grounding);
        }
        let found = self.resolve_target(subject);
        let Some(best) = found.index else {
            return Self::choose_nothing_without(subject, &found, grounding);
        };
        let scores = match self.scores_of_claim(subject) {
            Ok(scores) => scores,
            Err(not_found) => {
                let (anchor, missing) = *not_found;
                let reason = missing.reason.unwrap_or(NoMatchReason::Absent);
                self.choose(best, subject, found.confidence.min(missing.confidence), grounding);
                grounding.text = Self::nothing(&anchor, Some(reason));
                // What is not there is not on the desk either.
                if reason == NoMatchReason::Absent
                    && self.parsed.target.with.iter().any(|with| with.phrase == anchor)
                {
                    let answer = if claim.is_negated { "Yes" } else { "No" };
                    grounding.text = format!("{answer}. {}", grounding.text);
                    let ids = [self.instances()[best].id];
                    grounding.value =
                        Some(AnswerValue { yes: Some(claim.is_negated), ..value_of(&ids) });
                }
                return;
            }
        };
        let Some((scores, anchor_confidence)) = scores else {
            self.choose(best, subject, found.confidence, grounding);
            grounding.text = format!(
                "I found {}, but I cannot check what you ask about it.",
                self.spoken_name(subject, best)
            );
            return;
        };
        let top = found.scores[best];
        let holds = (0..scores.len())
            .filter(|&i| found.scores[i] >= ALSO_MEANT * top)
            .max_by(|&a, &b| {
                let joint = |i: usize| scores[i] * found.scores[i];
                joint(a).total_cmp(&joint(b)).then(b.cmp(&a))
            })
            .filter(|&i| scores[i] >= HOLDS);
        let index = holds.unwrap_or(best);
        let confidence = found.confidence.min(anchor_confidence) * margin(scores[index]);
        self.choose(index, subject, confidence, grounding);
        let is_so = holds.is_some();
        let yes = is_so != claim.is_negated;
        grounding.value =
            Some(AnswerValue { yes: Some(yes), ..value_of(&[self.instances()[index].id]) });
        let target = &self.parsed.target;
        // "The red lamp is red" says nothing.
        let name = if target.colors.is_empty() || is_of_id(subject) || !subject.colors.is_empty() {
            self.spoken_name(subject, index)
        } else {
            format!("the {}", self.instances()[index].label())
        };
        let name = capitalized(&name);
        let it = if be(&name) == "is" { "it is" } else { "they are" };
        let fact = if claims_a_place(subject, target) {
            self.names()
                .place(&self.assessor, index)
                .map_or_else(|| format!("{it} elsewhere"), |place| format!("{it} {place}"))
        } else {
            format!("{it} {}", self.names().a(index))
        };
        let answer = if yes { "Yes" } else { "No" };
        let said = self.predicate(subject, &name, is_so);
        grounding.text = if is_so {
            format!("{answer}. {name} {said}.")
        } else {
            format!("{answer}. {name} {said}; {fact}.")
        };
    }

    /// "Are all chairs on the floor"
    fn holds_of_all(&mut self, claim: &Claim, members: &[(usize, f32)], grounding: &mut Grounding) {
        let subject = &*claim.subject;
        let noun = plural_of(&spoken_phrase(subject));
        let scores = match self.scores_of_claim(subject) {
            Ok(scores) => scores,
            Err(not_found) => {
                let (anchor, missing) = *not_found;
                return Self::choose_nothing_without(&anchor, &missing, grounding);
            }
        };
        let Some((scores, anchor_confidence)) = scores else {
            self.choose_all(members, subject, grounding);
            grounding.text = format!(
                "I found {} {noun}, but I cannot check what you ask about them.",
                members.len()
            );
            return;
        };
        let (are, are_not): (Vec<_>, Vec<_>) =
            members.iter().partition(|(index, _)| scores[*index] >= HOLDS);
        // What a "no" rests on: the objects that are not as asked.
        let (yes, exceptions) =
            if claim.is_negated { (are.is_empty(), &are) } else { (are_not.is_empty(), &are_not) };
        let sure = |(index, belief): &(usize, f32)| belief * margin(scores[*index]);
        let confidence = if yes {
            members.iter().map(sure).product()
        } else {
            exceptions.iter().map(sure).fold(0.0, f32::max)
        };
        let shown: &[(usize, f32)] = if yes { members } else { exceptions };
        self.choose_all(shown, subject, grounding);
        grounding.confidence = anchor_confidence.min(confidence);
        let ids: Vec<_> = members.iter().map(|(index, _)| self.instances()[*index].id).collect();
        grounding.value = Some(AnswerValue { yes: Some(yes), ..value_of(&ids) });
        let answer = if yes { "Yes" } else { "No" };
        let all = members.len();
        let so = self.predicate(subject, if are.len() == 1 { "one" } else { &noun }, true);
        grounding.text = match (are.len(), are_not.len()) {
            (_, 0) if all == 2 => format!("{answer}. Both {noun} {so}."),
            (_, 0) => format!("{answer}. All {all} {noun} {so}."),
            (0, _) => format!("{answer}. None of the {all} {noun} {so}."),
            (some, others) => {
                let but = if others <= some {
                    format!("all but {}", self.listed(&are_not))
                } else {
                    format!("only {}", self.listed(&are))
                };
                format!("{answer}. {some} of the {all} {noun} {so}: {but}.")
            }
        };
    }

    /// Returns the instances that a phrase means where it means several, with the belief in each.
    pub(super) fn members(&mut self, subject: &Phrase) -> Option<Vec<(usize, f32)>> {
        let quantity =
            subject.count.filter(|count| *count > 1).map_or(Quantity::All, Quantity::Exactly);
        let parsed = ParsedQuery { target: subject.clone(), quantity, ..ParsedQuery::default() };
        let Verdict { status, several, beliefs, .. } = builtin::decide(&mut self.assessor, &parsed);
        (status != Status::NoMatch)
            .then(|| several.into_iter().map(|index| (index, beliefs[index])).collect())
    }

    /// Makes several instances the answer, as what a phrase means.
    pub(super) fn choose_all(
        &self,
        members: &[(usize, f32)],
        phrase: &Phrase,
        grounding: &mut Grounding,
    ) {
        let Some((first, belief)) = members.first() else { return };
        self.choose(*first, phrase, *belief, grounding);
        grounding.targets = members
            .iter()
            .map(|(index, belief)| to_target(&self.instances()[*index], *belief))
            .collect();
        grounding
            .alternatives
            .retain(|other| grounding.targets.iter().all(|target| target.id != other.id));
    }

    /// "the red chair (4) and the blue chair (7)"
    pub(super) fn listed(&self, members: &[(usize, f32)]) -> String {
        let mut names: Vec<String> = members
            .iter()
            .take(MOST_LISTED)
            .map(|(index, _)| {
                format!("{} ({})", self.names().the(*index), self.instances()[*index].id)
            })
            .collect();
        if members.len() > MOST_LISTED {
            names.push(format!("{} more", members.len() - MOST_LISTED));
        }
        joined(&names)
    }

    /// Returns how well the question's claim holds of every instance, and the confidence in its
    /// anchors; `None` where nothing in it can be checked.
    fn scores_of_claim(
        &mut self,
        subject: &Phrase,
    ) -> Result<Option<(Vec<f32>, f32)>, MissingAnchor> {
        let target = self.parsed.target.clone();
        // "Does the desk have a lamp", where there is no lamp.
        for with in target
            .with
            .iter()
            .filter(|with| !with.absent && !subject.with.contains(with) && !is_part(&with.phrase))
        {
            let found = self.resolve(&with.phrase);
            if found.index.is_none() {
                return Err(Box::new((with.phrase.clone(), found)));
            }
        }
        let (claim, confidence) = self.resolve_anchors(&target, Anchors::AllMeant)?;
        Ok(self.claim_scores(subject, &claim).map(|scores| (scores, confidence)))
    }

    /// Returns how well a claim holds of every instance; `None` where nothing in it can be checked.
    fn claim_scores(&self, subject: &Phrase, claim: &Phrase) -> Option<Vec<f32>> {
        // What is claimed to be carried has to be seen; a description may leave it open.
        let (own, carried): (Vec<&With>, Vec<&With>) = claim
            .with
            .iter()
            .partition(|with| subject.with.contains(with) || is_part(&with.phrase));
        let described = Phrase { with: own.into_iter().cloned().collect(), ..claim.clone() };
        let assessed = self.assessor.assess(&described);
        let all = 0..self.instances().len();
        let carried: Vec<(bool, Vec<(usize, f32)>)> = carried
            .into_iter()
            .map(|with| {
                let things = self.assessor.assess(&with.phrase).total;
                (with.absent, self.assessor.carried(&with.phrase, &things, all.clone()))
            })
            .collect();
        let named = matches!(subject.meaning(), Meaning::Instance(_))
            && !matches!(claim.meaning(), Meaning::Instance(_) | Meaning::Anything);
        // No parse finds the cushion of a chair.
        let with_parts = claim.with.iter().any(|with| is_part(&with.phrase));
        if with_parts && !subject.with.iter().any(|with| is_part(&with.phrase)) {
            return None;
        }
        let said = !claim.colors.is_empty()
            || !claim.other_than.is_empty()
            || !claim.traits.is_empty()
            || !claim.relations.is_empty()
            || !claim.with.is_empty()
            || claim.superlative.is_some();
        if !named && !said {
            return None;
        }
        let anchors = anchor_indices(claim);
        let of = |i: usize| {
            let mut score = if named { assessed.nouns[i] } else { 1.0 };
            if !claim.colors.is_empty() || !claim.other_than.is_empty() {
                score = score.min(colors_fit(self.assessor.scene, claim, i));
            }
            for (absent, fits) in &carried {
                let fit = fits[i].1;
                score = score.min(if *absent { 1.0 - fit } else { fit });
            }
            let is_described = !claim.traits.is_empty() || !described.with.is_empty();
            if is_described && assessed.nouns[i] > 0.0 {
                score = score.min(assessed.own[i] / assessed.nouns[i]);
            }
            if claims_a_place(subject, claim) {
                for (relation, bonds) in claim.relations.iter().zip(&assessed.bonds) {
                    let held = self.holds_by_support(relation, i, &anchors, bonds[i].score);
                    score = score.min(held);
                }
            }
            if claim.superlative.is_some() {
                score = score.min(assessed.total[i] / assessed.own[i].max(f32::EPSILON));
            }
            score
        };
        Some(all.map(of).collect())
    }

    /// Returns what the question claims of objects with a name, or that it does not hold: "is on the
    /// coffee table", "are not red", "has a lamp".
    fn predicate(&self, subject: &Phrase, name: &str, is_so: bool) -> String {
        let target = &self.parsed.target;
        let be = be(name);
        let said = |words: String| {
            if is_so { format!("{be} {words}") } else { format!("{be} not {words}") }
        };
        if matches!(subject.meaning(), Meaning::Instance(_)) && target.relations.is_empty() {
            return said(with_article(&spoken_phrase(target)));
        }
        if claims_a_place(subject, target)
            && let Some(words) = crate::reasoner::relation_words(target)
        {
            return said(words);
        }
        let has: Vec<String> = target
            .with
            .iter()
            .filter(|with| !subject.with.contains(with))
            .map(|with| {
                let thing = spoken_phrase(&with.phrase);
                let thing = match with.phrase.count {
                    Some(count) => format!("{count} {thing}"),
                    None => with_article(&thing),
                };
                if with.absent { format!("no {}", spoken_phrase(&with.phrase)) } else { thing }
            })
            .collect();
        let colors = target.colors.iter().map(|color| color.as_str().to_owned());
        let without = target.other_than.iter().map(|color| format!("not {}", color.as_str()));
        let traits = target.traits.iter().map(|seen| seen.as_str().to_owned());
        let rank = target.superlative.map(|rank| format!("the {}", superlative_words(&rank)));
        let is: Vec<String> = colors.chain(without).chain(traits).chain(rank).collect();
        let claimed = |all: &[String], of_subject: usize| {
            all.iter()
                .skip(of_subject.min(all.len().saturating_sub(1)))
                .cloned()
                .collect::<Vec<_>>()
        };
        match (is.is_empty(), has.is_empty()) {
            (true, false) => {
                let (verb, not) = match (be, is_so) {
                    ("is", true) => ("has", ""),
                    ("is", false) => ("does", " not have"),
                    (_, true) => ("have", ""),
                    (_, false) => ("do", " not have"),
                };
                format!("{verb}{not} {}", joined(&has))
            }
            _ => said(joined(&claimed(&is, subject.colors.len() + subject.traits.len()))),
        }
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

    /// "How much taller is the shelf than the desk"
    pub(super) fn difference(&mut self, comparison: &Comparison, grounding: &mut Grounding) {
        let Some(compared) = self.compare(comparison, grounding) else { return };
        let Compared { names: [first, second], measured: [a, b], difference, first_wins, .. } =
            compared;
        let unit = difference.unit.unwrap_or(Unit::Meters);
        let by = self.spoken(difference.number.unwrap_or_default().abs(), unit);
        let error = self.spoken(difference.error.unwrap_or_default(), unit);
        let word = &comparison.word;
        let measures = match &comparison.by {
            ComparedBy::Distance(_) => format!("{a} away, {second} {b}"),
            ComparedBy::Dimension(_) => format!("{a} against {b}"),
        };
        grounding.text = if first_wins {
            format!("{} is {by} ± {error} {word} than {second}: {measures}.", capitalized(&first))
        } else {
            format!(
                "{} is not {word} than {second}: {measures}, a difference of {by} ± {error}.",
                capitalized(&first)
            )
        };
        grounding.value = Some(difference);
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
                // "The bar table is higher than the dining table": both stand on the floor.
                let stand = [a, b].iter().all(|&i| self.instances()[i].support == Support::Floor);
                let dimension = match dimension {
                    Dimension::Elevation if stand => &Dimension::Height,
                    dimension => dimension,
                };
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
        let ahead = if comparison.more { x - y } else { y - x };
        Some(Compared {
            ids,
            names,
            measured: [self.spoken(x, unit), self.spoken(y, unit)],
            difference: AnswerValue {
                number: Some(rounded(ahead)),
                unit: Some(unit),
                error: Some(rounded(error)),
                ..value_of(&ids)
            },
            first_wins: ahead > 0.0,
        })
    }
}

/// Returns whether a phrase names an instance by its id: "#12".
fn is_of_id(phrase: &Phrase) -> bool {
    matches!(phrase.meaning(), Meaning::Instance(_))
}

/// Returns the lower share of the confidence for a score near the limit: it says little, one far
/// from it much.
fn margin(score: f32) -> f32 {
    0.5 + (score - HOLDS).abs().min(0.5)
}

/// Returns the indices of the anchors that are given by id.
fn anchor_indices(phrase: &Phrase) -> Vec<usize> {
    let anchors = phrase.relations.iter().flat_map(|relation| &relation.anchors);
    anchors
        .filter_map(|anchor| match anchor.meaning() {
            Meaning::Instance(id) => Some(id.0 as usize - 1),
            _ => None,
        })
        .collect()
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
    /// How much more the first object has of what is asked for, negative if less; with unit and
    /// expected error.
    difference: AnswerValue,
    first_wins: bool,
}
