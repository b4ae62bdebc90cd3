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
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::{FrameRef, Levelling, PointCloud};
use uniground_geometry::up_axis::UpAxis;
use uniground_geometry::{Isometry3, Vector3};
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
    /// Whether an inertial sensor made the world level. Surfaces are not examined then.
    pub by_gravity: bool,
    pub choice: LevellingChoice,
}

/// A world within this angle is level enough, degrees. Surfaces determine up only to within a
/// degree or two.
const LEVEL_DEG: f32 = 2.5;
/// Surfaces are trusted when they explain this share of the examined area, this clearly, and some
/// of them are level.
const EXPLAINED: f32 = 0.4;
const CLEARNESS: f32 = 0.06;
const LEVEL_SHARE: f32 = 0.03;
/// Surfaces and cameras that differ by more than this disagree about up, degrees.
const AGREEING_DEG: f32 = 25.0;

/// Finds up of posed frames, whose poses are in the world of the files.
pub(super) fn find_up_of_frames(
    frames: &[FrameRef],
    said: UpHint,
    warnings: &mut Vec<String>,
    progress: &Progress,
) -> Result<UpDirection, IngestError> {
    let poses: Vec<_> = frames.iter().map(|frame| frame.camera_to_world).collect();
    let cameras = cameras::up_from_cameras(&poses);
    let held = UpAxis::from_cameras(&poses);
    let axis = said.up.or(held).or(cameras.map(|c| UpAxis::nearest(&c.up)));
    if said.choice == LevellingChoice::Off || (said.by_gravity && axis.is_some()) {
        return Ok(up_along_axis(up_without_surfaces(axis, said, warnings), None));
    }
    let guess = match (said.up, cameras) {
        (Some(axis), _) => Some((axis.direction(), 40.0)),
        (None, Some(cameras)) => Some((cameras.up, if cameras.by_roll { 20.0 } else { 40.0 })),
        (None, None) => None,
    };
    let Some((guess, widest_deg)) = guess else {
        return Ok(up_along_axis(up_without_surfaces(axis, said, warnings), None));
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
        None => return Ok(up_along_axis(up_without_surfaces(axis, said, warnings), None)),
    };
    let axis = said.up.unwrap_or_else(|| UpAxis::nearest(&up));
    if said.up.is_none() && axis != UpAxis::Z {
        warnings.push(format!(
            "the files do not state the up axis: {} is assumed from the cameras; set up= if that is wrong",
            axis.name()
        ));
    }
    let least_deg = if believed { LEVEL_DEG } else { 4.0 * LEVEL_DEG };
    Ok(rotate_upright(axis, &up, least_deg, fit.explained_share(), evidence, warnings))
}

/// Finds up of a cloud without cameras, in the world of the files.
///
/// # Errors
/// Returns [`IngestError::UpUnknown`] when up is not stated and the cloud does not show it.
pub(super) fn find_up_of_cloud(
    cloud: &PointCloud,
    said: UpHint,
    warnings: &mut Vec<String>,
) -> Result<UpDirection, IngestError> {
    if said.choice == LevellingChoice::Off || (said.by_gravity && said.up.is_some()) {
        // The caller asked for the files' own axes, unchanged.
        return Ok(up_along_axis(up_without_surfaces(said.up, said, warnings), None));
    }
    let surfaces = surfaces::patches_of_cloud(cloud);
    if let Some(axis) = said.up {
        let fit = gravity::refine(&surfaces, &axis.direction(), 20.0);
        if !is_clear(&fit) {
            return Ok(up_along_axis(axis, None));
        }
        return Ok(rotate_upright(
            axis,
            &fit.up,
            LEVEL_DEG,
            fit.explained_share(),
            describe(&fit),
            warnings,
        ));
    }
    let candidates = lone_cloud::up_candidates(cloud, &surfaces);
    let best =
        lone_cloud::choose_up(&candidates).map_err(|reason| IngestError::UpUnknown { reason })?;
    let axis = UpAxis::nearest(&best.fit.up);
    warnings.push(format!(
        "the files do not state the up axis: {} is assumed from the shape of the cloud; set up= if that is wrong",
        axis.name()
    ));
    Ok(rotate_upright(
        axis,
        &best.fit.up,
        LEVEL_DEG,
        best.fit.explained_share(),
        describe(&best.fit),
        warnings,
    ))
}

fn is_clear(fit: &UpFit) -> bool {
    fit.explained_share() >= EXPLAINED && fit.clearness >= CLEARNESS && fit.level >= LEVEL_SHARE
}

fn describe(fit: &UpFit) -> String {
    format!(
        "{:.0}% of the surfaces are level with it and {:.0}% upright",
        fit.level * 100.0,
        fit.upright * 100.0
    )
}

/// Returns the stated axis, or the one that the cameras hold up, without examining surfaces. Falls
/// back to Z. Adds a warning unless the axis was stated.
fn up_without_surfaces(axis: Option<UpAxis>, said: UpHint, warnings: &mut Vec<String>) -> UpAxis {
    let Some(axis) = axis else {
        warnings.push(
            "the files do not state the up axis: z is assumed, the cameras do not agree; set up= if that is wrong"
                .into(),
        );
        return UpAxis::Z;
    };
    if said.up.is_none() && axis != UpAxis::Z {
        warnings.push(format!(
            "the files do not state the up axis: {} is assumed from the cameras; set up= if that is wrong",
            axis.name()
        ));
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
    warnings: &mut Vec<String>,
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
        warnings.push(format!(
            "the files' axes are tilted by {tilt_deg:.1} degrees from {} up: rotated level",
            axis.name()
        ));
    }
    upright
}

fn angle_deg(a: &Vector3<f32>, b: &Vector3<f32>) -> f32 {
    a.dot(b).clamp(-1.0, 1.0).acos().to_degrees()
}
