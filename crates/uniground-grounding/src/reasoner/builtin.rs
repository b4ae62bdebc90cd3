//! The built-in reasoner: deterministic, takes milliseconds, uses no model.
//!
//! [`assess`](crate::assess) computes the scores. This module turns them into a decision: the best
//! instance, a tie, or nothing.

use super::Verdict;
use super::confidence::{NamesFrom, share_right};
use super::explanation::{explain, explain_several, explain_tie, relation_words, why_nothing_fits};
use super::views::{View, views};
use crate::assess::{Assessment, Assessor};
use crate::fit::{can_check_word, colors_fit, most_plausible};
use crate::kinds::BROADER_NAME;
use crate::readings::Readings;
use crate::{NoMatchReason, SceneView, Status};
use uniground_geometry::scene::Level;
use uniground_language::{Meaning, ParsedQuery, Phrase, Quantity, Reach, RelationKind};
use uniground_models::attributes::Noun;

/// At this fit or above, an instance clearly has the requested colors. Below it, its color says
/// that it may not be meant.
const CLEAR_COLOR: f32 = 0.8;

/// Name and version, recorded with answers.
pub const NAME: &str = "builtin-3";

/// Below this fit, the best instance is not what the target's noun may mean.
const MIN_FIT: f32 = 0.25;
/// The same for an instance none of whose names is the requested one.
const MIN_UNNAMED_FIT: f32 = 0.35;
/// Below this, no likely instance has the requested color.
pub(crate) const MIN_COLOR: f32 = 0.42;
/// Where people or a model have named most things, one without a name denies nothing from this score
/// on.
const UNNAMED_FITS: f32 = 0.05;
/// Below this, the best instance contradicts the relations.
const MIN_SCORE: f32 = 0.12;
/// Factor of the belief where words of the question could not be used: they may have distinguished
/// the target from its kind.
const NOT_ALL_UNDERSTOOD: f32 = 0.6;
/// The same where no noun says what the target is: it may be anything.
const NO_NOUN: f32 = 0.6;
/// The same where the given name is only a broader word for the requested one: a "pot" for a frying
/// pan.
const CALLED_BROADER: f32 = 0.6;
/// A measured relation with a lower score does not hold.
const PLAINLY_AGAINST: f32 = 0.15;
/// An instance with at least this share of the best score is tied with it.
pub(crate) const TIE: f32 = 0.97;
/// If a question asks for several, an instance with this share of the best score is one of them.
pub(crate) const ALSO_MEANT: f32 = 0.5;
/// Weight of a score under the less likely reading of the words; the other has 1.
const OTHER_READING: f32 = 0.92;
/// Power of the scores that share the belief: the higher, the larger the share of the best.
const BELIEF_POWER: i32 = 4;

/// Added to explanations where no encoder has seen the instances and nobody has named them.
const NAMES_ARE_GUESSES: &str = " Names here are guessed from size, place and color. An image encoder or names given by people make answers more reliable.";

/// Decides one question.
#[must_use]
pub fn decide(assessor: &mut Assessor, parsed: &ParsedQuery) -> Verdict {
    if parsed.foreign {
        let why = "The question is not in English, the one language the built-in parser reads; a chat model may read it.".to_owned();
        return no_match(vec![0.0; assessor.scene.instances.len()], NoMatchReason::NotEnglish, why);
    }
    let mut verdict = decide_english(assessor, parsed);
    let best = (0..verdict.scores.len())
        .reduce(|best, i| if verdict.scores[i] > verdict.scores[best] { i } else { best });
    if best.is_some_and(|best| {
        guessed_from(assessor.scene, &parsed.target, best) == Some(NamesFrom::Measures)
    }) {
        verdict.explanation.push_str(NAMES_ARE_GUESSES);
    }
    verdict
}

fn decide_english(assessor: &mut Assessor, parsed: &ParsedQuery) -> Verdict {
    let read: Vec<Read> =
        views(assessor, parsed).into_iter().map(|view| Read::of(view, assessor, parsed)).collect();
    let mut scores: Vec<f32> = (0..assessor.scene.instances.len())
        .map(|i| read.iter().map(|read| read.score(i)).fold(0.0, f32::max))
        .collect();
    let mut order = best_first(&scores);
    // The view with the best score is the one to explain and to compare with others.
    let score_of_best = |read: &Read| order.first().map_or(0.0, |&best| read.score(best));
    let won = (0..read.len()).reduce(|best, next| {
        if score_of_best(&read[next]) > score_of_best(&read[best]) { next } else { best }
    });
    let Read { view, assessment, other, counts, .. } = &read[won.unwrap_or(0)];
    view.take(assessor);
    let instances = assessor.scene.instances;
    let best_fit = assessment.nouns.iter().copied().fold(0.0, f32::max);
    let is_unknown =
        Readings::of(&parsed.target).iter().all(|reading| reading.meaning == Meaning::Unknown);
    if best_fit < MIN_FIT && (is_unknown || order.is_empty()) {
        let reason = if is_unknown { NoMatchReason::NotRecognised } else { NoMatchReason::Absent };
        return no_match(assessment.own.clone(), reason, why_nothing_fits(parsed));
    }
    let likeliest = best_first(&assessment.own);
    if scores[order[0]] <= 0.0
        && guessed_from(assessor.scene, &parsed.target, likeliest[0]).is_some()
    {
        // Nothing guessed stands in the relations asked for: the anchor may have a wrong name.
        scores = assessment.own.iter().map(|own| MIN_SCORE * own).collect();
        order = likeliest;
    }
    let best = order[0];
    // Guessed names are wrong too often to deny an object. But a list of several may be empty, and
    // what most things are is known once they have been named.
    let is_guess = guessed_from(assessor.scene, &parsed.target, best).is_some();
    let is_nothing_likely = assessment.own.iter().all(|own| *own < UNNAMED_FITS);
    let may_deny = !is_guess || is_nothing_likely && is_mostly_named(assessor.scene);
    if (may_deny || parsed.quantity != Quantity::One)
        && (best_fit < MIN_FIT || !colors_agree(assessment, &parsed.target, assessor.scene))
    {
        return no_match(assessment.own.clone(), NoMatchReason::Absent, why_nothing_fits(parsed));
    }
    if !is_guess && scores[best] < MIN_SCORE && contradicted(&parsed.target, assessment, best) {
        let why = format!("No {} stands in the relations asked for.", parsed.target.text());
        return no_match(scores, NoMatchReason::Elsewhere, why);
    }
    if scores[best] <= 0.0 {
        return no_match(scores, NoMatchReason::Absent, why_nothing_fits(parsed));
    }
    // An instance may match the color and a rough size, yet not the measures of a fridge, while its
    // first guess is another name. An encoder has weighed the names already.
    let is_named = name_matches(assessor.scene, &parsed.target, best)
        && is_called(&parsed.target, assessor.scene)(best);
    if may_deny
        && assessor.scene.appearance.is_none()
        && assessment.nouns[best] < MIN_UNNAMED_FIT
        && !is_named
    {
        return no_match(scores, NoMatchReason::Absent, why_nothing_fits(parsed));
    }
    let several =
        several(&scores, &order, parsed.quantity, &is_called(&parsed.target, assessor.scene));
    let tied: Vec<usize> =
        order.iter().copied().take_while(|&i| scores[i] >= TIE * scores[best]).collect();
    // Several that fit badly are no choice to offer.
    let may_be_tied = !is_guess
        || assessment.nouns[best] >= MIN_UNNAMED_FIT
            && colors_agree(assessment, &parsed.target, assessor.scene);
    let status = if several.is_empty() && tied.len() > 1 && may_be_tied {
        Status::Ambiguous
    } else {
        Status::Grounded
    };
    // The reading with the best score is the one to explain.
    let (phrase, assessed) = match (&parsed.other_reading, other) {
        (Some(phrase), Some(other))
            if counts[1] * other.total[best] > counts[0] * assessment.total[best] =>
        {
            (phrase, other)
        }
        _ => (&parsed.target, assessment),
    };
    let explanation = match status {
        Status::Ambiguous => explain_tie(assessor.scene, &parsed.target, &tied),
        _ if several.len() > 1 => explain_several(assessor.scene, &parsed.target, &several),
        _ => explain(assessor, phrase, assessed, best, &looked_by(view, &read)),
    };
    // Several instances do not share one belief.
    let mut beliefs =
        if parsed.quantity == Quantity::One { beliefs(&scores) } else { scores.clone() };
    let is_checked = parsed.target.excluded.iter().all(|word| can_check_word(assessor.scene, word));
    let is_understood = parsed.not_understood.is_empty() && is_checked;
    let understood = if is_understood { 1.0 } else { NOT_ALL_UNDERSTOOD };
    let meaning = parsed.target.meaning();
    let named = if meaning == Meaning::Anything { NO_NOUN } else { 1.0 };
    for (i, belief) in beliefs.iter_mut().enumerate() {
        let called = if assessor.scene.names.get(i).is_some() && assessment.nouns[i] <= BROADER_NAME
        {
            CALLED_BROADER
        } else {
            1.0
        };
        let colored = if parsed.target.colors.is_empty() {
            1.0
        } else {
            (colors_fit(assessor.scene, &parsed.target, i) / CLEAR_COLOR).min(1.0)
        };
        *belief = called
            * colored
            * understood
            * named
            * share_right(*belief, NamesFrom::of_meaning(assessor.scene, &meaning, i));
    }
    Verdict {
        status,
        reason: None,
        beliefs,
        scores,
        several,
        explanation,
        anchor: assessed
            .bonds
            .iter()
            .find_map(|bond| bond[best].anchor)
            .or(view.by.map(|i| instances[i].id)),
        relation_used: relation_words(phrase),
        target_name_matches: Some(name_matches(assessor.scene, &parsed.target, best)),
    }
}

/// Returns whether at least half of the things have names that were given.
fn is_mostly_named(scene: SceneView) -> bool {
    let things = || {
        scene.instances.iter().enumerate().filter(|(_, instance)| {
            instance.level == Level::Thing && instance.structure.is_none() && !instance.dismissed
        })
    };
    let named = things().filter(|(i, _)| scene.names.get(*i).is_some()).count();
    named > 0 && 2 * named >= things().count()
}

/// Returns indices by descending score.
fn best_first(scores: &[f32]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..scores.len()).collect();
    order.sort_by(|&a, &b| scores[b].total_cmp(&scores[a]).then(a.cmp(&b)));
    order
}

/// Returns where the name comes from that the target's noun is compared with, for the instance at
/// an index. `None` if it was given, or if the target has no noun.
pub(crate) fn guessed_from(scene: SceneView, target: &Phrase, index: usize) -> Option<NamesFrom> {
    matches!(target.meaning(), Meaning::Nouns(_) | Meaning::Structure(_))
        .then(|| NamesFrom::of(scene, target, index))
        .filter(|source| *source != NamesFrom::Given)
}

/// Returns whether any instance that may be meant has the requested colors. A related color alone
/// ("orange" for yellow) is not enough.
fn colors_agree(assessment: &Assessment, target: &Phrase, scene: SceneView) -> bool {
    let likely = most_plausible(&assessment.nouns, usize::MAX);
    target.colors.is_empty()
        || target.roughly
        || likely.iter().any(|&(i, _)| colors_fit(scene, target, i) >= MIN_COLOR)
}

/// A question, assessed from one view.
struct Read {
    view: View,
    assessment: Assessment,
    /// Assessment under the second reading of its words.
    other: Option<Assessment>,
    /// Weights of the scores under the first and the second reading.
    counts: [f32; 2],
    scores: Vec<f32>,
}

impl Read {
    fn of(view: View, assessor: &mut Assessor, parsed: &ParsedQuery) -> Self {
        view.take(assessor);
        let assessment = assessor.assess_target(&parsed.target);
        let other = parsed.other_reading.as_ref().map(|phrase| assessor.assess_target(phrase));
        let second_first = other.is_some() && says_it_of_nothing(assessor, &parsed.target);
        let counts = if second_first { [OTHER_READING, 1.0] } else { [1.0, OTHER_READING] };
        let mut scores = joint_scores(&assessment, other.as_ref(), counts);
        // "facing the desk, the thing on the left" is not the desk.
        if let Some(by) = view.by.filter(|_| parsed.target.meaning() == Meaning::Anything) {
            scores[by] = 0.0;
        }
        Self { view, assessment, other, counts, scores }
    }

    /// Returns the score of an instance from this view, weighted by how likely the view is.
    fn score(&self, index: usize) -> f32 {
        self.view.sure * self.scores[index]
    }
}

/// Returns indices of the instances that define the views, that of the chosen view first.
fn looked_by(won: &View, read: &[Read]) -> Vec<usize> {
    let others = read.iter().filter_map(|read| read.view.by).filter(|by| Some(*by) != won.by);
    won.by.into_iter().chain(others).collect()
}

/// Returns the better of the two readings for each instance.
fn joint_scores(first: &Assessment, other: Option<&Assessment>, counts: [f32; 2]) -> Vec<f32> {
    match other {
        None => first.total.clone(),
        Some(other) => first
            .total
            .iter()
            .zip(&other.total)
            .map(|(a, b)| (counts[0] * a).max(counts[1] * b))
            .collect(),
    }
}

/// Returns whether a phrase's relations belong to an object that was not found. "The thing with
/// candles between the till and the door": if no candles were found, their place is meaningless.
fn says_it_of_nothing(assessor: &Assessor, phrase: &Phrase) -> bool {
    let anchors = phrase.relations.iter().flat_map(|relation| &relation.anchors);
    let mut related = phrase
        .with
        .iter()
        .map(|with| &with.phrase)
        .chain(anchors)
        .filter(|said| !said.relations.is_empty());
    related.any(|said| assessor.assess(said).total.iter().all(|score| *score < MIN_FIT))
}

/// Returns whether a reliable measurement contradicts an instance: its support and what it touches,
/// not relations that depend on the viewer, and no distance unless the question gives it in meters.
fn contradicted(target: &Phrase, read: &Assessment, instance: usize) -> bool {
    let measured =
        target.relations.iter().zip(&read.bonds).filter(|(relation, _)| match relation.kind {
            RelationKind::Near | RelationKind::Far => Reach::in_words(&relation.text).is_some(),
            RelationKind::Closest | RelationKind::Farthest => false,
            kind => !kind.depends_on_who_looks(),
        });
    let against =
        measured.map(|(_, bonds)| bonds[instance].score).any(|score| score < PLAINLY_AGAINST);
    against || read.own[instance] < MIN_SCORE * read.nouns[instance]
}

/// Returns all instances that a question for several means: those with a score close to the best,
/// best first. Where some have the requested noun as their first name, only those.
fn several(
    scores: &[f32],
    order: &[usize],
    quantity: Quantity,
    is_called: &dyn Fn(usize) -> bool,
) -> Vec<usize> {
    let most = match quantity {
        Quantity::One => return Vec::new(),
        Quantity::Exactly(count) => count as usize,
        Quantity::All => usize::MAX,
    };
    let best = order.first().map_or(0.0, |&i| scores[i]);
    let near_best = || order.iter().copied().take_while(|&i| scores[i] >= ALSO_MEANT * best);
    let some_are_called_so = near_best().any(is_called);
    near_best().filter(|&i| is_called(i) || !some_are_called_so).take(most).collect()
}

fn no_match(scores: Vec<f32>, reason: NoMatchReason, explanation: String) -> Verdict {
    Verdict {
        status: Status::NoMatch,
        reason: Some(reason),
        beliefs: vec![0.0; scores.len()],
        several: Vec::new(),
        scores,
        explanation,
        anchor: None,
        relation_used: None,
        target_name_matches: None,
    }
}

fn beliefs(scores: &[f32]) -> Vec<f32> {
    let total: f32 = scores.iter().map(|s| s.powi(BELIEF_POWER)).sum();
    let best = scores.iter().copied().fold(0.0, f32::max);
    scores
        .iter()
        .map(|s| if total > 0.0 { s.powi(BELIEF_POWER) / total * best.sqrt() } else { 0.0 })
        .collect()
}

/// Returns whether the name of the instance at an index, or one of its guesses, is what the phrase
/// may mean.
pub(crate) fn name_matches(scene: SceneView, target: &Phrase, index: usize) -> bool {
    match (target.meaning(), scene.names.get(index)) {
        (Meaning::Anything | Meaning::Instance(_), _) => true,
        (Meaning::Structure(structure), _)
            if scene.instances[index].structure == Some(structure) =>
        {
            true
        }
        (_, Some(name)) => Readings::of(target).called(name) > 0.0,
        (_, None) => {
            let guessed = |noun: &Noun| {
                scene.instances[index].names.iter().any(|guess| guess.name == noun.name)
            };
            Readings::of(target)
                .iter()
                .any(|reading| reading.nouns().iter().any(|noun| guessed(noun)))
        }
    }
}

/// Returns whether the name of the instance at an index, given or its first guess, is what the
/// phrase may mean.
fn is_called<'a>(target: &Phrase, scene: SceneView<'a>) -> impl Fn(usize) -> bool + 'a {
    let nouns: Vec<&Noun> =
        Readings::of(target).iter().flat_map(|reading| reading.nouns().to_vec()).collect();
    move |i| match scene.instances[i].names.first() {
        _ if nouns.is_empty() || scene.names.get(i).is_some() => true,
        guess => guess.is_some_and(|guess| nouns.iter().any(|noun| noun.name == guess.name)),
    }
}

#[cfg(test)]
mod tests;
