//! Turns bytes into a [`SceneBundle`]: unpacks an archive, recognizes its layout, checks it and
//! loads it.
//!
//! There are two steps. [`open`] runs while the caller waits: it reads manifests, poses and picture
//! headers, and refuses what cannot become a scene. [`load`] runs in the parse job: it reads or
//! fuses the cloud and checks that cloud, poses and depth agree. Everything that this crate returns
//! is canonical (meters, Z up, OpenCV cameras, camera-to-world).

#![warn(missing_docs)]

pub mod archive;
mod cloud_doubts;
mod clouds;
mod error;
mod formats;
mod frame_agreement;
mod fusion;
mod growth;
mod guess_units;
mod inventory;
mod levelling;
mod limited_reader;
mod load;
mod neighbors;
mod parts;
mod reprojection;
mod scan;
mod sens;
mod unpacked;
mod validate;

pub use error::{IngestError, IngestErrorKind};
pub use growth::{FitReport, add_scan, check_fit};
pub use load::{InspectedScan, check, inspect, load, read_cloud};
pub use neighbors::{NeighborAgreement, compare_neighbors};
pub use parts::{GROWN, GrownScan, ScanPart, is_reserved, part_folder};
pub use scan::Scan;
pub use unpacked::{ArchiveFormat, ScanFolder, describe_content, read_head};

use camino::Utf8Path;

/// Maximum number of points that are kept of an upload's own cloud. A room with one point per 5 mm
/// has fewer. Larger clouds are thinned out by keeping every n-th point.
pub const MAX_POINTS: usize = 8_000_000;
/// Limits on clouds of uploads.
const UPLOADED: clouds::CloudBounds =
    clouds::CloudBounds { announced: 200_000_000, kept: MAX_POINTS };
/// Maximum number of frames of an upload: half an hour of video at 30 frames per second.
pub const MAX_FRAMES: usize = 54_000;

/// Recognizes the layout below `folder` and checks everything that can be checked without decoding
/// pictures.
///
/// # Errors
/// Returns an [`IngestError`] that names the file, frame or field.
pub fn open(folder: &Utf8Path) -> Result<Scan, IngestError> {
    let mut scan = formats::read(folder)?;
    inventory::record(folder, &mut scan);
    validate::check(&mut scan)?;
    scan.findings.extend(inventory::find_copies(&scan));
    Ok(scan)
}
