//! A scan as its files describe it: what layouts produce and imports consume.

use super::IngestError;
use camino::{Utf8Path, Utf8PathBuf};
use image::ImageReader;
use nalgebra::Matrix4;
use uniground_geometry::scene::{
    FrameIndex, Intrinsics, Optics, PoseConvention, float_picture_size, is_compressed_floats,
    is_float_picture,
};
use uniground_geometry::up_axis::UpAxis;
use uniground_geometry::{Isometry3, pose};

/// A scan as its files describe it: not yet canonical, pictures not yet decoded, paths below
/// `root`.
#[derive(Debug)]
pub struct Scan {
    /// Folder that the other paths start from.
    pub root: Utf8PathBuf,
    /// Layout of the files: `uniground-scene/1`, `color-depth-pose`, `tum-rgbd` and so on.
    pub format: &'static str,
    /// `name` in `scene.json`; `None` when it has none, or the layout knows no names.
    pub name: Option<String>,
    /// The scan's own point cloud; `None`: one is fused from the frames.
    pub cloud: Option<Utf8PathBuf>,
    /// In the order of the files; frames whose pose is marked as lost are left out.
    pub frames: Vec<RawFrame>,
    /// As written in the files; `None` = not said.
    pub up: Option<UpAxis>,
    /// Whether an inertial sensor made the world level.
    pub by_gravity: bool,
    /// Camera axes the poses in the files use; made OpenCV's on loading.
    pub camera_axes: CameraAxes,
    /// Direction of the poses in the files; made camera-to-world on loading.
    pub pose: PoseConvention,
    /// Metres per unit of the depth pictures.
    pub depth_scale_m: f32,
    /// Whether its lengths are metres, or something that can be guessed; photogrammetry alone has
    /// no scale.
    pub has_scale: bool,
    /// A rigid transform (metres) that the files want applied to poses and cloud, such as
    /// ScanNet's axis alignment.
    pub alignment: Option<Matrix4<f64>>,
    /// What is taken off all positions, in the files' units: poses in map coordinates would lose
    /// their decimals.
    pub origin: [f64; 3],
    /// Frames left out: pose marked as lost, or damaged.
    pub frames_skipped: u32,
    /// Frames that could not be used, found so far.
    pub damage: SkippedFrames,
    /// What is odd but was accepted, each with its file or frame.
    pub warnings: Vec<String>,
}

/// Frames that could not be used.
#[derive(Debug, Default)]
pub struct SkippedFrames {
    /// How many.
    pub count: usize,
    /// What was wrong with the first few.
    pub first: Vec<IngestError>,
}

/// Damaged frames that are named.
const MAX_NAMED: usize = 5;

impl SkippedFrames {
    /// Notes a frame that can not be used. What is not the fault of one frame comes back.
    ///
    /// # Errors
    /// The disk's own, names that point outside, and calling off.
    pub fn note(&mut self, error: IngestError) -> Result<(), IngestError> {
        match error {
            IngestError::Io { .. }
            | IngestError::UnsafeEntry { .. }
            | IngestError::Cancelled(_) => Err(error),
            _ => {
                self.count += 1;
                if self.first.len() < MAX_NAMED {
                    self.first.push(error);
                }
                Ok(())
            }
        }
    }
}

#[derive(Debug, Clone)]
pub struct RawFrame {
    /// Place in the scan's own list.
    pub index: FrameIndex,
    pub colour: Utf8PathBuf,
    pub depth: Utf8PathBuf,
    /// Where the pose was read from, and which one of several.
    pub pose_file: Utf8PathBuf,
    /// In the files' units; double precision for map coordinates.
    pub pose: Matrix4<f64>,
    pub colour_intrinsics: Intrinsics,
    pub depth_intrinsics: Intrinsics,
    pub optics: Optics,
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

impl Scan {
    /// A scan without frames or cloud, as most layouts have it: OpenCV, camera-to-world,
    /// millimetres.
    pub(super) fn new(root: &Utf8Path, format: &'static str) -> Self {
        Self {
            root: root.to_owned(),
            format,
            name: None,
            cloud: None,
            frames: Vec::new(),
            up: None,
            by_gravity: false,
            camera_axes: CameraAxes::Opencv,
            pose: PoseConvention::CameraToWorld,
            depth_scale_m: 0.001,
            has_scale: true,
            alignment: None,
            origin: [0.0; 3],
            frames_skipped: 0,
            damage: SkippedFrames::default(),
            warnings: Vec::new(),
        }
    }

    /// Adds a frame, or notes why it can not be used.
    ///
    /// # Errors
    /// What is not the fault of one frame.
    pub(super) fn add(&mut self, frame: Result<RawFrame, IngestError>) -> Result<(), IngestError> {
        match frame {
            Ok(frame) => self.frames.push(frame),
            Err(error) => self.damage.note(error)?,
        }
        Ok(())
    }
}

impl RawFrame {
    /// The pose read under a convention, as camera-to-world with OpenCV axes, in the file's world
    /// less `origin`, metres.
    pub(super) fn camera_to_world(
        &self,
        convention: PoseConvention,
        axes: CameraAxes,
        units: &Units,
    ) -> Result<Isometry3<f32>, pose::PoseError> {
        let mut matrix = self.pose;
        for axis in 0..3 {
            matrix[(axis, 3)] = (matrix[(axis, 3)] - units.origin[axis]) * units.metres_per_unit;
        }
        let rigid = pose::rigid(&matrix.cast())?;
        let camera_to_world = match convention {
            PoseConvention::CameraToWorld => rigid,
            PoseConvention::WorldToCamera => rigid.inverse(),
        };
        Ok(match axes {
            CameraAxes::Opencv => camera_to_world,
            // OpenGL's camera is OpenCV's turned by half a turn about its own X.
            CameraAxes::Opengl => {
                camera_to_world * Isometry3::rotation(nalgebra::Vector3::x() * std::f32::consts::PI)
            }
        })
    }
}

/// How positions in the files become metres near the origin.
#[derive(Debug, Clone, Copy)]
pub(super) struct Units {
    /// In the files' units.
    pub origin: [f64; 3],
    pub metres_per_unit: f64,
}

/// Width and height from a picture's header; `None` for depth that does not say.
pub(super) fn picture_size(
    root: &Utf8Path,
    file: &Utf8Path,
) -> Result<Option<(u32, u32)>, IngestError> {
    let path = root.join(file);
    if !path.is_file() {
        return Err(IngestError::MissingFile { file: file.to_owned() });
    }
    let io = |source| IngestError::reading(file, source);
    if is_compressed_floats(&path).map_err(io)? {
        return Ok(None);
    }
    let not_readable = |reason: &dyn std::fmt::Display| {
        IngestError::malformed(file, format!("not a readable picture: {reason}"))
    };
    let size = match float_picture_size(&path) {
        Ok(Some(size)) => size,
        Ok(None) => {
            let reader = ImageReader::open(&path).map_err(io)?.with_guessed_format().map_err(io)?;
            reader.into_dimensions().map_err(|e| not_readable(&e))?
        }
        Err(e) => return Err(not_readable(&e)),
    };
    let (width, height) = size;
    if u64::from(width) * u64::from(height) > MAX_PIXELS {
        return Err(IngestError::malformed(
            file,
            format!("{width}x{height} is more than {} megapixels", MAX_PIXELS / 1_000_000),
        ));
    }
    Ok(Some((width, height)))
}

/// Metres per unit of depth pictures that nobody gave a unit: floats are metres, integers
/// millimetres.
pub(super) fn usual_depth_scale_m<'a>(
    root: &Utf8Path,
    depth: impl IntoIterator<Item = &'a Utf8PathBuf>,
) -> f32 {
    // What can not be read is told by who reads on.
    let is_float = depth
        .into_iter()
        .next()
        .is_some_and(|first| is_float_picture(&root.join(first)).unwrap_or(false));
    if is_float { 1.0 } else { 0.001 }
}

/// Several pictures are decoded at once: each may take some hundred megabytes, not more.
const MAX_PIXELS: u64 = 40_000_000;
