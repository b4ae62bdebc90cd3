//! `ScanNet`++ of an iPhone, with the pictures extracted by its toolkit: `rgb/`, `depth/`, and all
//! poses and intrinsics in one file.

use super::color_depth_pose::find_cloud;
use super::files::{DEPTHS, FolderListing, PICTURES};
use super::{entry_path, incomplete, pairing};
use crate::IngestError;
use crate::scan::{RawFrame, Scan, picture_size};
use camino::{Utf8Path, Utf8PathBuf};
use nalgebra::Matrix4;
use serde::Deserialize;
use std::collections::BTreeMap;
use uniground_geometry::scene::{FrameIndex, Intrinsics, Optics};

const LOOKS_LIKE: &str = "ScanNet++ of an iPhone";
const FILE: &str = "pose_intrinsic_imu.json";
const MAX_BYTES: u64 = 512 << 20;

#[derive(Deserialize)]
struct Entry {
    /// In the world of the laser scan, where the capture was aligned with it.
    #[serde(default, alias = "aligned_poses")]
    aligned_pose: Option<[[f64; 4]; 4]>,
    #[serde(default, alias = "poses")]
    pose: Option<[[f64; 4]; 4]>,
    intrinsic: [[f32; 3]; 3],
}

pub(super) fn can_read(folder: &FolderListing) -> bool {
    folder.has_file(FILE)
}

pub(super) fn read(folder: &FolderListing) -> Result<Scan, IngestError> {
    let list = |name: &str, endings: &[&str]| match folder.has_folder(name) {
        true => folder.files(name, endings),
        false => Ok(Vec::new()),
    };
    let (color, depth) = (list("rgb", PICTURES)?, list("depth", DEPTHS)?);
    for (files, name) in [(&color, "rgb"), (&depth, "depth")] {
        if files.is_empty() {
            return Err(incomplete(
                LOOKS_LIKE,
                format!(
                    "there are no pictures in {name}/: extract them with the ScanNet++ toolkit"
                ),
            ));
        }
    }
    let file = Utf8Path::new(FILE);
    let entries: BTreeMap<String, Entry> =
        serde_json::from_str(&folder.root.read_text(file, MAX_BYTES)?)
            .map_err(|e| IngestError::malformed(file, e))?;
    let is_aligned = entries.values().all(|entry| entry.aligned_pose.is_some());
    let named: Vec<Utf8PathBuf> = entries.keys().map(Utf8PathBuf::from).collect();
    let depth_of = pairing::match_files(&color, &depth);
    let pose_of = pairing::match_files(&color, &named);
    let entries: Vec<Entry> = entries.into_values().collect();
    let mut scan = Scan::new(&folder.root, "scannetpp");
    scan.cloud = find_cloud(folder);
    for ((color, depth_at), pose_at) in color.into_iter().zip(depth_of).zip(pose_of) {
        // The toolkit can extract every tenth frame only, and poses are of all of them.
        let (Some(depth_at), Some(pose_at)) = (depth_at, pose_at) else {
            scan.add(Err(IngestError::malformed(color, "there is no depth or no pose for it")))?;
            continue;
        };
        let source = entry_path(file, &named[pose_at]);
        let frame = frame(folder, color, &depth[depth_at], &entries[pose_at], is_aligned, source);
        scan.add(frame)?;
    }
    Ok(scan)
}

fn frame(
    folder: &FolderListing,
    color: Utf8PathBuf,
    depth: &Utf8Path,
    entry: &Entry,
    is_aligned: bool,
    source: Utf8PathBuf,
) -> Result<RawFrame, IngestError> {
    let pose = if is_aligned { entry.aligned_pose } else { entry.pose };
    let rows = pose.ok_or_else(|| IngestError::malformed(source.clone(), "it has no pose"))?;
    let size = |file: &Utf8Path| {
        picture_size(&folder.root, file)?
            .filter(|(width, height)| *width > 0 && *height > 0)
            .ok_or_else(|| IngestError::malformed(file, "its size in pixels is unknown"))
    };
    let [[fx, _, cx], [_, fy, cy], _] = entry.intrinsic;
    let (width, height) = size(&color)?;
    let camera = Intrinsics { width, height, fx, fy, cx, cy };
    let (depth_width, depth_height) = size(depth)?;
    Ok(RawFrame {
        index: FrameIndex(0),
        time_s: None,
        color,
        depth: depth.to_owned(),
        pose_file: source,
        pose: Matrix4::from_fn(|row, column| rows[row][column]),
        color_intrinsics: camera,
        depth_intrinsics: camera.scaled_to(depth_width, depth_height),
        optics: Optics::default(),
    })
}
