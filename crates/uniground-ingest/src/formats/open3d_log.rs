//! Open3D's reconstruction system: color and depth pictures next to a trajectory log with five
//! lines per pose (`trajectory.log`, `scene/integrated.log`), and the camera as JSON. Without a
//! camera, a PrimeSense sensor is assumed, as in Open3D's own examples.

use super::color_depth_pose::{
    FrameCameras, PoseFiles, ScanImages, UnmatchedImages, add_frames, find_cloud,
};
use super::files::{DEPTHS, FolderListing, PICTURES};
use super::{incomplete, intrinsics, trajectory};
use crate::IngestError;
use crate::scan::Scan;
use camino::{Utf8Path, Utf8PathBuf};
use uniground_geometry::scene::Intrinsics;
use uniground_types::findings::{Finding, FindingSubject};

const LOOKS_LIKE: &str = "an Open3D scene with a trajectory log";
const COLOR: &[&str] = &["color", "image", "rgb"];
const LOGS: &[&str] =
    &["trajectory.log", "scene/trajectory.log", "scene/integrated.log", "odometry.log"];
const PRIMESENSE: Intrinsics =
    Intrinsics { width: 640, height: 480, fx: 525.0, fy: 525.0, cx: 319.5, cy: 239.5 };

fn find_log(folder: &FolderListing) -> Option<Utf8PathBuf> {
    let other = || {
        folder
            .names()
            .iter()
            .find(|name| Utf8Path::new(name).extension() == Some("log"))
            .map(Utf8PathBuf::from)
    };
    folder.first_file(LOGS).or_else(other)
}

pub(super) fn can_read(folder: &FolderListing) -> bool {
    folder.has_folder("depth")
        && folder.first_folder(COLOR).is_some()
        && !folder.has_folder("pose")
        && find_log(folder).is_some()
}

pub(super) fn read(folder: &FolderListing) -> Result<Scan, IngestError> {
    let color = folder.files(folder.first_folder(COLOR).unwrap_or("color"), PICTURES)?;
    let pictures =
        ScanImages { color, depth: folder.files("depth", DEPTHS)?, confidence: Vec::new() };
    let Some(typical) = folder.typical_picture(&pictures.color) else {
        return Err(incomplete(LOOKS_LIKE, "its color pictures are missing"));
    };
    let mut scan = Scan::new(&folder.root, "open3d-log");
    let color = if intrinsics::find_color_file(folder).is_some() {
        intrinsics::read_color_intrinsics(folder, typical)?
    } else {
        scan.findings.push(
            Finding::assumed(
                FindingSubject::Camera,
                "unknown camera: a PrimeSense (525 525 319.5 239.5) is assumed; add intrinsic.txt or camera_intrinsic.json if that is wrong",
            )
            .stated_with("intrinsic.txt"),
        );
        PRIMESENSE
    };
    let file = find_log(folder).unwrap_or_else(|| LOGS[0].into());
    let poses = PoseFiles::List(trajectory::read(&folder.root, &file)?, file);
    add_frames(
        &mut scan,
        &pictures,
        &poses,
        &FrameCameras { color, depth: None },
        UnmatchedImages::Damaged,
    )?;
    scan.cloud = find_cloud(folder);
    Ok(scan)
}
