//! Checks that a scan's own cloud is of the same surfaces as its frames: in the same place, all of
//! them, in the same colors.

use super::agreement::Agreement;
use super::colors::{SAME_SURFACE, SharedColors};
use super::sketch::{FrameSketch, Tone};
use crate::clouds::LoadedCloud;
use rayon::prelude::*;
use std::collections::HashSet;
use uniground_geometry::Point3;
use uniground_geometry::voxels::VoxelKey;
use uniground_types::findings::{Finding, FindingSubject};

/// Number of points of a cloud that are projected into the frames.
const CLOUD_POINTS: usize = 3000;
/// A cloud whose agreement is this much below that of the frames with each other does not fit them.
const BELOW_FRAMES: f32 = 0.08;
/// A cloud of which fewer points are close to the measured depth than this share of the frames'
/// own points lies beside the surfaces. A correct cloud reaches 0.97; one that is 15 cm off 0.64,
/// one that is 5 % too large 0.41.
const CLOSE_OF_FRAMES: f32 = 0.75;
/// Edge of the cubes that tell whether there is a cloud near a frame's point, meters, and the
/// number of the cloud's points that are put into them.
const CUBE_M: f32 = 0.2;
const CUBE_POINTS: usize = 500_000;
/// Share of the frames' points that are near the cloud below which the cloud is incomplete.
const INCOMPLETE: f32 = 0.6;

/// A sample of the points of a cloud, in the world of the frames, with their colors.
pub(super) struct CloudSample {
    pub positions: Vec<Point3<f32>>,
    /// Empty if the cloud has no color.
    tones: Vec<Tone>,
}

impl CloudSample {
    pub fn new(loaded: &LoadedCloud) -> Self {
        let cloud = &loaded.cloud;
        let step = cloud.len().div_ceil(CLOUD_POINTS).max(1);
        let tones = cloud.colors.iter().step_by(step).map(|color| Tone::of(color.map(f32::from)));
        Self {
            positions: cloud.positions.iter().step_by(step).copied().collect(),
            tones: if loaded.has_color { tones.collect() } else { Vec::new() },
        }
    }

    /// Adds a finding if the colors are not those of the color pictures.
    pub fn check_colors(&self, sketches: &[&FrameSketch], findings: &mut Vec<Finding>) {
        let of_frame = |sketch: &&FrameSketch| {
            let pairs: Vec<(Tone, Tone)> = self
                .positions
                .iter()
                .zip(&self.tones)
                .filter_map(|(position, tone)| {
                    let seen = sketch.look_at(position)?;
                    (seen.farther.abs() <= SAME_SURFACE).then(|| (*tone, sketch.tones[seen.pixel]))
                })
                .collect();
            SharedColors::of(&pairs)
        };
        let shared: Vec<SharedColors> = sketches.par_iter().map(of_frame).collect();
        let mut total = SharedColors::default();
        shared.into_iter().for_each(|of_frame| total.add(of_frame));
        let text = if total.is_unlike() {
            "the colors of the cloud are not those of the color pictures: the cloud is colored by labels, heights or intensity, or it is of another scan"
        } else if total.has_swapped_channels() {
            "red, green and blue have another order in the cloud than in the color pictures: red and blue are swapped in one of them, for example"
        } else {
            return;
        };
        findings.push(Finding::unusual(FindingSubject::Color, text));
    }
}

/// Adds a finding if a cloud does not fit the frames although the frames fit each other. Returns
/// whether it fits.
pub(super) fn check_fit(
    of_cloud: &Agreement,
    of_frames: &Agreement,
    findings: &mut Vec<Finding>,
) -> bool {
    let (Some(cloud), Some(frames)) = (of_cloud.share(), of_frames.share()) else { return true };
    let text = if cloud < frames - BELOW_FRAMES {
        format!(
            "the cloud does not fit the frames, which fit each other: {:.0}% of the compared points of the cloud lie where a frame sees through, and {:.0}% of those of other frames. Is it of the same scan, in the same coordinates?",
            (1.0 - cloud) * 100.0,
            (1.0 - frames) * 100.0
        )
    } else if of_cloud.close_share() < CLOSE_OF_FRAMES * of_frames.close_share() {
        format!(
            "the cloud lies beside the surfaces that the frames show: {:.0}% of its compared points are within 2% of the measured distance, and {:.0}% of those of other frames. It is shifted, scaled or rotated a little, or was made from other poses, or the depth is too large or too small",
            of_cloud.close_share() * 100.0,
            of_frames.close_share() * 100.0
        )
    } else {
        return true;
    };
    findings.push(Finding::unusual(FindingSubject::Cloud, text));
    false
}

/// Adds a finding if a cloud covers only a part of what the frames show.
pub(super) fn check_extent(
    cloud: &[Point3<f32>],
    sketches: &[FrameSketch],
    findings: &mut Vec<Finding>,
) {
    let step = cloud.len().div_ceil(CUBE_POINTS).max(1);
    let near = |point: &Point3<f32>| VoxelKey::containing(point, CUBE_M);
    let occupied: HashSet<VoxelKey> = cloud.iter().step_by(step).map(near).collect();
    let is_covered = |point: &Point3<f32>| {
        let cube = near(point);
        let around = (-1..=1).flat_map(|x| (-1..=1).map(move |y| [x, y]));
        around
            .flat_map(|[x, y]| (-1..=1).map(move |z| [x, y, z]))
            .any(|by| occupied.contains(&cube.offset(by)))
    };
    let points: Vec<&Point3<f32>> =
        sketches.iter().flat_map(|sketch| &sketch.points).map(|point| &point.position).collect();
    let covered = points.par_iter().filter(|point| is_covered(point)).count();
    let share = covered as f32 / points.len().max(1) as f32;
    if !points.is_empty() && share < INCOMPLETE {
        let text = format!(
            "the cloud covers {:.0}% of the surfaces that the frames show: nothing is found elsewhere. Upload the frames without the cloud to have one made of them",
            share * 100.0
        );
        findings.push(Finding::unusual(FindingSubject::Cloud, text));
    }
}
