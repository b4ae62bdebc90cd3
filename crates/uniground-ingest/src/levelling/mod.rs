//! Finds which way is up, and how far the world of the files is from level.
//!
//! Floors are level and walls are upright: the direction that explains most surfaces is up
//! ([`gravity`]). The search starts at the axis stated in the files, at the cameras' up
//! ([`cameras`]), or, for a cloud alone, at the direction chosen by its shape ([`lone_cloud`]).
//! Worlds that are level within [`LEVEL_DEG`] stay bit-identical.

mod cameras;
mod gravity;
mod lone_cloud;
mod surfaces;

use super::IngestError;
use gravity::UpFit;
use nalgebra::UnitQuaternion;
use surfaces::SurfacePatch;
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::{FrameRef, Levelling, PointCloud};
use uniground_geometry::up_axis::UpAxis;
use uniground_geometry::{Isometry3, Vector3};
use uniground_types::findings::{Finding, FindingSubject};
use uniground_types::settings::LevellingChoice;

/// The detected up direction.
#[derive(Debug, Clone)]
pub(super) struct UpDirection {
    /// The axis of the files closest to up.
    pub axis: UpAxis,
    /// Rotation about the origin, from the world of the files (meters) to a level one with Z up.
    pub turn: Isometry3<f32>,
    /// The measured tilt. `None` where it could not be measured.
    pub report: Option<Levelling>,
}

/// What is known about up in advance.
#[derive(Debug, Clone, Copy)]
pub(super) struct UpHint {
    /// The axis stated by the request or the files.
    pub up: Option<UpAxis>,
    /// Whether the axis is only that of the files' format. Programs write clouds with Z up into
    /// formats that define Y up.
    pub by_format: bool,
    /// Whether an inertial sensor made the world level.
    pub by_gravity: bool,
    pub choice: LevellingChoice,
}

/// A world within this angle is level enough, degrees. Surfaces determine up only to within a
/// degree or two.
const LEVEL_DEG: f32 = 2.5;
/// An inertial sensor is trusted within this angle, degrees. It is more accurate than surfaces,
/// unless the world was rotated after the scan.
const LEVEL_BY_GRAVITY_DEG: f32 = 6.0;
/// Surfaces are trusted when they explain this share of the examined area, this clearly, and some
/// of them are level.
const EXPLAINED: f32 = 0.4;
const CLEARNESS: f32 = 0.06;
const LEVEL_SHARE: f32 = 0.03;
/// Minimum confidence for another up direction than the one that the files' format defines.
const SURE_AGAINST_FORMAT: f32 = 0.85;
/// Cameras that differ by more than this from the stated axis contradict it, degrees.
const CONTRADICTING_DEG: f32 = 45.0;
/// Surfaces and cameras that differ by more than this disagree about up, degrees.
const AGREEING_DEG: f32 = 25.0;

/// Finds up of posed frames, whose poses are in the world of the files.
pub(super) fn find_up_of_frames(
    frames: &[FrameRef],
    said: UpHint,
    findings: &mut Vec<Finding>,
    progress: &Progress,
) -> Result<UpDirection, IngestError> {
    let poses: Vec<_> = frames.iter().map(|frame| frame.camera_to_world).collect();
    let cameras = cameras::up_from_cameras(&poses);
    let held = UpAxis::from_cameras(&poses);
    let axis = said.up.or(held).or(cameras.map(|c| UpAxis::nearest(&c.up)));
    // Cameras without roll tell up, whatever they look at.
    if let (Some(stated), Some(cameras)) = (said.up, cameras.filter(|cameras| cameras.by_roll))
        && angle_deg(&cameras.up, &stated.direction()) > CONTRADICTING_DEG
    {
        let held = UpAxis::nearest(&cameras.up);
        findings.push(contradiction(stated, held, "the cameras are held upright along"));
    }
    if said.choice == LevellingChoice::Off {
        return Ok(up_along_axis(up_without_surfaces(axis, said, findings), None));
    }
    let guess = match (said.up, cameras) {
        (Some(axis), _) => Some((axis.direction(), 40.0)),
        (None, Some(cameras)) => Some((cameras.up, if cameras.by_roll { 20.0 } else { 40.0 })),
        (None, None) => None,
    };
    let Some((guess, widest_deg)) = guess else {
        return Ok(up_along_axis(up_without_surfaces(axis, said, findings), None));
    };
    let surfaces = surfaces::sample_patches(frames, progress);
    progress.report("levelling", 1.0)?;
    let mut fit = gravity::refine(&surfaces, &guess, widest_deg);
    if let Some(cameras) = cameras.filter(|c| c.by_roll && angle_deg(&c.up, &fit.up) > AGREEING_DEG)
    {
        fit = gravity::refine(&surfaces, &cameras.up, 10.0);
    }
    let believed = is_clear(&fit);
    // Cameras without roll determine up on their own, although not exactly.
    let (up, evidence) = match cameras.filter(|c| c.by_roll && said.up.is_none()) {
        _ if believed => (fit.up, describe(&fit)),
        Some(cameras) => {
            (cameras.up, "cameras held without roll; surfaces are not conclusive".to_owned())
        }
        None => return Ok(up_along_axis(up_without_surfaces(axis, said, findings), None)),
    };
    let axis = said.up.unwrap_or_else(|| UpAxis::nearest(&up));
    if said.up.is_none() {
        let assumed = assumed_axis(axis, "the cameras", believed.then(|| confidence_of(&fit)));
        findings.push(if axis == UpAxis::Z { assumed.without_warning() } else { assumed });
    }
    let least_deg = match (believed, said.by_gravity) {
        (true, true) => LEVEL_BY_GRAVITY_DEG,
        (true, false) => LEVEL_DEG,
        (false, _) => 4.0 * LEVEL_DEG,
    };
    Ok(rotate_upright(axis, &up, least_deg, fit.explained_share(), evidence, findings))
}

/// Finds up of a cloud without cameras, in the world of the files.
///
/// # Errors
/// Returns [`IngestError::UpUnknown`] when up is not stated and the cloud does not show it.
pub(super) fn find_up_of_cloud(
    cloud: &PointCloud,
    said: UpHint,
    findings: &mut Vec<Finding>,
) -> Result<UpDirection, IngestError> {
    if said.choice == LevellingChoice::Off {
        // The caller asked for the files' own axes, unchanged.
        return Ok(up_along_axis(up_without_surfaces(said.up, said, findings), None));
    }
    let surfaces = surfaces::patches_of_cloud(cloud);
    let (axis, fit) = if let Some(stated) = said.up {
        let other = contradicted_axis(cloud, &surfaces, stated, said.by_format, findings);
        let (axis, fit) = other
            .unwrap_or_else(|| (stated, gravity::refine(&surfaces, &stated.direction(), 20.0)));
        if !is_clear(&fit) || angle_deg(&fit.up, &axis.direction()) > AGREEING_DEG {
            return Ok(up_along_axis(axis, None));
        }
        (axis, fit)
    } else {
        let candidates = lone_cloud::up_candidates(cloud, &surfaces);
        let (best, confidence) = lone_cloud::choose_up(&candidates)?;
        let axis = UpAxis::nearest(&best.fit.up);
        findings.push(assumed_axis(axis, "the shape of the cloud", Some(confidence)));
        (axis, best.fit)
    };
    Ok(rotate_upright(axis, &fit.up, LEVEL_DEG, fit.explained_share(), describe(&fit), findings))
}

/// Returns the up direction that the cloud shows, if it clearly is another one than the axis that
/// the files' format defines. An axis that the files or the request state is kept, with a warning.
fn contradicted_axis(
    cloud: &PointCloud,
    surfaces: &[SurfacePatch],
    defined: UpAxis,
    by_format: bool,
    findings: &mut Vec<Finding>,
) -> Option<(UpAxis, UpFit)> {
    let candidates = lone_cloud::up_candidates(cloud, surfaces);
    let (best, confidence) = lone_cloud::choose_up(&candidates).ok()?;
    let axis = UpAxis::nearest(&best.fit.up);
    if axis == defined || confidence < SURE_AGAINST_FORMAT {
        return None;
    }
    if !by_format {
        findings.push(contradiction(defined, axis, "the cloud stands along"));
        return None;
    }
    let text = format!(
        "the format defines {} up, but the cloud stands along {}, which is used; set up={} if that is wrong",
        defined.name(),
        axis.name(),
        defined.name()
    );
    findings.push(
        Finding::assumed(FindingSubject::Up, text).with_confidence(confidence).stated_with("up"),
    );
    Some((axis, best.fit))
}

/// Describes that the data shows another up axis than the stated one, which is used.
fn contradiction(stated: UpAxis, shown: UpAxis, evidence: &str) -> Finding {
    let (stated, shown) = (stated.name(), shown.name());
    let text = format!(
        "{stated} up is stated and used, but {evidence} {shown}: set up={shown} if the scene lies on its side"
    );
    Finding::unusual(FindingSubject::Up, text).stated_with("up")
}

fn assumed_axis(axis: UpAxis, from: &str, confidence: Option<f32>) -> Finding {
    let text = format!(
        "the files do not state the up axis: {} is assumed from {from}; set up= if that is wrong",
        axis.name()
    );
    Finding::assumed(FindingSubject::Up, text).with_confidence(confidence).stated_with("up")
}

/// Returns how clearly surfaces support a direction over the next best one, `0.5..1`.
fn confidence_of(fit: &UpFit) -> f32 {
    1.0 / (1.0 + (-fit.clearness / CLEARNESS).exp())
}

fn is_clear(fit: &UpFit) -> bool {
    fit.explained_share() >= EXPLAINED && fit.clearness >= CLEARNESS && fit.level >= LEVEL_SHARE
}

fn describe(fit: &UpFit) -> String {
    format!(
        "{:.0}% of the surfaces are level with it and {:.0}% upright",
        fit.level * 100.0,
        fit.upright.abs() * 100.0
    )
}

/// Returns the stated axis, or the one that the cameras hold up, without examining surfaces. Falls
/// back to Z. Adds a warning unless the axis was stated.
fn up_without_surfaces(axis: Option<UpAxis>, said: UpHint, findings: &mut Vec<Finding>) -> UpAxis {
    let Some(axis) = axis else {
        findings.push(
            Finding::assumed(
                FindingSubject::Up,
                "the files do not state the up axis: z is assumed, the cameras do not agree; set up= if that is wrong",
            )
            .with_confidence(0.5)
            .stated_with("up"),
        );
        return UpAxis::Z;
    };
    if said.up.is_none() {
        let assumed = assumed_axis(axis, "the cameras", None);
        findings.push(if axis == UpAxis::Z { assumed.without_warning() } else { assumed });
    }
    axis
}

fn up_along_axis(axis: UpAxis, report: Option<Levelling>) -> UpDirection {
    UpDirection { axis, turn: axis.to_z_up(), report }
}

/// Rotates so that `up` is Z, unless the axis is accurate enough.
fn rotate_upright(
    axis: UpAxis,
    up: &Vector3<f32>,
    least_deg: f32,
    confidence: f32,
    evidence: String,
    findings: &mut Vec<Finding>,
) -> UpDirection {
    let tilt_deg = angle_deg(up, &axis.direction());
    let turned = tilt_deg > least_deg;
    let mut upright = up_along_axis(
        axis,
        Some(Levelling { tilt_deg, turned, confidence: confidence.clamp(0.0, 1.0), evidence }),
    );
    if turned {
        // The shortest rotation keeps headings as close to the files' as possible.
        let seen = upright.turn * up;
        let level = UnitQuaternion::rotation_between(&seen, &Vector3::z()).unwrap_or_default();
        upright.turn =
            Isometry3::from_parts(nalgebra::Translation3::identity(), level) * upright.turn;
        let text = format!(
            "the files' axes are tilted by {tilt_deg:.1} degrees from {} up: rotated level",
            axis.name()
        );
        findings.push(Finding::changed(FindingSubject::Up, text).stated_with("levelling"));
    }
    upright
}

fn angle_deg(a: &Vector3<f32>, b: &Vector3<f32>) -> f32 {
    a.dot(b).clamp(-1.0, 1.0).acos().to_degrees()
}
