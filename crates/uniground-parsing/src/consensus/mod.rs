//! Consensus of masks: things that masks of several views show although merging did not separate or
//! join them. Not in the paper.
//!
//! Merging decides from pair to pair of superpoints, and superpoints follow geometry. So a rug, a
//! towel or a pillow is lost in what it lies on. Masks of different views that show the same thing
//! are clustered ([`clusters`]), superpoints are cut where clusters cut them ([`cuts`]), and a
//! cluster becomes a region where all regions then fit the masks better ([`regrouping`]).

pub mod clusters;
pub(crate) mod cuts;
pub mod observations;

mod regrouping;

use crate::ParseError;
use crate::lifting::{FrameVisibility, MasksOfFrames};
use crate::merging::Regions;
use crate::planes::Planes;
use crate::superpoints::Superpoints;
use crate::visibility::Visibility;
use clusters::MaskCluster;
use observations::MaskObservations;
use regrouping::Regrouping;
use std::collections::{BTreeMap, BTreeSet};
use uniground_geometry::progress::{Cancelled, Progress};
use uniground_geometry::scene::{FrameIndex, FrameRef, PointCloud};
use uniground_geometry::voxels::{NEIGHBORS_26, VoxelKey};
use uniground_types::settings::ParsingSettings;

/// Maximum gap between points of one thing, meters.
const APART_M: f32 = 0.04;
/// Minimum share of a cluster's points in a connected piece of it.
const PIECE: f32 = 0.2;
/// A cluster with this IoU with a region shows nothing new.
const SAME: f32 = 0.75;

/// The superpoints of a scan and the regions they were merged into.
#[derive(Debug, Clone)]
pub struct RegionsOfScan {
    /// The superpoints.
    pub superpoints: Superpoints,
    /// The planes of the building. Superpoints of things are on none.
    pub planes: Planes,
    /// The stages of merging.
    pub levels: Regions,
    /// What the frames see of the superpoints.
    pub tables: Vec<FrameVisibility>,
    /// Region `0..n` of each superpoint.
    pub region_of: Vec<u32>,
    /// The superpoints of each cluster of masks that was no region after merging, ascending.
    pub clusters: Vec<Vec<u32>>,
}

/// The frames of a scan with their masks.
#[derive(Clone, Copy)]
pub struct MaskedFrames<'a> {
    /// The cloud.
    pub cloud: &'a PointCloud,
    /// The cloud prepared for look-ups in frames.
    pub visibility: &'a Visibility,
    /// The frames, in order.
    pub frames: &'a [FrameRef],
    /// The id images of each frame.
    pub masks_of: &'a MasksOfFrames,
}

/// Changes regions where clusters of masks show things better. `before.clusters` is ignored.
///
/// # Errors
/// [`ParseError`]: an unreadable frame, or cancellation.
pub fn regroup(
    seen: MaskedFrames,
    before: RegionsOfScan,
    settings: &ParsingSettings,
    progress: &Progress,
) -> Result<RegionsOfScan, ParseError> {
    let MaskedFrames { cloud, visibility, frames, masks_of } = seen;
    let observations =
        MaskObservations::collect(cloud.len(), visibility, frames, masks_of, progress)?;
    let region_of_point = before.superpoints.regions_of_points(&before.region_of);
    let mut clusters = find_clusters(cloud, &observations, progress)?;
    retain_new(&mut clusters, &region_of_point, &observations);
    clusters.sort_by_key(|cluster| {
        (std::cmp::Reverse((cluster.masks, cluster.samples.len())), cluster.samples[0])
    });
    let indices: Vec<FrameIndex> = frames.iter().map(|frame| frame.index).collect();
    let cut = cuts::cut_superpoints(
        cloud,
        &before.superpoints,
        (&before.tables, &indices, &observations),
        &clusters,
    );
    let old_regions = cut.extend(&before.region_of);
    let regrouping = Regrouping {
        superpoints: &cut.superpoints,
        tables: &cut.tables,
        min_points: settings.merging.min_points,
        min_agreement: settings.instances.min_agreement,
    };
    let region_of = regrouping.apply(&cut.clusters, &old_regions, progress)?;
    // What became a region of its own is a thing, not a part of the building.
    let mut of_superpoint = cut.extend(&before.planes.of_superpoint);
    of_superpoint
        .iter_mut()
        .zip(region_of.iter().zip(&old_regions))
        .filter(|(_, (new, old))| new != old)
        .for_each(|(plane, _)| *plane = None);
    let levels = before.levels.levels.iter().map(|level| cut.extend(level)).collect();
    Ok(RegionsOfScan {
        planes: Planes {
            of_superpoint,
            flat_thing_of: cut.extend(&before.planes.flat_thing_of),
            ..before.planes
        },
        levels: Regions { levels },
        region_of: without_gaps(&region_of),
        superpoints: cut.superpoints,
        tables: cut.tables,
        clusters: cut.clusters,
    })
}

/// Returns the sets of points that masks of several views show as one thing; each is connected.
///
/// # Errors
/// [`Cancelled`].
pub fn find_clusters(
    cloud: &PointCloud,
    observations: &MaskObservations,
    progress: &Progress,
) -> Result<Vec<MaskCluster>, Cancelled> {
    let mut found = Vec::new();
    for layer in 0..observations.layers {
        for cluster in clusters::cluster_masks(observations, layer, progress)? {
            let least = PIECE * cluster.samples.len() as f32;
            let pieces = connected_pieces(cloud, &cluster.samples).into_iter();
            found.extend(
                pieces
                    .filter(|piece| piece.len() as f32 >= least)
                    .map(|samples| MaskCluster { samples, masks: cluster.masks }),
            );
        }
    }
    Ok(found)
}

/// Removes clusters that are a region already.
fn retain_new(
    clusters: &mut Vec<MaskCluster>,
    region_of_point: &[u32],
    observations: &MaskObservations,
) {
    let region = |sample: u32| region_of_point[MaskObservations::point(sample)];
    let count = region_of_point.iter().max().map_or(0, |&r| r as usize + 1);
    let mut samples_of = vec![0_u32; count];
    (0..observations.samples as u32).for_each(|sample| samples_of[region(sample) as usize] += 1);
    clusters.retain(|cluster| {
        let mut shared: BTreeMap<u32, u32> = BTreeMap::new();
        cluster.samples.iter().for_each(|&s| *shared.entry(region(s)).or_default() += 1);
        let own = cluster.samples.len() as u32;
        shared.iter().all(|(&region, &both)| {
            (both as f32) < SAME * (own + samples_of[region as usize] - both) as f32
        })
    });
}

/// Returns the connected pieces of a set of sampled points, largest first.
fn connected_pieces(cloud: &PointCloud, samples: &[u32]) -> Vec<Vec<u32>> {
    let mut by_voxel: BTreeMap<VoxelKey, Vec<u32>> = BTreeMap::new();
    for &sample in samples {
        let position = &cloud.positions[MaskObservations::point(sample)];
        by_voxel.entry(VoxelKey::containing(position, APART_M)).or_default().push(sample);
    }
    let mut left: BTreeSet<VoxelKey> = by_voxel.keys().copied().collect();
    let mut pieces = Vec::new();
    while let Some(first) = left.pop_first() {
        let (mut reached, mut at) = (vec![first], 0);
        while let Some(&key) = reached.get(at) {
            reached
                .extend(NEIGHBORS_26.iter().map(|&by| key.offset(by)).filter(|k| left.remove(k)));
            at += 1;
        }
        let mut piece: Vec<u32> = reached.iter().flat_map(|key| &by_voxel[key]).copied().collect();
        piece.sort_unstable();
        pieces.push(piece);
    }
    pieces.sort_by_key(|piece| (std::cmp::Reverse(piece.len()), piece.first().copied()));
    pieces
}

/// Numbers regions without gaps, in their order.
fn without_gaps(region_of: &[u32]) -> Vec<u32> {
    let used: BTreeSet<u32> = region_of.iter().copied().collect();
    let number: BTreeMap<u32, u32> = used.into_iter().zip(0..).collect();
    region_of.iter().map(|region| number[region]).collect()
}

#[cfg(test)]
mod tests;
