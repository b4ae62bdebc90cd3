//! Chooses the candidates of a question: the instances a vision-language model is shown and may
//! choose from.
//!
//! There are three ways ([`CandidateSource`]). The fused one combines all sources: given names, the
//! encoder, measures, and the geometry of relations. An instance with the right name comes before
//! one that only stands in the right place. Among those with the right name, place counts more than
//! color. Instances that no name supports are ordered by rank fusion.

use super::answer::to_candidate;
use super::assess::{Assessment, Assessor};
use super::choose_level::keep_best_per_place;
use super::readings::Readings;
use super::{Appearance, Candidate, CandidateSource};
use uniground_geometry::statistics::largest_indices;
use uniground_language::{Meaning, ParsedQuery, Phrase};

/// An instance whose name fits the noun at least this well is a member of the class.
const CALLED_SO: f32 = 0.3;
/// How soon a lower rank counts little (rank fusion: `1 / (RANK + rank)`).
const RANK: f32 = 5.0;
/// Weights of the fused rankings: the instance and its relations together, the instance itself, its
/// appearance compared with the whole question, and its place alone.
const WEIGHTS: [f32; 4] = [1.0, 1.0, 1.0, 0.5];
/// Factor for a member of the class without the requested color: colors are the least certain.
const WITHOUT_COLOR: f32 = 0.4;
/// Instances with no side of this length are specks, meters.
const SPECK_M: f32 = 0.04;

/// Returns the `top_k` candidates of a question, best first. `scores` are the built-in reasoner's,
/// by index, and become the candidates' scores.
pub(super) fn choose(
    assessor: &Assessor,
    parsed: &ParsedQuery,
    scores: &[f32],
    from: CandidateSource,
    top_k: usize,
) -> Vec<Candidate> {
    let scene = assessor.scene;
    let order = match from {
        CandidateSource::Encoder => {
            best_indices(&appearance_scores(assessor, &parsed.target), top_k)
        }
        CandidateSource::Reasoner => choose_by_reasoner(assessor, parsed, scores, top_k),
        CandidateSource::Fused => choose_by_rank_fusion(assessor, parsed, scores, top_k),
    };
    order
        .into_iter()
        .zip(1..)
        .map(|(i, rank)| to_candidate(&scene.instances[i], rank, scores[i]))
        .collect()
}

/// Returns the similarity of each instance's appearance to the question's words, by index, one
/// instance for each place. Uses names and measures where no encoder has embedded the scene.
pub(super) fn appearance_scores(assessor: &Assessor, target: &Phrase) -> Vec<f32> {
    let scene = assessor.scene;
    let Some(looks) = scene.appearance.and_then(Appearance::shortlist) else {
        return assessor.own_fits(target).1;
    };
    let mut looks = looks.to_vec();
    keep_best_per_place(scene.instances, &mut looks);
    looks
}

/// Returns indices of the instances with a score above 0, best first.
fn best_indices(scores: &[f32], top_k: usize) -> Vec<usize> {
    largest_indices(scores, top_k).into_iter().filter(|&i| scores[i] > 0.0).collect()
}

/// Returns the instances that fit the whole question, then those that stand where it says, whatever
/// their names.
fn choose_by_reasoner(
    assessor: &Assessor,
    parsed: &ParsedQuery,
    scores: &[f32],
    top_k: usize,
) -> Vec<usize> {
    let mut order = best_indices(scores, top_k);
    let placed = assessor.assess(&without_noun(&parsed.target)).total;
    let others = best_indices(&placed, placed.len())
        .into_iter()
        .filter(|i| !order.contains(i))
        .take(top_k - order.len());
    order.extend(others.collect::<Vec<_>>());
    order
}

/// Returns a phrase without its noun.
fn without_noun(target: &Phrase) -> Phrase {
    Phrase { head: String::new(), could_be: Vec::new(), uses: Vec::new(), ..target.clone() }
}

fn choose_by_rank_fusion(
    assessor: &Assessor,
    parsed: &ParsedQuery,
    scores: &[f32],
    top_k: usize,
) -> Vec<usize> {
    let (scene, target) = (assessor.scene, &parsed.target);
    let meaning = target.meaning();
    let read = assessor.assess_target(target);
    let placed = assessor.assess_target(&without_noun(target)).total;
    let looks = scene.appearance.and_then(Appearance::shortlist);
    let asks_for_structure = matches!(meaning, Meaning::Structure(_));
    let may_be = |i: usize| {
        let instance = &scene.instances[i];
        let is_thing = instance.structure.is_none()
            && scene.names.get(i).is_none_or(super::GivenName::is_thing);
        (is_thing || asks_for_structure)
            && assessor.within.as_ref().is_none_or(|within| within[i])
            && !instance.dismissed
            && instance.aabb.size.max() >= SPECK_M
    };
    let readings = Readings::of(target);
    let is_called_so = |i: usize| {
        meaning != Meaning::Anything
            && scene.names.get(i).is_some_and(|name| readings.called(name) >= CALLED_SO)
    };
    let rankings: [Option<&[f32]>; 4] = [Some(scores), Some(&read.own), looks, Some(&placed)];
    let mut fusion = vec![0.0_f32; scores.len()];
    for (scores, weight) in
        rankings.into_iter().zip(WEIGHTS).filter_map(|(scores, weight)| Some((scores?, weight)))
    {
        for (i, rank) in
            best_indices(scores, scores.len()).into_iter().filter(|&i| may_be(i)).zip(0_u16..)
        {
            fusion[i] += weight / (RANK + f32::from(rank));
        }
    }
    let most = fusion.iter().copied().fold(f32::EPSILON, f32::max);
    // Members of the class come before everything else, so they start above the best fusion.
    let mut worth: Vec<f32> = fusion.iter().map(|f| f / most).collect();
    for i in (0..worth.len()).filter(|&i| may_be(i)) {
        if is_called_so(i) {
            worth[i] += 1.0 + member_score(&read, i);
        } else if scene.names.get(i).is_some_and(|name| name.carries(target, &meaning)) {
            worth[i] += 1.0;
        }
    }
    keep_best_per_place(scene.instances, &mut worth);
    best_indices(&worth, top_k)
}

/// Returns the worth of a member of the class, `0..=1`: name and relations, then colors.
fn member_score(read: &Assessment, i: usize) -> f32 {
    let color = if read.nouns[i] > 0.0 { read.own[i] / read.nouns[i] } else { 0.0 };
    let related = if read.own[i] > 0.0 { read.total[i] / read.own[i] } else { 0.0 };
    read.nouns[i] * related * (WITHOUT_COLOR + (1.0 - WITHOUT_COLOR) * color)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::direction::DirectionConvention;
    use crate::{NameIndex, SceneView, rank_candidates};
    use uniground_geometry::boxes::Aabb;
    use uniground_geometry::scene::{Instance, Structure, Support};
    use uniground_geometry::{Point3, Vector3};
    use uniground_models::attributes::name_guesses;
    use uniground_testing::thing;

    /// Returns named instances of one size in a row, with a wall behind them.
    fn room(names: &[&str]) -> Vec<Instance> {
        let named = |(i, name): (usize, &&str)| {
            let at = [i as f32, 0.0];
            Instance {
                given_name: Some((*name).to_owned()),
                ..thing(i as u32 + 1, at, [0.5, 0.5, 0.6], 0.0, Support::Floor, [120; 3])
            }
        };
        let mut instances: Vec<Instance> = names.iter().enumerate().map(named).collect();
        let wall = thing(
            instances.len() as u32 + 1,
            [2.0, 2.0],
            [6.0, 0.1, 2.6],
            0.0,
            Support::Floor,
            [200; 3],
        );
        instances.push(Instance { structure: Some(Structure::Wall), ..wall });
        instances.iter_mut().for_each(|i| i.names = name_guesses(i));
        instances
    }

    fn ids(instances: &[Instance], words: &str, top_k: usize) -> Vec<u32> {
        let extent = Aabb { center: Point3::new(2.0, 1.0, 1.3), size: Vector3::new(8.0, 5.0, 2.6) };
        let scene =
            SceneView { instances, extent, names: &NameIndex::of(instances), appearance: None };
        rank_candidates(scene, &uniground_language::parse(words), CandidateSource::Fused, top_k)
            .iter()
            .map(|c| c.id.0)
            .collect()
    }

    #[test]
    fn matching_names_rank_before_matching_places() {
        let names = [
            "grey trash can",
            "small wooden stool",
            "lime green bean bag chair",
            "white bean bag",
            "tall floor lamp",
        ];
        let room = room(&names);
        assert_eq!(
            ids(&room, "the white beanbag next to the lamp", 2),
            [4, 3],
            "color distinguishes members, class comes first"
        );
        assert_eq!(ids(&room, "the beanbag next to the stool", 2), [3, 4], "place before color");
        let all = ids(&room, "the beanbag", 24);
        assert!(all.len() <= names.len() && !all.contains(&6), "no wall unless requested: {all:?}");
        assert_eq!(ids(&room, "the wall", 1), [6]);
    }

    #[test]
    fn reasoner_candidates_are_ordered_by_score() {
        let instances = room(&["red mug", "blue mug"]);
        let extent = Aabb { center: Point3::new(2.0, 1.0, 1.3), size: Vector3::new(8.0, 5.0, 2.6) };
        let scene = SceneView {
            instances: &instances,
            extent,
            names: &NameIndex::of(&instances),
            appearance: None,
        };
        let assessor = Assessor::new(scene, DirectionConvention::Paper.into());
        let parsed = uniground_language::parse("the mug");
        let chosen = choose(&assessor, &parsed, &[0.9, 0.5, 0.0], CandidateSource::Reasoner, 2);
        assert_eq!(chosen.iter().map(|c| (c.id.0, c.rank)).collect::<Vec<_>>(), [(1, 1), (2, 2)]);
    }
}
