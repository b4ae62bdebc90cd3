//! Does the geometry agree with the depth pictures? Wrong pose directions, camera axes and depth scales show here first.

use super::IngestError;
use super::scan::{CameraAxes, RawFrame, Scan};
use crate::geometry::statistics::median;
use crate::geometry::{Isometry3, Point3};
use crate::scene::{Camera, DepthImage, FrameRef, PointCloud, PoseConvention};
use rayon::prelude::*;

/// Frames and points looked at: enough to tell conventions apart, few enough to cost nothing.
const MAX_FRAMES: usize = 20;
const MAX_POINTS: usize = 5000;
/// Relative depth difference that counts as agreement.
const TOLERANCE: f32 = 0.1;
/// From this agreement on, no other reading is looked at. Right ones give 0.6 to 0.9.
const CLEARLY_RIGHT: f32 = 0.6;
/// Another reading is taken for the right one when it agrees this well, and this many times better than the declared one.
const CLEARLY_BETTER: f32 = 0.45;
const TIMES_BETTER: f32 = 1.5;
/// Below this, a scan is odd however it is read.
const SUSPICIOUS: f32 = 0.15;
/// Median depth of an indoor scan, metres: a scale that leads out of this is no explanation.
const PLAUSIBLE_DEPTH_M: std::ops::RangeInclusive<f32> = 0.15..=30.0;
/// Depth units in the field: millimetres, metres, TUM's 1/5000, Replica's 1/6553.5.
const DEPTH_SCALES_M: [f32; 4] = [0.001, 1.0, 1.0 / 5000.0, 1.0 / 6553.5];

/// Share of points in view that agree with the depth there, over a sample of frames; `None` when there is nothing to compare.
///
/// The points are the archive's own cloud's. Without one, they are each frame's own depth, judged by the other frames.
///
/// # Errors
/// [`IngestError::ConventionMismatch`] when the declared convention fails and another one clearly fits.
pub(super) fn check(
    scan: &Scan,
    own_cloud: Option<&PointCloud>,
    frames: &[FrameRef],
    warnings: &mut Vec<String>,
) -> Result<Option<f32>, IngestError> {
    if frames.is_empty() || (own_cloud.is_none() && frames.len() < 2) {
        return Ok(None);
    }
    let sampled: Vec<(&FrameRef, &RawFrame, DepthImage)> = frames
        .par_iter()
        .zip(&scan.frames)
        .step_by(frames.len().div_ceil(MAX_FRAMES))
        .map(|(frame, raw)| Ok((frame, raw, frame.decode_depth()?)))
        .collect::<Result<_, IngestError>>()?;
    let sample = Sample {
        scan,
        frames: sampled,
        cloud: own_cloud.map(|cloud| cloud.positions.iter().step_by(cloud.len().div_ceil(MAX_POINTS)).copied().collect()),
    };
    let declared = Hypothesis { pose: scan.pose, axes: scan.camera_axes, depth_scale_m: scan.depth_scale_m };
    let agreement = sample.agreement(&declared);
    if agreement.is_some_and(|agreement| agreement >= CLEARLY_RIGHT) {
        return Ok(agreement);
    }
    let others = Hypothesis::all().filter(|h| *h != declared).filter_map(|h| Some((sample.agreement(&h)?, h)));
    let best = others.max_by(|a, b| a.0.total_cmp(&b.0));
    if let Some((other, hypothesis)) = best
        && other >= CLEARLY_BETTER.max(agreement.unwrap_or(0.0) * TIMES_BETTER)
    {
        return Err(IngestError::ConventionMismatch {
            agreement: agreement.unwrap_or(0.0) * 100.0,
            hypothesis: hypothesis.describe(),
            other_agreement: other * 100.0,
        });
    }
    match agreement {
        None => warnings
            .push("hardly any sampled point projects onto measured depth: the frames may not overlap, or not belong together".into()),
        Some(agreement) if agreement < SUSPICIOUS => {
            warnings.push(format!("only {:.0}% of the sampled points agree with the depth pictures", agreement * 100.0));
        }
        Some(_) => {}
    }
    Ok(agreement)
}

/// One way to read a scan's poses and depth.
#[derive(Clone, Copy, PartialEq)]
struct Hypothesis {
    pose: PoseConvention,
    axes: CameraAxes,
    depth_scale_m: f32,
}

impl Hypothesis {
    fn all() -> impl Iterator<Item = Self> {
        [PoseConvention::CameraToWorld, PoseConvention::WorldToCamera].into_iter().flat_map(|pose| {
            [CameraAxes::Opencv, CameraAxes::Opengl]
                .into_iter()
                .flat_map(move |axes| DEPTH_SCALES_M.into_iter().map(move |depth_scale_m| Self { pose, axes, depth_scale_m }))
        })
    }

    fn describe(&self) -> String {
        let pose = match self.pose {
            PoseConvention::CameraToWorld => "camera_to_world",
            PoseConvention::WorldToCamera => "world_to_camera",
        };
        let axes = match self.axes {
            CameraAxes::Opencv => "opencv",
            CameraAxes::Opengl => "opengl",
        };
        format!("pose {pose}, camera_axes {axes}, depth_scale_m {}", self.depth_scale_m)
    }
}

/// What the check looks at: a few frames' depth, and the points of a cloud where the archive has one.
struct Sample<'a> {
    scan: &'a Scan,
    frames: Vec<(&'a FrameRef, &'a RawFrame, DepthImage)>,
    cloud: Option<Vec<Point3<f32>>>,
}

impl Sample<'_> {
    /// Agreement in `0..=1` under one reading; `None` when too few points fall on measured depth to tell.
    fn agreement(&self, reading: &Hypothesis) -> Option<f32> {
        let cameras: Vec<(Camera, Isometry3<f32>)> =
            self.frames.iter().map(|(frame, raw, _)| self.camera(frame, raw, reading)).collect::<Option<_>>()?;
        let rescale = reading.depth_scale_m / self.scan.depth_scale_m;
        let measured = self.frames.iter().flat_map(|(_, _, depth)| depth.depth_m.iter().step_by(97)).filter(|z| **z > 0.0);
        let typical_m = median(&mut measured.map(|z| z * rescale).collect::<Vec<_>>())?;
        if !PLAUSIBLE_DEPTH_M.contains(&typical_m) {
            return None;
        }
        let per_frame = MAX_POINTS / self.frames.len();
        // Each point with the frame it comes from, which may not judge it.
        let points: Vec<(Option<usize>, Point3<f32>)> = match &self.cloud {
            Some(points) => points.iter().map(|p| (None, *p)).collect(),
            None => self
                .frames
                .iter()
                .enumerate()
                .flat_map(|(i, (_, _, depth))| {
                    let (camera, camera_to_world) = &cameras[i];
                    let step = (depth.depth_m.len() / per_frame).max(1);
                    let measured = (0..depth.depth_m.len()).step_by(step).filter(|&at| depth.depth_m[at] > 0.0);
                    measured
                        .map(move |at| {
                            let (u, v) = (at as u32 % depth.width, at as u32 / depth.width);
                            (Some(i), camera_to_world * camera.intrinsics.unproject(u as f32, v as f32, depth.depth_m[at] * rescale))
                        })
                        .collect::<Vec<_>>()
                })
                .collect(),
        };
        let (mut agree, mut seen) = (0_usize, 0_usize);
        for (i, ((camera, _), (_, _, depth))) in cameras.iter().zip(&self.frames).enumerate() {
            for (origin, point) in &points {
                if *origin == Some(i) {
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
        // A wrong reading may leave a handful of lucky points in view: they must be a fair share to count.
        (seen * 50 >= points.len()).then(|| agree as f32 / seen.max(1) as f32)
    }

    /// The frame's camera under a reading of its pose. The turn to Z up is the same for every reading.
    fn camera(&self, frame: &FrameRef, raw: &RawFrame, reading: &Hypothesis) -> Option<(Camera, Isometry3<f32>)> {
        let declared = raw.camera_to_world(self.scan.pose, self.scan.camera_axes).ok()?;
        let to_z_up = frame.camera_to_world * declared.inverse();
        let camera_to_world = to_z_up * raw.camera_to_world(reading.pose, reading.axes).ok()?;
        Some((Camera::new(frame.depth_intrinsics, &camera_to_world), camera_to_world))
    }
}
