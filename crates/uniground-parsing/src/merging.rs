//! Progressive merging: regions grow along affinities while the threshold is relaxed (paper: 0.9 to
//! 0.5 in five stages).

use super::affinity::{self, Edge};
use super::lifting::{FrameVisibility, coarsen};
use super::planes::Planes;
use super::superpoints::{Patch, Superpoints, relabelled};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, VecDeque};
use uniground_geometry::progress::{Cancelled, Progress};
use uniground_geometry::union_find::UnionFind;
use uniground_types::settings::MergeSettings;

/// Regions of superpoints, level by level, each made of whole regions of the one before.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Regions {
    /// Region `0..n` of each superpoint: after every stage, and at last with the small ones
    /// absorbed.
    pub levels: Vec<Vec<u32>>,
}

impl Regions {
    /// The coarsest level.
    #[must_use]
    pub fn last(&self) -> &[u32] {
        self.levels.last().map_or(&[], Vec::as_slice)
    }
}

/// Merges superpoints into regions.
///
/// # Errors
/// [`Cancelled`].
pub fn merge(
    superpoints: &Superpoints,
    planes: &Planes,
    tables: &[FrameVisibility],
    settings: &MergeSettings,
    progress: &Progress,
) -> Result<Regions, Cancelled> {
    let mut region_of: Vec<u32> = (0..superpoints.patches.len() as u32).collect();
    let mut levels = Vec::new();
    let plane_of = planes.of_superpoint.clone();
    let mut graph = SuperpointGraph {
        patches: superpoints.patches.clone(),
        adjacent: superpoints.adjacent.clone(),
        plane_of,
        tables: tables.to_vec(),
    };
    for (stage, &threshold) in settings.thresholds.iter().enumerate() {
        progress.report("merge", stage as f32 / settings.thresholds.len() as f32)?;
        let mut edges = graph.edges(settings, progress)?;
        if settings.keep_planes_apart {
            edges.retain(|edge| graph.plane_of[edge.a as usize] == graph.plane_of[edge.b as usize]);
        }
        let grown = grow(&graph.patches, &edges, threshold, settings.hop_decay, progress)?;
        region_of.iter_mut().for_each(|r| *r = grown[*r as usize]);
        graph = graph.coarsened(&grown);
        levels.push(region_of.clone());
    }
    if settings.keep_planes_apart {
        let whole = planes.with_patches(superpoints, &region_of);
        let patched = relation(&region_of, &whole);
        graph = graph.coarsened(&patched);
        region_of = whole;
    }
    let absorbed =
        absorb_small(&graph.patches, &graph.edges(settings, progress)?, settings.min_points);
    region_of.iter_mut().for_each(|r| *r = absorbed[*r as usize]);
    levels.push(region_of);
    Ok(Regions { levels })
}

/// The label in `coarse` of each label `0..n` in `fine`, of which `coarse` is made.
fn relation(fine: &[u32], coarse: &[u32]) -> Vec<u32> {
    let mut of = vec![0; fine.iter().max().map_or(0, |&r| r as usize + 1)];
    fine.iter().zip(coarse).for_each(|(&fine, &coarse)| of[fine as usize] = coarse);
    of
}

/// The primitives of one stage.
struct SuperpointGraph {
    patches: Vec<Patch>,
    adjacent: Vec<(u32, u32)>,
    plane_of: Vec<Option<u32>>,
    tables: Vec<FrameVisibility>,
}

impl SuperpointGraph {
    fn edges(&self, settings: &MergeSettings, progress: &Progress) -> Result<Vec<Edge>, Cancelled> {
        let pairs =
            affinity::pairs_within(&self.adjacent, self.patches.len(), settings.max_hop, progress)?;
        affinity::compute(&pairs, &self.patches, &self.tables, settings.normalisation, progress)
    }

    /// The graph whose primitives are the regions of this one.
    fn coarsened(self, region_of: &[u32]) -> Self {
        let count = region_of.iter().max().map_or(0, |&r| r as usize + 1);
        Self {
            patches: Patch::joined(&self.patches, region_of, count),
            adjacent: relabelled(&self.adjacent, region_of),
            plane_of: {
                let mut plane_of = vec![None; count];
                region_of
                    .iter()
                    .zip(&self.plane_of)
                    .for_each(|(&region, plane)| plane_of[region as usize] = *plane);
                plane_of
            },
            tables: self.tables.par_iter().map(|table| coarsen(table, region_of)).collect(),
        }
    }
}

/// One stage: regions grow from the largest primitives and take a neighbour whose point-weighted
/// mean affinity to the members within reach passes the threshold. Returns regions numbered in
/// order of their seeds.
fn grow(
    patches: &[Patch],
    edges: &[Edge],
    threshold: f32,
    hop_decay: f32,
    progress: &Progress,
) -> Result<Vec<u32>, Cancelled> {
    const NONE: u32 = u32::MAX;
    let neighbours = neighbour_lists(patches.len(), edges);
    let mut order: Vec<u32> = (0..patches.len() as u32).collect();
    order.sort_by_key(|&i| (std::cmp::Reverse(patches[i as usize].points), i));
    let mut region = vec![NONE; patches.len()];
    let mut regions = 0;
    for &seed in &order {
        if region[seed as usize] != NONE {
            continue;
        }
        // Weighted affinity of each outsider to the region so far, and the sum of the weights.
        let mut bond: BTreeMap<u32, (f32, f32)> = BTreeMap::new();
        let mut queue = VecDeque::new();
        let mut newcomer = Some(seed);
        while let Some(member) = newcomer {
            progress.check()?;
            region[member as usize] = regions;
            bond.remove(&member);
            for &(other, hop, affinity) in &neighbours[member as usize] {
                if region[other as usize] != NONE {
                    continue;
                }
                let weight =
                    patches[member as usize].points as f32 * hop_decay.powi(hop as i32 - 1);
                let sum = bond.entry(other).or_default();
                sum.0 += weight * affinity;
                sum.1 += weight;
                if hop == 1 {
                    queue.push_back(other);
                }
            }
            newcomer = None;
            while let Some(candidate) = queue.pop_front() {
                if bond.get(&candidate).is_some_and(|(sum, weight)| sum / weight >= threshold) {
                    newcomer = Some(candidate);
                    break;
                }
            }
        }
        regions += 1;
    }
    Ok(region)
}

fn neighbour_lists(count: usize, edges: &[Edge]) -> Vec<Vec<(u32, u32, f32)>> {
    let mut neighbours = vec![Vec::new(); count];
    for &Edge { a, b, hop, affinity } in edges {
        neighbours[a as usize].push((b, hop, affinity));
        neighbours[b as usize].push((a, hop, affinity));
    }
    neighbours
}

/// Regions below `min_points` join their most affine adjacent neighbour, smallest first; returns
/// labels `0..n`.
fn absorb_small(patches: &[Patch], edges: &[Edge], min_points: u32) -> Vec<u32> {
    let neighbours = neighbour_lists(patches.len(), edges);
    let mut sets = UnionFind::new(patches.len());
    let mut points: Vec<u32> = patches.iter().map(|p| p.points).collect();
    let mut small: Vec<u32> =
        (0..patches.len() as u32).filter(|&i| points[i as usize] < min_points).collect();
    small.sort_by_key(|&i| (points[i as usize], i));
    for i in small {
        let own = sets.find(i);
        if points[own as usize] >= min_points {
            continue;
        }
        let best = neighbours[i as usize]
            .iter()
            .filter(|(_, hop, _)| *hop == 1)
            .map(|&(other, _, affinity)| (affinity, std::cmp::Reverse(other)))
            .filter(|(_, other)| sets.find(other.0) != own)
            .max_by(|x, y| x.0.total_cmp(&y.0).then(x.1.cmp(&y.1)));
        if let Some((_, other)) = best {
            let total = points[own as usize] + points[sets.find(other.0) as usize];
            let root = sets.union(own, other.0);
            points[root as usize] = total;
        }
    }
    sets.into_labels().0
}

#[cfg(test)]
mod tests {
    use super::*;
    use uniground_geometry::colour::Lab;
    use uniground_geometry::{Point3, Vector3};

    fn patches(points: &[u32]) -> Vec<Patch> {
        points
            .iter()
            .map(|&points| Patch {
                points,
                center: Point3::origin(),
                normal: Vector3::z(),
                lab: Lab::zeros(),
            })
            .collect()
    }

    fn edge(a: u32, b: u32, affinity: f32) -> Edge {
        Edge { a, b, hop: 1, affinity }
    }

    #[test]
    fn a_chain_breaks_at_its_weak_link() {
        let region = grow(
            &patches(&[100, 90, 80, 70]),
            &[edge(0, 1, 0.95), edge(1, 2, 0.3), edge(2, 3, 0.95)],
            0.9,
            0.5,
            &Progress::silent(),
        );
        assert_eq!(region, Ok(vec![0, 0, 1, 1]));
    }

    #[test]
    fn a_neighbour_must_suit_the_whole_region() {
        // 2 is close to 1 but a stranger to the far larger 0: 0 and 1 merge first and then outvote
        // 1.
        let edges = [edge(0, 1, 0.95), edge(0, 2, 0.1), edge(1, 2, 0.95)];
        assert_eq!(
            grow(&patches(&[1000, 50, 60]), &edges, 0.9, 0.5, &Progress::silent()),
            Ok(vec![0, 0, 1])
        );
    }

    #[test]
    fn crumbs_join_their_most_affine_neighbour() {
        let labels = absorb_small(
            &patches(&[500, 500, 10, 3]),
            &[edge(0, 2, 0.2), edge(1, 2, 0.4), edge(2, 3, 0.1)],
            50,
        );
        assert_eq!(labels, [0, 1, 1, 1]);
        assert_eq!(absorb_small(&patches(&[500, 3]), &[], 50), [0, 1]);
    }
}
