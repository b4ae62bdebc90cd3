//! The neutral layout: `scene.json` names every file and convention (`uniground-scene/1`).

use super::color_depth_pose::LEAST_CONFIDENCE;
use super::files::{FolderListing, check_inside, deserialize_optional_path, deserialize_path};
use super::numbers::read_pose;
use crate::IngestError;
use crate::scan::{CameraAxes, RawFrame, Scan, usual_depth_scale_m};
use camino::{Utf8Path, Utf8PathBuf};
use nalgebra::Matrix4;
use serde::Deserialize;
use uniground_geometry::scene::{
    Confidence, DepthSensor, FrameIndex, Intrinsics, Lens, Optics, PoseConvention,
};
use uniground_geometry::up_axis::UpAxis;

const FILE: &str = "scene.json";
const FORMAT: &str = "uniground-scene/1";
/// Layout name of an unpacked ScanNet `.sens` file.
const SENS: &str = "scannet-sens";
const NAMED: &str = "named in scene.json points outside the archive";
/// Maximum size of the manifest: the maximum number of frames, each with its own cameras and paths
/// of usual length.
const MAX_MANIFEST_BYTES: u64 = 16 << 20;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Manifest {
    format: String,
    name: Option<String>,
    up: Option<UpAxis>,
    #[serde(default, deserialize_with = "deserialize_optional_path")]
    cloud: Option<Utf8PathBuf>,
    intrinsics: Option<Intrinsics>,
    depth_intrinsics: Option<Intrinsics>,
    /// Default: millimeters for integers, meters for floats.
    depth_scale_m: Option<f32>,
    #[serde(default = "opencv")]
    camera_axes: CameraAxes,
    #[serde(default = "camera_to_world")]
    pose: PoseConvention,
    /// Lens of the color pictures. Also used for the depth pictures unless they have their own
    /// camera.
    distortion: Option<Lens>,
    depth_distortion: Option<Lens>,
    /// Pose of the depth camera relative to the color camera: 4x4, row-major, meters.
    depth_to_color: Option<Vec<f64>>,
    /// The layout that this one was converted from.
    source: Option<String>,
    #[serde(default, deserialize_with = "super::listed::deserialize_frames")]
    frames: Vec<ManifestFrame>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ManifestFrame {
    #[serde(deserialize_with = "deserialize_path")]
    color: Utf8PathBuf,
    #[serde(deserialize_with = "deserialize_path")]
    depth: Utf8PathBuf,
    #[serde(deserialize_with = "deserialize_path")]
    pose: Utf8PathBuf,
    /// Values of one frame's camera that differ from the scan's.
    intrinsics: Option<Intrinsics>,
    depth_intrinsics: Option<Intrinsics>,
    #[serde(default, deserialize_with = "deserialize_optional_path")]
    confidence: Option<Utf8PathBuf>,
}

fn opencv() -> CameraAxes {
    CameraAxes::Opencv
}

fn camera_to_world() -> PoseConvention {
    PoseConvention::CameraToWorld
}

pub(super) fn can_read(folder: &FolderListing) -> bool {
    folder.has_file(FILE)
}

pub(super) fn read(folder: &FolderListing) -> Result<Scan, IngestError> {
    let (root, file) = (&folder.root, Utf8Path::new(FILE));
    let text = root.read_text(file, MAX_MANIFEST_BYTES)?;
    let manifest: Manifest = serde_json::from_str(text.trim_start_matches('\u{feff}'))
        .map_err(|e| IngestError::malformed(file, e))?;
    if manifest.format != FORMAT {
        return Err(IngestError::malformed(
            file,
            format!("format is {:?}, this server reads {FORMAT:?}", manifest.format),
        ));
    }
    for frame in &manifest.frames {
        for path in
            [Some(&frame.color), Some(&frame.depth), Some(&frame.pose), frame.confidence.as_ref()]
                .into_iter()
                .flatten()
        {
            check_inside(path, NAMED)?;
        }
    }
    let usual = || usual_depth_scale_m(root, manifest.frames.iter().map(|frame| &frame.depth));
    let depth_scale_m = manifest.depth_scale_m.unwrap_or_else(usual);
    if !(depth_scale_m.is_finite() && depth_scale_m > 0.0) {
        return Err(IngestError::malformed(
            file,
            format!("depth_scale_m is {depth_scale_m}, it must be positive"),
        ));
    }
    let mut scan =
        Scan::new(root, if manifest.source.as_deref() == Some(SENS) { SENS } else { FORMAT });
    let depth_to_color =
        manifest.depth_to_color.as_deref().map(parse_depth_to_color).transpose()?;
    for (i, frame) in manifest.frames.iter().enumerate() {
        let color_intrinsics = frame.intrinsics.or(manifest.intrinsics).ok_or_else(|| {
            IngestError::MissingIntrinsics { file: format!("scene.json, frame {i}").into() }
        })?;
        let depth_intrinsics = frame.depth_intrinsics.or(manifest.depth_intrinsics);
        // Depth without its own camera uses the color camera's lens.
        let shared = if depth_intrinsics.is_none() { manifest.distortion } else { None };
        let optics = Optics {
            color_lens: manifest.distortion.and_then(Lens::reject_identity),
            depth_lens: manifest.depth_distortion.or(shared).and_then(Lens::reject_identity),
            depth_sensor: depth_to_color.map(|depth_to_color| DepthSensor {
                intrinsics: depth_intrinsics.unwrap_or(color_intrinsics),
                depth_to_color,
            }),
            confidence: frame
                .confidence
                .clone()
                .map(|file| Confidence { file, at_least: LEAST_CONFIDENCE }),
        };
        scan.add(read_pose(root, &frame.pose).map(|pose: Matrix4<f64>| RawFrame {
            index: FrameIndex(0),
            time_s: None,
            pose,
            color: frame.color.clone(),
            depth: frame.depth.clone(),
            pose_file: frame.pose.clone(),
            color_intrinsics,
            depth_intrinsics: depth_intrinsics.unwrap_or(color_intrinsics),
            optics,
        }))?;
    }
    manifest.cloud.as_deref().map(|cloud| check_inside(cloud, NAMED)).transpose()?;
    let Manifest { name, up, cloud, camera_axes, pose, .. } = manifest;
    Ok(Scan { name, cloud, up, camera_axes, pose, depth_scale_m, ..scan })
}

fn parse_depth_to_color(values: &[f64]) -> Result<uniground_geometry::Isometry3<f32>, IngestError> {
    let bad = |reason: String| IngestError::malformed(FILE, format!("depth_to_color: {reason}"));
    let matrix = super::numbers::matrix_from_values(values)
        .ok_or_else(|| bad(format!("it has {} numbers, 16 are expected", values.len())))?;
    uniground_geometry::pose::rigid(&matrix.cast()).map_err(|e| bad(e.to_string()))
}
