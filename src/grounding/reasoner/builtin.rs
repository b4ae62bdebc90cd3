//! The built-in reasoner: deterministic, milliseconds, no model.
//!
//! Target and anchors are chosen together: an instance's score is its fit to the target phrase times, for each relation, the
//! best (fit of an anchor) x (geometry of the pair) over **all** instances. When nothing fits, it says so.

use super::Verdict;
use crate::geometry::Vector3;
use crate::grounding::answer::described;
use crate::grounding::direction::Directions;
use crate::grounding::fit::{most_plausible, phrase_fits};
use crate::grounding::query::{Meaning, Measure, ParsedQuery, Phrase, Relation, RelationKind, Superlative};
use crate::grounding::relations::{self, Room};
use crate::grounding::{SceneView, Status};
use crate::models::attributes;
use crate::scene::{Instance, InstanceId};
use std::collections::BTreeMap;
use std::fmt::Write;

/// Below this, the best instance does not fit the target phrase.
const MIN_FIT: f32 = 0.25;
/// Below this, the best instance contradicts the relations.
const MIN_SCORE: f32 = 0.12;
/// A rival this close in score is as good.
const TIE: f32 = 0.97;
/// What a contradicted relation leaves of a score: words are ambiguous, geometry is noisy.
const CONTRADICTED: f32 = 0.05;
/// Each place further from the asked extreme multiplies the score by this.
const NEXT_BEST: f32 = 0.45;
/// Sharpness with which scores become shares of belief.
const BELIEF_POWER: i32 = 4;

/// Anchors looked at per relation, the best ones: what bounds the work on a question over thousands of instances.
const MAX_ANCHORS: usize = 64;
/// The same for each anchor of "between", where pairs are looked at.
const MAX_ANCHORS_OF_A_PAIR: usize = 16;

/// An anchor chosen for one relation, with the score of the pair.
#[derive(Debug, Clone, Copy)]
struct Bond {
    score: f32,
    anchor: Option<InstanceId>,
}

/// Decides for one question. `fits` is the fit of each instance to the target phrase.
#[must_use]
pub fn decide(scene: SceneView, parsed: &ParsedQuery, fits: &[f32], directions: &Directions) -> Verdict {
    let best_fit = fits.iter().copied().fold(0.0, f32::max);
    if best_fit < MIN_FIT {
        return no_match(scene, fits.to_vec(), why_nothing_fits(parsed));
    }
    let room = Room { extent: scene.extent };
    let viewpoint = parsed.viewpoint.as_ref().and_then(|phrase| best_instance(scene, phrase));
    let directions = viewpoint.and_then(|anchor| Directions::facing(anchor, &scene.extent.center)).unwrap_or(*directions);

    let bonds: Vec<Vec<Bond>> = parsed.relations.iter().map(|relation| bonds(scene, relation, fits, &directions, &room)).collect();
    let mut scores: Vec<f32> = (0..scene.instances.len())
        .map(|i| {
            bonds
                .iter()
                .fold(fits[i], |score, bond| score * (CONTRADICTED + (1.0 - CONTRADICTED) * bond[i].score))
        })
        .collect();
    if let Some(superlative) = parsed.superlative {
        apply_superlative(scene, superlative, fits, &directions, &mut scores);
    }

    let mut order: Vec<usize> = (0..scores.len()).collect();
    order.sort_by(|&a, &b| scores[b].total_cmp(&scores[a]).then(a.cmp(&b)));
    let best = order[0];
    if scores[best] < MIN_SCORE {
        let why = format!("No {} stands in the relations asked for.", parsed.target.text());
        return no_match(scene, scores, why);
    }
    let tied: Vec<usize> = order.iter().copied().take_while(|&i| scores[i] >= TIE * scores[best]).collect();
    let status = if tied.len() > 1 { Status::Ambiguous } else { Status::Grounded };
    let lead = bonds.first().map(|bond| bond[best]);
    let explanation = match status {
        Status::Ambiguous => explain_tie(scene, parsed, &tied),
        _ => explain(scene, parsed, best, fits, &bonds, viewpoint),
    };
    Verdict {
        status,
        beliefs: beliefs(&scores),
        scores,
        explanation,
        anchor: lead.and_then(|bond| bond.anchor).or(viewpoint.map(|v| v.id)),
        relation_used: relation_words(parsed),
        target_name_matches: Some(name_matches(&parsed.target, &scene.instances[best])),
    }
}

fn no_match(scene: SceneView, scores: Vec<f32>, explanation: String) -> Verdict {
    Verdict {
        status: Status::NoMatch,
        beliefs: vec![0.0; scene.instances.len()],
        scores,
        explanation,
        anchor: None,
        relation_used: None,
        target_name_matches: None,
    }
}

fn why_nothing_fits(parsed: &ParsedQuery) -> String {
    match parsed.target.meaning() {
        Meaning::Unknown => {
            format!("The built-in encoder does not know what \"{}\" looks like; a model-backed encoder may.", parsed.target.head)
        }
        _ => format!("Nothing in the room fits \"{}\".", parsed.target.text()),
    }
}

/// The instance a phrase most likely means.
fn best_instance<'a>(scene: SceneView<'a>, phrase: &Phrase) -> Option<&'a Instance> {
    let fits = phrase_fits(scene, phrase);
    let best = (0..fits.len()).max_by(|&a, &b| fits[a].total_cmp(&fits[b]).then(b.cmp(&a)))?;
    (fits[best] > 0.0).then(|| &scene.instances[best])
}

/// For every instance as target: its best anchors and how well the relation holds.
fn bonds(scene: SceneView, relation: &Relation, fits: &[f32], directions: &Directions, room: &Room) -> Vec<Bond> {
    let most_anchors = if relation.kind == RelationKind::Between { MAX_ANCHORS_OF_A_PAIR } else { MAX_ANCHORS };
    let anchors: Vec<Vec<(usize, f32)>> = relation
        .anchors
        .iter()
        .map(|phrase| most_plausible(&phrase_fits(scene, phrase), most_anchors))
        .collect();
    let free = |score: f32| Bond { score, anchor: None };
    let bonds: Vec<Bond> = match (relation.kind, &anchors[..]) {
        (RelationKind::AgainstWall | RelationKind::InCorner, _) => scene
            .instances
            .iter()
            .map(|i| free(relations::score(relation.kind, &i.aabb, &[], directions, room)))
            .collect(),
        // "near" what? The parsed query tells the relation; the decision leaves it out.
        (_, []) => vec![free(1.0); scene.instances.len()],
        (RelationKind::Closest | RelationKind::Farthest, [first, ..]) => ranked_by_distance(scene, relation.kind, fits, first),
        (RelationKind::Between, [a, b, ..]) => (0..fits.len()).map(|t| between_pair(scene, t, a, b, directions, room)).collect(),
        (RelationKind::Between, [only]) => (0..fits.len()).map(|t| between_pair(scene, t, only, only, directions, room)).collect(),
        (kind, all) => (0..fits.len())
            .map(|t| {
                // Several anchors ("next to the sofa and the lamp") must all hold.
                let per_anchor: Vec<Bond> = all.iter().map(|anchor| best_bond(scene, kind, t, anchor, directions, room)).collect();
                Bond { score: per_anchor.iter().map(|b| b.score).product(), anchor: per_anchor.first().and_then(|b| b.anchor) }
            })
            .collect(),
    };
    match relation.negated {
        true => bonds.into_iter().map(|b| Bond { score: 1.0 - b.score, ..b }).collect(),
        false => bonds,
    }
}

fn best_bond(scene: SceneView, kind: RelationKind, target: usize, anchors: &[(usize, f32)], directions: &Directions, room: &Room) -> Bond {
    let target_box = &scene.instances[target].aabb;
    anchors
        .iter()
        .filter(|&&(a, _)| a != target)
        .map(|&(a, fit)| {
            let anchor = &scene.instances[a];
            let geometry = relations::score(kind, target_box, &[&anchor.aabb], directions, room);
            Bond { score: fit.sqrt() * geometry, anchor: Some(anchor.id) }
        })
        .fold(Bond { score: 0.0, anchor: None }, better)
}

fn between_pair(scene: SceneView, target: usize, a: &[(usize, f32)], b: &[(usize, f32)], directions: &Directions, room: &Room) -> Bond {
    let boxed = |i: usize| &scene.instances[i].aabb;
    let pairs = a
        .iter()
        .flat_map(|x| b.iter().map(move |y| (x, y)))
        .filter(|(x, y)| x.0 != y.0 && x.0 != target && y.0 != target);
    pairs
        .map(|(&(i, fit_i), &(j, fit_j))| {
            let geometry = relations::score(RelationKind::Between, boxed(target), &[boxed(i), boxed(j)], directions, room);
            Bond { score: (fit_i * fit_j).sqrt() * geometry, anchor: Some(scene.instances[i].id) }
        })
        .fold(Bond { score: 0.0, anchor: None }, better)
}

fn better(best: Bond, other: Bond) -> Bond {
    if other.score > best.score { other } else { best }
}

/// "closest to" compares the things the target may be: each place further down the list counts less.
fn ranked_by_distance(scene: SceneView, kind: RelationKind, fits: &[f32], anchors: &[(usize, f32)]) -> Vec<Bond> {
    let rivals = most_plausible(fits, usize::MAX);
    let mut bonds = vec![Bond { score: 0.0, anchor: None }; fits.len()];
    for &(a, anchor_fit) in anchors {
        let anchor = &scene.instances[a];
        let distance = |t: usize| {
            let centers = (scene.instances[t].aabb.center - anchor.aabb.center).norm();
            scene.instances[t].aabb.gap(&anchor.aabb) + 0.05 * centers
        };
        let mut order: Vec<usize> = rivals.iter().map(|&(t, _)| t).filter(|&t| t != a).collect();
        order.sort_by(|&x, &y| distance(x).total_cmp(&distance(y)).then(x.cmp(&y)));
        if kind == RelationKind::Farthest {
            order.reverse();
        }
        for (t, place) in soft_places(&order, fits) {
            let score = anchor_fit.sqrt() * NEXT_BEST.powf(place);
            bonds[t] = better(bonds[t], Bond { score, anchor: Some(anchor.id) });
        }
    }
    bonds
}

fn apply_superlative(scene: SceneView, superlative: Superlative, fits: &[f32], directions: &Directions, scores: &mut [f32]) {
    let along = |i: &Instance, direction: Vector3<f32>| i.aabb.center.coords.dot(&direction);
    let measure = |i: &Instance| match superlative.measure {
        Measure::Largest => i.aabb.volume(),
        Measure::Smallest => -i.aabb.volume(),
        Measure::Tallest => i.aabb.size.z,
        Measure::Shortest => -i.aabb.size.z,
        Measure::Highest => i.aabb.center.z,
        Measure::Lowest => -i.aabb.center.z,
        Measure::Leftmost => -along(i, directions.right),
        Measure::Rightmost => along(i, directions.right),
        Measure::Frontmost => along(i, directions.front),
        Measure::Backmost => -along(i, directions.front),
    };
    let mut order: Vec<usize> = most_plausible(fits, usize::MAX).into_iter().map(|(t, _)| t).collect();
    order.sort_by(|&a, &b| measure(&scene.instances[b]).total_cmp(&measure(&scene.instances[a])).then(a.cmp(&b)));
    let asked = superlative.rank.max(1) as f32 - 1.0;
    let places: BTreeMap<usize, f32> = soft_places(&order, fits).into_iter().collect();
    for (t, score) in scores.iter_mut().enumerate() {
        *score *= places.get(&t).map_or(0.0, |place| NEXT_BEST.powf((place - asked).abs()));
    }
}

/// Place of each instance in `order`, from 0, where those ahead count by how surely they are what the question names: a table
/// that might be a sofa hardly takes the place of one.
fn soft_places(order: &[usize], fits: &[f32]) -> Vec<(usize, f32)> {
    let best = fits.iter().copied().fold(f32::EPSILON, f32::max);
    let mut ahead = 0.0;
    let place = |&t: &usize| {
        let place = ahead;
        ahead += (fits[t] / best).powi(BELIEF_POWER);
        (t, place)
    };
    order.iter().map(place).collect()
}

fn beliefs(scores: &[f32]) -> Vec<f32> {
    let total: f32 = scores.iter().map(|s| s.powi(BELIEF_POWER)).sum();
    let best = scores.iter().copied().fold(0.0, f32::max);
    scores
        .iter()
        .map(|s| if total > 0.0 { s.powi(BELIEF_POWER) / total * best.sqrt() } else { 0.0 })
        .collect()
}

/// Whether the instance's own best name means the same as the phrase's noun.
fn name_matches(target: &Phrase, instance: &Instance) -> bool {
    match target.meaning() {
        Meaning::Anything => true,
        Meaning::Structure(structure) => instance.structure == Some(structure),
        Meaning::Nouns(nouns) => instance.names.iter().any(|guess| nouns.iter().any(|noun| noun.name == guess.name)),
        Meaning::Unknown => false,
    }
}

fn relation_words(parsed: &ParsedQuery) -> Option<String> {
    let relations = parsed.relations.iter().map(|r| {
        let anchors: Vec<String> = r.anchors.iter().map(Phrase::text).collect();
        let words = if anchors.is_empty() { r.text.clone() } else { format!("{} the {}", r.text, anchors.join(" and the ")) };
        if r.negated { format!("not {words}") } else { words }
    });
    let superlative = parsed.superlative.map(|s| match s.rank {
        1 => format!("{:?}", s.measure).to_lowercase(),
        rank => format!("{:?}, number {rank}", s.measure).to_lowercase(),
    });
    let words: Vec<String> = relations.chain(superlative).collect();
    (!words.is_empty()).then(|| words.join("; "))
}

fn explain(scene: SceneView, parsed: &ParsedQuery, best: usize, fits: &[f32], bonds: &[Vec<Bond>], viewpoint: Option<&Instance>) -> String {
    let instance = &scene.instances[best];
    let size = instance.aabb.size;
    let mut text = format!("Instance {} ({}, {:.2} x {:.2} x {:.2} m)", instance.id, described(instance), size.x, size.y, size.z);
    let noun = match parsed.target.meaning() {
        Meaning::Nouns(nouns) => nouns.iter().map(|n| attributes::noun_fit(n, instance)).fold(0.0, f32::max),
        _ => fits[best],
    };
    // Writing to a String can not fail.
    let _ = write!(
        text,
        " has the measures of a {} ({noun:.2})",
        if parsed.target.head.is_empty() { "thing" } else { &parsed.target.head }
    );
    for &colour in &parsed.target.colours {
        let _ = write!(text, ", is {} ({:.2})", colour.word(), attributes::colour_fit(colour, instance));
    }
    for (relation, bond) in parsed.relations.iter().zip(bonds) {
        let Bond { score, anchor } = bond[best];
        let not = if relation.negated { "not " } else { "" };
        match anchor.map(|id| &scene.instances[id.0 as usize - 1]) {
            Some(anchor) => {
                let gap = instance.aabb.gap(&anchor.aabb);
                let _ =
                    write!(text, "; {not}{} instance {} ({}), {gap:.2} m apart ({score:.2})", relation.text, anchor.id, described(anchor));
            }
            None => {
                let _ = write!(text, "; {not}{} ({score:.2})", relation.text);
            }
        }
    }
    if let Some(superlative) = parsed.superlative {
        let rivals = most_plausible(fits, usize::MAX).len();
        let _ = write!(text, "; {} of {rivals}", format!("{:?}", superlative.measure).to_lowercase());
    }
    if let Some(anchor) = viewpoint {
        let _ = write!(text, "; seen facing instance {} ({})", anchor.id, described(anchor));
    }
    text.push('.');
    text
}

fn explain_tie(scene: SceneView, parsed: &ParsedQuery, tied: &[usize]) -> String {
    let ids: Vec<String> = tied.iter().take(6).map(|&i| scene.instances[i].id.to_string()).collect();
    format!(
        "{} instances fit \"{}\" alike: {}. Say more about the one you mean.",
        tied.len(),
        parsed.target.text(),
        ids.join(", ")
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Point3;
    use crate::geometry::boxes::Aabb;
    use crate::grounding::direction::{DirectionConvention, Observer};
    use crate::grounding::{Grounding, Question, Timings, ground};
    use crate::models::attributes::tests::thing;
    use crate::scene::Support;

    /// A small room: two sofas, a table with two mugs, a rug.
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

    fn ask_with(query: &str, convention: DirectionConvention, observer: Option<Observer>) -> Grounding {
        let instances = room();
        let extent = Aabb { center: Point3::new(0.0, 0.0, 1.3), size: Vector3::new(7.0, 5.0, 2.6) };
        let question = Question { query: query.into(), top_k: 5, convention, observer, target_name: None };
        ground(SceneView { instances: &instances, extent }, &question)
    }

    fn ask(query: &str) -> Grounding {
        ask_with(query, DirectionConvention::Paper, None)
    }

    #[test]
    fn names_attributes_and_relations_pick_the_right_thing() {
        for (query, expected) in [
            ("the rug", 6),
            ("the red sofa", 1),
            ("the blue mug on the table", 5),
            ("the mug closest to the red sofa", 4),
            ("the sofa nearest to the blue mug", 2),
            ("the mug farthest from the red sofa", 5),
            ("the sofa that is not red", 2),
            ("the mug that is not blue on the table", 4),
        ] {
            let answer = ask(query);
            assert_eq!(answer.answer.predicted_id, Some(InstanceId(expected)), "{query}: {}", answer.answer.explanation);
            assert_eq!(answer.status, Status::Grounded);
            assert!(answer.aabb.is_some() && answer.oriented_box.is_some());
        }
    }

    #[test]
    fn the_anchor_and_the_relation_are_told() {
        let answer = ask("the blue mug on the table").answer;
        assert_eq!((answer.anchor_id, answer.relation_used.as_deref()), (Some(InstanceId(3)), Some("on the table")));
        assert!(answer.explanation.contains("instance 3"), "{}", answer.explanation);
    }

    #[test]
    fn absent_and_unknown_things_get_no_box() {
        for query in ["the fridge", "the green sofa", "the theremin", "the green mug on the table"] {
            let answer = ask(query);
            assert_eq!((answer.status, answer.aabb, answer.answer.predicted_id), (Status::NoMatch, None, None), "{query}: {answer:?}");
        }
    }

    #[test]
    fn a_tie_is_called_one() {
        let answer = ask("the mug");
        assert_eq!((answer.status, answer.aabb), (Status::Ambiguous, None));
        let mut tied: Vec<_> = answer.alternatives.iter().take(2).map(|a| a.id.0).collect();
        tied.sort_unstable();
        assert_eq!(tied, [4, 5]);
    }

    #[test]
    fn left_depends_on_who_looks() {
        // Mugs 4 (x = -0.5) and 5 (x = 0.5) stand side by side along X.
        let predicted = |answer: Grounding| answer.answer.predicted_id.map(|id| id.0);
        assert_eq!(predicted(ask_with("the leftmost mug", DirectionConvention::Viewer, None)), Some(4));
        assert_eq!(predicted(ask_with("the leftmost mug", DirectionConvention::Paper, None)), Some(5));
        let from_behind = Observer { position: [0.0, 4.0, 1.5], yaw_rad: -std::f32::consts::FRAC_PI_2 };
        let answer = ask_with("the leftmost mug", DirectionConvention::Viewer, Some(from_behind));
        assert_eq!(answer.direction_convention, "observer");
        assert_eq!(predicted(answer), Some(5));
        assert_eq!(predicted(ask("facing the table, the mug on the left")), Some(4));
    }

    #[test]
    fn the_same_question_gives_the_same_answer() {
        let strip = |mut answer: Grounding| {
            answer.timings_ms = Timings::default();
            answer
        };
        assert_eq!(strip(ask("the mug closest to the red sofa")), strip(ask("the mug closest to the red sofa")));
    }
}
