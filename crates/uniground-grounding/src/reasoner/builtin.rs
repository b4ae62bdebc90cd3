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
    let named = if parsed.target.meaning() == Meaning::Anything { NO_NOUN } else { 1.0 };
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
            * share_right(*belief, NamesFrom::of(assessor.scene, &parsed.target, i));
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
fn guessed_from(scene: SceneView, target: &Phrase, index: usize) -> Option<NamesFrom> {
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
mod tests {
    use super::*;
    use crate::answer::NOTHING_CLEARLY;
    use crate::direction::{DirectionConvention, Observer};
    use crate::{Grounding, NameIndex, Question, SceneView, SixFields, Timings, ground};
    use uniground_geometry::boxes::Aabb;
    use uniground_geometry::scene::{Instance, InstanceId, NameGuess, Structure, Support};
    use uniground_geometry::{Point3, Vector3};
    use uniground_models::attributes;
    use uniground_testing::thing;

    /// Returns a small room: two sofas, a table with two mugs, a rug.
    fn room() -> Vec<Instance> {
        let on_table = Support::Instance { id: InstanceId(3) };
        let mut instances = vec![
            thing(1, [-2.0, 0.0], [2.1, 0.9, 0.8], 0.0, Support::Floor, [180, 40, 40]),
            thing(2, [2.0, 0.0], [2.0, 0.9, 0.8], 0.0, Support::Floor, [40, 60, 170]),
            thing(3, [0.0, 1.5], [1.25, 0.8, 0.74], 0.0, Support::Floor, [110, 75, 45]),
            thing(4, [-0.5, 1.5], [0.11, 0.09, 0.1], 0.74, on_table, [200, 30, 30]),
            thing(5, [0.5, 1.5], [0.11, 0.09, 0.1], 0.74, on_table, [30, 60, 180]),
            thing(6, [0.0, -0.5], [2.0, 1.4, 0.01], 0.0, Support::Floor, [120, 60, 60]),
        ];
        instances.iter_mut().for_each(|i| i.names = attributes::name_guesses(i));
        instances
    }

    fn ask_with(
        query: &str,
        convention: DirectionConvention,
        observer: Option<Observer>,
    ) -> Grounding {
        let instances = room();
        let extent = Aabb { center: Point3::new(0.0, 0.0, 1.3), size: Vector3::new(7.0, 5.0, 2.6) };
        let question = Question { convention, observer, ..Question::of(query) };
        ground(
            SceneView {
                instances: &instances,
                extent,
                names: &NameIndex::default(),
                appearance: None,
            },
            &question,
        )
    }

    fn ask(query: &str) -> Grounding {
        ask_with(query, DirectionConvention::Paper, None)
    }

    #[test]
    fn names_attributes_and_relations_pick_the_right_instance() {
        for (query, expected) in [
            ("the rug", 6),
            ("the red sofa", 1),
            ("the blue mug on the table", 5),
            ("the mug closest to the red sofa", 4),
            ("the sofa nearest to the blue mug", 2),
            ("the mug farthest from the red sofa", 5),
            ("the sofa that is not red", 2),
            ("the mug that is not blue on the table", 4),
            ("the table with two mugs", 3),
            ("the mug closest to the table and the red sofa", 4),
            ("the second closest mug to the blue sofa", 4),
            ("standing at the blue sofa, the nearest mug", 5),
            ("as seen from the table, the sofa on the left", 2),
            ("something to sit on that is blue", 2),
            ("the sofa, but not the red one", 2),
        ] {
            let answer = ask(query);
            assert_eq!(
                answer.answer.predicted_id,
                Some(InstanceId(expected)),
                "{query}: {}",
                answer.answer.explanation
            );
            assert_eq!(answer.status, Status::Grounded);
            assert!(answer.aabb.is_some() && answer.oriented_box.is_some());
        }
    }

    #[test]
    fn answer_reports_anchor_and_relation() {
        let answer = ask("the blue mug on the table").answer;
        assert_eq!(
            (answer.anchor_id, answer.relation_used.as_deref()),
            (Some(InstanceId(3)), Some("on the table"))
        );
        assert!(answer.explanation.contains("instance 3"), "{}", answer.explanation);
    }

    #[test]
    fn explanation_says_when_an_anchor_has_another_name() {
        // There is no cabinet: the table has the size of one.
        let answer = ask("the blue mug on the cabinet").answer;
        assert_eq!(
            (answer.predicted_id, answer.anchor_id),
            (Some(InstanceId(5)), Some(InstanceId(3))),
            "{}",
            answer.explanation
        );
        assert!(
            answer.explanation.contains(", the likeliest \"cabinet\")"),
            "{}",
            answer.explanation
        );
        let as_called = ask("the blue mug on the table").answer.explanation;
        assert!(!as_called.contains("the likeliest"), "{as_called}");
    }

    #[test]
    fn explanation_says_when_the_view_differs_from_the_convention() {
        // By the paper's convention +X is left. For a viewer who faces the table from the middle of
        // the room, +X is on the right.
        for (query, faced) in
            [("the red sofa left of the table", true), ("the red sofa right of the table", false)]
        {
            let SixFields { predicted_id, explanation, .. } = ask(query).answer;
            assert_eq!(predicted_id, Some(InstanceId(1)), "{query}: {explanation}");
            assert_eq!(
                explanation.contains("as who faces it sees it"),
                faced,
                "{query}: {explanation}"
            );
        }
    }

    /// Returns the answer in a room whose instances have their names from a person.
    fn ask_named(query: &str) -> Grounding {
        let mut named = room();
        named.iter_mut().for_each(|instance| instance.given_name = Some(instance.label().into()));
        let extent = Aabb { center: Point3::new(0.0, 0.0, 1.3), size: Vector3::new(7.0, 5.0, 2.6) };
        let names = NameIndex::of(&named);
        let scene = SceneView { instances: &named, extent, names: &names, appearance: None };
        ground(scene, &Question::of(query))
    }

    #[test]
    fn absent_and_unknown_objects_get_no_box() {
        for query in
            ["the chandelier", "the green sofa", "the theremin", "the green mug on the table"]
        {
            let answer = ask_named(query);
            assert_eq!(
                (answer.status, answer.aabb, answer.answer.predicted_id),
                (Status::NoMatch, None, None),
                "{query}: {answer:?}"
            );
        }
    }

    #[test]
    fn guessed_names_deny_no_object() {
        for query in ["the chandelier", "the green sofa"] {
            let mut answer = ask(query);
            answer.require_confidence(0.7);
            assert_eq!(answer.status, Status::Uncertain, "{query}: {answer:?}");
            assert!(answer.confidence < 0.2, "{query}: {answer:?}");
        }
        // Most things have names: what is not among them is not there.
        let mut named = room();
        named.iter_mut().skip(1).for_each(|it| it.given_name = Some(it.label().into()));
        let extent = Aabb { center: Point3::new(0.0, 0.0, 1.3), size: Vector3::new(7.0, 5.0, 2.6) };
        let names = NameIndex::of(&named);
        let scene = SceneView { instances: &named, extent, names: &names, appearance: None };
        assert_eq!(ground(scene, &Question::of("the chandelier")).status, Status::NoMatch);
        // Nothing is in a missing thing, but the best of its kind is offered.
        let mut answer = ask("the red mug with a chandelier in it");
        answer.require_confidence(0.7);
        assert_eq!(answer.status, Status::Uncertain, "{answer:?}");
        assert!(answer.aabb.is_some() && answer.confidence < 0.7, "{answer:?}");
        // A list may be empty. How sure that is, nobody knows.
        let none = ask("all the chandeliers");
        assert_eq!((none.status, none.count), (Status::NoMatch, Some(0)));
        assert!(none.confidence <= 0.5, "{none:?}");
    }

    #[test]
    fn an_answer_whose_object_has_other_names_is_uncertain() {
        let mut answer = ask("the red mug");
        assert_eq!(answer.status, Status::Grounded, "{answer:?}");
        answer.text = format!("{NOTHING_CLEARLY} a mug.");
        answer.require_confidence(0.0);
        assert_eq!(answer.status, Status::Grounded);
        answer.require_confidence(answer.confidence / 2.0);
        assert_eq!(answer.status, Status::Uncertain);
    }

    #[test]
    fn ties_are_reported_as_ambiguous() {
        let answer = ask("the mug");
        assert_eq!((answer.status, answer.aabb), (Status::Ambiguous, None));
        let mut tied: Vec<_> = answer.alternatives.iter().take(2).map(|a| a.id.0).collect();
        tied.sort_unstable();
        assert_eq!(tied, [4, 5]);
    }

    #[test]
    fn left_depends_on_the_viewer() {
        // Mugs 4 (x = -0.5) and 5 (x = 0.5) stand side by side along X.
        let predicted = |answer: Grounding| answer.answer.predicted_id.map(|id| id.0);
        assert_eq!(
            predicted(ask_with("the leftmost mug", DirectionConvention::Viewer, None)),
            Some(4)
        );
        // The convention is the default one, and no viewer stands behind the table, where the room
        // ends.
        assert_eq!(
            predicted(ask_with("the leftmost mug", DirectionConvention::Paper, None)),
            Some(4)
        );
        let from_behind =
            Observer { position: [0.0, 4.0, 1.5], yaw_rad: -std::f32::consts::FRAC_PI_2 };
        let answer = ask_with("the leftmost mug", DirectionConvention::Viewer, Some(from_behind));
        assert_eq!(answer.direction_convention, "observer");
        assert_eq!(predicted(answer), Some(5));
        assert_eq!(predicted(ask("facing the table, the mug on the left")), Some(4));
    }

    #[test]
    fn plural_questions_return_all_targets_and_their_count() {
        for (query, ids) in [
            ("how many mugs are there?", vec![4, 5]),
            ("both sofas", vec![1, 2]),
            ("all the mugs on the table", vec![4, 5]),
            ("the red mugs", vec![4]),
            ("the tables", vec![3]),
        ] {
            let answer = ask(query);
            let mut found: Vec<u32> = answer.targets.iter().map(|target| target.id.0).collect();
            found.sort_unstable();
            assert_eq!(
                (answer.status, &found, answer.count),
                (Status::Grounded, &ids, Some(ids.len() as u32)),
                "{query}"
            );
            assert_eq!(answer.answer.predicted_id, answer.targets.first().map(|target| target.id));
        }
        assert_eq!(
            (ask("how many chandeliers do we have").status, ask("the chandeliers").count),
            (Status::NoMatch, Some(0))
        );
        let one = ask("the rug");
        assert_eq!((one.count, one.targets.len(), one.targets[0].id), (None, 1, InstanceId(6)));
    }

    #[test]
    fn hanging_on_the_wall_prefers_wall_supported_instances() {
        let mut instances = room();
        // Books on the table reach higher than the clock on the wall behind them.
        let wall = Instance {
            structure: Some(Structure::Wall),
            ..thing(7, [0.0, 2.1], [6.0, 0.1, 2.6], 0.0, Support::Floor, [200; 3])
        };
        let books = thing(
            8,
            [0.0, 1.9],
            [0.4, 0.25, 1.3],
            0.74,
            Support::Instance { id: InstanceId(3) },
            [90, 60, 40],
        );
        let clock = thing(
            9,
            [1.5, 2.0],
            [0.3, 0.05, 0.3],
            1.4,
            Support::Wall { id: InstanceId(7) },
            [90, 60, 40],
        );
        instances.extend([wall, books, clock]);
        instances.iter_mut().for_each(|i| i.names = attributes::name_guesses(i));
        let extent = Aabb { center: Point3::new(0.0, 0.0, 1.3), size: Vector3::new(7.0, 5.0, 2.6) };
        let scene = SceneView {
            instances: &instances,
            extent,
            names: &NameIndex::default(),
            appearance: None,
        };
        let answer = ground(scene, &Question::of("the highest thing hanging on the wall"));
        assert_eq!(
            answer.answer.predicted_id,
            Some(InstanceId(9)),
            "{}",
            answer.answer.explanation
        );
    }

    #[test]
    fn viewpoint_comes_from_seats_and_faced_objects() {
        // Seen from the only seat at the table, which is behind it, +X is on the left.
        let mut instances = room();
        let chair = thing(7, [0.0, 2.3], [0.45, 0.45, 0.9], 0.0, Support::Floor, [90, 60, 40]);
        instances.push(chair);
        instances.iter_mut().for_each(|i| i.names = attributes::name_guesses(i));
        let extent = Aabb { center: Point3::new(0.0, 0.0, 1.3), size: Vector3::new(7.0, 5.0, 2.6) };
        let scene = SceneView {
            instances: &instances,
            extent,
            names: &NameIndex::default(),
            appearance: None,
        };
        let id =
            |query: &str| ground(scene, &Question::of(query)).answer.predicted_id.map(|id| id.0);
        assert_eq!(id("sitting at the table, the mug on the left"), Some(5));
        assert_eq!(
            id("facing the table, the mug on the left"),
            Some(4),
            "from the middle of the room"
        );
        assert_eq!(id("facing the table, the mug on the left side of the table"), Some(4));
        // There is no piano: the viewer is assumed to face the mugs.
        assert_eq!(id("facing the piano, the mug on the left"), Some(4));
    }

    #[test]
    fn observer_position_resolves_me_and_nearest() {
        let from = |query: &str, x: f32, yaw_rad: f32| {
            ask_with(
                query,
                DirectionConvention::Paper,
                Some(Observer { position: [f64::from(x), 0.5, 1.5], yaw_rad }),
            )
        };
        let predicted = |answer: &Grounding| answer.answer.predicted_id.map(|id| id.0);
        for (query, x, yaw_rad, expected) in [
            ("the sofa closest to me", -1.0, 0.0, 1),
            ("the sofa closest to me", 1.0, 0.0, 2),
            ("the nearest sofa", 1.0, 0.0, 2),
            ("the sofa in front of me", 0.0, 0.0, 2),
            ("the sofa behind me", 0.0, 0.0, 1),
            ("the sofa in front of me", 0.0, std::f32::consts::PI, 1),
        ] {
            let answer = from(query, x, yaw_rad);
            assert_eq!(
                predicted(&answer),
                Some(expected),
                "{query} from {x} along {yaw_rad}: {}",
                answer.answer.explanation
            );
            assert!(
                answer.parsed_query.not_understood.is_empty(),
                "{query}: {:?}",
                answer.parsed_query
            );
        }
        let explained = from("the sofa closest to me", -1.0, 0.0).answer.explanation;
        assert!(explained.contains("; closest to you, "), "{explained}");
        let nowhere = ask("the sofa closest to me");
        assert_eq!(nowhere.parsed_query.not_understood, ["me"]);
        let explained = ask("the red sofa closest to me").answer.explanation;
        let expected = "\"closest to me\" is not checked, as the request has no observer";
        assert!(explained.contains(expected), "{explained}");
    }

    #[test]
    fn no_match_answers_have_a_reason() {
        for (query, reason) in [
            ("the chandelier", NoMatchReason::Absent),
            ("the green sofa", NoMatchReason::Absent),
            ("the quux", NoMatchReason::NotRecognised),
            ("das blaue Sofa neben dem Tisch", NoMatchReason::NotEnglish),
        ] {
            assert_eq!(ask_named(query).no_match_reason, Some(reason), "{query}");
        }
        assert_eq!(ask("the rug").no_match_reason, None);
        // Only names that were given deny a relation.
        let mut named = room();
        named[0].given_name = Some("sofa".into());
        named[1].given_name = Some("sofa".into());
        let extent = Aabb { center: Point3::new(0.0, 0.0, 1.3), size: Vector3::new(7.0, 5.0, 2.6) };
        let names = NameIndex::of(&named);
        let scene = SceneView { instances: &named, extent, names: &names, appearance: None };
        let elsewhere = ground(scene, &Question::of("the sofa on the table"));
        assert_eq!(elsewhere.no_match_reason, Some(NoMatchReason::Elsewhere), "{elsewhere:?}");
        assert_eq!(ask("the sofa on the table").no_match_reason, None);
    }

    #[test]
    fn explanations_say_when_names_are_guesses() {
        let explained = |instances: &[Instance], query: &str| {
            let extent =
                Aabb { center: Point3::new(0.0, 0.0, 1.3), size: Vector3::new(7.0, 5.0, 2.6) };
            let names = NameIndex::of(instances);
            let scene = SceneView { instances, extent, names: &names, appearance: None };
            let answer = ground(scene, &Question::of(query));
            (answer.answer.explanation.ends_with(NAMES_ARE_GUESSES), answer.confidence)
        };
        let mut instances = room();
        for query in ["the red sofa", "the mug", "the fridge", "both sofas"] {
            assert!(explained(&instances, query).0, "{query}");
        }
        for query in ["the quux", "the red thing"] {
            assert!(!explained(&instances, query).0, "{query}");
        }
        // A name that a person gave, and a wall that is flat.
        let guessed = explained(&instances, "the red sofa").1;
        instances[0].given_name = Some("sofa".into());
        let (is_guess, given) = explained(&instances, "the red sofa");
        assert!(!is_guess && given > guessed, "{given} and {guessed}");
        instances[0].given_name = None;
        instances[0].structure = Some(Structure::Wall);
        assert!(!explained(&instances, "the wall").0);
        assert!(explained(&instances, "the red sofa").0);
    }

    #[test]
    fn weak_measured_fit_requires_the_noun_as_first_guess() {
        let guess = |name: &str, score: f32| NameGuess { name: name.to_owned(), score };
        let asked = |names: [NameGuess; 2]| {
            let mut instances = room();
            let green = thing(
                7,
                [2.7, 1.4],
                [0.715, 0.616, 0.49],
                0.85,
                Support::Instance { id: InstanceId(3) },
                [40, 140, 50],
            );
            instances.push(Instance { names: names.to_vec(), ..green });
            let extent =
                Aabb { center: Point3::new(0.0, 0.0, 1.3), size: Vector3::new(7.0, 5.0, 2.6) };
            let scene = SceneView {
                instances: &instances,
                extent,
                names: &NameIndex::default(),
                appearance: None,
            };
            ground(scene, &Question::of("the green fridge"))
        };
        // Measures never deny what may be there, but the answer says that it has another name.
        let plant = asked([guess("plant", 0.5), guess("box", 0.3)]);
        assert_eq!(plant.answer.predicted_id, Some(InstanceId(7)), "{plant:?}");
        assert_eq!(plant.answer.target_name_matches, Some(false), "{plant:?}");
        let text =
            "I found nothing that is clearly a green fridge. The likeliest is the green plant";
        assert!(plant.text.starts_with(text) && plant.confidence < 0.5, "{plant:?}");
        let fridge = asked([guess("mini fridge", 0.5), guess("plant", 0.3)]);
        assert_eq!(fridge.answer.predicted_id, Some(InstanceId(7)), "{fridge:?}");
    }

    #[test]
    fn unchecked_words_lower_confidence_but_keep_the_answer() {
        let (plain, with_more) =
            (ask("the red sofa"), ask("the red sofa with the brass studs by the quux"));
        assert_eq!(plain.answer.predicted_id, with_more.answer.predicted_id);
        assert!(
            with_more.status == Status::Grounded && with_more.confidence < 0.7 * plain.confidence,
            "{}",
            with_more.confidence
        );
    }

    #[test]
    fn confidence_below_the_minimum_makes_the_answer_uncertain() {
        let sure = ask("the red sofa with the brass studs by the quux");
        let mut answer = sure.clone();
        answer.require_confidence(sure.confidence);
        assert_eq!(answer, sure);
        answer.require_confidence(sure.confidence + 0.01);
        let text = format!("I am not sure. {}", sure.text);
        assert_eq!(answer, Grounding { status: Status::Uncertain, text, ..sure });
    }

    #[test]
    fn the_same_question_gives_the_same_answer() {
        let strip = |mut answer: Grounding| {
            answer.timings_ms = Timings::default();
            answer
        };
        assert_eq!(
            strip(ask("the mug closest to the red sofa")),
            strip(ask("the mug closest to the red sofa"))
        );
    }
}
