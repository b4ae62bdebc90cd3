//! Layouts of scans. Each file knows one and describes it as a [`Scan`]; nothing is decoded here.
//! They are recognised by which files are there, the most particular first; what is recognised and
//! incomplete is refused with what it looks like and what is missing.

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
mod seven_scenes;
mod stray_scanner;
mod task_folder;
mod trajectory;
mod tum;

use super::scan::Scan;
use super::{IngestError, MAX_FRAMES};
use camino::{Utf8Path, Utf8PathBuf};
use files::FolderListing;

/// One way to lay out a scan.
struct Layout {
    recognises: fn(&FolderListing) -> bool,
    read: fn(&FolderListing) -> Result<Scan, IngestError>,
}

/// In the order they are tried.
const LAYOUTS: [Layout; 18] = [
    Layout { recognises: neutral::recognises, read: neutral::read },
    Layout { recognises: nerfstudio::recognises, read: nerfstudio::read },
    Layout { recognises: polycam::recognises, read: polycam::read },
    Layout { recognises: record3d::recognises, read: record3d::read },
    Layout { recognises: arkit_scenes::recognises, read: arkit_scenes::read },
    Layout { recognises: stray_scanner::recognises, read: stray_scanner::read },
    Layout { recognises: tum::recognises, read: tum::read },
    Layout { recognises: replica::recognises, read: replica::read },
    Layout { recognises: scanner_app::recognises, read: scanner_app::read },
    Layout { recognises: seven_scenes::recognises, read: seven_scenes::read },
    Layout { recognises: task_folder::recognises, read: task_folder::read },
    Layout { recognises: scannet::recognises, read: scannet::read },
    Layout { recognises: open3d_log::recognises, read: open3d_log::read },
    Layout { recognises: rtabmap::recognises, read: rtabmap::read },
    Layout { recognises: color_depth_pose::recognises_posed, read: color_depth_pose::read },
    Layout { recognises: colmap::recognises, read: colmap::read },
    Layout { recognises: lone_cloud::recognises, read: lone_cloud::read },
    Layout { recognises: color_depth_pose::recognises, read: color_depth_pose::read },
];

/// Folders one in another that an archive is stepped into.
const MAX_STEPS: usize = 6;

/// Reads the layout below `folder` without checking it.
///
/// # Errors
/// [`IngestError`] naming the file, or what the folder holds instead of a scan.
pub(super) fn read(folder: &Utf8Path) -> Result<Scan, IngestError> {
    let mut folder = FolderListing::open(folder)?;
    for _ in 0..MAX_STEPS {
        if let Some(layout) = LAYOUTS.iter().find(|layout| (layout.recognises)(&folder)) {
            let scan = (layout.read)(&folder)?;
            check_frames(scan.format, scan.frames.len())?;
            return Ok(scan);
        }
        // Archives are often made of one folder: step into it.
        match folder.only_folder() {
            Some(inner) => folder = FolderListing::open(&folder.root.join(inner))?,
            None => break,
        }
    }
    Err(IngestError::UnknownLayout { found: folder.describe() })
}

/// Refuses a scan of more frames than are read.
fn check_frames(file: &str, frames: usize) -> Result<(), IngestError> {
    match frames > MAX_FRAMES {
        true => Err(IngestError::malformed(
            file,
            format!("{frames} frames, {MAX_FRAMES} are read at most: leave some out"),
        )),
        false => Ok(()),
    }
}

/// What is recognised and lacks something.
fn incomplete(looks_like: &'static str, missing: impl Into<String>) -> IngestError {
    IngestError::IncompleteLayout { looks_like, missing: missing.into() }
}

/// A path in a list of frames: a file, or one of the lines or entries of a file.
fn entry(file: &Utf8Path, entry: impl std::fmt::Display) -> Utf8PathBuf {
    format!("{file}, {entry}").into()
}
