//! Refinement: moves points at the border of a region to the region that masks assign them to.
//!
//! A superpoint is a few centimeters wide and belongs to one region as a whole. So a picture
//! includes a rim of the wall around it, and a box is only as good as its outermost points. Masks
//! end where things end, to a pixel. Every frame that separates a region from its surroundings
//! votes on the region's points.

use super::ParseError;
use super::lifting::MasksOfFrames;
use super::visibility::Visibility;
use rayon::prelude::*;
use std::collections::BTreeMap;
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::{FrameRef, PointCloud, stream_frames};
use uniground_geometry::voxels::{NEIGHBORS_26, VoxelKey, VoxelMap};

/// A point moves only to a region that comes within this distance, meters.
const REACH_M: f32 = 0.05;

/// The votes of frames on one point.
#[derive(Clone, Copy, Default)]
struct PointVotes {
    own: u16,
    /// The leading other region (majority vote of Boyer and Moore), and its lead.
    other: u32,
    lead: u16,
}

impl PointVotes {
    fn add_vote(&mut self, own: u32, region: u32) {
        if region == own {
            self.own = self.own.saturating_add(1);
        } else if self.lead == 0 || self.other == region {
            self.other = region;
            self.lead = self.lead.saturating_add(1);
        } else {
            self.lead -= 1;
        }
    }
}

/// Returns the region of each point, given that of its superpoint. `masks` are those of `frames`,
/// in the same order.
///
/// # Errors
/// [`ParseError`]: an unreadable frame, or cancellation.
pub fn refine(
    cloud: &PointCloud,
    visibility: &Visibility,
    mut region_of: Vec<u32>,
    frames: &[FrameRef],
    masks: &MasksOfFrames,
    progress: &Progress,
) -> Result<Vec<u32>, ParseError> {
    let mut votes = vec![PointVotes::default(); cloud.len()];
    stream_frames(
        frames,
        |frame| {
            progress.check()?;
            let seen = visibility.in_frame(&frame.depth_camera(), &frame.decode_depth()?);
            let by_image = masks[&frame.index].iter().flat_map(|masks| {
                let ids = masks.to_image();
                let hits: Vec<(u32, u16)> =
                    seen.iter().map(|seen| (seen.point, ids.at(seen.cell))).collect();
                assign_points(&hits, &region_of)
            });
            Ok::<_, ParseError>(by_image.collect::<Vec<_>>())
        },
        |i, assigned| {
            for (point, region) in assigned {
                votes[point as usize].add_vote(region_of[point as usize], region);
            }
            Ok(progress.report("refine", (i + 1) as f32 / frames.len() as f32)?)
        },
    )?;
    let mut near: VoxelMap<Vec<u32>> = VoxelMap::default();
    for (p, &region) in cloud.positions.iter().zip(&region_of) {
        let here = near.entry(VoxelKey::containing(p, REACH_M)).or_default();
        if !here.contains(&region) {
            here.push(region);
        }
    }
    let is_near = |p, region: u32| {
        let key = VoxelKey::containing(p, REACH_M);
        let holds = |key: VoxelKey| near.get(&key).is_some_and(|regions| regions.contains(&region));
        holds(key) || NEIGHBORS_26.iter().any(|&d| holds(key.offset(d)))
    };
    let moved: Vec<(usize, u32)> = votes
        .par_iter()
        .enumerate()
        .filter(|(_, votes)| votes.lead > votes.own)
        .filter(|(i, votes)| is_near(&cloud.positions[*i], votes.other))
        .map(|(i, votes)| (i, votes.other))
        .collect();
    for (i, region) in moved {
        region_of[i] = region;
    }
    Ok(region_of)
}

/// Returns the region that the masks of one frame assign to each visible point, for points of
/// regions that this frame separates from others.
fn assign_points(hits: &[(u32, u16)], region_of: &[u32]) -> Vec<(u32, u32)> {
    let region = |&(point, _): &(u32, u16)| region_of[point as usize];
    // Neighbors mostly agree, so equal ones in a row are looked up once.
    let runs = || hits.chunk_by(|a, b| a.1 == b.1 && region(a) == region(b));
    let mut shared: BTreeMap<(u16, u32), u32> = BTreeMap::new();
    for run in runs() {
        *shared.entry((run[0].1, region(&run[0]))).or_default() += run.len() as u32;
    }
    // Per mask: its number of points, and the region with most of them. Per region: the mask with
    // most of its points, including no mask.
    let mut masks: BTreeMap<u16, (u32, u32, u32)> = BTreeMap::new();
    let mut regions: BTreeMap<u32, (u32, u16)> = BTreeMap::new();
    for (&(mask, region), &n) in &shared {
        let of_mask = masks.entry(mask).or_default();
        of_mask.0 += n;
        if n > of_mask.1 {
            (of_mask.1, of_mask.2) = (n, region);
        }
        let of_region = regions.entry(region).or_default();
        if n > of_region.0 {
            *of_region = (n, mask);
        }
    }
    let owner = |mask: u16| {
        masks
            .get(&mask)
            .filter(|(all, most, _)| mask != 0 && 2 * most > *all)
            .map(|&(_, _, region)| region)
    };
    let best_region = |run: &[(u32, u16)]| {
        let own = region(&run[0]);
        let told_apart = owner(regions[&own].1) == Some(own);
        told_apart.then(|| owner(run[0].1)).flatten()
    };
    runs()
        .filter_map(|run| Some((run, best_region(run)?)))
        .flat_map(|(run, to)| run.iter().map(move |&(point, _)| (point, to)))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rim_points_return_to_the_surrounding_region() {
        // A picture (points 0 to 5) includes two points of its wall (4, 5). Masks 1 and 2 end where
        // the picture ends.
        let region_of = [0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 1];
        let hits: Vec<(u32, u16)> = (0..11).map(|i| (i, if i < 4 { 1 } else { 2 })).collect();
        let assigned = assign_points(&hits, &region_of);
        assert_eq!(
            assigned
                .iter()
                .filter(|(_, region)| *region == 0)
                .map(|(point, _)| *point)
                .collect::<Vec<_>>(),
            [0, 1, 2, 3]
        );
        let mut votes = PointVotes::default();
        assigned
            .iter()
            .filter(|(point, _)| *point == 4)
            .for_each(|&(_, region)| votes.add_vote(0, region));
        assert_eq!((votes.own, votes.other, votes.lead), (0, 1, 1));
    }

    #[test]
    fn frames_that_do_not_separate_a_region_do_not_vote_on_it() {
        // A mug (points 0, 1) on a table (2 to 9), all in one mask.
        let region_of = [0, 0, 1, 1, 1, 1, 1, 1, 1, 1];
        let hits: Vec<(u32, u16)> = (0..10).map(|i| (i, 1)).collect();
        assert!(
            assign_points(&hits, &region_of)
                .iter()
                .all(|(point, region)| *point >= 2 && *region == 1)
        );
    }

    #[test]
    fn majority_vote_finds_the_leading_other_region() {
        let mut votes = PointVotes::default();
        [7, 3, 7, 0, 7, 5, 7].into_iter().for_each(|region| votes.add_vote(0, region));
        assert_eq!((votes.own, votes.other), (1, 7));
        assert!(votes.lead > votes.own);
    }
}
