//! Clusters masks of different views that show the same thing, by the consensus of the other views
//! (`MaskClustering`, Yan et al., CVPR 2024): two masks belong together when most views that show
//! both contain both in one mask.

use super::observations::MaskObservations;
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};
use uniground_geometry::progress::{Cancelled, Progress};
use uniground_geometry::union_find::UnionFind;

/// Number of samples by which a mask is looked up in other views.
const PROBES: usize = 64;
/// Minimum number of samples of a mask and of a cluster.
const MIN_SAMPLES: usize = 12;
/// A view shows a mask when it shows this share of the mask's samples.
const SHOWN: f32 = 0.3;
/// A view contains a mask when one of its masks has this share of the samples it shows.
const CONTAINED: f32 = 0.8;
/// A mask that more than this share of the views splits shows several things.
const SPLIT: f32 = 0.3;
/// Minimum share of the views of two masks that contain both in one mask.
const CONSENSUS: f32 = 0.9;
/// Minimum share of the views of a sample that have it in the cluster.
const AGREED: f32 = 0.5;
/// Minimum number of views of a cluster.
const MIN_VIEWS: usize = 2;
/// Number of steps in which pairs are decided, those with many common views first.
const STEPS: usize = 20;

/// A set of points that masks of several views show as one thing.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MaskCluster {
    /// Samples, ascending; see [`MaskObservations`].
    pub samples: Vec<u32>,
    /// Number of masks.
    pub masks: usize,
}

/// A mask of one frame.
struct ObservedMask {
    /// Index of the frame.
    frame: u32,
    /// The samples it shows, ascending.
    samples: Vec<u32>,
}

/// What a view shows of a mask of another view.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ViewOfMask {
    /// Too little to tell.
    Nothing,
    /// It lies in several masks.
    Split,
    /// It lies in this mask.
    Inside(u16),
}

/// One mask, or several that show the same thing.
#[derive(Debug, Clone)]
struct MaskGroup {
    /// Indices of its masks.
    masks: Vec<u32>,
    /// Views that have it in one mask, one bit each.
    views: Vec<u64>,
    /// The masks that contain it, ascending; those of all views are numbered consecutively.
    inside: Vec<u32>,
}

/// Clusters the masks of one id image.
///
/// # Errors
/// [`Cancelled`].
pub fn cluster_masks(
    observations: &MaskObservations,
    layer: usize,
    progress: &Progress,
) -> Result<Vec<MaskCluster>, Cancelled> {
    let masks = collect_masks(observations, layer);
    let by_view: Vec<Vec<ViewOfMask>> = observations
        .frames
        .par_iter()
        .map(|frame| {
            progress.check()?;
            let mut mask_of = vec![None; observations.samples];
            frame.points(layer).for_each(|(sample, mask)| mask_of[sample as usize] = Some(mask));
            Ok(masks.iter().map(|mask| view_of_mask(&mask.samples, &mask_of)).collect())
        })
        .collect::<Result<_, Cancelled>>()?;
    let (mut groups, numbers) = single_masks(&by_view, masks.len());
    for least_views in view_schedule(&groups) {
        progress.check()?;
        groups = merge_agreeing(groups, numbers, least_views);
    }
    Ok(groups.iter().filter_map(|group| cluster(group, &masks, observations, layer)).collect())
}

/// Returns the masks of all frames, in order of frame and id. Specks are left out.
fn collect_masks(observations: &MaskObservations, layer: usize) -> Vec<ObservedMask> {
    let mut masks = Vec::new();
    for (frame, observed) in (0..).zip(&observations.frames) {
        let mut of_mask: BTreeMap<u16, Vec<u32>> = BTreeMap::new();
        observed
            .points(layer)
            .filter(|(_, mask)| *mask != 0)
            .for_each(|(sample, mask)| of_mask.entry(mask).or_default().push(sample));
        let of_mask = of_mask.into_values().filter(|samples| samples.len() >= MIN_SAMPLES);
        masks.extend(of_mask.map(|samples| ObservedMask { frame, samples }));
    }
    masks
}

/// Returns what a view shows of a mask, given the view's mask of each sample that it shows.
fn view_of_mask(samples: &[u32], mask_of: &[Option<u16>]) -> ViewOfMask {
    let step = samples.len().div_ceil(PROBES).max(1);
    let probes = samples.len().div_ceil(step);
    let mut found: Vec<u16> =
        samples.iter().step_by(step).filter_map(|&sample| mask_of[sample as usize]).collect();
    if (found.len() as f32) < SHOWN * probes as f32 {
        return ViewOfMask::Nothing;
    }
    found.sort_unstable();
    let largest = found.chunk_by(|a, b| a == b).map(|same| (same.len(), same[0])).max();
    match largest.filter(|(most, _)| *most as f32 >= CONTAINED * found.len() as f32) {
        // In no mask: the view does not tell things apart there.
        Some((_, 0)) => ViewOfMask::Nothing,
        Some((_, mask)) => ViewOfMask::Inside(mask),
        None => ViewOfMask::Split,
    }
}

/// Returns each mask as a group, without masks that many views split, and the number of masks that
/// can contain them.
fn single_masks(by_view: &[Vec<ViewOfMask>], masks: usize) -> (Vec<MaskGroup>, usize) {
    // The number of the first mask of each view.
    let mut first = Vec::new();
    let mut numbers = 0;
    for view in by_view {
        first.push(numbers);
        let most =
            view.iter().map(|of| if let ViewOfMask::Inside(id) = of { *id } else { 0 }).max();
        numbers += u32::from(most.unwrap_or(0)) + 1;
    }
    let group = |mask: usize| {
        let mut group = MaskGroup {
            masks: vec![mask as u32],
            views: vec![0; by_view.len().div_ceil(64)],
            inside: Vec::new(),
        };
        let mut splits = 0;
        for (view, of_masks) in by_view.iter().enumerate() {
            match of_masks[mask] {
                ViewOfMask::Nothing => {}
                ViewOfMask::Split => splits += 1,
                ViewOfMask::Inside(id) => {
                    group.views[view / 64] |= 1 << (view % 64);
                    group.inside.push(first[view] + u32::from(id));
                }
            }
        }
        let views = splits + group.inside.len();
        (splits as f32 <= SPLIT * views as f32 && splits < views).then_some(group)
    };
    ((0..masks).filter_map(group).collect(), numbers as usize)
}

/// Returns the numbers of common views that pairs must have, step by step.
fn view_schedule(groups: &[MaskGroup]) -> Vec<u32> {
    let count = |group: &MaskGroup| group.views.iter().map(|word| word.count_ones()).sum();
    let mut counts: Vec<u32> = groups.iter().map(count).collect();
    counts.sort_unstable();
    let quantile = |step: usize| counts.get(counts.len() * step / STEPS).copied();
    let mut steps: Vec<u32> = (0..STEPS).rev().filter_map(quantile).chain([1]).collect();
    steps.dedup();
    steps
}

/// Merges groups that at least `least_views` views show, if most of these contain both in one mask.
fn merge_agreeing(groups: Vec<MaskGroup>, numbers: usize, least_views: u32) -> Vec<MaskGroup> {
    let mut contents: Vec<Vec<u32>> = vec![Vec::new(); numbers];
    for (i, group) in (0..).zip(&groups) {
        group.inside.iter().for_each(|&mask| contents[mask as usize].push(i));
    }
    let agreeing: Vec<(u32, u32)> = (0..groups.len() as u32)
        .into_par_iter()
        .map_init(
            || vec![0_u32; groups.len()],
            |together, i| {
                let group = &groups[i as usize];
                let mut others = BTreeSet::new();
                for &mask in &group.inside {
                    for &other in contents[mask as usize].iter().filter(|&&other| other > i) {
                        together[other as usize] += 1;
                        if together[other as usize] == 1 {
                            others.insert(other);
                        }
                    }
                }
                let agree = |&other: &u32| {
                    let contained = std::mem::take(&mut together[other as usize]);
                    let words = group.views.iter().zip(&groups[other as usize].views);
                    let views: u32 = words.map(|(a, b)| (a & b).count_ones()).sum();
                    views >= least_views && contained as f32 >= CONSENSUS * views as f32
                };
                others.into_iter().filter(agree).map(|other| (i, other)).collect::<Vec<_>>()
            },
        )
        .flatten_iter()
        .collect();
    let mut sets = UnionFind::new(groups.len());
    for (a, b) in agreeing {
        sets.union(a, b);
    }
    let (labels, count) = sets.into_labels();
    let mut merged: Vec<Option<MaskGroup>> = vec![None; count];
    for (group, label) in groups.into_iter().zip(labels) {
        match &mut merged[label as usize] {
            None => merged[label as usize] = Some(group),
            Some(so_far) => {
                so_far.masks.extend(group.masks);
                so_far.views.iter_mut().zip(group.views).for_each(|(a, b)| *a |= b);
                so_far.inside.extend(group.inside);
                so_far.inside.sort_unstable();
                so_far.inside.dedup();
            }
        }
    }
    merged.into_iter().flatten().collect()
}

/// Returns the samples that most views of a group have in its masks. `None` if the group has too
/// few views or samples.
fn cluster(
    group: &MaskGroup,
    masks: &[ObservedMask],
    observations: &MaskObservations,
    layer: usize,
) -> Option<MaskCluster> {
    let mut frames: BTreeSet<u32> = BTreeSet::new();
    // By sample: number of masks that show it, and number of views.
    let mut held: BTreeMap<u32, (u32, u32)> = BTreeMap::new();
    for &mask in &group.masks {
        let ObservedMask { frame, samples } = &masks[mask as usize];
        frames.insert(*frame);
        samples.iter().for_each(|&sample| held.entry(sample).or_default().0 += 1);
    }
    if frames.len() < MIN_VIEWS {
        return None;
    }
    for &frame in &frames {
        for (sample, _) in observations.frames[frame as usize].points(layer) {
            held.entry(sample).and_modify(|(_, shown)| *shown += 1);
        }
    }
    let agreed =
        held.into_iter().filter(|(_, (held, shown))| *held as f32 >= AGREED * *shown as f32);
    let samples: Vec<u32> = agreed.map(|(sample, _)| sample).collect();
    (samples.len() >= MIN_SAMPLES).then_some(MaskCluster { samples, masks: group.masks.len() })
}
