//! VCCS (Papon et al. 2013): supervoxels grow from seeds over the voxel graph, one ring per round.
//!
//! All voxels read their neighbors' labels of the previous round. So a round runs in parallel, and
//! its result does not depend on the order of work.

use super::voxel_cloud::VoxelCloud;
use super::{Patch, SuperpointSettings};
use rayon::prelude::*;
use uniground_geometry::color::Lab;
use uniground_geometry::progress::{Cancelled, Progress};
use uniground_geometry::voxels::VoxelGrid;
use uniground_geometry::{Point3, Vector3};

const NONE: u32 = u32::MAX;
/// CIELAB distance that counts as one unit.
const COLOR_UNIT: f32 = 50.0;
/// Maximum extent of a supervoxel in seed distances: PCL's value, enough to meet neighbors around
/// corners.
const REACH: f32 = 1.8;

/// Growth ends when fewer voxels than this share changed their label in a round: then only single
/// voxels still alternate.
const SETTLED_SHARE: f32 = 0.05;

/// Labels every voxel. Parts of the graph that no seed reaches become separate supervoxels.
pub(super) fn grow(
    voxels: &VoxelCloud,
    settings: &SuperpointSettings,
    progress: &Progress,
) -> Result<Vec<u32>, Cancelled> {
    let seeds = seeds(voxels, settings);
    let mut labels = vec![NONE; voxels.len()];
    for (label, &seed) in seeds.iter().enumerate() {
        labels[seed as usize] = label as u32;
    }
    let mut centers: Vec<Patch> = seeds.iter().map(|&s| voxels.patches[s as usize]).collect();
    // Only voxels at a border can change their label. A voxel becomes one when a neighbor changes.
    let mut at_border = vec![false; voxels.len()];
    seeds.iter().flat_map(|&s| voxels.neighbors(s)).for_each(|&n| at_border[n as usize] = true);
    let rounds = (REACH * settings.seed_m / settings.voxel_m).ceil() as usize;
    for round in 0..rounds {
        progress.report("superpoints", round as f32 / rounds as f32)?;
        let border: Vec<u32> =
            (0..voxels.len() as u32).filter(|&v| at_border[v as usize]).collect();
        let wanted: Vec<Option<u32>> = border
            .par_iter()
            .map(|&v| best_label(voxels, &labels, &centers, v, settings))
            .collect();
        let mut changed = Vec::new();
        for (&v, label) in border.iter().zip(wanted) {
            at_border[v as usize] = label.is_some();
            if let Some(label) = label.filter(|&l| l != labels[v as usize]) {
                labels[v as usize] = label;
                changed.push(v);
            }
        }
        changed
            .iter()
            .flat_map(|&v| voxels.neighbors(v))
            .for_each(|&n| at_border[n as usize] = true);
        if (changed.len() as f32) < SETTLED_SHARE * voxels.len() as f32 {
            break;
        }
        centers = recenter(voxels, &labels, &centers);
    }
    // Voxels that no seed reached still share one label: connected() separates them.
    Ok(voxels.connected_labels(&labels))
}

/// Places one seed per occupied cell of the coarse grid: the voxel nearest the cell's center of
/// mass.
///
/// Seeds with hardly any surface around them are noise and are left out (their voxels can still
/// join a neighbor's supervoxel).
fn seeds(voxels: &VoxelCloud, settings: &SuperpointSettings) -> Vec<u32> {
    let centers: Vec<Point3<f32>> = voxels.patches.par_iter().map(|p| p.center).collect();
    let cells = VoxelGrid::new(&centers, settings.seed_m);
    let mut sums = vec![(Vector3::zeros(), 0.0_f32); cells.len()];
    for (center, &cell) in centers.iter().zip(&cells.of_point) {
        let sum = &mut sums[cell as usize];
        sum.0 += center.coords;
        sum.1 += 1.0;
    }
    let mut nearest = vec![(f32::INFINITY, NONE); cells.len()];
    for (v, (center, &cell)) in centers.iter().zip(&cells.of_point).enumerate() {
        let (sum, count) = sums[cell as usize];
        let distance = (center.coords - sum / count).norm_squared();
        let best = &mut nearest[cell as usize];
        if distance < best.0 {
            *best = (distance, v as u32);
        }
    }
    let mut seeds: Vec<u32> = nearest
        .into_iter()
        .map(|(_, v)| v)
        .filter(|&v| voxels.neighbors(v).len() >= MIN_SEED_NEIGHBORS)
        .collect();
    seeds.sort_unstable();
    seeds
}

/// A surface through a voxel occupies about eight of its neighbors; an isolated point has none.
const MIN_SEED_NEIGHBORS: usize = 2;

/// Returns the nearest supervoxel among the voxel's own and those of its neighbors; `None` if all
/// are the same.
fn best_label(
    voxels: &VoxelCloud,
    labels: &[u32],
    centers: &[Patch],
    v: u32,
    settings: &SuperpointSettings,
) -> Option<u32> {
    let own = labels[v as usize];
    let neighbors = voxels.neighbors(v);
    if neighbors.iter().all(|&n| labels[n as usize] == own) {
        return None;
    }
    let mut best = (
        if own == NONE {
            f32::INFINITY
        } else {
            distance(voxels, v, &centers[own as usize], settings)
        },
        own,
    );
    let mut seen = [NONE; 26];
    for (i, &n) in neighbors.iter().enumerate() {
        let label = labels[n as usize];
        if label == NONE || label == own || seen[..i].contains(&label) {
            continue;
        }
        seen[i] = label;
        let candidate = (distance(voxels, v, &centers[label as usize], settings), label);
        if candidate.0 < best.0 || (candidate.0 == best.0 && candidate.1 < best.1) {
            best = candidate;
        }
    }
    Some(best.1)
}

/// Returns the distance of a voxel to a supervoxel in space, normal and color, each divided by its
/// own unit.
fn distance(voxels: &VoxelCloud, v: u32, center: &Patch, settings: &SuperpointSettings) -> f32 {
    let voxel = &voxels.patches[v as usize];
    let space = (voxel.center - center.center).norm() / settings.seed_m;
    let normal = 1.0 - voxel.normal.dot(&center.normal).abs();
    let color = (voxel.lab - center.lab).norm() / COLOR_UNIT;
    settings.spatial_weight * space
        + settings.normal_weight * normal
        + settings.colour_weight * color
}

/// Returns the unweighted means over the voxels of each supervoxel, so that dense parts of a scan
/// do not pull the centers.
fn recenter(voxels: &VoxelCloud, labels: &[u32], before: &[Patch]) -> Vec<Patch> {
    let mut sums = vec![(0_u32, Vector3::zeros(), Vector3::zeros(), Lab::zeros()); before.len()];
    for (voxel, &label) in voxels.patches.iter().zip(labels) {
        if label == NONE {
            continue;
        }
        let sum = &mut sums[label as usize];
        // Normals have no sign: flip each to the side of the supervoxel's normal.
        let side = voxel.normal.dot(&before[label as usize].normal).signum();
        sum.0 += 1;
        sum.1 += voxel.center.coords;
        sum.2 += voxel.normal * side;
        sum.3 += voxel.lab;
    }
    sums.into_iter()
        .zip(before)
        .map(|((points, position, normal, lab), before)| match points {
            0 => *before,
            n => Patch {
                points,
                center: Point3::from(position / n as f32),
                normal: normal.try_normalize(1e-6).unwrap_or(before.normal),
                lab: lab / n as f32,
            },
        })
        .collect()
}
