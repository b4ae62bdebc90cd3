//! ARKitScenes: `lowres_wide/ lowres_depth/ lowres_wide_intrinsics/ lowres_wide.traj`, and
//! `confidence/`, named `<video>_<seconds>`. Poses are world-to-camera in a world that ARKit made
//! level, Z up. The mesh `*_3dod_mesh.ply` is one folder up.

use super::color_depth_pose::LEAST_CONFIDENCE;
use super::files::{DEPTHS, FolderListing, PICTURES, TextFiles};
use super::numbers::parse;
use super::trajectory::{TimedPose, pose_at};
use super::{entry_path, incomplete, intrinsics, pairing};
use crate::scan::{RawFrame, Scan};
use crate::{IngestError, MAX_FRAMES};
use camino::{Utf8Path, Utf8PathBuf};
use nalgebra::{Matrix4, Rotation3, Vector3};
use uniground_geometry::scene::{Confidence, FrameIndex, Intrinsics, Optics, PoseConvention};
use uniground_geometry::up_axis::UpAxis;
use uniground_types::findings::{Finding, FindingSubject};

const LOOKS_LIKE: &str = "an ARKitScenes scan";
const TRAJECTORY: &str = "lowres_wide.traj";
const COLOR: &str = "lowres_wide";
const DEPTH: &str = "lowres_depth";
const CAMERAS: &str = "lowres_wide_intrinsics";
const MAX_TRAJECTORY_BYTES: u64 = 32 << 20;
/// Pictures are at 60 Hz, poses at 10 Hz.
const POSE_WITHIN_S: f64 = 0.005;
/// File names of the same moment can differ by a rounded millisecond.
const NAME_WITHIN_S: f64 = 0.0015;

/// Returns the folder of the frames: this one, or the only one named `*_frames`.
fn find_frames_folder(folder: &FolderListing) -> Option<String> {
    let has = |inner: &str| {
        [TRAJECTORY, COLOR].iter().any(|name| folder.root.join(inner).join(name).exists())
    };
    if has("") {
        return Some(String::new());
    }
    folder.folders().find(|name| name.ends_with("_frames") && has(name)).map(str::to_owned)
}

pub(super) fn can_read(folder: &FolderListing) -> bool {
    find_frames_folder(folder).is_some()
}

pub(super) fn read(folder: &FolderListing) -> Result<Scan, IngestError> {
    let inner = Utf8PathBuf::from(find_frames_folder(folder).unwrap_or_default());
    let root = &folder.root;
    for (name, what) in [
        (TRAJECTORY, "the poses"),
        (COLOR, "the pictures"),
        (DEPTH, "the depth"),
        (CAMERAS, "the cameras"),
    ] {
        if !root.join(&inner).join(name).exists() {
            return Err(incomplete(
                LOOKS_LIKE,
                format!("{} ({what}) is missing", inner.join(name)),
            ));
        }
    }
    let trajectory = inner.join(TRAJECTORY);
    let mut poses = read_poses(root, &trajectory)?;
    poses.sort_by(|a, b| a.time_s.total_cmp(&b.time_s));
    let list = |name: &str, endings: &[&str]| match root.join(&inner).join(name).is_dir() {
        true => folder.files(inner.join(name).as_str(), endings),
        false => Ok(Vec::new()),
    };
    let (color, depth, confidence) =
        (list(COLOR, PICTURES)?, list(DEPTH, DEPTHS)?, list("confidence", &["png"])?);
    let cameras = list(CAMERAS, &["pincam"])?;
    let times = |files: &[Utf8PathBuf]| {
        files.iter().map(|file| pairing::parse_seconds(file)).collect::<Vec<_>>()
    };
    let own = times(&color);
    let partner =
        |files: &[Utf8PathBuf]| pairing::match_nearest_times(&own, &times(files), NAME_WITHIN_S);
    let (depth_of, camera_of, confidence_of) =
        (partner(&depth), partner(&cameras), partner(&confidence));
    let mut scan = Scan::new(root, "arkit-scenes");
    scan.pose = PoseConvention::WorldToCamera;
    (scan.up, scan.by_gravity) = (Some(UpAxis::Z), true);
    let mut last_camera: Option<(usize, Intrinsics)> = None;
    let mut left_out = 0;
    for (i, picture) in color.iter().enumerate() {
        let pose = own[i].and_then(|time| pose_at(&poses, time, POSE_WITHIN_S));
        let (Some(pose), Some(depth_at), Some(camera_at)) = (pose, depth_of[i], camera_of[i])
        else {
            left_out += 1;
            continue;
        };
        let camera = match last_camera.filter(|(at, _)| *at == camera_at) {
            Some((_, camera)) => Ok(camera),
            None => intrinsics::read_pincam(root, &cameras[camera_at]),
        };
        last_camera = camera.as_ref().ok().map(|camera| (camera_at, *camera));
        scan.add(camera.map(|camera| RawFrame {
            index: FrameIndex(0),
            time_s: None,
            color: picture.clone(),
            depth: depth[depth_at].clone(),
            pose_file: entry_path(&trajectory, picture),
            pose,
            color_intrinsics: camera,
            depth_intrinsics: camera,
            optics: Optics {
                confidence: confidence_of[i].map(|at| Confidence {
                    file: confidence[at].clone(),
                    at_least: LEAST_CONFIDENCE,
                }),
                ..Optics::default()
            },
        }))?;
    }
    if scan.frames.is_empty() {
        return Err(incomplete(
            LOOKS_LIKE,
            "no picture has depth, a camera and a pose at the same time",
        ));
    }
    if left_out > 0 {
        let text = format!(
            "{left_out} of {} pictures skipped: no depth, camera or pose at the same time",
            color.len()
        );
        scan.findings.push(Finding::left_out(FindingSubject::Frames, text).counting(left_out));
    }
    scan.cloud =
        folder.clouds(&["_3dod_mesh.ply"]).into_iter().find(|file| file.extension() == Some("ply"));
    Ok(scan)
}

/// Reads lines of time, rotation (axis times angle) and translation.
fn read_poses(root: &TextFiles, file: &Utf8Path) -> Result<Vec<TimedPose>, IngestError> {
    let text = root.read_text(file, MAX_TRAJECTORY_BYTES)?;
    let mut poses = Vec::new();
    for (number, line) in text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()) {
        let values = parse(line).ok();
        let Some([time, rx, ry, rz, x, y, z]) = values.as_deref() else {
            return Err(IngestError::malformed(
                file,
                format!("line {} is not seven numbers: time, axis-angle, translation", number + 1),
            ));
        };
        let rotation = Rotation3::new(Vector3::new(*rx, *ry, *rz)).to_homogeneous();
        let pose = Matrix4::new_translation(&Vector3::new(*x, *y, *z)) * rotation;
        poses.push(TimedPose { time_s: *time, pose, id: None });
        if poses.len() > 10 * MAX_FRAMES {
            return Err(IngestError::malformed(file, "it has too many lines"));
        }
    }
    Ok(poses)
}
