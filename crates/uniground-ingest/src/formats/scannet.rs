//! ScanNet as written by its own exporter: `color/ depth/ pose/ intrinsic/`, with a separate depth
//! camera, next to the scan's mesh and `<scene>.txt`, whose axis alignment applies to poses and
//! mesh. Also the flat `posed_images/` of later toolboxes.

use super::color_depth_pose::{FrameCameras, PoseFiles, ScanImages, UnmatchedImages, add_frames};
use super::files::{DEPTHS, FolderListing, PICTURES};
use super::numbers::{find_values, matrix_from_values, parse};
use super::{incomplete, intrinsics};
use crate::IngestError;
use crate::scan::Scan;
use camino::{Utf8Path, Utf8PathBuf};
use nalgebra::Matrix4;
use uniground_types::findings::{Finding, FindingSubject};

const LOOKS_LIKE: &str = "a ScanNet export";
const MAX_META_BYTES: u64 = 1 << 20;
const COLOR_CAMERA: &str = "intrinsic/intrinsic_color.txt";
const DEPTH_CAMERA: &str = "intrinsic/intrinsic_depth.txt";
const MESHES: &[&str] = &["_vh_clean_2.ply", "_vh_clean.ply", ".aligned.ply"];

pub(super) fn can_read(folder: &FolderListing) -> bool {
    folder.has_folder("intrinsic") && (folder.has_folder("color") || folder.has_folder("pose"))
        || is_flat(folder)
}

/// Returns whether `00000.jpg`, `00000.png` and `00000.txt` are in one folder.
fn is_flat(folder: &FolderListing) -> bool {
    let has = |ending: &str| {
        folder
            .names()
            .iter()
            .any(|name| name.ends_with(ending) && name.starts_with(|c: char| c.is_ascii_digit()))
    };
    has(".jpg") && has(".png") && has(".txt") && intrinsics::find_color_file(folder).is_some()
}

pub(super) fn read(folder: &FolderListing) -> Result<Scan, IngestError> {
    let root = &folder.root;
    let mut scan = Scan::new(root, "scannet-export");
    let flat = is_flat(folder);
    let list = |name: &'static str, endings: &[&str]| match (flat, folder.has_folder(name)) {
        (true, _) => {
            let numbered =
                |file: &Utf8PathBuf| file.as_str().starts_with(|c: char| c.is_ascii_digit());
            Ok(folder.files("", endings)?.into_iter().filter(numbered).collect())
        }
        (false, true) => folder.files(name, endings),
        (false, false) => Err(incomplete(LOOKS_LIKE, format!("{name}/ is missing"))),
    };
    let color_endings = if flat { &["jpg", "jpeg"] } else { PICTURES };
    let pictures = ScanImages {
        color: list("color", color_endings)?,
        depth: list("depth", DEPTHS)?,
        confidence: Vec::new(),
    };
    let poses = list("pose", &["txt"])?;
    let typical = |pictures| folder.typical_picture(pictures);
    let (Some(color), Some(depth)) = (typical(&pictures.color), typical(&pictures.depth)) else {
        return Err(incomplete(LOOKS_LIKE, "its pictures are missing"));
    };
    let cameras = if flat || !folder.has_file(COLOR_CAMERA) {
        FrameCameras { color: intrinsics::read_color_intrinsics(folder, color)?, depth: None }
    } else {
        let depth_camera = folder
            .has_file(DEPTH_CAMERA)
            .then(|| intrinsics::read_intrinsics(root, Utf8Path::new(DEPTH_CAMERA), depth))
            .transpose()?;
        FrameCameras {
            color: intrinsics::read_intrinsics(root, Utf8Path::new(COLOR_CAMERA), color)?,
            depth: depth_camera,
        }
    };
    add_frames(&mut scan, &pictures, &PoseFiles::Files(poses), &cameras, UnmatchedImages::Damaged)?;
    let is_mesh = |file: &Utf8PathBuf| MESHES.iter().any(|ending| file.as_str().ends_with(ending));
    scan.cloud = folder
        .clouds(MESHES)
        .into_iter()
        .find(is_mesh)
        .or_else(|| super::color_depth_pose::find_cloud(folder));
    if let Some((alignment, file)) = read_alignment(folder)? {
        let text = format!("{file}: its axis alignment is applied to poses and cloud");
        scan.findings.push(Finding::changed(FindingSubject::Poses, text).in_file(file.as_str()));
        scan.alignment = Some(alignment);
    }
    Ok(scan)
}

/// Returns `axisAlignment` of the scene's text file, and that file, unless it is the identity.
fn read_alignment(
    folder: &FolderListing,
) -> Result<Option<(Matrix4<f64>, Utf8PathBuf)>, IngestError> {
    for name in folder
        .names()
        .iter()
        .filter(|name| name.starts_with("scene") && Utf8Path::new(name).extension() == Some("txt"))
    {
        let file = Utf8Path::new(name);
        let text = folder.root.read_text(file, MAX_META_BYTES)?;
        let Some(values) = find_values(&text, "axisAlignment") else { continue };
        let values = parse(values).map_err(|word| {
            IngestError::malformed(file, format!("axisAlignment: {word:?} is not a number"))
        })?;
        let matrix = matrix_from_values(&values).filter(|_| values.len() == 16);
        let matrix = matrix.ok_or_else(|| {
            IngestError::malformed(
                file,
                format!("axisAlignment has {} numbers, 16 are expected", values.len()),
            )
        })?;
        return Ok((matrix != Matrix4::identity()).then(|| (matrix, file.to_owned())));
    }
    Ok(None)
}
