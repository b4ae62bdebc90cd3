//! RTAB-Map's export: `rgb/ depth/ calib/` (or `<name>_rgb/` and so on) and camera poses with
//! times, in a world with Z up.

use super::color_depth_pose::{FrameCameras, PoseFiles, ScanImages, UnmatchedImages, add_frames};
use super::files::{DEPTHS, FolderListing, PICTURES, TextFiles};
use super::{incomplete, trajectory};
use crate::IngestError;
use crate::scan::Scan;
use camino::{Utf8Path, Utf8PathBuf};
use uniground_geometry::scene::Intrinsics;
use uniground_types::findings::{Finding, FindingSubject};

const LOOKS_LIKE: &str = "an RTAB-Map export";
const MAX_CALIBRATION_BYTES: u64 = 64 << 10;

/// Returns the folder with this name, alone or after the database's name.
fn find_folder(folder: &FolderListing, name: &str) -> Option<String> {
    let is = |other: &&str| *other == name || other.ends_with(&format!("_{name}"));
    folder.folders().find(is).map(str::to_owned)
}

/// Returns the file of the camera's poses if it exists. The poses of the robot's base differ.
fn find_poses_file(folder: &FolderListing) -> Option<Utf8PathBuf> {
    let ends = |ending: &str| {
        folder.names().iter().find(|name| name.ends_with(ending)).map(Utf8PathBuf::from)
    };
    ends("camera_poses.txt").or_else(|| ends("poses.txt"))
}

pub(super) fn can_read(folder: &FolderListing) -> bool {
    find_folder(folder, "calib").is_some() && find_folder(folder, "rgb").is_some()
}

pub(super) fn read(folder: &FolderListing) -> Result<Scan, IngestError> {
    let missing = |what: &str| incomplete(LOOKS_LIKE, format!("{what} is missing"));
    let [rgb, depth, calibration] = ["rgb", "depth", "calib"]
        .map(|name| find_folder(folder, name).ok_or_else(|| missing(name)));
    let (rgb, depth, calibration) = (rgb?, depth?, calibration?);
    let file = find_poses_file(folder).ok_or_else(|| {
        missing(
            "the file with the camera's poses (rtabmap-export --poses_camera --poses_format 10)",
        )
    })?;
    let pictures = ScanImages {
        color: folder.files(&rgb, PICTURES)?,
        depth: folder.files(&depth, DEPTHS)?,
        confidence: Vec::new(),
    };
    let calibrations = folder.files(&calibration, &["yaml", "yml"])?;
    let first = calibrations.first().ok_or_else(|| missing("the camera's calibration"))?;
    let mut scan = Scan::new(&folder.root, "rtabmap");
    scan.up = Some(uniground_geometry::up_axis::UpAxis::Z);
    if !file.as_str().ends_with("camera_poses.txt") {
        let text = format!(
            "{file} is assumed to hold the camera's poses. If they are a robot base's, export with --poses_camera"
        );
        scan.findings.push(
            Finding::assumed(FindingSubject::Poses, text)
                .in_file(file.as_str())
                .stated_with("camera_poses.txt"),
        );
    }
    let cameras = FrameCameras { color: read_camera(&folder.root, first)?, depth: None };
    let poses = PoseFiles::List(trajectory::read(&folder.root, &file)?, file);
    add_frames(&mut scan, &pictures, &poses, &cameras, UnmatchedImages::LeftOut)?;
    scan.cloud = folder
        .clouds(&["_cloud.ply", "cloud.ply", "_mesh.ply"])
        .into_iter()
        .find(|file| file.extension() == Some("ply"));
    Ok(scan)
}

/// Reads OpenCV's YAML: `image_width`, `image_height`, and the projection matrix, which is that of
/// the rectified picture.
fn read_camera(root: &TextFiles, file: &Utf8Path) -> Result<Intrinsics, IngestError> {
    let text = root.read_text(file, MAX_CALIBRATION_BYTES)?;
    let missing =
        |key: &str| IngestError::malformed(file, format!("{key} is missing or not a number"));
    let number = |key: &str| -> Result<u32, IngestError> {
        let line = text.lines().find_map(|line| line.trim().strip_prefix(key)?.strip_prefix(':'));
        line.and_then(|v| v.trim().parse().ok()).ok_or_else(|| missing(key))
    };
    let matrix = |key: &str| -> Option<Vec<f64>> {
        let after = &text[text.find(key)?..];
        let data = &after[after.find("data:")?..];
        super::numbers::parse(&data[data.find('[')? + 1..data.find(']')?]).ok()
    };
    let (projection, camera) = (
        matrix("projection_matrix").filter(|m| m.len() == 12),
        matrix("camera_matrix").filter(|m| m.len() == 9),
    );
    let at = match (&projection, &camera) {
        (Some(m), _) if m[0] > 0.0 => [m[0], m[5], m[2], m[6]],
        (_, Some(m)) => [m[0], m[4], m[2], m[5]],
        _ => return Err(missing("camera_matrix")),
    };
    let [fx, fy, cx, cy] = at.map(|v| v as f32);
    Ok(Intrinsics {
        width: number("image_width")?,
        height: number("image_height")?,
        fx,
        fy,
        cx,
        cy,
    })
}
