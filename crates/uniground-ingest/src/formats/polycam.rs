//! Polycam raw data: `keyframes/` with `images/ cameras/ depth/ confidence/`, named by
//! microseconds; `corrected_*` after its own optimization. OpenGL cameras in a world that ARKit
//! made level, Y up.

use super::color_depth_pose::LEAST_CONFIDENCE;
use super::files::{DEPTHS, FolderListing, PICTURES};
use super::{incomplete, pairing};
use crate::IngestError;
use crate::limited_reader::read_text;
use crate::scan::{CameraAxes, RawFrame, Scan};
use camino::Utf8Path;
use nalgebra::Matrix4;
use serde::Deserialize;
use uniground_geometry::scene::{Confidence, FrameIndex, Intrinsics, Optics};
use uniground_geometry::up_axis::UpAxis;

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

pub(super) fn read(folder: &FolderListing) -> Result<Scan, IngestError> {
    let keyframes = FolderListing::open(&folder.root.join("keyframes"))?;
    let corrected =
        keyframes.has_folder("corrected_cameras") && keyframes.has_folder("corrected_images");
    let (images, cameras) =
        if corrected { ("corrected_images", "corrected_cameras") } else { ("images", "cameras") };
    for name in [images, cameras, "depth"] {
        if !keyframes.has_folder(name) {
            let why = if name == "depth" { ": only phones with LiDAR write it" } else { "" };
            return Err(incomplete(LOOKS_LIKE, format!("keyframes/{name}/ is missing{why}")));
        }
    }
    let list = |name: &str, endings: &[&str]| match keyframes.has_folder(name) {
        true => folder.files(&format!("keyframes/{name}"), endings),
        false => Ok(Vec::new()),
    };
    let (color, cameras, depth, confidence) = (
        list(images, PICTURES)?,
        list(cameras, &["json"])?,
        list("depth", DEPTHS)?,
        list("confidence", &["png"])?,
    );
    let (camera_of, depth_of, confidence_of) = (
        pairing::match_files(&color, &cameras),
        pairing::match_files(&color, &depth),
        pairing::match_files(&color, &confidence),
    );
    let mut scan = Scan::new(&folder.root, "polycam");
    scan.camera_axes = CameraAxes::Opengl;
    (scan.up, scan.by_gravity) = (Some(UpAxis::Y), true);
    for (i, picture) in color.iter().enumerate() {
        let (Some(camera_at), Some(depth_at)) = (camera_of[i], depth_of[i]) else {
            scan.damage.record(IngestError::FrameCountMismatch {
                color: color.len(),
                depth: depth.len(),
                pose: cameras.len(),
                first: picture.clone(),
            })?;
            continue;
        };
        let file = &cameras[camera_at];
        let frame = read_camera(&folder.root, file).map(|camera| RawFrame {
            index: FrameIndex(0),
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
        true => Err(incomplete(LOOKS_LIKE, format!("keyframes/{images}/ is empty"))),
        false => Ok(scan),
    }
}

fn read_camera(root: &Utf8Path, file: &Utf8Path) -> Result<Camera, IngestError> {
    serde_json::from_str(&read_text(root, file, MAX_CAMERA_BYTES)?)
        .map_err(|e| IngestError::malformed(file, e))
}
