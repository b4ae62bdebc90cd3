//! Checks that the geometry agrees with the depth pictures. Wrong pose directions, camera axes and
//! depth scales are detected here.

mod causes;

use super::IngestError;
use super::scan::{CameraAxes, Scan, Units, camera_to_world};
use causes::with_scalar_first;
use rayon::prelude::*;
use std::collections::HashMap;
use std::fmt::Write;
use uniground_geometry::scene::{Camera, DepthImage, FrameRef, PointCloud, PoseConvention};
use uniground_geometry::statistics::median;
use uniground_geometry::{Isometry3, Point3};
use uniground_types::findings::{Finding, FindingSubject};

/// Number of frames and points in the sample: enough to tell conventions apart, and cheap.
const MAX_FRAMES: usize = 20;
const MAX_POINTS: usize = 5000;
/// Relative depth difference that counts as agreement.
const TOLERANCE: f32 = 0.1;
/// At this agreement or above, no other interpretation is tried. Correct ones give 0.6 to 0.9.
const CLEARLY_RIGHT: f32 = 0.6;
/// Another interpretation replaces the declared one only if it agrees at least this well, and this
/// many times better than the declared one.
const CLEARLY_BETTER: f32 = 0.45;
const TIMES_BETTER: f32 = 1.5;
/// Another unit of length must agree better than the declared one by this factor: cameras at nearly
/// the same position agree too easily.
const TIMES_BETTER_UNITS: f32 = 2.5;
/// Below this agreement, a scan gets a warning under any interpretation.
const SUSPICIOUS: f32 = 0.4;
/// Below this agreement, cloud, poses and depth do not belong together.
const NOTHING_FITS: f32 = 0.03;
/// Plausible median depth of an indoor scan, meters. A scale that leads outside is rejected.
const PLAUSIBLE_DEPTH_M: std::ops::RangeInclusive<f32> = 0.15..=30.0;
/// Common depth units: millimeters, meters, `RealSense` L515's 1/4000, TUM's 1/5000, Replica's
/// 1/6553.5, `RealSense` D405's 1/10000.
const DEPTH_SCALES_M: [f32; 6] =
    [0.001, 1.0, 1.0 / 4000.0, 1.0 / 5000.0, 1.0 / 6553.5, 1.0 / 10_000.0];
/// A rare depth unit, which is tried in the declared convention only.
const CENTIMETERS_M: f32 = 0.01;
/// Width of the window, in logarithms of distances, that a fitted unit of depth agrees within.
const FIT_WINDOW: f32 = 0.05;
/// Minimum share of the compared points in that window. Of unrelated distances 2 to 5 % are.
const MIN_FIT: f32 = 0.3;

/// Common units of length of positions, meters.
const LENGTHS_M: [f64; 2] = [0.001, 0.01];

/// How the poses and the depth of a scan are interpreted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct SourceConvention {
    pub pose: PoseConvention,
    pub axes: CameraAxes,
    pub depth_scale_m: f32,
    pub metres_per_unit: f64,
}

/// Depth units within this factor of each other agree with the same points.
const SAME_UNIT: f32 = 1.0 + 2.0 * TOLERANCE;
/// Minimum confidence of an interpretation that differs from the declared one. It is reached at 1.15
/// times the agreement of the next best one: neighboring common units of depth are that close.
const LEAST_SURE: f32 = 0.75;

/// The interpretation that fits, with its agreement.
pub(super) struct CheckedConvention {
    pub reading: SourceConvention,
    /// Share of points in view that agree with the depth there. `None` when there is nothing to
    /// compare.
    pub agreement: Option<f32>,
}

/// Compares points in view with the depth there, over a sample of frames, under the declared
/// convention. If that does not fit and another interpretation clearly does, the other one is used,
/// with a warning. The findings get the interpretation and how clearly it fits better than the next
/// best one.
///
/// The points come from the archive's own cloud (as `declared`, meters). Without one, they come
/// from each frame's own depth and are checked against the other frames.
///
/// # Errors
/// Returns [`IngestError::NothingFits`] when hardly anything agrees under any interpretation, and
/// [`IngestError::ConventionUnclear`] when the declared one does not fit and two others fit about
/// equally well.
pub(super) fn check(
    scan: &Scan,
    declared: SourceConvention,
    own_cloud: Option<&PointCloud>,
    frames: &[FrameRef],
    findings: &mut Vec<Finding>,
) -> Result<CheckedConvention, IngestError> {
    let as_declared = |agreement| Ok(CheckedConvention { reading: declared, agreement });
    if frames.is_empty() {
        return as_declared(None);
    }
    if own_cloud.is_none() && !has_distinct_views(frames) {
        let which = match frames.len() {
            1 => "there is only one frame".to_owned(),
            n => format!("all {n} frames are taken from the same place"),
        };
        let text = format!(
            "{which}: the direction of the poses, the camera axes and the depth scale cannot be checked and are taken as declared"
        );
        findings.push(
            Finding::assumed(FindingSubject::Poses, text)
                .with_confidence(0.5)
                .stated_with("scene.json"),
        );
        return as_declared(None);
    }
    let sampled = sample_frames(frames);
    if sampled.is_empty() {
        return as_declared(None);
    }
    let sample = ReprojectionSample {
        scan,
        declared,
        frames: sampled,
        cloud: own_cloud.map(|cloud| {
            cloud.positions.iter().step_by(cloud.len().div_ceil(MAX_POINTS)).copied().collect()
        }),
    };
    let agreement = sample.agreement(&declared);
    let fits = agreement.unwrap_or(0.0);
    let measure = |readings: Vec<SourceConvention>| -> Vec<(f32, SourceConvention)> {
        readings.into_par_iter().filter_map(|r| Some((sample.agreement(&r)?, r))).collect()
    };
    let best_of = |readings: &[(f32, SourceConvention)]| {
        readings.iter().copied().max_by(|a, b| a.0.total_cmp(&b.0))
    };
    let common = measure(SourceConvention::all(declared.metres_per_unit).collect());
    // The best interpretation that is a different one.
    let rival_of = |reading: &SourceConvention| {
        let others: Vec<_> =
            common.iter().copied().filter(|(_, other)| !other.is_like(reading)).collect();
        best_of(&others)
    };
    if fits >= CLEARLY_RIGHT {
        findings.push(declared.as_finding(fits, rival_of(&declared)));
        findings.extend(sample.find_shift(&declared, fits));
        return as_declared(agreement);
    }
    let others: Vec<_> = common.iter().copied().filter(|(_, r)| *r != declared).collect();
    let mut best = best_of(&others);
    // None of the common units fits well: the cloud may tell which one does.
    if best.is_none_or(|(other, _)| other.max(fits) < CLEARLY_RIGHT) {
        let fitted = best_of(&measure(sample.uncommon_units()));
        if fitted.is_some_and(|(other, _)| {
            other >= CLEARLY_RIGHT && best.is_none_or(|(common, _)| other > common)
        }) {
            best = fitted;
        }
    }
    let mut wanted = CLEARLY_BETTER.max(fits * TIMES_BETTER);
    if best.is_none_or(|(other, _)| other < wanted) && fits < CLEARLY_BETTER {
        let other_units = best_of(&measure(
            LENGTHS_M
                .into_iter()
                .flat_map(|m| SourceConvention::all(declared.metres_per_unit * m))
                .collect(),
        ));
        if other_units
            .is_some_and(|(other, _)| other >= CLEARLY_RIGHT.max(fits * TIMES_BETTER_UNITS))
        {
            (best, wanted) = (other_units, 0.0);
        }
    }
    if let Some((other, reading)) = best
        && other >= wanted
    {
        let rival = rival_of(&reading);
        let confidence = confidence_over(other, rival);
        if let Some((next, rival)) = rival
            && confidence < LEAST_SURE
        {
            return Err(IngestError::ConventionUnclear {
                agreement: fits * 100.0,
                readings: format!(
                    "{:.0}% do with {}, and {:.0}% with {}",
                    other * 100.0,
                    reading.describe(&declared),
                    next * 100.0,
                    rival.describe(&declared)
                ),
            });
        }
        let text = format!(
            "poses, axes or depth are not as declared: {:.0}% of the sampled points fit the depth pictures as declared, but {:.0}% do with {}, which is used",
            fits * 100.0,
            other * 100.0,
            reading.describe(&declared),
        );
        findings.push(
            Finding::assumed(FindingSubject::Poses, text)
                .with_confidence(confidence)
                .stated_with("scene.json"),
        );
        return Ok(CheckedConvention { reading, agreement: Some(other) });
    }
    match agreement {
        None => findings.push(Finding::unusual(FindingSubject::Poses, sample.why_unknown())),
        Some(agreement) if agreement < NOTHING_FITS => {
            let (other_agreement, hypothesis) = best
                .map_or((0.0, "none".into()), |(other, reading)| {
                    (other * 100.0, reading.describe(&declared))
                });
            return Err(IngestError::NothingFits {
                agreement: agreement * 100.0,
                hypothesis,
                other_agreement,
                cause: sample
                    .likely_cause(&declared, agreement)
                    .unwrap_or(CHECK_CONVENTIONS.into()),
            });
        }
        Some(agreement) if agreement < SUSPICIOUS => {
            let cause = sample.likely_cause(&declared, agreement);
            let text = format!(
                "only {:.0}% of the sampled points agree with the depth pictures (a correct scan has 60 to 90%): {}",
                agreement * 100.0,
                cause.as_deref().unwrap_or(CHECK_ALL)
            );
            findings.push(
                Finding::unusual(FindingSubject::Poses, text)
                    .with_confidence(confidence_over(agreement, rival_of(&declared)))
                    .stated_with("scene.json"),
            );
        }
        Some(agreement) => {
            findings.push(declared.as_finding(agreement, rival_of(&declared)));
            findings.extend(sample.find_shift(&declared, agreement));
        }
    }
    as_declared(agreement)
}

/// Decodes the depth of some frames. Unreadable pictures are reported by another check.
fn sample_frames(frames: &[FrameRef]) -> Vec<SampledFrame<'_>> {
    // Not every n-th frame: mistakes can be periodic.
    let count = frames.len().min(MAX_FRAMES);
    let decode = |i: usize| {
        let at = i * frames.len() / count;
        let frame = &frames[at];
        let mut depth = frame.decode_depth().ok()?;
        remove_constant(&mut depth);
        Some(SampledFrame { at, frame, depth })
    };
    (0..count).into_par_iter().filter_map(decode).collect()
}

/// What to check where no cause is known.
const CHECK_CONVENTIONS: &str = "check pose, camera_axes and depth_scale_m";
const CHECK_ALL: &str = "check the direction of the poses, the camera axes, the depth scale, the intrinsics, and which pictures and poses belong together";
/// Cameras closer to each other than this have the same view: the depth of one fits that of the
/// other under any convention.
const SAME_PLACE_M: f32 = 0.01;
const SAME_DIRECTION_RAD: f32 = 0.02;

/// Share of the measured pixels from which a single value is no measurement: depth that is cut off
/// at a maximum, or a marker for no depth. Of real measurements, a few percent are equal.
pub(super) const CONSTANT_SHARE: f32 = 0.15;

/// Returns the most frequent value of a depth picture and its share of the measured pixels.
pub(super) fn most_frequent(depth_m: &[f32]) -> Option<(f32, f32)> {
    let mut counts: HashMap<u32, u32> = HashMap::new();
    let mut measured = 0_u32;
    for z in depth_m.iter().filter(|z| **z > 0.0) {
        measured += 1;
        *counts.entry(z.to_bits()).or_default() += 1;
    }
    let (bits, count) = counts.into_iter().max_by_key(|&(bits, count)| (count, bits))?;
    Some((f32::from_bits(bits), count as f32 / measured as f32))
}

/// Removes the most frequent value of a depth picture if it is no measurement. Such pixels would
/// agree with each other wherever the cameras are.
fn remove_constant(depth: &mut DepthImage) {
    if let Some((value, share)) = most_frequent(&depth.depth_m)
        && share >= CONSTANT_SHARE
    {
        depth.depth_m.iter_mut().filter(|z| **z == value).for_each(|z| *z = 0.0);
    }
}

/// Returns whether two cameras have different views.
fn is_distinct(a: &Isometry3<f32>, b: &Isometry3<f32>) -> bool {
    (a.translation.vector - b.translation.vector).norm() > SAME_PLACE_M
        || a.rotation.angle_to(&b.rotation) > SAME_DIRECTION_RAD
}

/// Returns whether any frame has another view than the first.
fn has_distinct_views(frames: &[FrameRef]) -> bool {
    let Some((first, others)) = frames.split_first() else { return false };
    others.iter().any(|frame| is_distinct(&frame.camera_to_world, &first.camera_to_world))
}

impl SourceConvention {
    fn all(metres_per_unit: f64) -> impl Iterator<Item = Self> {
        [PoseConvention::CameraToWorld, PoseConvention::WorldToCamera].into_iter().flat_map(
            move |pose| {
                CameraAxes::ALL.into_iter().flat_map(move |axes| {
                    DEPTH_SCALES_M.into_iter().map(move |depth_scale_m| Self {
                        pose,
                        axes,
                        depth_scale_m,
                        metres_per_unit,
                    })
                })
            },
        )
    }

    /// Returns whether another interpretation cannot be told from this one.
    fn is_like(&self, other: &Self) -> bool {
        let units = self.depth_scale_m / other.depth_scale_m;
        (self.pose, self.axes) == (other.pose, other.axes)
            && (1.0 / SAME_UNIT..SAME_UNIT).contains(&units)
    }

    /// Describes that this interpretation, the declared one, is used. A warning if another one fits
    /// about as well.
    fn as_finding(&self, agreement: f32, rival: Option<(f32, Self)>) -> Finding {
        let mut text = format!(
            "read with {}: {:.0}% of the sampled points fit the depth pictures",
            self.describe(self),
            agreement * 100.0
        );
        if let Some((next, rival)) = rival.filter(|(next, _)| *next > NOTHING_FITS) {
            let of_rival = rival.describe(self);
            let _ = write!(text, "; next best is {of_rival}: {:.0}%", next * 100.0);
        }
        let confidence = confidence_over(agreement, rival);
        let finding = Finding::assumed(FindingSubject::Poses, text)
            .with_confidence(confidence)
            .stated_with("scene.json");
        // What is declared needs less support than a guess.
        let least = if agreement >= CLEARLY_RIGHT { 0.5 } else { LEAST_SURE };
        if confidence < least { finding } else { finding.without_warning() }
    }

    fn describe(&self, declared: &Self) -> String {
        let pose = match self.pose {
            PoseConvention::CameraToWorld => "camera_to_world",
            PoseConvention::WorldToCamera => "world_to_camera",
        };
        let axes = self.axes.as_str();
        let units = match self.metres_per_unit == declared.metres_per_unit {
            true => String::new(),
            false => format!(", metres_per_unit {}", self.metres_per_unit),
        };
        format!("pose {pose}, camera_axes {axes}, depth_scale_m {}{units}", self.depth_scale_m)
    }
}

/// Returns how clearly an agreement is better than that of the next best interpretation, `0..=1`.
fn confidence_over(agreement: f32, rival: Option<(f32, SourceConvention)>) -> f32 {
    let next = rival.map_or(0.0, |(next, _)| next);
    let (this, next) = (agreement.max(0.001).powi(8), next.powi(8));
    this / (this + next)
}

/// The data of the check: the depth of some frames, and the points of a cloud where the archive has
/// one.
struct ReprojectionSample<'a> {
    scan: &'a Scan,
    /// The convention that was used to decode the depth and scale the cloud.
    declared: SourceConvention,
    frames: Vec<SampledFrame<'a>>,
    cloud: Option<Vec<Point3<f32>>>,
}

/// A frame of the sample.
struct SampledFrame<'a> {
    /// Position in the scan's frames.
    at: usize,
    frame: &'a FrameRef,
    depth: DepthImage,
}

/// Which pose a frame takes. Any but the first is a mistake that scans contain.
#[derive(Debug, Clone, Copy, PartialEq)]
enum PoseOf {
    Itself,
    Next,
    Previous,
    /// Its own, whose quaternion is in the order `w x y z`.
    ScalarFirst,
}

impl ReprojectionSample<'_> {
    /// Returns the agreement in `0..=1` under one interpretation. `None` when too few points fall
    /// on measured depth.
    fn agreement(&self, reading: &SourceConvention) -> Option<f32> {
        self.agreement_with(reading, PoseOf::Itself)
    }

    /// Returns the agreement of the frames with each other, where there is a cloud.
    fn agreement_without_cloud(&self, reading: &SourceConvention) -> Option<f32> {
        self.cloud.as_ref()?;
        self.agreement_of(reading, PoseOf::Itself, None)
    }

    /// Returns the agreement if frames take other poses than their own.
    fn agreement_with(&self, reading: &SourceConvention, pose: PoseOf) -> Option<f32> {
        self.agreement_of(reading, pose, self.cloud.as_deref())
    }

    fn agreement_of(
        &self,
        reading: &SourceConvention,
        pose: PoseOf,
        cloud: Option<&[Point3<f32>]>,
    ) -> Option<f32> {
        let cameras: Vec<(Camera, Isometry3<f32>)> = self
            .frames
            .iter()
            .map(|sampled| self.camera(sampled, reading, pose))
            .collect::<Option<_>>()?;
        let rescale = reading.depth_scale_m / self.declared.depth_scale_m;
        let relength = (reading.metres_per_unit / self.declared.metres_per_unit) as f32;
        if !PLAUSIBLE_DEPTH_M.contains(&(self.typical_depth_m()? * rescale)) {
            return None;
        }
        let per_frame = MAX_POINTS / self.frames.len();
        // Each point with the frame it comes from. That frame must not be used to check the point.
        let points: Vec<(Option<usize>, Point3<f32>)> = match cloud {
            Some(points) => points.iter().map(|p| (None, p * relength)).collect(),
            None => self
                .frames
                .iter()
                .enumerate()
                .flat_map(|(i, SampledFrame { depth, .. })| {
                    let (camera, camera_to_world) = &cameras[i];
                    let step = (depth.depth_m.len() / per_frame).max(1);
                    let measured = (0..depth.depth_m.len())
                        .step_by(step)
                        .filter(|&at| depth.depth_m[at] > 0.0);
                    measured
                        .map(move |at| {
                            let (u, v) = (at as u32 % depth.width, at as u32 / depth.width);
                            (
                                Some(i),
                                camera_to_world
                                    * camera.intrinsics.unproject(
                                        u as f32,
                                        v as f32,
                                        depth.depth_m[at] * rescale,
                                    ),
                            )
                        })
                        .collect::<Vec<_>>()
                })
                .collect(),
        };
        let (mut agree, mut seen) = (0_usize, 0_usize);
        for ((camera, pose), SampledFrame { depth, .. }) in cameras.iter().zip(&self.frames) {
            // A frame, and copies of it, must not be used to check its own points.
            let is_other: Vec<bool> =
                cameras.iter().map(|(_, other)| is_distinct(pose, other)).collect();
            for (origin, point) in &points {
                if origin.is_some_and(|origin| !is_other[origin]) {
                    continue;
                }
                let Some(pixel) = camera.project(point) else { continue };
                let measured_m = depth.at(pixel.cell()) * rescale;
                if measured_m > 0.0 {
                    seen += 1;
                    agree += usize::from((pixel.z_m - measured_m).abs() <= TOLERANCE * measured_m);
                }
            }
        }
        // A wrong interpretation can leave a few points in view by chance. Agreement counts only if
        // at least 2 % of the points are in view.
        (seen * 50 >= points.len()).then(|| agree as f32 / seen.max(1) as f32)
    }

    /// Returns the median depth as declared, meters.
    fn typical_depth_m(&self) -> Option<f32> {
        let all = self.frames.iter().flat_map(|sampled| sampled.depth.depth_m.iter().step_by(97));
        median(&mut all.copied().filter(|z| *z > 0.0).collect::<Vec<_>>())
    }

    /// Explains why no point could be compared.
    fn why_unknown(&self) -> String {
        match self.typical_depth_m() {
            Some(typical_m) if !PLAUSIBLE_DEPTH_M.contains(&typical_m) => format!(
                "half of the depth is {} than {typical_m:.3} m, which is not plausible for a room: check depth_scale_m and the format of the depth pictures",
                if typical_m < *PLAUSIBLE_DEPTH_M.start() { "less" } else { "more" }
            ),
            _ => "almost no sampled point projects onto measured depth: the frames may not overlap or may be of different scans".to_owned(),
        }
    }

    /// Returns interpretations with less common units of depth: centimeters, and those that follow
    /// from the archive's own cloud: the most frequent ratio of a point's distance to the depth
    /// there.
    fn uncommon_units(&self) -> Vec<SourceConvention> {
        let centimeters = SourceConvention { depth_scale_m: CENTIMETERS_M, ..self.declared };
        let Some(points) = &self.cloud else { return vec![centimeters] };
        let with_unit = |reading: SourceConvention| {
            let mut ratios = Vec::new();
            for sampled in &self.frames {
                let (camera, _) = self.camera(sampled, &reading, PoseOf::Itself)?;
                ratios.extend(points.iter().filter_map(|point| {
                    let pixel = camera.project(point)?;
                    let measured_m = sampled.depth.at(pixel.cell());
                    (measured_m > 0.0 && pixel.z_m > 0.0).then(|| (pixel.z_m / measured_m).ln())
                }));
            }
            let ratio = densest(&mut ratios)?.exp();
            Some(SourceConvention { depth_scale_m: reading.depth_scale_m * ratio, ..reading })
        };
        SourceConvention::all(self.declared.metres_per_unit)
            .filter(|reading| reading.depth_scale_m == DEPTH_SCALES_M[0])
            .map(|reading| SourceConvention {
                depth_scale_m: self.declared.depth_scale_m,
                ..reading
            })
            .filter_map(with_unit)
            .chain([centimeters])
            .collect()
    }

    /// Returns the frame's camera under an interpretation of its pose, in the world of the files.
    fn camera(
        &self,
        sampled: &SampledFrame,
        reading: &SourceConvention,
        pose: PoseOf,
    ) -> Option<(Camera, Isometry3<f32>)> {
        let units = Units { origin: self.scan.origin, metres_per_unit: reading.metres_per_unit };
        let frames = &self.scan.frames;
        let pose = match pose {
            PoseOf::Itself => frames[sampled.at].pose,
            PoseOf::Next => frames[(sampled.at + 1).min(frames.len() - 1)].pose,
            PoseOf::Previous => frames[sampled.at.saturating_sub(1)].pose,
            PoseOf::ScalarFirst => with_scalar_first(&frames[sampled.at].pose)?,
        };
        let camera_to_world = camera_to_world(&pose, reading.pose, reading.axes, &units).ok()?;
        Some((Camera::new(sampled.frame.depth_intrinsics, &camera_to_world), camera_to_world))
    }
}

/// Returns the middle of the window that holds the most numbers, if enough of them are in it.
fn densest(numbers: &mut [f32]) -> Option<f32> {
    numbers.sort_by(f32::total_cmp);
    let (mut start, mut best) = (0, (0, 0));
    for end in 0..numbers.len() {
        while numbers[end] - numbers[start] > FIT_WINDOW {
            start += 1;
        }
        if end + 1 - start > best.1 - best.0 {
            best = (start, end + 1);
        }
    }
    let window = &numbers[best.0..best.1];
    (window.len() as f32 >= MIN_FIT * numbers.len() as f32).then_some(())?;
    window.get(window.len() / 2).copied()
}

#[cfg(test)]
mod tests {
    use super::densest;

    #[test]
    fn the_most_frequent_value_is_found_among_scattered_ones() {
        let mut numbers: Vec<f32> = (0..60).map(|i| i as f32 * 0.1 - 3.0).collect();
        numbers.extend((0..40).map(|i| 0.7 + i as f32 * 0.001));
        assert!((densest(&mut numbers).unwrap() - 0.72).abs() < 0.02);
        let mut scattered: Vec<f32> = (0..100).map(|i| i as f32 * 0.1).collect();
        assert_eq!(densest(&mut scattered), None);
        assert_eq!(densest(&mut []), None);
    }
}
