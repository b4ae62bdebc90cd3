//! Stray Scanner: `depth/ confidence/ odometry.csv camera_matrix.csv` and a video. Videos are not
//! decoded here. One command extracts their frames, and the error message names it.

use super::color_depth_pose::LEAST_CONFIDENCE;
use super::files::{DEPTHS, FolderListing, PICTURES, TextFiles};
use super::numbers::{parse, pose_from_quaternion};
use super::{entry_path, incomplete, intrinsics, pairing};
use crate::scan::{RawFrame, Scan};
use crate::{IngestError, MAX_FRAMES};
use camino::Utf8Path;
use std::collections::BTreeMap;
use uniground_geometry::scene::{Confidence, FrameIndex, Optics};
use uniground_geometry::up_axis::UpAxis;

const LOOKS_LIKE: &str = "a Stray Scanner recording";
const ODOMETRY: &str = "odometry.csv";
const CAMERA: &str = "camera_matrix.csv";
const MAX_BYTES: u64 = 64 << 20;

pub(super) fn can_read(folder: &FolderListing) -> bool {
    folder.has_file(ODOMETRY) && (folder.has_file(CAMERA) || folder.has_folder("depth"))
}

pub(super) fn read(folder: &FolderListing) -> Result<Scan, IngestError> {
    let root = &folder.root;
    if !folder.has_file(CAMERA) {
        return Err(incomplete(LOOKS_LIKE, format!("{CAMERA} is missing")));
    }
    if !folder.has_folder("depth") {
        return Err(incomplete(LOOKS_LIKE, "depth/ is missing"));
    }
    let color = if folder.has_folder("rgb") { folder.files("rgb", PICTURES)? } else { Vec::new() };
    let Some(first) = color.first() else {
        return Err(incomplete(
            LOOKS_LIKE,
            "its video cannot be decoded here: run `mkdir rgb && ffmpeg -i rgb.mp4 -start_number 0 -q:v 2 rgb/%06d.jpg` in its folder first",
        ));
    };
    let camera = intrinsics::read_intrinsics(root, Utf8Path::new(CAMERA), first)?;
    let depth = folder.files("depth", DEPTHS)?;
    let confidence = if folder.has_folder("confidence") {
        folder.files("confidence", &["png"])?
    } else {
        Vec::new()
    };
    let (depth_of, confidence_of) =
        (pairing::match_files(&color, &depth), pairing::match_files(&color, &confidence));
    let poses = read_poses(root)?;
    let mut scan = Scan::new(root, "stray-scanner");
    (scan.up, scan.by_gravity) = (Some(UpAxis::Y), true);
    for (i, picture) in color.iter().enumerate() {
        let pose = pairing::last_number(picture).and_then(|number| poses.get(&number));
        let frame = match (depth_of[i], pose) {
            (Some(depth_at), Some(pose)) => Ok(RawFrame {
                index: FrameIndex(0),
                time_s: None,
                color: picture.clone(),
                depth: depth[depth_at].clone(),
                pose_file: entry_path(Utf8Path::new(ODOMETRY), picture),
                pose: *pose,
                color_intrinsics: camera,
                depth_intrinsics: camera,
                optics: Optics {
                    confidence: confidence_of[i].map(|at| Confidence {
                        file: confidence[at].clone(),
                        at_least: LEAST_CONFIDENCE,
                    }),
                    ..Optics::default()
                },
            }),
            _ => Err(IngestError::FrameCountMismatch {
                color: color.len(),
                depth: depth.len(),
                pose: poses.len(),
                first: picture.clone(),
            }),
        };
        scan.add(frame)?;
    }
    Ok(scan)
}

/// Reads `timestamp, frame, x, y, z, qx, qy, qz, qw`, by the frame's number.
fn read_poses(root: &TextFiles) -> Result<BTreeMap<u64, nalgebra::Matrix4<f64>>, IngestError> {
    let file = Utf8Path::new(ODOMETRY);
    let text = root.read_text(file, MAX_BYTES)?;
    let mut poses = BTreeMap::new();
    // The first line names the columns.
    for (number, line) in
        text.lines().enumerate().skip(1).filter(|(_, line)| !line.trim().is_empty())
    {
        let values = parse(line).ok();
        let Some([_, frame, x, y, z, qx, qy, qz, qw, ..]) = values.as_deref() else {
            return Err(IngestError::malformed(
                file,
                format!("line {} is not nine numbers", number + 1),
            ));
        };
        poses.insert(*frame as u64, pose_from_quaternion([*x, *y, *z], [*qx, *qy, *qz, *qw]));
        if poses.len() > MAX_FRAMES {
            return Err(IngestError::malformed(file, format!("more than {MAX_FRAMES} poses")));
        }
    }
    Ok(poses)
}
