//! The neutral layout: `scene.json` names every file and convention (`uniground-scene/1`).

use super::{check_frames, read_pose};
use crate::geometry::up_axis::UpAxis;
use crate::ingest::IngestError;
use crate::ingest::bounded::read_text;
use crate::ingest::scan::{CameraAxes, RawFrame, Scan};
use crate::scene::{FrameIndex, Intrinsics, PoseConvention};
use camino::{Utf8Component, Utf8Path, Utf8PathBuf};
use serde::Deserialize;

const FORMAT: &str = "uniground-scene/1";
/// The most frames, each with cameras of its own and paths of everyday length.
const MAX_MANIFEST_BYTES: u64 = 16 << 20;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Manifest {
    format: String,
    name: Option<String>,
    up: Option<UpAxis>,
    cloud: Option<Utf8PathBuf>,
    intrinsics: Option<Intrinsics>,
    depth_intrinsics: Option<Intrinsics>,
    #[serde(default = "millimetres")]
    depth_scale_m: f32,
    #[serde(default = "opencv")]
    camera_axes: CameraAxes,
    #[serde(default = "camera_to_world")]
    pose: PoseConvention,
    #[serde(default)]
    frames: Vec<ManifestFrame>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ManifestFrame {
    color: Utf8PathBuf,
    depth: Utf8PathBuf,
    pose: Utf8PathBuf,
    /// Where one frame's camera differs from the scan's.
    intrinsics: Option<Intrinsics>,
    depth_intrinsics: Option<Intrinsics>,
}

fn millimetres() -> f32 {
    0.001
}

fn opencv() -> CameraAxes {
    CameraAxes::Opencv
}

fn camera_to_world() -> PoseConvention {
    PoseConvention::CameraToWorld
}

pub(super) fn read(root: &Utf8Path) -> Result<Scan, IngestError> {
    let file = Utf8Path::new("scene.json");
    let text = read_text(root, file, MAX_MANIFEST_BYTES)?;
    let Manifest { format, name, up, cloud, intrinsics, depth_intrinsics, depth_scale_m, camera_axes, pose, frames } =
        serde_json::from_str(text.trim_start_matches('\u{feff}')).map_err(|e| IngestError::malformed(file, e))?;
    if format != FORMAT {
        return Err(IngestError::malformed(file, format!("format is {format:?}, this server reads {FORMAT:?}")));
    }
    if !(depth_scale_m.is_finite() && depth_scale_m > 0.0) {
        return Err(IngestError::malformed(file, format!("depth_scale_m is {depth_scale_m}, it must be positive")));
    }
    check_frames("scene.json", frames.len())?;
    let frames = frames
        .into_iter()
        .enumerate()
        .map(|(i, frame)| {
            let colour_intrinsics = frame
                .intrinsics
                .or(intrinsics)
                .ok_or_else(|| IngestError::MissingIntrinsics { file: format!("scene.json, frame {i}").into() })?;
            for path in [&frame.color, &frame.depth, &frame.pose] {
                inside(path)?;
            }
            Ok(RawFrame {
                index: FrameIndex(0),
                pose: read_pose(root, &frame.pose)?,
                colour: frame.color,
                depth: frame.depth,
                pose_file: frame.pose,
                colour_intrinsics,
                depth_intrinsics: frame.depth_intrinsics.or(depth_intrinsics).unwrap_or(colour_intrinsics),
            })
        })
        .collect::<Result<_, IngestError>>()?;
    cloud.as_deref().map(inside).transpose()?;
    let root = root.to_owned();
    Ok(Scan { root, format: FORMAT, name, cloud, frames, up, camera_axes, pose, depth_scale_m, frames_skipped: 0, warnings: Vec::new() })
}

/// A manifest may only name files of its own archive.
fn inside(path: &Utf8Path) -> Result<(), IngestError> {
    let plain = path.components().all(|c| matches!(c, Utf8Component::Normal(_) | Utf8Component::CurDir));
    if plain && !path.as_str().is_empty() {
        return Ok(());
    }
    Err(IngestError::UnsafeEntry { entry: path.to_string(), reason: "named in scene.json points outside the archive" })
}
