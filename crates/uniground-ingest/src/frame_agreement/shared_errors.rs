//! Finds errors that all frames share: a wrong focal length, a wrong scale of the depth or of the
//! poses, distances along the ray. Frames then fit each other roughly, but not closely.

use super::sketch::{FrameSketch, SharedChange};
use rayon::prelude::*;
use std::fmt;
use uniground_types::findings::{Finding, FindingSubject};

/// Maximum number of frames that are compared, and minimum number of compared points.
const MAX_FRAMES: usize = 40;
const MIN_POINTS: u32 = 1000;
/// Relative difference of depth that counts as close.
const CLOSE: f32 = 0.02;
/// Share of close points below which something is wrong. Correct scans reach 0.92 to 0.98; with a
/// focal length or a scale that is a tenth off, 0.46 to 0.72; with poses that are 5 cm off, 0.46.
const LOW: f32 = 0.72;
/// A change explains the error if the share then reaches this, and rises by this factor.
const EXPLAINED: f32 = 0.85;
const TIMES_BETTER: f32 = 1.15;
/// Factors that are tried.
const FACTORS: [f32; 8] = [0.75, 0.8, 0.85, 0.9, 1.1, 1.15, 1.25, 1.33];

/// Frames that fit each other only roughly.
pub(super) struct RoughFit {
    /// Share of the compared points that are close to what another frame measured.
    close: f32,
    /// What would make them fit, as a sentence.
    pub cause: Option<String>,
}

impl RoughFit {
    /// Compares a sample of the frames. `None` if they fit closely, or too little can be compared.
    pub fn of(sketches: &[&FrameSketch]) -> Option<Self> {
        let count = sketches.len().min(MAX_FRAMES);
        let sample: Vec<FrameSketch> =
            (0..count).map(|i| sketches[i * sketches.len() / count].clone()).collect();
        let close = close_share(&sample).filter(|close| *close < LOW)?;
        let scaled = FACTORS
            .into_iter()
            .flat_map(|f| [SharedChange::DepthTimes(f), SharedChange::FocalLengthTimes(f)]);
        let cause = std::iter::once(SharedChange::DepthAlongRay)
            .chain(scaled)
            .filter_map(|change| {
                let changed: Vec<FrameSketch> = sample.iter().map(|s| s.changed(change)).collect();
                Some((close_share(&changed)?, change))
            })
            .max_by(|a, b| a.0.total_cmp(&b.0))
            .filter(|(share, _)| *share >= EXPLAINED.max(close * TIMES_BETTER))
            .map(|(share, change)| format!("{:.0}% would if {change}", share * 100.0));
        Some(Self { close, cause })
    }

    pub fn as_finding(&self) -> Finding {
        let text = format!(
            "frames fit each other only roughly: {:.0}% of the compared points are within 2% of the distance that another frame measured (correct scans: more than 90%); {}",
            self.close * 100.0,
            self.cause.as_deref().unwrap_or(
                "poses are imprecise or drift, or the intrinsics or the depth are wrong"
            )
        );
        Finding::unusual(FindingSubject::Camera, text)
    }
}

impl fmt::Display for SharedChange {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::DepthAlongRay => f.write_str(
                "the depth pictures hold distances along the ray: convert them to depth along the optical axis",
            ),
            Self::DepthTimes(factor) => write!(
                f,
                "depth is multiplied by about {factor}, or camera positions are divided by it: check depth_scale_m and the unit of the poses"
            ),
            Self::FocalLengthTimes(factor) => write!(
                f,
                "the focal length is multiplied by about {factor}: check the intrinsics and the picture size they are for"
            ),
        }
    }
}

/// Returns the share of compared points that are close to what another frame measured, of those
/// that are close or in front of it. `None` if too few were compared.
fn close_share(sketches: &[FrameSketch]) -> Option<f32> {
    let (close, in_front) = sketches
        .par_iter()
        .map(|sketch| {
            let others = sketches.iter().filter(|other| other.at != sketch.at);
            others.flat_map(|other| &other.points).fold((0, 0), |(close, in_front), point| {
                match sketch.look_at(&point.position).map(|seen| seen.farther) {
                    Some(off) if off.abs() <= CLOSE => (close + 1, in_front),
                    Some(off) if off < 0.0 => (close, in_front + 1),
                    _ => (close, in_front),
                }
            })
        })
        .reduce(|| (0_u32, 0_u32), |a, b| (a.0 + b.0, a.1 + b.1));
    let compared = close + in_front;
    (compared >= MIN_POINTS).then(|| close as f32 / compared as f32)
}
