//! Places in an order: "the second closest", "the leftmost", "the third from the door".

use super::Assessor;
use crate::geometry::Vector3;
use crate::grounding::fit::most_plausible;
use crate::grounding::query::{Measure, Relation, RelationKind, Superlative};
use crate::grounding::relations;

/// Each place further from the asked extreme multiplies the score by this.
const NEXT_BEST: f32 = 0.45;
/// Power of a fit when things are ranked: what hardly fits the noun hardly takes up a place in the ranking.
const PRESENCE_POWER: i32 = 4;
/// Windows, doors, screens and pictures are thinner, metres.
const THIN_M: f32 = 0.2;
/// What stands on the floor begins below, metres.
const OFF_THE_FLOOR_M: f32 = 0.4;
/// At this gap from what is looked at a thing is half in view, metres.
const LOOKED_AT_REACH_M: f32 = 1.5;

impl Assessor<'_> {
    /// "the largest", "the second from the left".
    pub(super) fn apply_superlative(&self, superlative: Superlative, scores: &mut [f32]) {
        let along = |i: usize, direction: Vector3<f32>| self.solids[i].center.coords.dot(&direction);
        let measure = |i: usize| match superlative.measure {
            Measure::Largest => self.solids[i].volume(),
            Measure::Smallest => -self.solids[i].volume(),
            Measure::Tallest => self.solids[i].size[2],
            Measure::Shortest => -self.solids[i].size[2],
            Measure::Highest => self.solids[i].center.z,
            Measure::Lowest => -self.solids[i].center.z,
            Measure::Leftmost => -along(i, self.directions.right),
            Measure::Rightmost | Measure::Middle => along(i, self.directions.right),
            Measure::Frontmost => along(i, self.directions.front),
            Measure::Backmost => -along(i, self.directions.front),
        };
        let sideways = matches!(superlative.measure, Measure::Leftmost | Measure::Rightmost | Measure::Middle);
        // Who faces a window or a picture has the whole room in view.
        let floor_z = self.scene.extent.min().z;
        let stands_free = |i: &usize| self.solids[*i].sides().1 > THIN_M && self.solids[*i].bottom < floor_z + OFF_THE_FLOOR_M;
        if let Some(looked_at) = self.looked_at.filter(|_| sideways).filter(stands_free) {
            let here = |i: usize| relations::reaching(&self.solids[i], &self.solids[looked_at], LOOKED_AT_REACH_M);
            scores.iter_mut().enumerate().for_each(|(i, score)| *score *= 0.5 + 0.5 * here(i));
        }
        let mut order: Vec<(f32, usize)> = most_plausible(scores, usize::MAX).into_iter().map(|(t, _)| (measure(t), t)).collect();
        order.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        let places = soft_places(&order, scores);
        let asked = match superlative.measure {
            Measure::Middle => places.last().map_or(0.0, |(_, last, _)| last / 2.0),
            _ => superlative.rank.max(1) as f32 - 1.0,
        };
        let mut factors = vec![0.0; scores.len()];
        nearness_to(&places, asked).into_iter().for_each(|(t, factor)| factors[t] = factor);
        scores.iter_mut().zip(factors).for_each(|(score, factor)| *score *= factor);
    }
}

/// How well each instance has the asked place of an order by distance.
pub(super) fn ranked(relation: &Relation, order: &mut [(f32, usize)], fits: &[f32]) -> Vec<(usize, f32)> {
    order.sort_by(|x, y| x.0.total_cmp(&y.0).then(x.1.cmp(&y.1)));
    if relation.kind == RelationKind::Farthest {
        order.reverse();
    }
    nearness_to(&soft_places(order, fits), (relation.rank.max(1) - 1) as f32)
}

/// For each instance of an order: its index, its place from 0, and how surely it is what is asked for, `0..=1`.
///
/// Those ahead count towards the place only as far as they fit themselves: the largest thing that might be a table is seldom a table.
fn soft_places(order: &[(f32, usize)], fits: &[f32]) -> Vec<(usize, f32, f32)> {
    let best = order.iter().map(|&(_, t)| fits[t]).fold(f32::EPSILON, f32::max);
    let mut ahead = 0.0;
    let place = |&(_, t): &(f32, usize)| {
        let (place, presence) = (ahead, (fits[t] / best).powi(PRESENCE_POWER));
        ahead += presence;
        (t, place, presence.sqrt())
    };
    order.iter().map(place).collect()
}

/// How near each instance stands to the asked place (from 0), weighed by how surely it is what is asked for; scaled so that the best
/// has 1.
fn nearness_to(places: &[(usize, f32, f32)], asked: f32) -> Vec<(usize, f32)> {
    let factor = |&(t, place, presence): &(usize, f32, f32)| (t, presence * NEXT_BEST.powf((place - asked).abs()));
    let factors: Vec<(usize, f32)> = places.iter().map(factor).collect();
    let best = factors.iter().map(|f| f.1).fold(f32::EPSILON, f32::max);
    factors.into_iter().map(|(t, factor)| (t, factor / best)).collect()
}
