//! Joins patches into things: the cheapest border first, if it is flat or convex and the colors
//! agree.

use super::RgbdSettings;
use super::patches::signed_bend;
use super::surfaces::SurfaceGrid;
use nalgebra::SymmetricEigen;
use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};
use uniground_geometry::color::Lab;
use uniground_geometry::union_find::UnionFind;
use uniground_geometry::{Matrix3, Vector3};

/// Facts about a patch or a union of patches.
#[derive(Clone, Copy)]
struct PatchRegion {
    pixels: f32,
    area_m2: f32,
    lab: Lab,
    /// Sum of the points' positions, camera axes, meters.
    position_sum: Vector3<f32>,
    /// Second moments of the points about the origin.
    moments: Matrix3<f32>,
    /// Generation number that identifies stale queue entries.
    version: u32,
}

/// Facts about the border between two regions.
#[derive(Clone, Copy, Default)]
struct RegionBorder {
    /// Links across the border, and the number of them across which the surface continues.
    links: f32,
    continuous: f32,
    /// Sum of signed bends over the continuous links, radians.
    bend: f32,
}

/// A possible merge: cost (as bits, cheapest first), the two regions, and their generations when it
/// was queued.
type MergeOffer = (Reverse<u32>, Reverse<(u32, u32)>, u32, u32);

/// Returns the thing label `0..n` of each element.
pub(super) fn join_patches(
    surfaces: &SurfaceGrid,
    patches: &[u32],
    settings: &RgbdSettings,
) -> Vec<u32> {
    let count = patches.iter().max().map_or(0, |&p| p as usize + 1);
    let mut regions = regions(surfaces, patches, count);
    let mut borders = borders(surfaces, patches, count);
    let mut sets = UnionFind::new(count);
    let mut queue: BinaryHeap<MergeOffer> = BinaryHeap::new();
    let push = |queue: &mut BinaryHeap<_>,
                regions: &[PatchRegion],
                a: u32,
                b: u32,
                border: &RegionBorder| {
        let cost = join_cost(&regions[a as usize], &regions[b as usize], border, settings);
        if cost < settings.join_cost {
            // Costs are never negative, so their bits sort like the numbers.
            queue.push((
                Reverse(cost.to_bits()),
                Reverse((a, b)),
                regions[a as usize].version,
                regions[b as usize].version,
            ));
        }
    };
    for a in 0..count as u32 {
        for (&b, border) in borders[a as usize].range(a + 1..) {
            push(&mut queue, &regions, a, b, border);
        }
    }
    while let Some((_, Reverse((a, b)), version_a, version_b)) = queue.pop() {
        if regions[a as usize].version != version_a || regions[b as usize].version != version_b {
            continue;
        }
        let root = sets.union(a, b);
        let gone = if root == a { b } else { a };
        regions[root as usize] = merge_regions(&regions[a as usize], &regions[b as usize]);
        regions[gone as usize].version = u32::MAX;
        let moved = std::mem::take(&mut borders[gone as usize]);
        borders[root as usize].remove(&gone);
        for (other, border) in moved {
            borders[other as usize].remove(&gone);
            if other == root {
                continue;
            }
            for (from, to) in [(root, other), (other, root)] {
                let sum = borders[from as usize].entry(to).or_default();
                *sum = RegionBorder {
                    links: sum.links + border.links,
                    continuous: sum.continuous + border.continuous,
                    bend: sum.bend + border.bend,
                };
            }
        }
        for (&other, border) in &borders[root as usize] {
            push(&mut queue, &regions, root.min(other), root.max(other), border);
        }
    }
    let (labels, _) = sets.into_labels();
    patches.iter().map(|&p| labels[p as usize]).collect()
}

/// Returns the cost of joining: color difference and concavity along the border, each divided by
/// its own unit.
fn join_cost(
    a: &PatchRegion,
    b: &PatchRegion,
    border: &RegionBorder,
    settings: &RgbdSettings,
) -> f32 {
    // The border is mostly a depth step: one region hides the other.
    if border.continuous < 0.5 * border.links {
        return f32::INFINITY;
    }
    let color = (a.lab - b.lab).norm() / settings.join_colour;
    let bend_deg = (border.bend / border.continuous).to_degrees();
    let concave = bend_deg.max(0.0) / settings.join_concave_deg;
    // A thing on a plane meets it in a valley and is separate. The sides of a box meet in a ridge
    // and belong together.
    let planes = [a, b].map(|r| r.area_m2 >= settings.plane_area_m2 && r.is_flat());
    let apart = match planes {
        _ if bend_deg < SAME_PLANE_DEG => 0.0,
        [true, true] => 1.0,
        [false, false] => 0.0,
        _ => 0.3,
    };
    color + concave + apart
}

/// Concave bend above which a plane ends, degrees.
const SAME_PLANE_DEG: f32 = 8.0;

impl PatchRegion {
    /// Returns whether the points stay close to their plane within the sensor noise, which grows
    /// with distance squared.
    fn is_flat(&self) -> bool {
        let mean = self.position_sum / self.pixels;
        let covariance = self.moments / self.pixels - mean * mean.transpose();
        let eigen = SymmetricEigen::new(covariance).eigenvalues;
        eigen.min().max(0.0).sqrt() < 0.01 + 0.004 * mean.z * mean.z
    }
}

fn merge_regions(a: &PatchRegion, b: &PatchRegion) -> PatchRegion {
    let pixels = a.pixels + b.pixels;
    PatchRegion {
        pixels,
        area_m2: a.area_m2 + b.area_m2,
        lab: (a.lab * a.pixels + b.lab * b.pixels) / pixels,
        position_sum: a.position_sum + b.position_sum,
        moments: a.moments + b.moments,
        version: a.version.max(b.version) + 1,
    }
}

fn regions(surfaces: &SurfaceGrid, patches: &[u32], count: usize) -> Vec<PatchRegion> {
    let empty = PatchRegion {
        pixels: 0.0,
        area_m2: 0.0,
        lab: Lab::zeros(),
        position_sum: Vector3::zeros(),
        moments: Matrix3::zeros(),
        version: 0,
    };
    let mut regions = vec![empty; count];
    for (i, &patch) in patches.iter().enumerate() {
        let region = &mut regions[patch as usize];
        let p = surfaces.points[i].coords;
        // A pixel covers more surface the further away and the more slanted the surface is.
        let facing = surfaces.normals[i]
            .dot(&p.try_normalize(1e-9).unwrap_or_else(Vector3::z))
            .abs()
            .max(0.1);
        region.pixels += 1.0;
        region.area_m2 += (surfaces.spacing_per_m * surfaces.depth_m[i]).powi(2) / facing;
        region.lab += surfaces.labs[i];
        region.position_sum += p;
        region.moments += p * p.transpose();
    }
    regions.iter_mut().for_each(|r| r.lab /= r.pixels);
    regions
}

fn borders(
    surfaces: &SurfaceGrid,
    patches: &[u32],
    count: usize,
) -> Vec<BTreeMap<u32, RegionBorder>> {
    let mut borders = vec![BTreeMap::<u32, RegionBorder>::new(); count];
    for (i, j) in surfaces.adjacent_pairs() {
        let (a, b) = (patches[i], patches[j]);
        if a == b {
            continue;
        }
        let continuous = surfaces.is_continuous(i, j);
        // Measures the bend across a border a few elements away from it, because normals at an edge
        // are smoothed.
        let (far_i, far_j) = extend_pair(surfaces, patches, i, j);
        let bend = if continuous { signed_bend(surfaces, far_i, far_j) } else { 0.0 };
        for (from, to) in [(a, b), (b, a)] {
            let border = borders[from as usize].entry(to).or_default();
            border.links += 1.0;
            border.continuous += f32::from(u8::from(continuous));
            border.bend += bend;
        }
    }
    borders
}

/// Extends the link `(i, j)` by up to [`STRETCH`] elements into both patches.
fn extend_pair(surfaces: &SurfaceGrid, patches: &[u32], i: usize, j: usize) -> (usize, usize) {
    let step = j - i;
    let row_bound = step == 1;
    let (mut back, mut ahead) = (i, j);
    for _ in 0..STRETCH {
        if back >= step
            && patches[back - step] == patches[i]
            && (!row_bound || back % surfaces.width != 0)
        {
            back -= step;
        }
        if ahead + step < patches.len()
            && patches[ahead + step] == patches[j]
            && (!row_bound || (ahead + 1) % surfaces.width != 0)
        {
            ahead += step;
        }
    }
    (back, ahead)
}

/// Maximum radius of normal smoothing, elements. Nearer to an edge, normals show less than the true
/// bend.
const STRETCH: usize = 6;
