//! nerfstudio and instant-ngp: `transforms.json`, OpenGL cameras, shared or per-frame intrinsics
//! with lens distortion. Depth is optional in this format and required here. Without it, only the
//! cloud that the file names is read.

use super::files::{
    FolderListing, TextFiles, check_inside, deserialize_optional_path, deserialize_path,
};
use super::numbers::matrix_from_values;
use super::{entry_path, incomplete};
use crate::IngestError;
use crate::scan::{CameraAxes, RawFrame, Scan, picture_size, usual_depth_scale_m};
use camino::{Utf8Path, Utf8PathBuf};
use serde::Deserialize;
use uniground_geometry::scene::{FrameIndex, Intrinsics, Lens, Optics};
use uniground_types::findings::{Finding, FindingSubject};

const LOOKS_LIKE: &str = "a nerfstudio or instant-ngp scene (transforms.json)";
const FILE: &str = "transforms.json";
const NAMED: &str = "named in transforms.json points outside the archive";
const MAX_BYTES: u64 = 64 << 20;

#[derive(Deserialize)]
struct Transforms {
    camera_model: Option<String>,
    #[serde(flatten)]
    camera: Camera,
    /// Meters per unit of depth (instant-ngp).
    integer_depth_scale: Option<f32>,
    #[serde(default, deserialize_with = "deserialize_optional_path")]
    ply_file_path: Option<Utf8PathBuf>,
    #[serde(default, deserialize_with = "super::listed::deserialize_frames")]
    frames: Vec<Frame>,
}

#[derive(Deserialize)]
struct Frame {
    #[serde(deserialize_with = "deserialize_path")]
    file_path: Utf8PathBuf,
    #[serde(default, alias = "depth_path", deserialize_with = "deserialize_optional_path")]
    depth_file_path: Option<Utf8PathBuf>,
    transform_matrix: Vec<Vec<f64>>,
    #[serde(flatten)]
    camera: Camera,
}

/// Complete or partial intrinsics. Values that a frame lacks are taken from the shared ones.
#[derive(Deserialize, Clone, Copy, Default)]
#[allow(clippy::struct_field_names)] // The names are those of the format.
struct Camera {
    fl_x: Option<f32>,
    fl_y: Option<f32>,
    cx: Option<f32>,
    cy: Option<f32>,
    w: Option<f32>,
    h: Option<f32>,
    camera_angle_x: Option<f32>,
    k1: Option<f32>,
    k2: Option<f32>,
    k3: Option<f32>,
    k4: Option<f32>,
    p1: Option<f32>,
    p2: Option<f32>,
    is_fisheye: Option<bool>,
}

impl Camera {
    fn or(self, all: Self) -> Self {
        Self {
            fl_x: self.fl_x.or(all.fl_x),
            fl_y: self.fl_y.or(all.fl_y),
            cx: self.cx.or(all.cx),
            cy: self.cy.or(all.cy),
            w: self.w.or(all.w),
            h: self.h.or(all.h),
            camera_angle_x: self.camera_angle_x.or(all.camera_angle_x),
            k1: self.k1.or(all.k1),
            k2: self.k2.or(all.k2),
            k3: self.k3.or(all.k3),
            k4: self.k4.or(all.k4),
            p1: self.p1.or(all.p1),
            p2: self.p2.or(all.p2),
            is_fisheye: self.is_fisheye.or(all.is_fisheye),
        }
    }

    fn intrinsics(&self, root: &Utf8Path, picture: &Utf8Path) -> Result<Intrinsics, IngestError> {
        let (width, height) = match (self.w, self.h) {
            (Some(w), Some(h)) => (w.round() as u32, h.round() as u32),
            _ => picture_size(root, picture)?.ok_or_else(|| {
                IngestError::malformed(picture, "the picture does not state its size")
            })?,
        };
        let by_angle = self.camera_angle_x.map(|angle| 0.5 * width as f32 / (0.5 * angle).tan());
        let fx = self
            .fl_x
            .or(self.fl_y)
            .or(by_angle)
            .ok_or_else(|| IngestError::MissingIntrinsics { file: FILE.into() })?;
        let (cx, cy) =
            (self.cx.unwrap_or(width as f32 / 2.0), self.cy.unwrap_or(height as f32 / 2.0));
        Ok(Intrinsics { width, height, fx, fy: self.fl_y.unwrap_or(fx), cx, cy })
    }

    fn lens(&self) -> Option<Lens> {
        let or_zero = |k: Option<f32>| k.unwrap_or(0.0);
        // Here, k4 is in the denominator. Only fisheye lenses use it otherwise.
        let (k1, k2, k3) = (or_zero(self.k1), or_zero(self.k2), or_zero(self.k3));
        Lens { k1, k2, k3, p1: or_zero(self.p1), p2: or_zero(self.p2), ..Lens::default() }
            .reject_identity()
    }
}

pub(super) fn can_read(folder: &FolderListing) -> bool {
    folder.has_file(FILE)
}

pub(super) fn read(folder: &FolderListing) -> Result<Scan, IngestError> {
    let root = &folder.root;
    let text = root.read_text(Utf8Path::new(FILE), MAX_BYTES)?;
    let transforms: Transforms =
        serde_json::from_str(&text).map_err(|e| IngestError::malformed(FILE, e))?;
    let fisheye = transforms
        .camera_model
        .as_deref()
        .is_some_and(|model| model.contains("FISHEYE") || model == "EQUIRECTANGULAR");
    if fisheye || transforms.camera.is_fisheye == Some(true) {
        let model = transforms.camera_model.as_deref().unwrap_or("fisheye");
        return Err(incomplete(
            LOOKS_LIKE,
            format!("its cameras are {model}: undistort the pictures to a pinhole camera first"),
        ));
    }
    let mut scan = Scan::new(root, "nerfstudio");
    scan.camera_axes = CameraAxes::Opengl;
    scan.cloud = transforms
        .ply_file_path
        .clone()
        .map(|cloud| check_inside(&cloud, NAMED).map(|()| cloud))
        .transpose()?;
    if scan.cloud.is_none() {
        scan.cloud = super::color_depth_pose::find_cloud(folder);
    }
    let with_depth =
        transforms.frames.iter().filter(|frame| frame.depth_file_path.is_some()).count();
    if with_depth == 0 {
        if scan.cloud.is_none() {
            return Err(incomplete(
                LOOKS_LIKE,
                "its frames have no depth_file_path and there is no cloud: pictures alone are not supported, add depth or a cloud in meters",
            ));
        }
        let count = transforms.frames.len();
        let text = format!(
            "{count} pictures are ignored: they have no depth (depth_file_path), only the cloud is used"
        );
        scan.findings.push(Finding::left_out(FindingSubject::Frames, text).counting(count));
        return Ok(scan);
    }
    if let Some(scale) =
        transforms.integer_depth_scale.filter(|scale| scale.is_finite() && *scale > 0.0)
    {
        scan.depth_scale_m = scale;
    }
    for (i, frame) in transforms.frames.iter().enumerate() {
        scan.add(to_raw_frame(root, i, frame, transforms.camera))?;
    }
    // The scale applies to integer depth only.
    if usual_depth_scale_m(root, scan.frames.iter().map(|frame| &frame.depth)) == 1.0 {
        scan.depth_scale_m = 1.0;
    }
    Ok(scan)
}

fn to_raw_frame(
    root: &TextFiles,
    number: usize,
    frame: &Frame,
    all: Camera,
) -> Result<RawFrame, IngestError> {
    let pose_file = entry_path(Utf8Path::new(FILE), format_args!("frame {number}"));
    let color = find_picture(root, &frame.file_path)?;
    let depth = frame
        .depth_file_path
        .as_ref()
        .ok_or_else(|| IngestError::malformed(&pose_file, "it has no depth_file_path"))?;
    let depth = find_picture(root, depth)?;
    let camera = frame.camera.or(all);
    let intrinsics = camera.intrinsics(root, &color)?;
    let pose = matrix_from_values(&frame.transform_matrix.concat())
        .ok_or_else(|| IngestError::malformed(&pose_file, "its transform_matrix is not 4x4"))?;
    let lens = camera.lens();
    Ok(RawFrame {
        index: FrameIndex(0),
        time_s: None,
        color,
        depth,
        pose_file,
        pose,
        color_intrinsics: intrinsics,
        depth_intrinsics: intrinsics,
        optics: Optics { color_lens: lens, depth_lens: lens, ..Optics::default() },
    })
}

/// Finds a picture. Paths can lack their extension and begin with `./`.
fn find_picture(root: &Utf8Path, path: &Utf8Path) -> Result<Utf8PathBuf, IngestError> {
    check_inside(path, NAMED)?;
    let with_ending = ["png", "jpg"].map(|ending| Utf8PathBuf::from(format!("{path}.{ending}")));
    let found =
        std::iter::once(path.to_owned()).chain(with_ending).find(|p| root.join(p).is_file());
    found.ok_or_else(|| IngestError::MissingFile { file: path.to_owned() })
}
