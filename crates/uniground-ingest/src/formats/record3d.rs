//! Record3D: a `.r3d`, unpacked (`rgbd/{i}.jpg|.depth|.conf` and `metadata`, depth as
//! LZFSE-compressed 32-bit meters), or its export as EXR and JPEG (`rgb/{i}.jpg`, `depth/{i}.exr`
//! and `metadata.json`). Cameras are OpenGL. The first pose defines the world, so the world is not
//! level.

use super::color_depth_pose::LEAST_CONFIDENCE;
use super::files::FolderListing;
use super::numbers::pose_from_quaternion;
use super::{entry_path, incomplete};
use crate::IngestError;
use crate::scan::{CameraAxes, RawFrame, Scan, picture_size};
use camino::{Utf8Path, Utf8PathBuf};
use serde::Deserialize;
use uniground_geometry::scene::{Confidence, FrameIndex, Intrinsics, Optics};

const LOOKS_LIKE: &str = "a Record3D recording";
/// The metadata of a `.r3d`, and of an export.
const FILE: &str = "metadata";
const EXPORTED_FILE: &str = "metadata.json";
const MAX_BYTES: u64 = 64 << 20;
/// Size of a phone's depth pictures, used if the recording does not state it.
const USUAL_DEPTH: (u32, u32) = (192, 256);

#[derive(Deserialize)]
struct Metadata {
    w: u32,
    h: u32,
    dw: Option<u32>,
    dh: Option<u32>,
    /// 3x3, column-major.
    #[serde(rename = "K")]
    k: Vec<f32>,
    /// Quaternion x y z w, then the position.
    #[serde(deserialize_with = "super::listed::deserialize_frames")]
    poses: Vec<[f64; 7]>,
    /// `fx fy cx cy` of each frame, if the intrinsics vary.
    #[serde(
        rename = "perFrameIntrinsicCoeffs",
        default,
        deserialize_with = "super::listed::deserialize_frames"
    )]
    each: Vec<Vec<f32>>,
}

pub(super) fn can_read(folder: &FolderListing) -> bool {
    let has = |name: &str, ending: &str| {
        folder.has_folder(name)
            && folder.files(name, &[ending]).is_ok_and(|files| !files.is_empty())
    };
    (folder.has_folder("rgbd") && (folder.has_file(FILE) || has("rgbd", "depth")))
        || is_export(folder)
}

fn is_export(folder: &FolderListing) -> bool {
    folder.has_file(EXPORTED_FILE)
        && folder.has_folder("rgb")
        && folder.has_folder("depth")
        && folder.files("depth", &["exr"]).is_ok_and(|files| !files.is_empty())
}

/// Returns color, depth and confidence of a frame.
fn files_of(frame: usize, is_export: bool) -> [Utf8PathBuf; 3] {
    match is_export {
        false => ["jpg", "depth", "conf"].map(|ending| format!("rgbd/{frame}.{ending}").into()),
        true => [
            format!("rgb/{frame}.jpg").into(),
            format!("depth/{frame}.exr").into(),
            format!("conf/{frame}.png").into(),
        ],
    }
}

pub(super) fn read(folder: &FolderListing) -> Result<Scan, IngestError> {
    let is_export = is_export(folder) && !folder.has_folder("rgbd");
    let file = Utf8Path::new(if is_export { EXPORTED_FILE } else { FILE });
    if !folder.has_file(file.as_str()) {
        return Err(incomplete(LOOKS_LIKE, "the file metadata is missing"));
    }
    let metadata: Metadata = serde_json::from_str(&folder.root.read_text(file, MAX_BYTES)?)
        .map_err(|e| IngestError::malformed(file, e))?;
    let [fx, _, _, _, fy, _, cx, cy, _] = metadata.k[..] else {
        return Err(IngestError::malformed(
            file,
            format!("K has {} numbers, 9 are expected", metadata.k.len()),
        ));
    };
    let whole = Intrinsics { width: metadata.w, height: metadata.h, fx, fy, cx, cy };
    if whole.width == 0 || whole.height == 0 {
        return Err(IngestError::malformed(file, "its picture size is 0"));
    }
    let (portrait, usual) = (whole.height >= whole.width, USUAL_DEPTH);
    let usual = if portrait { usual } else { (usual.1, usual.0) };
    // An EXR picture states its own size.
    let stated = match is_export {
        true => picture_size(&folder.root, &files_of(0, is_export)[1]).ok().flatten(),
        false => None,
    };
    let usual = stated.unwrap_or(usual);
    let (dw, dh) = (metadata.dw.unwrap_or(usual.0), metadata.dh.unwrap_or(usual.1));
    if dw == 0 || dh == 0 || u64::from(dw) * u64::from(dh) > 40_000_000 {
        return Err(IngestError::malformed(
            file,
            format!("its depth size {dw}x{dh} is not supported"),
        ));
    }
    let mut scan = Scan::new(&folder.root, "record3d");
    scan.camera_axes = CameraAxes::Opengl;
    scan.depth_scale_m = 1.0;
    for (i, [qx, qy, qz, qw, x, y, z]) in metadata.poses.iter().copied().enumerate() {
        let camera = match metadata.each.get(i).map(Vec::as_slice) {
            Some([fx, fy, cx, cy, ..]) => {
                Intrinsics { fx: *fx, fy: *fy, cx: *cx, cy: *cy, ..whole }
            }
            _ => whole,
        };
        let [color, depth, confidence] = files_of(i, is_export);
        let confidence = folder
            .root
            .join(&confidence)
            .is_file()
            .then_some(Confidence { file: confidence, at_least: LEAST_CONFIDENCE });
        let missing = [&color, &depth].into_iter().find(|file| !folder.root.join(file).is_file());
        let frame = match missing {
            Some(file) => Err(IngestError::MissingFile { file: file.clone() }),
            None => Ok(RawFrame {
                index: FrameIndex(0),
                time_s: None,
                color,
                depth,
                pose_file: entry_path(file, format_args!("pose {i}")),
                pose: pose_from_quaternion([x, y, z], [qx, qy, qz, qw]),
                color_intrinsics: camera,
                depth_intrinsics: camera.scaled_to(dw, dh),
                optics: Optics { confidence, ..Optics::default() },
            }),
        };
        scan.add(frame)?;
    }
    Ok(scan)
}
