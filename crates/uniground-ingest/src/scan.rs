//! A scan as its files describe it: the output of layouts and the input of imports.

use super::IngestError;
use camino::{Utf8Path, Utf8PathBuf};
use image::ImageReader;
use nalgebra::{Matrix4, Quaternion, UnitQuaternion};
use std::collections::BTreeSet;
use uniground_geometry::scene::{
    FrameIndex, Intrinsics, Optics, PoseConvention, float_picture_size, is_compressed_floats,
    is_float_picture,
};
use uniground_geometry::up_axis::UpAxis;
use uniground_geometry::{Isometry3, pose};
use uniground_types::findings::Finding;

/// A scan as its files describe it. It is not canonical yet, its pictures are not decoded, and its
/// paths are below `root`.
#[derive(Debug)]
pub struct Scan {
    /// Folder that the other paths are relative to.
    pub root: Utf8PathBuf,
    /// Layout of the files: `uniground-scene/1`, `color-depth-pose`, `tum-rgbd` and so on.
    pub format: &'static str,
    /// `name` in `scene.json`. `None` if it is missing, or if the layout has no names.
    pub name: Option<String>,
    /// The scan's own point cloud. `None`: a cloud is fused from the frames.
    pub cloud: Option<Utf8PathBuf>,
    /// Text files that describe the scan, such as intrinsics and lists of poses.
    pub described_by: BTreeSet<Utf8PathBuf>,
    /// Frames in the order of the files. Frames whose pose is marked as lost are omitted.
    pub frames: Vec<RawFrame>,
    /// The up axis as written in the files. `None`: not stated.
    pub up: Option<UpAxis>,
    /// Whether an inertial sensor made the world level.
    pub by_gravity: bool,
    /// Camera axes of the poses in the files. Converted to OpenCV's on loading.
    pub camera_axes: CameraAxes,
    /// Direction of the poses in the files. Converted to camera-to-world on loading.
    pub pose: PoseConvention,
    /// Meters per unit of the depth pictures.
    pub depth_scale_m: f32,
    /// Whether lengths are in meters or in a unit that can be guessed. Pure photogrammetry has no
    /// scale.
    pub has_scale: bool,
    /// A rigid transform (meters) that the files require for poses and cloud, such as ScanNet's
    /// axis alignment.
    pub alignment: Option<Matrix4<f64>>,
    /// Offset that is subtracted from all positions, in the files' units. Without it, poses in map
    /// coordinates would lose decimals.
    pub origin: [f64; 3],
    /// Number of frames left out: pose marked as lost, or damaged.
    pub frames_skipped: u32,
    /// Unusable frames found so far.
    pub damage: SkippedFrames,
    /// What was found so far.
    pub findings: Vec<Finding>,
}

/// Frames that could not be used.
#[derive(Debug, Default)]
pub struct SkippedFrames {
    /// Number of frames.
    pub count: usize,
    /// The errors of the first few frames.
    pub first: Vec<IngestError>,
}

/// Maximum number of damaged frames that are named.
const MAX_NAMED: usize = 5;

impl SkippedFrames {
    /// Records a frame that cannot be used. Returns errors that are not the fault of a single
    /// frame.
    ///
    /// # Errors
    /// Returns errors of the disk, names that point outside of the upload, and cancellation.
    pub fn record(&mut self, error: IngestError) -> Result<(), IngestError> {
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
    /// Index in the scan's own list.
    pub index: FrameIndex,
    /// Time of the color picture, seconds since 1970. `None`: not stated, or counted from another
    /// start.
    pub time_s: Option<f64>,
    pub color: Utf8PathBuf,
    pub depth: Utf8PathBuf,
    /// The file that the pose was read from, and the entry if it holds several.
    pub pose_file: Utf8PathBuf,
    /// The pose in the files' units. Double precision, because of map coordinates.
    pub pose: Matrix4<f64>,
    pub color_intrinsics: Intrinsics,
    pub depth_intrinsics: Intrinsics,
    pub optics: Optics,
}

/// The directions of a camera's own axes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum CameraAxes {
    /// x right, y down, z forward.
    Opencv,
    /// x right, y up, z backward.
    Opengl,
    /// x forward, y left, z up: the body axes of ROS (REP 103).
    Ros,
}

impl CameraAxes {
    pub(super) const ALL: [Self; 3] = [Self::Opencv, Self::Opengl, Self::Ros];

    /// Returns the name in `scene.json` and in reports.
    pub(super) fn as_str(self) -> &'static str {
        match self {
            Self::Opencv => "opencv",
            Self::Opengl => "opengl",
            Self::Ros => "ros",
        }
    }

    /// Returns the rotation from OpenCV's axes to these.
    fn rotation_from_opencv(self) -> UnitQuaternion<f32> {
        UnitQuaternion::new_unchecked(match self {
            Self::Opencv => Quaternion::new(1.0, 0.0, 0.0, 0.0),
            // 180 degrees about x.
            Self::Opengl => Quaternion::new(0.0, 1.0, 0.0, 0.0),
            // (x, y, z) becomes (z, -x, -y).
            Self::Ros => Quaternion::new(0.5, -0.5, 0.5, -0.5),
        })
    }
}

impl Scan {
    /// Creates a scan without frames or cloud, with the most common conventions: OpenCV,
    /// camera-to-world, millimeters.
    pub(super) fn new(root: &Utf8Path, format: &'static str) -> Self {
        Self {
            root: root.to_owned(),
            format,
            name: None,
            cloud: None,
            described_by: BTreeSet::new(),
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
            findings: Vec::new(),
        }
    }

    /// Adds a frame, or records why it cannot be used.
    ///
    /// # Errors
    /// Returns errors that are not the fault of a single frame.
    pub(super) fn add(&mut self, frame: Result<RawFrame, IngestError>) -> Result<(), IngestError> {
        match frame {
            Ok(frame) => self.frames.push(frame),
            Err(error) => self.damage.record(error)?,
        }
        Ok(())
    }
}

impl RawFrame {
    /// Returns the pose under a convention, as camera-to-world with OpenCV axes, in the file's
    /// world with `origin` subtracted, meters.
    pub(super) fn camera_to_world(
        &self,
        convention: PoseConvention,
        axes: CameraAxes,
        units: &Units,
    ) -> Result<Isometry3<f32>, pose::PoseError> {
        camera_to_world(&self.pose, convention, axes, units)
    }
}

/// Returns a pose in the files' units under a convention, as [`RawFrame::camera_to_world`] does.
pub(super) fn camera_to_world(
    pose: &Matrix4<f64>,
    convention: PoseConvention,
    axes: CameraAxes,
    units: &Units,
) -> Result<Isometry3<f32>, pose::PoseError> {
    let mut matrix = *pose;
    for axis in 0..3 {
        matrix[(axis, 3)] = (matrix[(axis, 3)] - units.origin[axis]) * units.metres_per_unit;
    }
    let rigid = pose::rigid(&matrix.cast())?;
    let camera_to_world = match convention {
        PoseConvention::CameraToWorld => rigid,
        PoseConvention::WorldToCamera => rigid.inverse(),
    };
    Ok(camera_to_world * axes.rotation_from_opencv())
}

/// How positions in the files are converted to meters near the origin.
#[derive(Debug, Clone, Copy)]
pub(super) struct Units {
    /// The origin, in the files' units.
    pub origin: [f64; 3],
    pub metres_per_unit: f64,
}

/// Reads width and height from a picture's header. Returns `None` for depth formats without a size.
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

/// Returns meters per unit of depth pictures without a declared unit: meters for floats,
/// millimeters for integers.
pub(super) fn usual_depth_scale_m<'a>(
    root: &Utf8Path,
    depth: impl IntoIterator<Item = &'a Utf8PathBuf>,
) -> f32 {
    // Unreadable files are reported when they are loaded.
    let is_float = depth
        .into_iter()
        .next()
        .is_some_and(|first| is_float_picture(&root.join(first)).unwrap_or(false));
    if is_float { 1.0 } else { 0.001 }
}

/// Maximum number of pixels. Several pictures are decoded at once, and each must not take more than
/// a few hundred megabytes.
const MAX_PIXELS: u64 = 40_000_000;
