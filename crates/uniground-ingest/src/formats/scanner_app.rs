//! 3D Scanner App, "all data": `frame_00000.jpg` with `frame_00000.json`, `depth_00000.png` and
//! `conf_00000.png` in one folder. OpenGL cameras in a world that ARKit made level, Y up.

use super::color_depth_pose::LEAST_CONFIDENCE;
use super::files::{DEPTHS, FolderListing, PICTURES};
use super::numbers::matrix_from_values;
use super::{incomplete, intrinsics, pairing};
use crate::IngestError;
use crate::scan::{CameraAxes, RawFrame, Scan};
use camino::{Utf8Path, Utf8PathBuf};
use serde::Deserialize;
use uniground_geometry::scene::{Confidence, FrameIndex, Optics};
use uniground_geometry::up_axis::UpAxis;

const LOOKS_LIKE: &str = "an export of 3D Scanner App";
const MAX_BYTES: u64 = 256 << 10;

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct ScannerAppFrame {
    #[serde(rename = "cameraPoseARFrame")]
    pose: Vec<f64>,
    intrinsics: Vec<f64>,
}

fn list_files(
    folder: &FolderListing,
    start: &str,
    endings: &[&str],
) -> Result<Vec<Utf8PathBuf>, IngestError> {
    Ok(folder
        .files("", endings)?
        .into_iter()
        .filter(|file| file.as_str().starts_with(start))
        .collect())
}

pub(super) fn can_read(folder: &FolderListing) -> bool {
    let some = |start: &str, ending: &str| {
        list_files(folder, start, &[ending]).is_ok_and(|files| !files.is_empty())
    };
    some("frame_", "json") || (some("frame_", "jpg") && some("depth_", "png"))
}

pub(super) fn read(folder: &FolderListing) -> Result<Scan, IngestError> {
    let root = &folder.root;
    let (color, depth) =
        (list_files(folder, "frame_", PICTURES)?, list_files(folder, "depth_", DEPTHS)?);
    let (taken, confidence) =
        (list_files(folder, "frame_", &["json"])?, list_files(folder, "conf_", &["png"])?);
    for (list, what) in [
        (&color, "the pictures frame_*.jpg are"),
        (&depth, "the depth pictures depth_*.png are"),
        (&taken, "the poses frame_*.json are"),
    ] {
        if list.is_empty() {
            return Err(incomplete(LOOKS_LIKE, format!("{what} missing: export \"all data\"")));
        }
    }
    // The app writes more poses than pictures. Depth exists only for pictures.
    let (depth_of, taken_of, confidence_of) = (
        pairing::match_files(&color, &depth),
        pairing::match_files(&color, &taken),
        pairing::match_files(&color, &confidence),
    );
    let mut scan = Scan::new(root, "3d-scanner-app");
    scan.camera_axes = CameraAxes::Opengl;
    (scan.up, scan.by_gravity) = (Some(UpAxis::Y), true);
    for (i, picture) in color.iter().enumerate() {
        let frame = || {
            let (Some(depth_at), Some(taken_at)) = (depth_of[i], taken_of[i]) else {
                return Err(IngestError::FrameCountMismatch {
                    color: color.len(),
                    depth: depth.len(),
                    pose: taken.len(),
                    first: picture.clone(),
                });
            };
            let file: &Utf8Path = &taken[taken_at];
            let taken: ScannerAppFrame = serde_json::from_str(&root.read_text(file, MAX_BYTES)?)
                .map_err(|e| IngestError::malformed(file, e))?;
            let pose = matrix_from_values(&taken.pose).ok_or_else(|| {
                IngestError::malformed(file, "cameraPoseARFrame must have 16 numbers")
            })?;
            let camera =
                intrinsics::intrinsics_from_values(root, file, &taken.intrinsics, picture)?;
            Ok(RawFrame {
                index: FrameIndex(0),
                time_s: None,
                color: picture.clone(),
                depth: depth[depth_at].clone(),
                pose_file: file.to_owned(),
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
            })
        };
        scan.add(frame())?;
    }
    Ok(scan)
}
