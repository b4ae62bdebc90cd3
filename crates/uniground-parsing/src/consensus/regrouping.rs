//! Gives what a cluster of masks shows a region of its own.
//!
//! Its superpoints are taken from the regions they are in, if all these regions then fit the masks
//! better than before. A book in the region of a desk is split off, because the masks of the desk
//! leave it out. A drawer is not, because they include it. Two halves of a door are joined.

use crate::frame_masks::FrameMasks;
use crate::lifting::FrameVisibility;
use crate::superpoints::Superpoints;
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};
use uniground_geometry::progress::{Cancelled, Progress};

/// Minimum gain of agreement per visible point of a cluster. Agreement is the IoU of a region's
/// visible points and the mask that fits them best.
const LEAST_GAIN: f32 = 0.35;

/// What regions are judged by.
pub struct Regrouping<'a> {
    pub superpoints: &'a Superpoints,
    /// What the frames see of the superpoints.
    pub tables: &'a [FrameVisibility],
    /// Minimum number of points of a region.
    pub min_points: u32,
    /// Minimum agreement of a new region.
    pub min_agreement: f32,
}

impl Regrouping<'_> {
    /// Gives clusters, as sets of superpoints, regions of their own, those that gain most first.
    /// Returns the region of each superpoint: a new number for each new region. Old regions can
    /// become empty.
    ///
    /// # Errors
    /// [`Cancelled`].
    pub fn apply(
        &self,
        clusters: &[Vec<u32>],
        region_of: &[u32],
        progress: &Progress,
    ) -> Result<Vec<u32>, Cancelled> {
        let mut grouping = Grouping::new(self, region_of.to_vec());
        let mut open: BTreeMap<usize, Change> = BTreeMap::new();
        let mut stale: Vec<usize> = (0..clusters.len()).collect();
        loop {
            progress.check()?;
            let gains = |change: &Change| {
                change.agreement >= self.min_agreement && change.gain >= LEAST_GAIN * change.visible
            };
            let changes: Vec<(usize, Change)> = stale
                .par_iter()
                .filter_map(|&i| Some((i, grouping.propose(&clusters[i]).filter(gains)?)))
                .collect();
            open.extend(changes);
            let by_gain = |(i, a): &(&usize, &Change), (j, b): &(&usize, &Change)| {
                a.gain.total_cmp(&b.gain).then(j.cmp(i))
            };
            let Some(best) = open.iter().max_by(by_gain).map(|(&best, _)| best) else { break };
            let Some(change) = open.remove(&best) else { break };
            let touched: BTreeSet<u32> = change.taken.iter().map(|(region, _)| *region).collect();
            grouping.apply(change);
            stale = open
                .iter()
                .filter(|(_, other)| other.taken.iter().any(|(from, _)| touched.contains(from)))
                .map(|(&i, _)| i)
                .collect();
            stale.iter().for_each(|i| {
                open.remove(i);
            });
        }
        Ok(grouping.region_of)
    }
}

/// The regions of a scan, while they change.
struct Grouping<'a> {
    rules: &'a Regrouping<'a>,
    frames: Vec<FrameMasks<'a>>,
    region_of: Vec<u32>,
    /// The superpoints of each region.
    members: Vec<BTreeSet<u32>>,
    /// What frames show of each region.
    shown: Vec<Shown>,
}

/// A set of superpoints that becomes a region.
struct Change {
    /// The superpoints.
    set: Vec<u32>,
    /// The regions it takes superpoints from, with what frames show of these superpoints.
    taken: Vec<(u32, Shown)>,
    /// Gain of agreement, times points, summed over frames.
    gain: f32,
    /// Number of visible points of the set, summed over frames.
    visible: f32,
    /// How well masks show the set, `0..=1`.
    agreement: f32,
}

impl<'a> Grouping<'a> {
    fn new(rules: &'a Regrouping<'a>, region_of: Vec<u32>) -> Self {
        let frames = FrameMasks::of_all(rules.tables);
        let count = region_of.iter().max().map_or(0, |&r| r as usize + 1);
        let mut members = vec![BTreeSet::new(); count];
        for (s, &region) in (0..).zip(&region_of) {
            members[region as usize].insert(s);
        }
        let shown = members.par_iter().map(|set| Shown::of(set, &frames)).collect();
        Self { rules, frames, region_of, members, shown }
    }

    fn points<'s>(&self, set: impl IntoIterator<Item = &'s u32>) -> u32 {
        set.into_iter().map(|&s| self.rules.superpoints.patches[s as usize].points).sum()
    }

    /// Returns what changes when a cluster becomes a region. `None` if it is one already, or is too
    /// small.
    fn propose(&self, cluster: &[u32]) -> Option<Change> {
        let mut parts: BTreeMap<u32, BTreeSet<u32>> = BTreeMap::new();
        for &s in cluster {
            parts.entry(self.region_of[s as usize]).or_default().insert(s);
        }
        // What would remain of a region must be large enough to be one.
        for (&region, part) in &mut parts {
            let members = &self.members[region as usize];
            if part.len() < members.len()
                && self.points(members.difference(part)) < self.rules.min_points
            {
                part.clone_from(members);
            }
        }
        let set: Vec<u32> = parts.values().flatten().copied().collect();
        let is_region = parts.len() == 1
            && parts.iter().all(|(r, part)| part.len() == self.members[*r as usize].len());
        if is_region || self.points(&set) < self.rules.min_points {
            return None;
        }
        let taken: Vec<(u32, Shown)> =
            parts.iter().map(|(&region, part)| (region, Shown::of(part, &self.frames))).collect();
        let whole = Shown::sum(taken.iter().map(|(_, shown)| shown), &self.frames);
        let (mut gain, mut weight, mut agreement) = (0.0, 0.0, 0.0);
        for (i, frame) in self.frames.iter().enumerate() {
            let visible = whole.visible[i] as f32;
            if visible == 0.0 {
                continue;
            }
            let own = visible * frame.best_iou(whole.visible[i], &whole.masks[i]);
            agreement += own;
            weight += visible;
            gain += own;
            for (region, part) in &taken {
                let before = &self.shown[*region as usize];
                let (all, gone) = (before.visible[i], part.visible[i]);
                gain += (all - gone) as f32
                    * frame.best_iou_without(all - gone, &before.masks[i], &part.masks[i])
                    - all as f32 * frame.best_iou(all, &before.masks[i]);
            }
        }
        (weight > 0.0).then(|| Change {
            set,
            taken,
            gain,
            visible: weight,
            agreement: agreement / weight,
        })
    }

    fn apply(&mut self, change: Change) {
        let region = self.members.len() as u32;
        let shown = Shown::sum(change.taken.iter().map(|(_, shown)| shown), &self.frames);
        for (from, part) in &change.taken {
            self.shown[*from as usize].remove(part);
        }
        for &s in &change.set {
            self.members[self.region_of[s as usize] as usize].remove(&s);
            self.region_of[s as usize] = region;
        }
        self.members.push(change.set.into_iter().collect());
        self.shown.push(shown);
    }
}

/// What each frame shows of a set of superpoints.
struct Shown {
    /// Number of visible points by frame.
    visible: Vec<u32>,
    /// By frame and id image: visible points per mask.
    masks: Vec<Vec<BTreeMap<u16, u32>>>,
}

impl Shown {
    fn of(set: &BTreeSet<u32>, frames: &[FrameMasks]) -> Self {
        let (visible, masks) = frames.iter().map(|frame| frame.look_up(set)).unzip();
        Self { visible, masks }
    }

    /// Returns what the frames show of all these disjoint sets.
    fn sum<'s>(sets: impl Iterator<Item = &'s Self>, frames: &[FrameMasks]) -> Self {
        let images = frames.first().map_or(0, |frame| frame.images.len());
        let mut sum = Self {
            visible: vec![0; frames.len()],
            masks: vec![vec![BTreeMap::new(); images]; frames.len()],
        };
        for set in sets {
            sum.visible.iter_mut().zip(&set.visible).for_each(|(all, own)| *all += own);
            for (all, own) in sum.masks.iter_mut().flatten().zip(set.masks.iter().flatten()) {
                own.iter().for_each(|(mask, n)| *all.entry(*mask).or_default() += n);
            }
        }
        sum
    }

    fn remove(&mut self, part: &Self) {
        self.visible.iter_mut().zip(&part.visible).for_each(|(all, own)| *all -= own);
        for (all, own) in self.masks.iter_mut().flatten().zip(part.masks.iter().flatten()) {
            for (mask, n) in own {
                all.entry(*mask).and_modify(|all| *all -= n);
            }
        }
    }
}
