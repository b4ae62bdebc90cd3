//! COLMAP: poses of pictures without depth, without a unit of length and without an up direction.
//! Its dense cloud can be read if the caller states the unit's length.

use super::files::FolderListing;
use super::incomplete;
use crate::IngestError;
use crate::scan::Scan;
use uniground_types::findings::{Finding, FindingSubject};

const LOOKS_LIKE: &str = "a COLMAP reconstruction";
const CLOUDS: &[&str] = &["fused.ply", "dense/fused.ply", "dense/0/fused.ply"];

pub(super) fn can_read(folder: &FolderListing) -> bool {
    ["", "sparse/", "sparse/0/"].iter().any(|at| {
        ["cameras.bin", "cameras.txt"].iter().any(|name| folder.has_file(&format!("{at}{name}")))
    })
}

pub(super) fn read(folder: &FolderListing) -> Result<Scan, IngestError> {
    let Some(cloud) = folder.first_file(CLOUDS) else {
        return Err(incomplete(
            LOOKS_LIKE,
            "it has no dense cloud (fused.ply): poses without depth are not supported. Make one with `colmap stereo_fusion` and set metres_per_unit",
        ));
    };
    let mut scan = Scan::new(&folder.root, "colmap-dense");
    let text = "its pictures are ignored: they have no depth";
    scan.findings.push(Finding::left_out(FindingSubject::Frames, text));
    scan.has_scale = false;
    scan.cloud = Some(cloud);
    Ok(scan)
}
