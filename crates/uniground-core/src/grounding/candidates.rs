//! Which instances a question's candidates are: what a vision-language model is shown and may choose from.
//!
//! Three ways ([`CandidateSource`]). The fused one asks everybody who knows something: names somebody gave, the encoder, measures, and the
//! geometry of relations. What is called the right thing comes before what only stands in the right place; among those, place counts more
//! than colour; what nobody speaks for by name is ordered by rank fusion.

use super::assess::{Assessment, Assessor};
use super::place::one_per_place;
use super::query::{Meaning, ParsedQuery, Phrase};
use super::{Appearance, Candidate, CandidateSource};
use crate::geometry::statistics::largest;

/// Names that fit the noun at least this well make their bearers members of the class.
const CALLED_SO: f32 = 0.3;
/// How soon a lower rank counts little (rank fusion: `1 / (RANK + rank)`).
const RANK: f32 = 5.0;
/// Weights of the rankings that are fused: the thing and its relations together, the thing itself, its looks beside the whole question,
/// and its place alone.
const WEIGHTS: [f32; 4] = [1.0, 1.0, 1.0, 0.5];
/// What a colour that is not there leaves of a member's place: colours are the least certain.
const WITHOUT_COLOUR: f32 = 0.4;
/// Things with no side of this length are specks, metres.
const SPECK_M: f32 = 0.04;

/// The `top_k` candidates of a question, best first; `scores` are the built-in reasoner's, by index, and told as the candidates' own.
pub(super) fn choose(assessor: &Assessor, parsed: &ParsedQuery, scores: &[f32], from: CandidateSource, top_k: usize) -> Vec<Candidate> {
    let scene = assessor.scene;
    let order = match (from, scene.appearance.and_then(Appearance::shortlist)) {
        (CandidateSource::Encoder, Some(looks)) => {
            let mut looks = looks.to_vec();
            one_per_place(scene.instances, &mut looks);
            best(&looks, top_k)
        }
        (CandidateSource::Encoder, None) => best(&assessor.own_fits(&parsed.target).1, top_k),
        (CandidateSource::Reasoner, _) => reasoned(assessor, parsed, scores, top_k),
        (CandidateSource::Fused, _) => fused(assessor, parsed, scores, top_k),
    };
    let candidate = |(i, rank): (usize, u32)| {
        let instance = &scene.instances[i];
        Candidate { id: instance.id, rank, score: scores[i], aabb: instance.aabb }
    };
    order.into_iter().zip(1..).map(candidate).collect()
}

/// Indices of what scores anything, best first.
fn best(scores: &[f32], top_k: usize) -> Vec<usize> {
    largest(scores, top_k).into_iter().filter(|&i| scores[i] > 0.0).collect()
}

/// What fits the whole question, then what stands where it says, whatever it is called.
fn reasoned(assessor: &Assessor, parsed: &ParsedQuery, scores: &[f32], top_k: usize) -> Vec<usize> {
    let mut order = best(scores, top_k);
    let placed = assessor.assess(&unnamed(&parsed.target)).total;
    let others = best(&placed, placed.len()).into_iter().filter(|i| !order.contains(i)).take(top_k - order.len());
    order.extend(others.collect::<Vec<_>>());
    order
}

/// A phrase without its noun.
fn unnamed(target: &Phrase) -> Phrase {
    Phrase { head: String::new(), uses: Vec::new(), ..target.clone() }
}

fn fused(assessor: &Assessor, parsed: &ParsedQuery, scores: &[f32], top_k: usize) -> Vec<usize> {
    let (scene, target) = (assessor.scene, &parsed.target);
    let meaning = target.meaning();
    let read = assessor.assess(target);
    let placed = assessor.assess(&unnamed(target)).total;
    let looks = scene.appearance.and_then(Appearance::shortlist);
    let asks_for_structure = matches!(meaning, Meaning::Structure(_));
    let may_be = |i: usize| {
        let instance = &scene.instances[i];
        let is_thing = instance.structure.is_none() && scene.names.get(i).is_none_or(super::GivenName::is_thing);
        (is_thing || asks_for_structure) && instance.aabb.size.max() >= SPECK_M
    };
    let is_called_so = |i: usize| meaning != Meaning::Anything && scene.names.get(i).is_some_and(|name| name.fit(target, &meaning) >= CALLED_SO);
    let rankings: [Option<&[f32]>; 4] = [Some(scores), Some(&read.own), looks, Some(&placed)];
    let mut fusion = vec![0.0_f32; scores.len()];
    for (scores, weight) in rankings.into_iter().zip(WEIGHTS).filter_map(|(scores, weight)| Some((scores?, weight))) {
        for (i, rank) in best(scores, scores.len()).into_iter().filter(|&i| may_be(i)).zip(0_u16..) {
            fusion[i] += weight / (RANK + f32::from(rank));
        }
    }
    let most = fusion.iter().copied().fold(f32::EPSILON, f32::max);
    // Members of the class come before everything else, so they start above the best fusion.
    let mut worth: Vec<f32> = fusion.iter().map(|f| f / most).collect();
    for i in (0..worth.len()).filter(|&i| may_be(i) && is_called_so(i)) {
        worth[i] += 1.0 + member(&read, i);
    }
    one_per_place(scene.instances, &mut worth);
    best(&worth, top_k)
}

/// Worth of a member of the class, `0..=1`: name and relations, then colours.
fn member(read: &Assessment, i: usize) -> f32 {
    let colour = if read.nouns[i] > 0.0 { read.own[i] / read.nouns[i] } else { 0.0 };
    let related = if read.own[i] > 0.0 { read.total[i] / read.own[i] } else { 0.0 };
    read.nouns[i] * related * (WITHOUT_COLOUR + (1.0 - WITHOUT_COLOUR) * colour)
}
