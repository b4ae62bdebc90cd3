//! A checked [`Scan`] to a canonical [`SceneBundle`].

use super::fusion;
use super::scan::{CameraAxes, RawFrame, Scan};
use super::{IngestError, MAX_POINTS, clouds, reprojection};
use crate::geometry::boxes::Aabb;
use crate::geometry::up_axis::UpAxis;
use crate::geometry::{Isometry3, Point3};
use crate::progress::Progress;
use crate::scene::{FrameRef, ImportReport, PointCloud, SceneBundle};
use camino::Utf8Path;
use uniground_types::settings::ImportSettings;

/// Reads or fuses the cloud, turns everything Z-up, and checks that cloud, poses and depth agree.
///
/// # Errors
/// [`IngestError`]; [`IngestError::ConventionMismatch`] names the reading of the poses that would fit.
pub fn load(scan: &Scan, settings: &ImportSettings, progress: &Progress) -> Result<SceneBundle, IngestError> {
    progress.report("import", 0.0)?;
    let mut warnings = scan.warnings.clone();
    let in_file_world = scan.frames.iter().map(|frame| frame_ref(scan, frame)).collect::<Result<Vec<_>, _>>()?;
    let poses: Vec<_> = in_file_world.iter().map(|f| f.camera_to_world).collect();
    let up = settings.up.or(scan.up).unwrap_or_else(|| guess_up(&poses, &mut warnings));
    let to_z_up = up.to_z_up();
    let frames: Vec<_> = in_file_world
        .into_iter()
        .map(|f| FrameRef { camera_to_world: to_z_up * f.camera_to_world, ..f })
        .collect();

    let own_cloud = scan.cloud.as_ref().map(|file| own_cloud_of(scan, file, &to_z_up, &mut warnings)).transpose()?;
    progress.report("check_reprojection", 0.1)?;
    let reprojection_agreement = reprojection::check(scan, own_cloud.as_ref(), &frames, &mut warnings)?;
    let cloud_points = own_cloud.as_ref().map(|cloud| cloud.len() as u64);
    let cloud = match own_cloud {
        Some(cloud) => cloud,
        None => fusion::fuse(&frames, &settings.fusion, &mut warnings, &progress.part(0.2, 1.0))?,
    };
    warn_of_odd_size(&cloud.positions, &mut warnings);
    let report = ImportReport {
        format: scan.format.into(),
        up,
        pose: scan.pose,
        camera_axes: match scan.camera_axes {
            CameraAxes::Opencv => "opencv".into(),
            CameraAxes::Opengl => "opengl".into(),
        },
        frames: frames.len() as u32,
        frames_skipped: scan.frames_skipped,
        cloud_points,
        reprojection_agreement,
        warnings,
    };
    Ok(SceneBundle { cloud, frames, report })
}

/// Reads a cloud this service wrote: canonical already.
///
/// # Errors
/// [`IngestError`] naming the file.
pub fn read_cloud(file: &Utf8Path) -> Result<PointCloud, IngestError> {
    Ok(clouds::ply::read(file.parent().unwrap_or(file), Utf8Path::new(file.file_name().unwrap_or_default()), usize::MAX)?.cloud)
}

fn own_cloud_of(scan: &Scan, file: &Utf8Path, to_z_up: &Isometry3<f32>, warnings: &mut Vec<String>) -> Result<PointCloud, IngestError> {
    let clouds::ply::Loaded { mut cloud, dropped, without_colour, has_colour } = clouds::ply::read(&scan.root, file, MAX_POINTS)?;
    if without_colour > 0 {
        warnings.push(format!("{file}: the colours of {without_colour} points are not numbers: taken as grey"));
    }
    if dropped > 0 {
        warnings.push(format!("{file}: {dropped} points dropped, their coordinates are not finite"));
    }
    if !has_colour {
        warnings.push(format!("{file}: no colour; points are shown grey and colour words can not be answered"));
    }
    cloud.positions.iter_mut().for_each(|p| *p = to_z_up * *p);
    Ok(cloud)
}

/// A frame with its pose as the scan declares it, still in the file's world.
fn frame_ref(scan: &Scan, raw: &RawFrame) -> Result<FrameRef, IngestError> {
    let camera_to_world = raw.camera_to_world(scan.pose, scan.camera_axes).map_err(|source| IngestError::BadPose {
        frame: raw.index,
        file: raw.pose_file.clone(),
        source,
    })?;
    Ok(FrameRef {
        index: raw.index,
        colour: scan.root.join(&raw.colour),
        depth: scan.root.join(&raw.depth),
        colour_intrinsics: raw.colour_intrinsics,
        depth_intrinsics: raw.depth_intrinsics,
        depth_scale_m: scan.depth_scale_m,
        camera_to_world,
    })
}

fn guess_up(poses: &[Isometry3<f32>], warnings: &mut Vec<String>) -> UpAxis {
    if poses.is_empty() {
        warnings.push("the archive does not say which axis is up and has no cameras to tell: taken as z".into());
        return UpAxis::Z;
    }
    match UpAxis::from_cameras(poses) {
        Some(UpAxis::Z) => UpAxis::Z,
        Some(axis) => {
            warnings.push(format!("the archive does not say which axis is up: the cameras hold {} up, taken as that", axis.name()));
            axis
        }
        None => {
            warnings.push("the archive does not say which axis is up and the cameras do not agree on one: taken as z".into());
            UpAxis::Z
        }
    }
}

fn warn_of_odd_size(positions: &[Point3<f32>], warnings: &mut Vec<String>) {
    let Some(extent) = Aabb::around(positions) else { return };
    let across = extent.size.max();
    if across < 1.0 {
        warnings.push(format!("the scene is only {across:.3} m across: are its lengths metres?"));
    } else if across > 200.0 {
        warnings.push(format!("the scene is {across:.0} m across: are its lengths metres?"));
    }
}
