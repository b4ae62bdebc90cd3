//! Compares instances by their distance to an anchor: "closest to", "farthest from", and which of
//! several is rather "near" or "far".

use super::places::{places_by_distance, ranks_by_distance};
use super::{Assessor, NO_BOND, RelationMatch, better_match};
use crate::fit::most_plausible;
use crate::relations;
use uniground_language::Relation;

/// An instance that stands on or in an anchor to at least this degree counts as touching it. In an
/// order by distance it comes before all that are apart: distance in meters.
const MOSTLY_HELD: f32 = 0.5;
const HELD_M: f32 = -1e3;
/// Lowest factor of "near" and "far" for instances that others surpass: of two that are near, the
/// nearer one is rather meant, but "all chairs near the table" means both.
const SURPASSED: f32 = 0.8;

impl Assessor<'_> {
    /// Returns the distance by which instances are compared, meters. An instance that touches the
    /// anchor because it stands on or in it is nearer than all others.
    fn distance(&self, target: usize, anchor: usize) -> f32 {
        let (of_target, of_anchor) = (&self.solids[target], &self.solids[anchor]);
        let is_building = self.scene.instances[anchor].structure.is_some();
        let held = !is_building && relations::holds(of_anchor, of_target) > MOSTLY_HELD;
        relations::apart(of_target, of_anchor, is_building, self.room())
            + if held { HELD_M } else { 0.0 }
    }

    /// Lowers "near" and "far" of instances that others surpass.
    pub(super) fn rank_matches(
        &self,
        relation: &Relation,
        fits: &[f32],
        bonds: &mut [RelationMatch],
    ) {
        let mut order: Vec<(f32, usize)> = most_plausible(fits, usize::MAX)
            .into_iter()
            .filter_map(|(t, _)| {
                let anchor = bonds[t].anchor?.0 as usize - 1;
                Some((self.distance(t, anchor), t))
            })
            .collect();
        for (t, rank) in places_by_distance(relation, &mut order, fits) {
            bonds[t].score *= SURPASSED + (1.0 - SURPASSED) * 0.5_f32.powf(rank);
        }
    }

    /// Scores "closest to": compares the instances that the target may be, and each rank further
    /// down counts less. Several anchors count by the sum of the distances to them.
    pub(super) fn match_by_distance(
        &self,
        relation: &Relation,
        fits: &[f32],
        anchors: &[Vec<(usize, f32)>],
    ) -> Vec<RelationMatch> {
        let [first, others @ ..] = anchors else { return vec![NO_BOND; fits.len()] };
        let rivals = most_plausible(fits, usize::MAX);
        let likeliest: Vec<usize> = others
            .iter()
            .filter_map(|c| c.iter().max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0))))
            .map(|c| c.0)
            .collect();
        let mut bonds = vec![NO_BOND; fits.len()];
        for &(a, anchor_fit) in first {
            let mut order: Vec<(f32, usize)> = rivals
                .iter()
                .map(|&(t, _)| t)
                .filter(|&t| t != a && !likeliest.contains(&t))
                .map(|t| {
                    let others = likeliest.iter().map(|&b| self.distance(t, b)).sum::<f32>();
                    (self.distance(t, a) + others, t)
                })
                .collect();
            for (t, factor) in ranks_by_distance(relation, &mut order, fits) {
                bonds[t] = better_match(
                    bonds[t],
                    RelationMatch { score: anchor_fit.sqrt() * factor, anchor: Some(self.id(a)) },
                );
            }
        }
        bonds
    }
}
