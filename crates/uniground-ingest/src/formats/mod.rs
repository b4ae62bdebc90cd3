//! Layouts of scans. Each file of this folder describes one layout as a [`Scan`]. Nothing is
//! decoded here. Layouts are recognized by which files exist, the most specific first. A layout
//! that is recognized but incomplete is refused with its name and what is missing.

mod arkit_scenes;
mod colmap;
mod color_depth_pose;
mod files;
mod intrinsics;
mod listed;
mod lone_cloud;
mod nerfstudio;
mod neutral;
mod numbers;
mod open3d_log;
mod pairing;
mod polycam;
mod record3d;
mod replica;
mod rtabmap;
mod scanner_app;
mod scannet;
mod scannetpp;
mod seven_scenes;
mod stray_scanner;
mod task_folder;
mod trajectory;
mod tum;

use super::scan::Scan;
use super::{IngestError, MAX_FRAMES};
use camino::{Utf8Path, Utf8PathBuf};
use files::FolderListing;
pub(super) use files::is_of_system;

/// A layout of a scan's files.
struct Layout {
    can_read: fn(&FolderListing) -> bool,
    read: fn(&FolderListing) -> Result<Scan, IngestError>,
}

/// All layouts, in the order in which they are tried.
const LAYOUTS: [Layout; 19] = [
    Layout { can_read: neutral::can_read, read: neutral::read },
    Layout { can_read: nerfstudio::can_read, read: nerfstudio::read },
    Layout { can_read: polycam::can_read, read: polycam::read },
    Layout { can_read: record3d::can_read, read: record3d::read },
    Layout { can_read: scannetpp::can_read, read: scannetpp::read },
    Layout { can_read: arkit_scenes::can_read, read: arkit_scenes::read },
    Layout { can_read: stray_scanner::can_read, read: stray_scanner::read },
    Layout { can_read: tum::can_read, read: tum::read },
    Layout { can_read: replica::can_read, read: replica::read },
    Layout { can_read: scanner_app::can_read, read: scanner_app::read },
    Layout { can_read: seven_scenes::can_read, read: seven_scenes::read },
    Layout { can_read: task_folder::can_read, read: task_folder::read },
    Layout { can_read: scannet::can_read, read: scannet::read },
    Layout { can_read: open3d_log::can_read, read: open3d_log::read },
    Layout { can_read: rtabmap::can_read, read: rtabmap::read },
    Layout { can_read: color_depth_pose::can_read_posed, read: color_depth_pose::read },
    Layout { can_read: colmap::can_read, read: colmap::read },
    Layout { can_read: lone_cloud::can_read, read: lone_cloud::read },
    Layout { can_read: color_depth_pose::can_read, read: color_depth_pose::read },
];

/// Maximum number of nested folders that are entered.
const MAX_STEPS: usize = 6;

/// Reads the layout below `folder` without checking it.
///
/// # Errors
/// Returns an [`IngestError`] that names the file, or the content of a folder that is not a scan.
pub(super) fn read(folder: &Utf8Path) -> Result<Scan, IngestError> {
    let mut folder = FolderListing::open(folder)?;
    for _ in 0..MAX_STEPS {
        if let Some(layout) = LAYOUTS.iter().find(|layout| (layout.can_read)(&folder)) {
            let mut scan = (layout.read)(&folder)?;
            check_frames(scan.format, scan.frames.len())?;
            scan.described_by = folder.root.into_read();
            return Ok(scan);
        }
        // Archives often consist of one folder: enter it.
        match folder.only_folder() {
            Some(inner) => folder = FolderListing::open(&folder.root.join(inner))?,
            None => break,
        }
    }
    let scans = scans_within(&folder);
    let found = match scans.len() {
        0 | 1 => folder.describe(),
        n => format!("{n} scans ({}): upload each of them alone", scans.join(", ")),
    };
    Err(IngestError::UnknownLayout { found })
}

/// Returns the folders within this one that are scans by themselves.
fn scans_within(folder: &FolderListing) -> Vec<String> {
    let is_scan = |name: &&str| {
        let inner = FolderListing::open(&folder.root.join(name));
        inner.is_ok_and(|inner| LAYOUTS.iter().any(|layout| (layout.can_read)(&inner)))
    };
    folder.folders().filter(is_scan).map(|name| format!("{name}/")).collect()
}

/// Refuses a scan with more than the maximum number of frames.
fn check_frames(file: &str, frames: usize) -> Result<(), IngestError> {
    match frames > MAX_FRAMES {
        true => Err(IngestError::malformed(
            file,
            format!("{frames} frames; the limit is {MAX_FRAMES}: leave some out"),
        )),
        false => Ok(()),
    }
}

/// Builds the error for a recognized layout with something missing.
fn incomplete(looks_like: &'static str, missing: impl Into<String>) -> IngestError {
    IngestError::IncompleteLayout { looks_like, missing: missing.into() }
}

/// Builds the path of a frame in a list: a file, followed by a line or an entry of that file.
fn entry_path(file: &Utf8Path, entry: impl std::fmt::Display) -> Utf8PathBuf {
    format!("{file}, {entry}").into()
}
