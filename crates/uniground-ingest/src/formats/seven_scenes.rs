//! 7-Scenes and 3RScan: `frame-000000.color.*`, `.depth.*` and `.pose.txt` in one folder. 3RScan
//! states its cameras in `_info.txt`. 7-Scenes was recorded with a Kinect whose depth camera is
//! offset from its color camera.

use super::color_depth_pose::{FrameCameras, PoseFiles, ScanImages, UnmatchedImages, add_frames};
use super::files::{DEPTHS, FolderListing, PICTURES};
use super::numbers::{find_values, parse};
use super::{incomplete, intrinsics};
use crate::IngestError;
use crate::scan::Scan;
use camino::{Utf8Path, Utf8PathBuf};
use uniground_geometry::scene::Intrinsics;
use uniground_types::findings::{Finding, FindingSubject};

const LOOKS_LIKE: &str = "a 7-Scenes or 3RScan sequence";
const INFO: &str = "_info.txt";
const MAX_INFO_BYTES: u64 = 1 << 20;
/// The Kinect according to the authors of 7-Scenes, at 640x480.
const KINECT: Intrinsics =
    Intrinsics { width: 640, height: 480, fx: 585.0, fy: 585.0, cx: 320.0, cy: 240.0 };
const CLOUDS: &[&str] =
    &["labels.instances.annotated.v2.ply", "mesh.refined.v2.obj", "mesh.refined.obj", "cloud.ply"];

/// Returns the folder of the frames, below the one that was opened.
fn find_frames_folder(folder: &FolderListing) -> Option<&'static str> {
    let has = |names: &[String]| {
        names.iter().any(|name| {
            name.starts_with("frame-") && name.ends_with(".pose.txt") || name.contains(".color.")
        })
    };
    if has(folder.names()) {
        return Some("");
    }
    ["sequence", "seq-01"].into_iter().find(|name| {
        FolderListing::open(&folder.root.join(name)).is_ok_and(|inner| has(inner.names()))
    })
}

pub(super) fn can_read(folder: &FolderListing) -> bool {
    find_frames_folder(folder).is_some()
}

pub(super) fn read(folder: &FolderListing) -> Result<Scan, IngestError> {
    let inner = find_frames_folder(folder).unwrap_or_default();
    let root = &folder.root;
    let named = |part: &str, endings: &[&str]| -> Result<Vec<Utf8PathBuf>, IngestError> {
        Ok(folder
            .files(inner, endings)?
            .into_iter()
            .filter(|file| file.as_str().contains(part))
            .collect())
    };
    let pictures = ScanImages {
        color: named(".color.", PICTURES)?,
        depth: named(".depth.", DEPTHS)?,
        confidence: Vec::new(),
    };
    let poses = named(".pose.", &["txt"])?;
    let Some(typical) = folder.typical_picture(&pictures.color) else {
        return Err(incomplete(LOOKS_LIKE, "its .color pictures are missing"));
    };
    if pictures.depth.is_empty() {
        return Err(incomplete(LOOKS_LIKE, "its .depth pictures are missing"));
    }
    if poses.is_empty() {
        return Err(incomplete(LOOKS_LIKE, "its .pose.txt files are missing"));
    }
    let info = [Utf8Path::new(inner).join(INFO), INFO.into()]
        .into_iter()
        .find(|file| root.join(file).is_file());
    let is_3rscan = info.is_some();
    let mut scan = Scan::new(root, if is_3rscan { "3rscan" } else { "7-scenes" });
    let cameras = match info {
        Some(info) => {
            let text = root.read_text(&info, MAX_INFO_BYTES)?;
            if let Some(shift) = find_values(&text, "m_depthShift")
                .and_then(|v| v.parse::<f32>().ok())
                .filter(|s| *s > 0.0)
            {
                scan.depth_scale_m = 1.0 / shift;
            }
            let color = parse_camera(&info, &text, "Color")?;
            FrameCameras { color, depth: parse_camera(&info, &text, "Depth").ok() }
        }
        None if intrinsics::find_color_file(folder).is_some() => {
            FrameCameras { color: intrinsics::read_color_intrinsics(folder, typical)?, depth: None }
        }
        None => {
            scan.findings.push(
                Finding::assumed(
                    FindingSubject::Camera,
                    "unknown camera: the Kinect of 7-Scenes (585 585 320 240) is assumed; add intrinsic.txt if that is wrong",
                )
                .stated_with("intrinsic.txt"),
            );
            FrameCameras { color: KINECT, depth: None }
        }
    };
    add_frames(&mut scan, &pictures, &PoseFiles::Files(poses), &cameras, UnmatchedImages::Damaged)?;
    scan.cloud = CLOUDS.iter().find(|name| folder.has_file(name)).map(Utf8PathBuf::from);
    Ok(scan)
}

/// Reads `m_colorWidth`, `m_colorHeight` and `m_calibrationColorIntrinsic`, or the same values of
/// the depth camera.
fn parse_camera(info: &Utf8Path, text: &str, which: &str) -> Result<Intrinsics, IngestError> {
    let lower = which.to_ascii_lowercase();
    let missing =
        |key: &str| IngestError::malformed(info, format!("{key} is missing or not a number"));
    let size = |side: &str| {
        let key = format!("m_{lower}{side}");
        find_values(text, &key).and_then(|v| v.parse::<u32>().ok()).ok_or_else(|| missing(&key))
    };
    let key = format!("m_calibration{which}Intrinsic");
    let values = find_values(text, &key)
        .and_then(|v| parse(v).ok())
        .filter(|v| v.len() == 16)
        .ok_or_else(|| missing(&key))?;
    let [fx, fy, cx, cy] = [0, 5, 2, 6].map(|i| values[i] as f32);
    Ok(Intrinsics { width: size("Width")?, height: size("Height")?, fx, fy, cx, cy })
}
