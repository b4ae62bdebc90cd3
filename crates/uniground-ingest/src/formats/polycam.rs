//! Polycam raw data: `keyframes/` with `images/ cameras/ depth/ confidence/`, named by
//! microseconds; `corrected_*` after its own optimization. OpenGL cameras in a world that ARKit
//! made level, Y up.

use super::color_depth_pose::LEAST_CONFIDENCE;
use super::files::{DEPTHS, FolderListing, PICTURES, TextFiles};
use super::{incomplete, pairing};
use crate::IngestError;
use crate::scan::{CameraAxes, RawFrame, Scan};
use camino::{Utf8Path, Utf8PathBuf};
use nalgebra::Matrix4;
use serde::Deserialize;
use std::collections::BTreeMap;
use uniground_geometry::scene::{Confidence, FrameIndex, Intrinsics, Optics};
use uniground_geometry::up_axis::UpAxis;
use uniground_types::findings::{Finding, FindingSubject};

const LOOKS_LIKE: &str = "Polycam raw data";
const MAX_CAMERA_BYTES: u64 = 64 << 10;

#[derive(Deserialize)]
struct Camera {
    width: f32,
    height: f32,
    fx: f32,
    fy: f32,
    cx: f32,
    cy: f32,
    t_00: f64,
    t_01: f64,
    t_02: f64,
    t_03: f64,
    t_10: f64,
    t_11: f64,
    t_12: f64,
    t_13: f64,
    t_20: f64,
    t_21: f64,
    t_22: f64,
    t_23: f64,
}

impl Camera {
    fn pose(&self) -> Matrix4<f64> {
        Matrix4::new(
            self.t_00, self.t_01, self.t_02, self.t_03, self.t_10, self.t_11, self.t_12, self.t_13,
            self.t_20, self.t_21, self.t_22, self.t_23, 0.0, 0.0, 0.0, 1.0,
        )
    }

    fn intrinsics(&self) -> Intrinsics {
        let Self { width, height, fx, fy, cx, cy, .. } = *self;
        Intrinsics { width: width.round() as u32, height: height.round() as u32, fx, fy, cx, cy }
    }
}

pub(super) fn can_read(folder: &FolderListing) -> bool {
    folder.has_folder("keyframes")
}

/// Pictures of a scan, each with the camera that belongs to it.
struct Keyframes {
    color: Vec<Utf8PathBuf>,
    cameras: Vec<Utf8PathBuf>,
}

impl Keyframes {
    fn list(folder: &FolderListing, images: &str, cameras: &str) -> Result<Self, IngestError> {
        Ok(Self {
            color: folder.files(&format!("keyframes/{images}"), PICTURES)?,
            cameras: folder.files(&format!("keyframes/{cameras}"), &["json"])?,
        })
    }

    /// Returns the pictures with their cameras, by the name that belongs to a frame.
    fn by_name(&self) -> BTreeMap<String, (&Utf8PathBuf, Option<&Utf8PathBuf>)> {
        let camera_of = pairing::match_files(&self.color, &self.cameras);
        let name = |file: &Utf8PathBuf| file.file_stem().unwrap_or_default().to_owned();
        let pairs = self.color.iter().zip(camera_of);
        pairs.map(|(file, at)| (name(file), (file, at.map(|at| &self.cameras[at])))).collect()
    }
}

pub(super) fn read(folder: &FolderListing) -> Result<Scan, IngestError> {
    let keyframes = FolderListing::open(&folder.root.join("keyframes"))?;
    let has = |name: &str| keyframes.has_folder(name);
    let is_corrected = has("corrected_cameras") && has("corrected_images");
    let is_original = has("cameras") && has("images");
    if !has("depth") {
        let why = "keyframes/depth/ is missing: only phones with LiDAR write it";
        return Err(incomplete(LOOKS_LIKE, why));
    }
    if let Some(name) = ["images", "cameras"].into_iter().find(|name| !is_corrected && !has(name)) {
        return Err(incomplete(LOOKS_LIKE, format!("keyframes/{name}/ is missing")));
    }
    let list = |images, cameras, is_there: bool| match is_there {
        true => Keyframes::list(folder, images, cameras),
        false => Ok(Keyframes { color: Vec::new(), cameras: Vec::new() }),
    };
    let corrected = list("corrected_images", "corrected_cameras", is_corrected)?;
    let original = list("images", "cameras", is_original)?;
    let depth = folder.files("keyframes/depth", DEPTHS)?;
    let confidence = match has("confidence") {
        true => folder.files("keyframes/confidence", &["png"])?,
        false => Vec::new(),
    };
    // Polycam's optimization can leave frames out: these keep their own cameras.
    let mut frames = original.by_name();
    let (all, improved) = (frames.len(), corrected.by_name());
    frames.extend(improved.iter().map(|(name, pair)| (name.clone(), *pair)));
    let mut scan = Scan::new(&folder.root, "polycam");
    scan.camera_axes = CameraAxes::Opengl;
    (scan.up, scan.by_gravity) = (Some(UpAxis::Y), true);
    if !improved.is_empty() && improved.len() < frames.len() {
        let count = frames.len() - improved.len();
        let text = format!(
            "{count} of {} frames have no corrected camera; their original cameras are used",
            all.max(frames.len())
        );
        scan.findings.push(Finding::unusual(FindingSubject::Camera, text).counting(count));
    }
    let mut frames: Vec<_> = frames.into_values().collect();
    frames.sort_by_cached_key(|(picture, _)| {
        pairing::natural_sort_key(Utf8Path::new(picture.file_name().unwrap_or_default()))
    });
    let color: Vec<Utf8PathBuf> = frames.iter().map(|(picture, _)| (*picture).clone()).collect();
    let depth_of = pairing::match_files(&color, &depth);
    let confidence_of = pairing::match_files(&color, &confidence);
    for (i, (picture, camera)) in frames.into_iter().enumerate() {
        let (Some(file), Some(depth_at)) = (camera, depth_of[i]) else {
            scan.damage.record(IngestError::FrameCountMismatch {
                color: color.len(),
                depth: depth.len(),
                pose: corrected.cameras.len().max(original.cameras.len()),
                first: picture.clone(),
            })?;
            continue;
        };
        let frame = read_camera(&folder.root, file).map(|camera| RawFrame {
            index: FrameIndex(0),
            time_s: None,
            color: picture.clone(),
            depth: depth[depth_at].clone(),
            pose_file: file.clone(),
            pose: camera.pose(),
            color_intrinsics: camera.intrinsics(),
            depth_intrinsics: camera.intrinsics(),
            optics: Optics {
                confidence: confidence_of[i].map(|at| Confidence {
                    file: confidence[at].clone(),
                    at_least: LEAST_CONFIDENCE,
                }),
                ..Optics::default()
            },
        });
        scan.add(frame)?;
    }
    match color.is_empty() {
        true => Err(incomplete(LOOKS_LIKE, "keyframes/images/ is empty")),
        false => Ok(scan),
    }
}

fn read_camera(root: &TextFiles, file: &Utf8Path) -> Result<Camera, IngestError> {
    serde_json::from_str(&root.read_text(file, MAX_CAMERA_BYTES)?)
        .map_err(|e| IngestError::malformed(file, e))
}
