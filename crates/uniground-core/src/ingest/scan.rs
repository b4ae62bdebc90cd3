//! A scan as its files describe it: what layouts produce and imports consume.

use super::IngestError;
use crate::geometry::up_axis::UpAxis;
use crate::geometry::{Isometry3, Matrix4, pose};
use crate::scene::{FrameIndex, Intrinsics, PoseConvention};
use camino::{Utf8Path, Utf8PathBuf};
use image::ImageReader;

/// A scan as its files describe it: not yet canonical, pictures not yet decoded, paths below `root`.
#[derive(Debug, Clone)]
pub struct Scan {
    /// Folder that the other paths start from.
    pub root: Utf8PathBuf,
    /// Layout of the files: `uniground-scene/1` or `color-depth-pose`.
    pub format: &'static str,
    /// `name` in `scene.json`; `None` when it has none, or the layout knows no names.
    pub name: Option<String>,
    /// The scan's own point cloud; `None`: one is fused from the frames.
    pub cloud: Option<Utf8PathBuf>,
    /// In the order of the files; frames whose pose is marked as lost are left out.
    pub frames: Vec<RawFrame>,
    /// As written in the files; `None` = not said.
    pub up: Option<UpAxis>,
    /// Camera axes the poses in the files use; made OpenCV's on loading.
    pub camera_axes: CameraAxes,
    /// Direction of the poses in the files; made camera-to-world on loading.
    pub pose: PoseConvention,
    /// Metres per unit of the depth pictures.
    pub depth_scale_m: f32,
    /// Frames left out because their pose is marked as lost (all infinite).
    pub frames_skipped: u32,
    /// What is odd but was accepted, each with its file or frame.
    pub warnings: Vec<String>,
}

#[derive(Debug, Clone)]
pub struct RawFrame {
    /// Place in the scan's own list.
    pub index: FrameIndex,
    pub colour: Utf8PathBuf,
    pub depth: Utf8PathBuf,
    pub pose_file: Utf8PathBuf,
    pub pose: Matrix4<f32>,
    pub colour_intrinsics: Intrinsics,
    pub depth_intrinsics: Intrinsics,
}

/// Which way a camera's own axes point.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum CameraAxes {
    /// x right, y down, z forward.
    Opencv,
    /// x right, y up, z backward.
    Opengl,
}

impl RawFrame {
    /// The pose read under a convention, as camera-to-world with OpenCV axes, in the file's world.
    pub(super) fn camera_to_world(&self, convention: PoseConvention, axes: CameraAxes) -> Result<Isometry3<f32>, pose::PoseError> {
        let rigid = pose::rigid(&self.pose)?;
        let camera_to_world = match convention {
            PoseConvention::CameraToWorld => rigid,
            PoseConvention::WorldToCamera => rigid.inverse(),
        };
        Ok(match axes {
            CameraAxes::Opencv => camera_to_world,
            // OpenGL's camera is OpenCV's turned by half a turn about its own X.
            CameraAxes::Opengl => camera_to_world * Isometry3::rotation(nalgebra::Vector3::x() * std::f32::consts::PI),
        })
    }
}

/// Width and height from a picture's header.
pub(super) fn picture_size(root: &Utf8Path, file: &Utf8Path) -> Result<(u32, u32), IngestError> {
    let path = root.join(file);
    if !path.is_file() {
        return Err(IngestError::MissingFile { file: file.to_owned() });
    }
    let io = |source| IngestError::reading(file, source);
    let reader = ImageReader::open(&path).map_err(io)?.with_guessed_format().map_err(io)?;
    let (width, height) = reader
        .into_dimensions()
        .map_err(|e| IngestError::malformed(file, format!("not a readable picture: {e}")))?;
    if u64::from(width) * u64::from(height) > MAX_PIXELS {
        return Err(IngestError::malformed(file, format!("{width}x{height} is more than {} megapixels", MAX_PIXELS / 1_000_000)));
    }
    Ok((width, height))
}

/// Several pictures are decoded at once: each may take some hundred megabytes, not more.
const MAX_PIXELS: u64 = 40_000_000;
