//! The plain layout: `color/ depth/ pose/ intrinsic.txt` and, optionally, `cloud.ply`; or `cloud.ply` alone.
//!
//! Files belong together by stem (`color/7.jpg`, `depth/7.png`, `pose/7.txt`); order is by number, so `10` follows `9`.

use super::{check_frames, entries, read_numbers, read_pose};
use crate::ingest::IngestError;
use crate::ingest::scan::{CameraAxes, RawFrame, Scan, picture_size};
use crate::scene::{FrameIndex, Intrinsics, PoseConvention};
use camino::{Utf8Path, Utf8PathBuf};
use std::collections::BTreeMap;

const CLOUD: &str = "cloud.ply";
const INTRINSICS: &str = "intrinsic.txt";

pub(super) fn recognises(root: &Utf8Path) -> bool {
    ["color", "depth", "pose", CLOUD].iter().any(|name| root.join(name).exists())
}

pub(super) fn read(root: &Utf8Path) -> Result<Scan, IngestError> {
    let cloud = root.join(CLOUD).is_file().then(|| Utf8PathBuf::from(CLOUD));
    let [colour, depth, pose] = [("color", &["jpg", "jpeg", "png"][..]), ("depth", &["png"]), ("pose", &["txt"])]
        .map(|(folder, endings)| by_stem(root, folder, endings));
    let (colour, depth, pose) = (colour?, depth?, pose?);
    let unpaired = [&colour, &depth, &pose]
        .into_iter()
        .flatten()
        .find(|(stem, _)| !(colour.contains_key(stem) && depth.contains_key(stem) && pose.contains_key(stem)));
    if let Some((_, first)) = unpaired {
        return Err(IngestError::FrameCountMismatch { colour: colour.len(), depth: depth.len(), pose: pose.len(), first: first.clone() });
    }
    check_frames("color", colour.len())?;
    let mut frames = Vec::with_capacity(colour.len());
    if let Some(first) = colour.values().next() {
        let intrinsics = read_intrinsics(root, first)?;
        for (stem, colour) in &colour {
            let pose_file = pose[stem].clone();
            frames.push(RawFrame {
                index: FrameIndex(0),
                colour: colour.clone(),
                depth: depth[stem].clone(),
                pose: read_pose(root, &pose_file)?,
                pose_file,
                colour_intrinsics: intrinsics,
                depth_intrinsics: intrinsics,
            });
        }
    }
    Ok(Scan {
        root: root.to_owned(),
        format: "color-depth-pose",
        name: None,
        cloud,
        frames,
        up: None,
        camera_axes: CameraAxes::Opencv,
        pose: PoseConvention::CameraToWorld,
        depth_scale_m: 0.001,
        frames_skipped: 0,
        warnings: Vec::new(),
    })
}

/// A stem in natural order: its digits as a number first, then its text.
type Stem = (Option<u64>, String);

fn by_stem(root: &Utf8Path, folder: &str, endings: &[&str]) -> Result<BTreeMap<Stem, Utf8PathBuf>, IngestError> {
    if !root.join(folder).is_dir() {
        return Ok(BTreeMap::new());
    }
    let mut files = BTreeMap::new();
    for name in entries(&root.join(folder))? {
        let path = Utf8Path::new(&name);
        let (Some(stem), Some(ending)) = (path.file_stem(), path.extension()) else { continue };
        if !endings.contains(&ending.to_ascii_lowercase().as_str()) {
            continue;
        }
        let digits: String = stem.chars().filter(char::is_ascii_digit).collect();
        let file = Utf8Path::new(folder).join(&name);
        if let Some(other) = files.insert((digits.parse().ok(), stem.to_owned()), file) {
            return Err(IngestError::malformed(other, format!("another file in {folder}/ has the same stem")));
        }
    }
    Ok(files)
}

/// A 3x3 or 4x4 camera matrix; the size comes from the first colour picture, which is what the matrix describes.
fn read_intrinsics(root: &Utf8Path, first_colour: &Utf8Path) -> Result<Intrinsics, IngestError> {
    let file = Utf8Path::new(INTRINSICS);
    if !root.join(file).is_file() {
        return Err(IngestError::MissingIntrinsics { file: file.into() });
    }
    let m = read_numbers(root, file)?;
    let columns = match m.len() {
        9 => 3,
        16 => 4,
        n => return Err(IngestError::malformed(file, format!("a camera matrix has 9 or 16 numbers, this file has {n}"))),
    };
    let (width, height) = picture_size(root, first_colour)?;
    Ok(Intrinsics { width, height, fx: m[0], fy: m[columns + 1], cx: m[2], cy: m[columns + 2] })
}
