//! Progressive merging: regions grow along affinities while the threshold is relaxed (paper: 0.9 to
//! 0.5 in five stages).

use super::affinity::{self, Edge};
use super::lifting::{FrameVisibility, coarsen};
use super::planes::Planes;
use super::superpoints::{Patch, Superpoints, relabel_pairs};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, VecDeque};
use uniground_geometry::progress::{Cancelled, Progress};
use uniground_geometry::union_find::UnionFind;
use uniground_types::settings::MergeSettings;

/// Regions of superpoints, level by level. Each level consists of whole regions of the previous
/// one.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Regions {
    /// Region `0..n` of each superpoint: one level per stage, and a last one with small regions
    /// absorbed.
    pub levels: Vec<Vec<u32>>,
}

impl Regions {
    /// Returns the coarsest level.
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
    let plane_of = planes.kept_apart();
    let mut graph = SuperpointGraph {
        patches: superpoints.patches.clone(),
        adjacent: superpoints.adjacent.clone(),
        plane_of,
        tables: tables.to_vec(),
    };
    if settings.keep_planes_apart {
        region_of = join_flat_things(planes);
        graph = graph.coarsen(&region_of);
    }
    for (stage, &threshold) in settings.thresholds.iter().enumerate() {
        progress.report("merge", stage as f32 / settings.thresholds.len() as f32)?;
        let mut edges = graph.compute_edges(settings, progress)?;
        if settings.keep_planes_apart {
            edges.retain(|edge| graph.plane_of[edge.a as usize] == graph.plane_of[edge.b as usize]);
        }
        let grown = grow(&graph.patches, &edges, threshold, settings.hop_decay, progress)?;
        region_of.iter_mut().for_each(|r| *r = grown[*r as usize]);
        graph = graph.coarsen(&grown);
        levels.push(region_of.clone());
    }
    if settings.keep_planes_apart {
        let whole = planes.with_patches(superpoints, &region_of);
        let patched = label_mapping(&region_of, &whole);
        graph = graph.coarsen(&patched);
        region_of = whole;
    }
    let absorbed = absorb_small(
        &graph.patches,
        &graph.compute_edges(settings, progress)?,
        settings.min_points,
    );
    region_of.iter_mut().for_each(|r| *r = absorbed[*r as usize]);
    levels.push(region_of);
    Ok(Regions { levels })
}

/// Returns the region `0..n` of each superpoint if each flat thing is one region.
fn join_flat_things(planes: &Planes) -> Vec<u32> {
    let mut sets = UnionFind::new(planes.flat_thing_of.len());
    let mut first: BTreeMap<u32, u32> = BTreeMap::new();
    for (s, thing) in (0..).zip(&planes.flat_thing_of) {
        if let Some(thing) = thing {
            sets.union(*first.entry(*thing).or_insert(s), s);
        }
    }
    sets.into_labels().0
}

/// Maps each label `0..n` in `fine` to its label in `coarse`, which must consist of whole `fine`
/// regions.
fn label_mapping(fine: &[u32], coarse: &[u32]) -> Vec<u32> {
    let mut of = vec![0; fine.iter().max().map_or(0, |&r| r as usize + 1)];
    fine.iter().zip(coarse).for_each(|(&fine, &coarse)| of[fine as usize] = coarse);
    of
}

/// The primitives of one stage and their edges.
struct SuperpointGraph {
    patches: Vec<Patch>,
    adjacent: Vec<(u32, u32)>,
    plane_of: Vec<Option<u32>>,
    tables: Vec<FrameVisibility>,
}

impl SuperpointGraph {
    fn compute_edges(
        &self,
        settings: &MergeSettings,
        progress: &Progress,
    ) -> Result<Vec<Edge>, Cancelled> {
        let pairs =
            affinity::pairs_within(&self.adjacent, self.patches.len(), settings.max_hop, progress)?;
        affinity::compute(&pairs, &self.patches, &self.tables, settings.normalisation, progress)
    }

    /// Returns the graph whose primitives are the regions of this one.
    fn coarsen(self, region_of: &[u32]) -> Self {
        let count = region_of.iter().max().map_or(0, |&r| r as usize + 1);
        Self {
            patches: Patch::merge_by_label(&self.patches, region_of, count),
            adjacent: relabel_pairs(&self.adjacent, region_of),
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

/// Runs one stage: regions grow from the largest primitives. A neighbor is added if its
/// point-weighted mean affinity to the members within reach passes the threshold. Returns regions
/// numbered in order of their seeds.
fn grow(
    patches: &[Patch],
    edges: &[Edge],
    threshold: f32,
    hop_decay: f32,
    progress: &Progress,
) -> Result<Vec<u32>, Cancelled> {
    const NONE: u32 = u32::MAX;
    let neighbors = neighbor_lists(patches.len(), edges);
    let mut order: Vec<u32> = (0..patches.len() as u32).collect();
    order.sort_by_key(|&i| (std::cmp::Reverse(patches[i as usize].points), i));
    let mut region = vec![NONE; patches.len()];
    let mut regions = 0;
    for &seed in &order {
        if region[seed as usize] != NONE {
            continue;
        }
        // Weighted affinity of each outside primitive to the region so far, and the sum of the
        // weights.
        let mut bond: BTreeMap<u32, (f32, f32)> = BTreeMap::new();
        let mut queue = VecDeque::new();
        let mut newcomer = Some(seed);
        while let Some(member) = newcomer {
            progress.check()?;
            region[member as usize] = regions;
            bond.remove(&member);
            for &(other, hop, affinity) in &neighbors[member as usize] {
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

fn neighbor_lists(count: usize, edges: &[Edge]) -> Vec<Vec<(u32, u32, f32)>> {
    let mut neighbors = vec![Vec::new(); count];
    for &Edge { a, b, hop, affinity } in edges {
        neighbors[a as usize].push((b, hop, affinity));
        neighbors[b as usize].push((a, hop, affinity));
    }
    neighbors
}

/// Merges regions below `min_points` into their most affine adjacent neighbor, smallest first.
/// Returns labels `0..n`.
fn absorb_small(patches: &[Patch], edges: &[Edge], min_points: u32) -> Vec<u32> {
    let neighbors = neighbor_lists(patches.len(), edges);
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
        let best = neighbors[i as usize]
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
    use crate::lifting::VisibleSuperpoint;
    use crate::planes::Plane;
    use proptest::prelude::*;
    use std::sync::{Arc, Mutex};
    use uniground_geometry::color::Lab;
    use uniground_geometry::scene::{FrameIndex, Structure};
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
    fn chain_is_split_at_a_weak_edge() {
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
    fn neighbor_must_match_the_whole_region() {
        // 2 has a high affinity to 1 but a low one to the much larger 0. 0 and 1 merge first, and 0
        // outweighs 1.
        let edges = [edge(0, 1, 0.95), edge(0, 2, 0.1), edge(1, 2, 0.95)];
        assert_eq!(
            grow(&patches(&[1000, 50, 60]), &edges, 0.9, 0.5, &Progress::silent()),
            Ok(vec![0, 0, 1])
        );
    }

    #[test]
    fn small_regions_join_their_most_affine_neighbor() {
        let labels = absorb_small(
            &patches(&[500, 500, 10, 3]),
            &[edge(0, 2, 0.2), edge(1, 2, 0.4), edge(2, 3, 0.1)],
            50,
        );
        assert_eq!(labels, [0, 1, 1, 1]);
        assert_eq!(absorb_small(&patches(&[500, 3]), &[], 50), [0, 1]);
    }

    fn grow_silently(
        points: &[u32],
        edges: &[Edge],
        threshold: f32,
        hop_decay: f32,
    ) -> Result<Vec<u32>, Cancelled> {
        grow(&patches(points), edges, threshold, hop_decay, &Progress::silent())
    }

    #[test]
    fn affinity_at_the_threshold_joins_and_below_does_not() {
        let joined = |affinity: f32, threshold: f32| {
            grow_silently(&[64, 32], &[edge(0, 1, affinity)], threshold, 0.5) == Ok(vec![0, 0])
        };
        // Halves and quarters are exact.
        for threshold in [0.5, 0.625, 0.75, 0.875] {
            assert!(joined(threshold, threshold), "at {threshold}");
            assert!(joined(threshold + 1e-3, threshold), "just above {threshold}");
            assert!(!joined(threshold - 1e-3, threshold), "just below {threshold}");
            assert!(!joined(0.9 * threshold, threshold), "a tenth below {threshold}");
        }
        assert!(joined(0.0, 0.0));
    }

    #[test]
    fn affinity_to_a_region_is_a_mean_weighted_by_points_and_hops() {
        // 1 joins 0. Then 2 has the affinity 1/4 to 0, two borders away, and 3/4 to 1 beside it:
        // weights 100 * 0.5 = 50 and 50 * 1 = 50, mean (50 / 4 + 50 * 3 / 4) / 100 = 1/2. Without
        // the decay it would be (100 / 4 + 150 / 4) / 150 = 5/12, without the points
        // (0.5 / 4 + 3 / 4) / 1.5 = 7/12.
        let edges =
            [edge(0, 1, 1.0), edge(1, 2, 0.75), Edge { a: 0, b: 2, hop: 2, affinity: 0.25 }];
        let regions = |threshold| grow_silently(&[100, 50, 10], &edges, threshold, 0.5);
        assert_eq!(regions(0.5), Ok(vec![0, 0, 0]));
        assert_eq!(regions(0.501), Ok(vec![0, 0, 1]));
    }

    #[test]
    fn weight_at_three_hops_is_the_decay_squared() {
        // 2 to 0 over three borders with the affinity 0, to 1 with 3/4: weights 64 / 16 = 4 and
        // 12, mean (0 + 12 * 3 / 4) / 16 = 9/16.
        let edges = [edge(0, 1, 1.0), edge(1, 2, 0.75), Edge { a: 0, b: 2, hop: 3, affinity: 0.0 }];
        let regions = |threshold| grow_silently(&[64, 12, 10], &edges, threshold, 0.25);
        assert_eq!(regions(0.5625), Ok(vec![0, 0, 0]));
        assert_eq!(regions(0.563), Ok(vec![0, 0, 1]));
    }

    #[test]
    fn zero_hop_decay_counts_only_adjacent_superpoints() {
        // 2 has no affinity to 0, two borders away. Only its affinity to the adjacent 1 counts.
        let edges = [edge(0, 1, 1.0), edge(1, 2, 0.75), Edge { a: 0, b: 2, hop: 2, affinity: 0.0 }];
        assert_eq!(grow_silently(&[64, 32, 8], &edges, 0.75, 0.0), Ok(vec![0, 0, 0]));
        assert_eq!(grow_silently(&[64, 32, 8], &edges, 0.75, 1.0), Ok(vec![0, 0, 1]));
    }

    #[test]
    fn regions_grow_only_to_adjacent_superpoints() {
        let far = [Edge { a: 0, b: 1, hop: 2, affinity: 1.0 }];
        assert_eq!(grow_silently(&[64, 32], &far, 0.5, 1.0), Ok(vec![0, 1]));
    }

    #[test]
    fn regions_are_numbered_by_descending_seed_size() {
        assert_eq!(grow_silently(&[10, 100, 50, 100], &[], 0.5, 0.5), Ok(vec![3, 0, 2, 1]));
        // A small superpoint between two large ones joins the larger one and does not connect the
        // other.
        let edges = [edge(0, 1, 1.0), edge(1, 2, 1.0), Edge { a: 0, b: 2, hop: 2, affinity: 0.0 }];
        assert_eq!(grow_silently(&[100, 10, 90], &edges, 0.5, 0.5), Ok(vec![0, 0, 1]));
        assert_eq!(grow_silently(&[90, 10, 100], &edges, 0.5, 0.5), Ok(vec![1, 0, 0]));
    }

    #[test]
    fn cancellation_stops_growing() {
        let cancelled = Progress::new(|_, _| {}, || true);
        assert_eq!(grow(&patches(&[1]), &[], 0.5, 0.5, &cancelled), Err(Cancelled));
    }

    #[test]
    fn regions_with_enough_points_are_not_absorbed() {
        let absorbed = |min_points| {
            absorb_small(&patches(&[500, 50]), &[edge(0, 1, 0.1)], min_points) == [0, 0]
        };
        assert_eq!([49, 50, 51].map(absorbed), [false, false, true]);
    }

    #[test]
    fn small_regions_join_only_adjacent_regions() {
        let far = Edge { a: 0, b: 2, hop: 2, affinity: 0.9 };
        assert_eq!(absorb_small(&patches(&[500, 400, 3]), &[far], 50), [0, 1, 2]);
        let edges = [far, edge(1, 2, 0.1)];
        assert_eq!(absorb_small(&patches(&[500, 400, 3]), &edges, 50), [0, 1, 1]);
    }

    #[test]
    fn ties_in_affinity_go_to_the_first_neighbor() {
        let edges = [edge(1, 2, 0.5), edge(0, 2, 0.5)];
        assert_eq!(absorb_small(&patches(&[500, 600, 3]), &edges, 50), [0, 1, 0]);
    }

    #[test]
    fn small_regions_that_are_large_enough_together_stay_separate() {
        // 2 joins 1: 30 + 25 = 55 points.
        let edges = [edge(0, 1, 0.1), edge(1, 2, 0.9)];
        assert_eq!(absorb_small(&patches(&[500, 30, 25]), &edges, 55), [0, 1, 1]);
        assert_eq!(absorb_small(&patches(&[500, 30, 25]), &edges, 56), [0, 0, 0]);
        // 10 + 8 = 18 is too few. The product, 80, would be enough.
        assert_eq!(absorb_small(&patches(&[500, 10, 8]), &edges, 50), [0, 0, 0]);
    }

    #[test]
    fn smallest_regions_are_absorbed_first() {
        // 2 joins 1, then both join 0. If 1 were first, both would join 3 through 2's affinity to
        // it.
        let edges = [edge(0, 1, 0.1), edge(1, 2, 0.9), edge(2, 3, 0.5)];
        assert_eq!(absorb_small(&patches(&[500, 10, 3, 500]), &edges, 50), [0, 0, 0, 1]);
        // With equal numbers of points, the lower label is first.
        assert_eq!(absorb_small(&patches(&[500, 10, 10, 500]), &edges, 50), [0, 1, 1, 1]);
    }

    #[test]
    fn label_mapping_gives_the_coarse_label_of_each_fine_label() {
        assert_eq!(label_mapping(&[0, 1, 1, 3, 2], &[4, 0, 0, 1, 4]), [4, 0, 4, 1]);
        assert!(label_mapping(&[], &[]).is_empty());
    }

    #[test]
    fn coarsened_graph_has_regions_as_primitives() {
        let row = |superpoint, visible, masks: &[(u16, u32)]| VisibleSuperpoint {
            superpoint,
            visible,
            masks: masks.to_vec(),
        };
        let table = |rows| FrameVisibility { frame: FrameIndex(2), layer: 0, masks: 1, rows };
        let graph = SuperpointGraph {
            patches: patches(&[10, 20, 40]),
            adjacent: vec![(0, 1), (0, 2), (1, 2)],
            plane_of: vec![None, Some(3), None],
            tables: vec![table(vec![
                row(0, 1, &[(1, 1)]),
                row(1, 2, &[(1, 2)]),
                row(2, 4, &[(1, 4)]),
            ])],
        };
        let coarse = graph.coarsen(&[1, 0, 1]);
        assert_eq!(coarse.patches.iter().map(|patch| patch.points).collect::<Vec<_>>(), [20, 50]);
        assert_eq!((coarse.adjacent, coarse.plane_of), (vec![(0, 1)], vec![Some(3), None]));
        assert_eq!(coarse.tables, [table(vec![row(0, 2, &[(1, 2)]), row(1, 5, &[(1, 5)])])]);
    }

    /// Returns superpoints with these numbers of points, each adjacent to the next, and one frame
    /// that sees all of them in these masks.
    fn chain(points: &[u32], masks: &[&[(u16, u32)]]) -> (Superpoints, [FrameVisibility; 1]) {
        let count = points.len() as u32;
        let rows = (0..).zip(points).zip(masks);
        let rows = rows.map(|((superpoint, &visible), masks)| VisibleSuperpoint {
            superpoint,
            visible,
            masks: masks.to_vec(),
        });
        let table =
            FrameVisibility { frame: FrameIndex(0), layer: 0, masks: 9, rows: rows.collect() };
        let superpoints = Superpoints {
            of_point: (0..count).collect(),
            patches: patches(points),
            adjacent: (1..count).map(|i| (i - 1, i)).collect(),
            roughness_m: vec![0.0; points.len()],
        };
        (superpoints, [table])
    }

    fn wall() -> Plane {
        Plane {
            structure: Structure::Wall,
            normal: Vector3::x(),
            middle: Point3::origin(),
            area_m2: 10.0,
        }
    }

    fn without_planes(count: usize) -> Planes {
        Planes::new(Vec::new(), vec![None; count])
    }

    fn settings(thresholds: &[f32], min_points: u32) -> MergeSettings {
        MergeSettings {
            thresholds: thresholds.to_vec(),
            min_points,
            keep_planes_apart: false,
            ..MergeSettings::default()
        }
    }

    #[test]
    fn each_stage_merges_affinities_that_reach_its_threshold() {
        // 0 and 1 are in one mask: affinity 1. 2 has the histogram (3, 4): affinity 3/5 to each of
        // them, and to both together.
        let (superpoints, tables) =
            chain(&[40, 30, 20], &[&[(1, 40)], &[(1, 30)], &[(1, 12), (2, 16)]]);
        let told = Arc::new(Mutex::new(Vec::new()));
        let sink = told.clone();
        let progress =
            Progress::new(move |stage, done| sink.lock().unwrap().push((stage, done)), || false);
        let levels = |thresholds: &[f32], progress: &Progress| {
            merge(&superpoints, &without_planes(3), &tables, &settings(thresholds, 0), progress)
                .unwrap()
                .levels
        };
        let (apart, all) = (vec![0, 0, 1], vec![0, 0, 0]);
        assert_eq!(
            levels(&[0.9, 0.65, 0.59, 0.1], &progress),
            [apart.clone(), apart.clone(), all.clone(), all.clone(), all]
        );
        assert_eq!(
            *told.lock().unwrap(),
            [("merge", 0.0), ("merge", 0.25), ("merge", 0.5), ("merge", 0.75)]
        );
        // 3/5 is below 0.65, by less than 10 %.
        assert_eq!(levels(&[0.65], &Progress::silent()), [apart.clone(), apart]);
        assert_eq!(
            levels(&[], &Progress::silent()),
            [vec![0, 1, 2]],
            "without stages nothing merges"
        );
    }

    #[test]
    fn last_level_absorbs_small_regions() {
        // Each is in a mask of its own, so nothing merges. 2 has 9 points and joins 1.
        let (superpoints, tables) = chain(&[40, 30, 9], &[&[(1, 40)], &[(2, 30)], &[(3, 9)]]);
        let merged = |min_points| {
            merge(
                &superpoints,
                &without_planes(3),
                &tables,
                &settings(&[0.5], min_points),
                &Progress::silent(),
            )
            .unwrap()
        };
        assert_eq!(merged(10).levels, [vec![0, 1, 2], vec![0, 1, 1]]);
        assert_eq!(merged(9).levels, [vec![0, 1, 2], vec![0, 1, 2]]);
        assert_eq!(merged(10).last(), [0, 1, 1]);
        assert!(Regions { levels: Vec::new() }.last().is_empty());
    }

    #[test]
    fn superpoints_of_different_planes_stay_separate() {
        // All in one mask: affinity 1.
        let (superpoints, tables) =
            chain(&[40, 30, 20, 10], &[&[(1, 40)], &[(1, 30)], &[(1, 20)], &[(1, 10)]]);
        let merged = |of_superpoint: [Option<u32>; 4], keep_planes_apart| {
            let planes = Planes::new(Vec::new(), of_superpoint.to_vec());
            let settings = MergeSettings { keep_planes_apart, ..settings(&[0.5], 0) };
            merge(&superpoints, &planes, &tables, &settings, &Progress::silent()).unwrap().levels
        };
        let planes = [Some(0), Some(0), Some(1), None];
        assert_eq!(merged(planes, true), [vec![0, 0, 1, 2], vec![0, 0, 1, 2]]);
        assert_eq!(merged(planes, false), [vec![0; 4], vec![0; 4]]);
        // Superpoints on no plane join each other.
        let before_a_plane = vec![0, 1, 1, 1];
        assert_eq!(
            merged([Some(0), None, None, None], true),
            [before_a_plane.clone(), before_a_plane]
        );
    }

    #[test]
    fn flat_things_stay_whole_and_apart() {
        // A poster, superpoints 1 and 2, which one mask shows with the wall and another one cuts.
        let (superpoints, tables) =
            chain(&[40, 30, 20, 10], &[&[(1, 40)], &[(1, 30)], &[(2, 20)], &[(2, 10)]]);
        let mut planes = Planes::new(vec![wall()], vec![Some(0), None, None, None]);
        planes.flat_thing_of = vec![None, Some(0), Some(0), None];
        let last = |keep_planes_apart| {
            let settings = MergeSettings { keep_planes_apart, ..settings(&[0.5], 0) };
            let merged = merge(&superpoints, &planes, &tables, &settings, &Progress::silent());
            merged.unwrap().last().to_vec()
        };
        // Regions by size.
        assert_eq!(last(true), [1, 0, 0, 2]);
        assert_eq!(last(false), [0, 0, 1, 1]);
    }

    #[test]
    fn patches_rejoin_their_plane_before_small_regions_are_absorbed() {
        // 0 is a wall of 1000 points, 1 a patch of it in a mask of its own, 10 of 1010 points of 10
        // square meters: 0.099. 2 is a small region next to the patch, 3 a large thing next to the
        // small region.
        let (superpoints, tables) =
            chain(&[1000, 10, 5, 400], &[&[(1, 1000)], &[(2, 10)], &[(2, 3), (3, 4)], &[(4, 400)]]);
        let planes = Planes::new(vec![wall()], vec![Some(0), Some(0), None, None]);
        let merged = |keep_planes_apart| {
            let settings = MergeSettings { keep_planes_apart, ..settings(&[0.9], 6) };
            merge(&superpoints, &planes, &tables, &settings, &Progress::silent()).unwrap().levels
        };
        // Regions by size: 0, 3, 1, 2. The patch rejoins the wall, together with the small region.
        assert_eq!(merged(true), [vec![0, 2, 3, 1], vec![0, 0, 0, 1]]);
        // Otherwise the patch stays separate and absorbs the small region.
        assert_eq!(merged(false), [vec![0, 2, 3, 1], vec![0, 2, 2, 1]]);
    }

    #[test]
    fn empty_input_gives_empty_levels_and_cancellation_stops_merging() {
        let (superpoints, tables) = chain(&[], &[]);
        let merged = |progress: &Progress| {
            merge(&superpoints, &without_planes(0), &tables, &settings(&[0.5], 9), progress)
        };
        let nothing = Regions { levels: vec![vec![], vec![]] };
        assert_eq!(merged(&Progress::silent()), Ok(nothing));
        assert_eq!(merged(&Progress::new(|_, _| {}, || true)), Err(Cancelled));
    }

    /// Generates sizes of superpoints and edges between them, with affinities in 64ths.
    fn graphs() -> impl Strategy<Value = (Vec<u32>, Vec<Edge>)> {
        let border = (0_u32..8, 0_u32..8, 1_u32..3, 0_u32..=64);
        let borders = prop::collection::vec(border, 0..20);
        (prop::collection::vec(1_u32..100, 8), borders).prop_map(|(points, borders)| {
            let borders = borders.into_iter().filter(|border| border.0 < border.1);
            let edges: BTreeMap<(u32, u32), Edge> = borders
                .map(|(a, b, hop, share)| {
                    ((a, b), Edge { a, b, hop, affinity: share as f32 / 64.0 })
                })
                .collect();
            (points, edges.into_values().collect())
        })
    }

    proptest! {
        #[test]
        fn two_superpoints_join_exactly_from_the_threshold_on(
            points in prop::array::uniform2(0_u32..10),
            affinity in 0_u32..=64,
            threshold in 0_u32..=64,
        ) {
            // Powers of two and 64ths: nothing is rounded.
            let share = |of_64: u32| of_64 as f32 / 64.0;
            let edges = [edge(0, 1, share(affinity))];
            let found =
                grow_silently(&points.map(|n| 1 << n), &edges, share(threshold), 0.5).unwrap();
            prop_assert_eq!(found[0] == found[1], affinity >= threshold, "{:?}", found);
        }

        /// Regions are also numbered by the descending size of their largest superpoint.
        #[test]
        fn regions_are_connected_and_numbered_without_gaps(
            (points, edges) in graphs(),
            threshold in 0.0_f32..1.0,
        ) {
            let region = grow_silently(&points, &edges, threshold, 0.5).unwrap();
            let mut sets = UnionFind::new(8);
            let inner = |edge: &&Edge| {
                edge.hop == 1 && region[edge.a as usize] == region[edge.b as usize]
            };
            edges.iter().filter(inner).for_each(|edge| {
                sets.union(edge.a, edge.b);
            });
            let regions = region.iter().max().unwrap() + 1;
            let (_, connected) = sets.into_labels();
            prop_assert_eq!(connected, regions as usize, "{:?}", region);
            let largest = |r: u32| {
                (0..8).filter(|&i| region[i] == r).map(|i| points[i]).max().unwrap_or(0)
            };
            prop_assert!((1..regions).all(|r| 0 < largest(r) && largest(r) <= largest(r - 1)));
        }

        /// Above all affinities nothing merges. At 0 everything adjacent merges.
        #[test]
        fn extreme_thresholds_merge_nothing_or_all_adjacent_superpoints(
            (points, edges) in graphs(),
        ) {
            let region = grow_silently(&points, &edges, 1.01, 0.5).unwrap();
            prop_assert_eq!(region.iter().max(), Some(&7));
            let region = grow_silently(&points, &edges, 0.0, 0.5).unwrap();
            let touching = edges.iter().filter(|edge| edge.hop == 1);
            for edge in touching {
                prop_assert_eq!(region[edge.a as usize], region[edge.b as usize], "{:?}", edge);
            }
        }

        #[test]
        fn absorbing_does_not_depend_on_edge_order(
            (points, edges) in graphs(),
            min_points in 0_u32..120,
        ) {
            let mut reversed = edges.clone();
            reversed.reverse();
            let absorbed = |edges: &[Edge]| absorb_small(&patches(&points), edges, min_points);
            prop_assert_eq!(absorbed(&edges), absorbed(&reversed));
        }

        #[test]
        fn remaining_small_regions_have_no_neighbors(
            (points, edges) in graphs(),
            min_points in 0_u32..120,
        ) {
            let label = absorb_small(&patches(&points), &edges, min_points);
            let size = |of: u32| {
                (0..8).filter(|&i| label[i] == of).map(|i| points[i]).sum::<u32>()
            };
            let big = (0..8).all(|i| points[i] >= min_points);
            prop_assert!(!big || label == [0, 1, 2, 3, 4, 5, 6, 7], "{:?}", label);
            // A small region that joined nothing has no adjacent region.
            for i in (0..8).filter(|&i| points[i] < min_points && size(label[i]) == points[i]) {
                let touches = |edge: &&Edge| {
                    edge.hop == 1 && (edge.a as usize == i || edge.b as usize == i)
                };
                prop_assert_eq!(edges.iter().find(touches), None, "{} of {:?}", i, label);
            }
        }
    }
}
