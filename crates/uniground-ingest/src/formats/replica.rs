//! Replica as rendered by NICE-SLAM: `results/frame*.jpg` and `depth*.png`, `traj.txt` with one
//! pose per line, and `cam_params.json` in the same folder or one folder up.

use super::color_depth_pose::{FrameCameras, PoseFiles, ScanImages, UnmatchedImages, add_frames};
use super::files::{DEPTHS, FolderListing, PICTURES, TextFiles};
use super::{incomplete, trajectory};
use crate::IngestError;
use crate::scan::Scan;
use camino::{Utf8Path, Utf8PathBuf};
use serde::Deserialize;
use uniground_geometry::scene::Intrinsics;
use uniground_types::findings::{Finding, FindingSubject};

const LOOKS_LIKE: &str = "a Replica sequence (NICE-SLAM)";
const CAMERA: &str = "cam_params.json";
const MAX_JSON_BYTES: u64 = 64 << 10;

#[derive(Deserialize)]
struct Parameters {
    camera: Camera,
}

#[derive(Deserialize)]
struct Camera {
    w: u32,
    h: u32,
    fx: f32,
    fy: f32,
    cx: f32,
    cy: f32,
    scale: f32,
}

/// The camera that all of Replica's rooms are rendered with.
const USUAL: Camera =
    Camera { w: 1200, h: 680, fx: 600.0, fy: 600.0, cx: 599.5, cy: 339.5, scale: 6553.5 };

/// Returns the folder of the room: this one, or the only one next to the camera's parameters.
fn find_room_folder(folder: &FolderListing) -> Option<String> {
    if folder.has_folder("results") {
        return Some(String::new());
    }
    let mut rooms = folder.folders().filter(|name| folder.has_folder(&format!("{name}/results")));
    let room = rooms.next().map(str::to_owned);
    room.filter(|_| folder.has_file(CAMERA) && rooms.next().is_none())
}

pub(super) fn can_read(folder: &FolderListing) -> bool {
    find_room_folder(folder).is_some()
}

pub(super) fn read(folder: &FolderListing) -> Result<Scan, IngestError> {
    let room = Utf8PathBuf::from(find_room_folder(folder).unwrap_or_default());
    let traj = room.join("traj.txt");
    if !folder.root.join(&traj).is_file() {
        return Err(incomplete(LOOKS_LIKE, "traj.txt is missing"));
    }
    let results = room.join("results");
    let named = |start: &str, endings: &[&str]| -> Result<Vec<Utf8PathBuf>, IngestError> {
        let files = folder.files(results.as_str(), endings)?;
        Ok(files
            .into_iter()
            .filter(|file| file.file_name().is_some_and(|name| name.starts_with(start)))
            .collect())
    };
    let pictures = ScanImages {
        color: named("frame", PICTURES)?,
        depth: named("depth", DEPTHS)?,
        confidence: Vec::new(),
    };
    if pictures.color.is_empty() || pictures.depth.is_empty() {
        return Err(incomplete(LOOKS_LIKE, "results/ has no frame* and depth* pictures"));
    }
    let mut scan = Scan::new(&folder.root, "replica");
    let file = [CAMERA.into(), room.join(CAMERA)]
        .into_iter()
        .find(|file| folder.root.join(file).is_file());
    let camera = if let Some(file) = file {
        read_parameters(&folder.root, &file)?
    } else {
        let text =
            format!("{CAMERA} is missing: assumed 1200x680, focal length 600, depth in 1/6553.5 m");
        scan.findings.push(Finding::assumed(FindingSubject::Camera, text).stated_with(CAMERA));
        USUAL
    };
    let Camera { w: width, h: height, fx, fy, cx, cy, scale } = camera;
    if !(scale.is_finite() && scale > 0.0) {
        return Err(IngestError::malformed(
            CAMERA,
            format!("scale is {scale}, it must be positive"),
        ));
    }
    scan.depth_scale_m = 1.0 / scale;
    let cameras = FrameCameras { color: Intrinsics { width, height, fx, fy, cx, cy }, depth: None };
    let poses = PoseFiles::List(trajectory::read(&folder.root, &traj)?, traj);
    add_frames(&mut scan, &pictures, &poses, &cameras, UnmatchedImages::Damaged)?;
    Ok(scan)
}

fn read_parameters(root: &TextFiles, file: &Utf8Path) -> Result<Camera, IngestError> {
    let text = root.read_text(file, MAX_JSON_BYTES)?;
    Ok(serde_json::from_str::<Parameters>(&text)
        .map_err(|e| IngestError::malformed(file, e))?
        .camera)
}
