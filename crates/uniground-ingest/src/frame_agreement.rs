//! Compares frames with each other: which of them show surfaces where others see through.
//!
//! A wrong pose or depth puts a frame's surfaces into space that other frames saw to be free, and
//! the other way around. Surfaces behind others tell nothing: they are hidden. So the measure does
//! not depend on how much frames hide of each other.

use super::IngestError;
use super::reprojection::{CONSTANT_SHARE, most_frequent};
use super::scan::Scan;
use rayon::prelude::*;
use uniground_geometry::Point3;
use uniground_geometry::scene::{Camera, DepthImage, FrameRef};
use uniground_geometry::statistics::median;
use uniground_types::findings::{Finding, FindingSubject};

/// Maximum number of frames that are compared.
const MAX_FRAMES: usize = 150;
/// Number of points of a frame that are projected into the others, and of a cloud.
const FRAME_POINTS: usize = 300;
const CLOUD_POINTS: usize = 3000;
/// Size of the depth that is kept of a frame, pixels along the longer side.
const KEPT_PIXELS: u32 = 160;
/// Relative depth difference that counts as agreement, as in the check of conventions.
const TOLERANCE: f32 = 0.1;
/// Minimum number of compared points of a frame, and of compared frames.
const MIN_POINTS: u32 = 400;
const MIN_FRAMES: usize = 4;
/// A frame whose agreement is this much below the median contradicts the others. Frames of correct
/// scans agree by 0.91 to 1; a frame that is half a meter off, by 0.4 to 0.7.
const BELOW_MEDIAN: f32 = 0.08;
/// If half of the frames agree by less than this, many of them are wrong.
const MANY_WRONG: f32 = 0.88;
/// A cloud whose agreement is this much below that of the frames with each other does not fit them.
const CLOUD_BELOW_FRAMES: f32 = 0.08;
/// Two frames with this many agreeing points see the same surfaces.
const CONNECTED: u32 = 10;
/// Maximum number of frames that are named.
const MAX_NAMED: usize = 5;

/// A frame's points and a small version of its depth.
struct DepthSketch {
    /// Position in the scan's frames.
    at: usize,
    camera: Camera,
    points: Vec<Point3<f32>>,
    /// Every n-th column and row of the depth picture is kept.
    step: u32,
    width: u32,
    depth_m: Vec<f32>,
}

/// How many points agree with a depth picture, and how many lie in space that it sees through.
#[derive(Debug, Clone, Copy, Default)]
struct Agreement {
    agree: u32,
    contradict: u32,
}

impl Agreement {
    /// Returns the share of compared points that agree. `None` if too few were compared.
    fn share(&self) -> Option<f32> {
        let compared = self.agree + self.contradict;
        (compared >= MIN_POINTS).then(|| self.agree as f32 / compared as f32)
    }

    fn add(&mut self, other: Self) {
        self.agree += other.agree;
        self.contradict += other.contradict;
    }
}

/// Compares frames with each other and with the scan's own cloud (in the world of the frames). Adds
/// findings for frames that contradict the others and for depth pictures without a measurement.
///
/// # Errors
/// Returns [`IngestError::NoUsableFrames`] if no depth picture has a measurement.
pub(super) fn check(
    scan: &Scan,
    frames: &[FrameRef],
    cloud: Option<&[Point3<f32>]>,
    findings: &mut Vec<Finding>,
) -> Result<(), IngestError> {
    let step = frames.len().div_ceil(MAX_FRAMES).max(1);
    // Unreadable pictures are reported by another check.
    let sketches: Vec<DepthSketch> = (0..frames.len())
        .into_par_iter()
        .step_by(step)
        .filter_map(|at| Some(DepthSketch::new(at, &frames[at], &frames[at].decode_depth().ok()?)))
        .collect();
    check_measurements(scan, &sketches, findings)?;
    check_constant(&sketches, findings);
    let comparison = Comparison::new(&sketches, cloud);
    comparison.check_cloud(findings);
    comparison.check_parts(scan, &sketches, findings);
    let everyone = vec![true; sketches.len()];
    let Some(middle) = comparison.median_share(&everyone) else { return Ok(()) };
    if middle < MANY_WRONG {
        let text = format!(
            "frames contradict each other: in half of them, {:.0}% or more of the compared points lie where another frame sees through (correct scans: less than 10%). Poses or depth of some frames are wrong, the poses drift, or the intrinsics are wrong",
            (1.0 - middle) * 100.0
        );
        findings.push(Finding::unusual(FindingSubject::Poses, text));
        return Ok(());
    }
    let wrong: Vec<usize> =
        comparison.find_wrong(everyone).into_iter().map(|i| sketches[i].at).collect();
    if !wrong.is_empty() {
        let text = format!(
            "at least {} of {} compared frames contradict the others: their pose, depth or intrinsics are wrong, or something moved: {}",
            wrong.len(),
            sketches.len(),
            name_frames(scan, &wrong)
        );
        findings.push(Finding::unusual(FindingSubject::Poses, text).counting(wrong.len()));
    }
    Ok(())
}

/// Reports depth pictures without a measurement.
fn check_measurements(
    scan: &Scan,
    sketches: &[DepthSketch],
    findings: &mut Vec<Finding>,
) -> Result<(), IngestError> {
    let is_empty = |sketch: &&DepthSketch| sketch.points.is_empty();
    let empty: Vec<usize> = sketches.iter().filter(is_empty).map(|sketch| sketch.at).collect();
    let Some(first) = empty.first() else { return Ok(()) };
    let with_confidence = match &scan.frames[*first].optics.confidence {
        Some(confidence) => format!(" above the confidence level {}", confidence.at_least),
        None => String::new(),
    };
    if empty.len() == sketches.len() && scan.cloud.is_none() {
        let reason = format!("the depth pictures have no measurement{with_confidence}");
        return Err(IngestError::NoUsableFrames { reason });
    }
    let text = format!(
        "{} of {} examined depth pictures have no measurement{with_confidence}: {}",
        empty.len(),
        sketches.len(),
        name_frames(scan, &empty)
    );
    findings.push(Finding::unusual(FindingSubject::Frames, text).counting(empty.len()));
    Ok(())
}

/// Reports a value that fills much of many depth pictures.
fn check_constant(sketches: &[DepthSketch], findings: &mut Vec<Finding>) {
    let found: Vec<(f32, f32)> = sketches
        .iter()
        .filter_map(|sketch| most_frequent(&sketch.depth_m))
        .filter(|(_, share)| *share >= CONSTANT_SHARE)
        .collect();
    let Some((value_m, _)) = found.get(found.len() / 2) else { return };
    if found.len() * 4 < sketches.len() {
        return;
    }
    let text = format!(
        "in {} of {} examined depth pictures, one value ({value_m:.3} m) fills up to {:.0}% of the measured pixels: depth seems to be cut off there, or this marks no measurement",
        found.len(),
        sketches.len(),
        found.iter().map(|(_, share)| *share).fold(0.0, f32::max) * 100.0
    );
    findings.push(Finding::unusual(FindingSubject::Frames, text).counting(found.len()));
}

/// Returns the color pictures of the first few frames.
fn name_frames(scan: &Scan, frames: &[usize]) -> String {
    let named = frames.iter().take(MAX_NAMED).map(|&at| scan.frames[at].color.as_str());
    let named = named.collect::<Vec<_>>().join(", ");
    match frames.len().saturating_sub(MAX_NAMED) {
        0 => named,
        more => format!("{named} and {more} more"),
    }
}

/// What every frame sees of the points of every other. Row i, column j: what frame i sees of the
/// points of frame j, and of the cloud where i is j.
struct Comparison(Vec<Vec<Agreement>>);

impl Comparison {
    fn new(sketches: &[DepthSketch], cloud: Option<&[Point3<f32>]>) -> Self {
        let cloud: Vec<Point3<f32>> = cloud.map_or(Vec::new(), |points| {
            points.iter().step_by(points.len().div_ceil(CLOUD_POINTS).max(1)).copied().collect()
        });
        let rows = sketches.par_iter().map(|sketch| {
            let compare = |other: &DepthSketch| match sketch.at == other.at {
                true => sketch.compare(&cloud),
                false => sketch.compare(&other.points),
            };
            sketches.iter().map(compare).collect()
        });
        Self(rows.collect())
    }

    /// Reports a cloud that does not fit the frames although the frames fit each other.
    fn check_cloud(&self, findings: &mut Vec<Finding>) {
        let (mut of_cloud, mut of_frames) = (Agreement::default(), Agreement::default());
        for (i, row) in self.0.iter().enumerate() {
            for (j, seen) in row.iter().enumerate() {
                if i == j { &mut of_cloud } else { &mut of_frames }.add(*seen);
            }
        }
        let (Some(cloud), Some(frames)) = (of_cloud.share(), of_frames.share()) else { return };
        if cloud < frames - CLOUD_BELOW_FRAMES {
            let text = format!(
                "the cloud does not fit the frames, which fit each other: {:.0}% of the compared points of the cloud lie where a frame sees through, and {:.0}% of those of other frames. Is it of the same scan, in the same coordinates?",
                (1.0 - cloud) * 100.0,
                (1.0 - frames) * 100.0
            );
            findings.push(Finding::unusual(FindingSubject::Cloud, text));
        }
    }

    /// Reports groups of frames that never see a surface of each other.
    fn check_parts(&self, scan: &Scan, sketches: &[DepthSketch], findings: &mut Vec<Finding>) {
        let frames = self.0.len();
        let sees =
            |i: usize, j: usize| i != j && self.0[i][j].agree + self.0[j][i].agree >= CONNECTED;
        let mut part_of: Vec<Option<usize>> = vec![None; frames];
        let mut sizes: Vec<(usize, usize)> = Vec::new();
        for first in 0..frames {
            if part_of[first].is_some() || sketches[first].points.is_empty() {
                continue;
            }
            let part = sizes.len();
            part_of[first] = Some(part);
            let (mut open, mut size) = (vec![first], 0);
            while let Some(i) = open.pop() {
                size += 1;
                for j in (0..frames).filter(|&j| sees(i, j)) {
                    if part_of[j].is_none() {
                        part_of[j] = Some(part);
                        open.push(j);
                    }
                }
            }
            sizes.push((size, sketches[first].at));
        }
        sizes.retain(|(size, _)| *size > 1);
        if sizes.len() > 1 {
            let named: Vec<String> = sizes
                .iter()
                .take(MAX_NAMED)
                .map(|(size, at)| format!("{size} from {} on", scan.frames[*at].color))
                .collect();
            let text = format!(
                "the frames are in {} parts that never see each other ({}): nothing shows whether their poses are in the same coordinates",
                sizes.len(),
                named.join(", ")
            );
            findings.push(Finding::unusual(FindingSubject::Poses, text).counting(sizes.len()));
        }
    }

    /// Returns the share of the points that a frame sees of others, and that others see of it, that
    /// agree. Only frames that are `used` are counted.
    fn share(&self, i: usize, used: &[bool]) -> Option<f32> {
        let mut total = self.0[i][i];
        for j in (0..self.0.len()).filter(|&j| j != i && used[j]) {
            total.add(self.0[i][j]);
            total.add(self.0[j][i]);
        }
        total.share()
    }

    /// Returns the frames that are used and their shares, the lowest first.
    fn shares(&self, used: &[bool]) -> Vec<(f32, usize)> {
        let one = |i: usize| Some((self.share(i, used)?, i));
        let mut shares: Vec<(f32, usize)> =
            (0..used.len()).filter(|&i| used[i]).filter_map(one).collect();
        shares.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        shares
    }

    /// Returns the median of the shares. `None` if too few frames have one.
    fn median_share(&self, used: &[bool]) -> Option<f32> {
        let mut shares: Vec<f32> = self.shares(used).into_iter().map(|(share, _)| share).collect();
        median(&mut shares).filter(|_| shares.len() >= MIN_FRAMES)
    }

    /// Returns the frames that contradict the others, ascending. The worst is removed first, because
    /// it lowers the shares of its neighbors as well.
    fn find_wrong(&self, mut used: Vec<bool>) -> Vec<usize> {
        let mut wrong = Vec::new();
        while let (Some(middle), Some((lowest, i))) =
            (self.median_share(&used), self.shares(&used).first().copied())
            && lowest < middle - BELOW_MEDIAN
        {
            used[i] = false;
            wrong.push(i);
        }
        wrong.sort_unstable();
        wrong
    }
}

impl DepthSketch {
    fn new(at: usize, frame: &FrameRef, depth: &DepthImage) -> Self {
        let step = depth.width.max(depth.height).div_ceil(KEPT_PIXELS).max(1);
        let width = depth.width.div_ceil(step);
        let height = depth.height.div_ceil(step);
        let depth_m: Vec<f32> = (0..height)
            .flat_map(|v| (0..width).map(move |u| (u * step, v * step)))
            .map(|pixel| depth.at(pixel))
            .collect();
        let known: Vec<usize> = (0..depth_m.len()).filter(|&i| depth_m[i] > 0.0).collect();
        let unproject = |&i: &usize| {
            let (u, v) = (i as u32 % width * step, i as u32 / width * step);
            let local = frame.depth_intrinsics.unproject(u as f32, v as f32, depth_m[i]);
            frame.camera_to_world * local
        };
        // Not a divisor of the width, so that all columns are used.
        let every = (known.len() / FRAME_POINTS).max(1) | 1;
        let points = known.iter().step_by(every).map(unproject).collect();
        let camera = Camera::new(frame.depth_intrinsics, &frame.camera_to_world);
        Self { at, camera, points, step, width, depth_m }
    }

    /// Compares points, in the world of the frames, with this frame's depth.
    fn compare(&self, points: &[Point3<f32>]) -> Agreement {
        let mut found = Agreement::default();
        for point in points {
            let Some(pixel) = self.camera.project(point) else { continue };
            let (column, row) = pixel.cell();
            let at = (row / self.step * self.width + column / self.step) as usize;
            let Some(&measured_m) = self.depth_m.get(at).filter(|z| **z > 0.0) else { continue };
            let off = (pixel.z_m - measured_m) / measured_m;
            found.agree += u32::from(off.abs() <= TOLERANCE);
            found.contradict += u32::from(off < -TOLERANCE);
        }
        found
    }
}
