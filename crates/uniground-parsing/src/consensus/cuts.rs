//! Cuts superpoints where masks of several views cut them.

use super::clusters::MaskCluster;
use super::observations::MaskObservations;
use crate::lifting::{FrameVisibility, VisibleSuperpoint};
use crate::superpoints::{Patch, Superpoints};
use std::collections::{BTreeMap, BTreeSet};
use uniground_geometry::color::{Lab, srgb_to_lab};
use uniground_geometry::scene::{FrameIndex, PointCloud};
use uniground_geometry::voxels::{VoxelKey, VoxelMap};
use uniground_geometry::{Point3, Vector3};

/// A superpoint with at least this share in a cluster is not cut, nor one with at most the rest.
const WHOLLY: f32 = 0.8;
/// Minimum number of sampled points on both sides of a cut.
const MIN_SAMPLES: usize = 6;
/// Points between sampled ones go where most samples within a cell go, meters.
const CELL_M: f32 = 0.02;

/// Superpoints that end where clusters end.
pub struct CutSuperpoints {
    /// The superpoints. Those that were cut off have the highest numbers.
    pub superpoints: Superpoints,
    /// What the frames see of them.
    pub tables: Vec<FrameVisibility>,
    /// The superpoint that each was cut off, by its number less that of the old superpoints.
    pub cut_off: Vec<u32>,
    /// The superpoints of each cluster, ascending.
    pub clusters: Vec<Vec<u32>>,
}

impl CutSuperpoints {
    /// Returns the values of all superpoints, given those of the old ones.
    pub fn extend<T: Copy>(&self, of: &[T]) -> Vec<T> {
        let mut all = of.to_vec();
        self.cut_off.iter().for_each(|&parent| all.push(all[parent as usize]));
        all
    }
}

/// Cuts superpoints that lie partly in a cluster. `seen` is what the frames see of the superpoints,
/// the frames in order, and what they show of samples.
pub fn cut_superpoints(
    cloud: &PointCloud,
    superpoints: &Superpoints,
    seen: (&[FrameVisibility], &[FrameIndex], &MaskObservations),
    clusters: &[MaskCluster],
) -> CutSuperpoints {
    let mut pieces = Pieces::of(cloud, superpoints);
    let mut sets: Vec<BTreeSet<u32>> = Vec::new();
    for cluster in clusters {
        let set = pieces.cut(cluster, &mut sets);
        sets.push(set);
    }
    let Pieces { of_point, points, cut_off, .. } = pieces;
    let old = superpoints.patches.len();
    let mut patches = superpoints.patches.clone();
    let mut roughness_m = superpoints.roughness_m.clone();
    let mut beside: Vec<BTreeSet<u32>> = vec![BTreeSet::new(); points.len()];
    for &(a, b) in &superpoints.adjacent {
        beside[a as usize].insert(b);
        beside[b as usize].insert(a);
    }
    // A piece touches what its superpoint touched: that it does not touch some of it is no loss.
    for (child, &parent) in (old as u32..).zip(&cut_off) {
        patches.push(patches[parent as usize]);
        roughness_m.push(roughness_m[parent as usize]);
        let mut around = beside[parent as usize].clone();
        around.insert(parent);
        around.iter().for_each(|&other| {
            beside[other as usize].insert(child);
        });
        beside[child as usize] = around;
    }
    let changed: BTreeSet<u32> =
        cut_off.iter().copied().chain(old as u32..points.len() as u32).collect();
    for &superpoint in &changed {
        let patch = &mut patches[superpoint as usize];
        *patch = mean_of(cloud, &points[superpoint as usize], patch);
    }
    let tables = update_tables(seen, &of_point, &changed);
    let pairs = |(a, around): (u32, BTreeSet<u32>)| {
        around.into_iter().filter(move |b| *b > a).map(move |b| (a, b))
    };
    let adjacent = (0..).zip(beside).flat_map(pairs).collect();
    CutSuperpoints {
        superpoints: Superpoints { of_point, patches, adjacent, roughness_m },
        tables,
        cut_off,
        clusters: sets.into_iter().map(|set| set.into_iter().collect()).collect(),
    }
}

/// Superpoints while they are cut.
struct Pieces<'a> {
    cloud: &'a PointCloud,
    of_point: Vec<u32>,
    /// Points of each superpoint, ascending.
    points: Vec<Vec<u32>>,
    cut_off: Vec<u32>,
}

impl<'a> Pieces<'a> {
    fn of(cloud: &'a PointCloud, superpoints: &Superpoints) -> Self {
        let of_point = superpoints.of_point.clone();
        let mut points: Vec<Vec<u32>> = vec![Vec::new(); superpoints.patches.len()];
        (0..).zip(&of_point).for_each(|(point, &s): (u32, &u32)| points[s as usize].push(point));
        Self { cloud, of_point, points, cut_off: Vec::new() }
    }

    /// Cuts superpoints along the border of a cluster. Returns those inside. `sets` are those of
    /// earlier clusters.
    fn cut(&mut self, cluster: &MaskCluster, sets: &mut [BTreeSet<u32>]) -> BTreeSet<u32> {
        let inside: BTreeSet<u32> =
            cluster.samples.iter().map(|&s| MaskObservations::point(s) as u32).collect();
        let mut in_cluster: BTreeMap<u32, usize> = BTreeMap::new();
        for &point in &inside {
            *in_cluster.entry(self.of_point[point as usize]).or_default() += 1;
        }
        let mut set = BTreeSet::new();
        for (superpoint, own) in in_cluster {
            let points = self.points[superpoint as usize].iter();
            let all = points.filter(|p| MaskObservations::sample(**p as usize).is_some()).count();
            let share = own as f32 / all.max(1) as f32;
            let is_cut =
                (1.0 - WHOLLY..WHOLLY).contains(&share) && own.min(all - own) >= MIN_SAMPLES;
            if !is_cut {
                if share > 0.5 {
                    set.insert(superpoint);
                }
                continue;
            }
            let (cut, rest) = self.divide(superpoint, &inside);
            let child = self.points.len() as u32;
            cut.iter().for_each(|&point| self.of_point[point as usize] = child);
            self.points[superpoint as usize] = rest;
            self.points.push(cut);
            self.cut_off.push(superpoint);
            for earlier in sets.iter_mut().filter(|earlier| earlier.contains(&superpoint)) {
                earlier.insert(child);
            }
            set.insert(child);
        }
        set
    }

    /// Divides the points of a superpoint into those inside and outside of a cluster, of which the
    /// sampled points are known.
    fn divide(&self, superpoint: u32, inside: &BTreeSet<u32>) -> (Vec<u32>, Vec<u32>) {
        let cell = |point: u32| VoxelKey::containing(&self.cloud.positions[point as usize], CELL_M);
        let is_sample = |point: u32| MaskObservations::sample(point as usize).is_some();
        let points = &self.points[superpoint as usize];
        let mut votes: VoxelMap<i32> = VoxelMap::default();
        for &point in points.iter().filter(|point| is_sample(**point)) {
            *votes.entry(cell(point)).or_default() += if inside.contains(&point) { 1 } else { -1 };
        }
        points.iter().partition(|&&point| match is_sample(point) {
            true => inside.contains(&point),
            false => votes.get(&cell(point)).is_some_and(|votes| *votes > 0),
        })
    }
}

/// Returns the mean of these points, with the normal of the superpoint they were part of.
fn mean_of(cloud: &PointCloud, points: &[u32], before: &Patch) -> Patch {
    if points.is_empty() {
        return Patch { points: 0, ..*before };
    }
    let (mut center, mut lab) = (Vector3::<f64>::zeros(), Lab::zeros());
    for &point in points {
        center += cloud.positions[point as usize].coords.cast::<f64>();
        lab += srgb_to_lab(cloud.colors[point as usize]);
    }
    Patch {
        points: points.len() as u32,
        center: Point3::from((center / points.len() as f64).cast::<f32>()),
        lab: lab / points.len() as f32,
        ..*before
    }
}

/// Returns the tables with the rows of changed superpoints counted anew.
fn update_tables(
    (tables, frames, observations): (&[FrameVisibility], &[FrameIndex], &MaskObservations),
    of_point: &[u32],
    changed: &BTreeSet<u32>,
) -> Vec<FrameVisibility> {
    let place: BTreeMap<FrameIndex, usize> =
        frames.iter().enumerate().map(|(i, &frame)| (frame, i)).collect();
    tables
        .iter()
        .map(|table| {
            let mut rows: Vec<VisibleSuperpoint> = table
                .rows
                .iter()
                .filter(|row| !changed.contains(&row.superpoint))
                .cloned()
                .collect();
            let mut counts: BTreeMap<u32, BTreeMap<u16, u32>> = BTreeMap::new();
            for (sample, mask) in
                observations.frames[place[&table.frame]].points(table.layer as usize)
            {
                let superpoint = of_point[MaskObservations::point(sample)];
                if changed.contains(&superpoint) {
                    *counts.entry(superpoint).or_default().entry(mask).or_default() +=
                        MaskObservations::WEIGHT;
                }
            }
            rows.extend(counts.into_iter().map(|(superpoint, masks)| VisibleSuperpoint {
                superpoint,
                visible: masks.values().sum(),
                masks: masks.into_iter().filter(|(mask, _)| *mask != 0).collect(),
            }));
            rows.sort_by_key(|row| row.superpoint);
            FrameVisibility { rows, ..*table }
        })
        .collect()
}
