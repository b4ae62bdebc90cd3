//! Task folders of the UniGround benchmark: `task.json` next to `full_pcd.ply`, with Z up.

use super::files::FolderListing;
use super::incomplete;
use crate::IngestError;
use crate::scan::Scan;
use uniground_geometry::up_axis::UpAxis;

const CLOUD: &str = "full_pcd.ply";

pub(super) fn can_read(folder: &FolderListing) -> bool {
    folder.has_file("task.json")
        && (folder.has_file("ref.json") || folder.has_file("gt.json") || folder.has_file(CLOUD))
}

pub(super) fn read(folder: &FolderListing) -> Result<Scan, IngestError> {
    if !folder.has_file(CLOUD) {
        return Err(incomplete(
            "a task folder of the UniGround benchmark",
            format!("{CLOUD} is missing"),
        ));
    }
    Ok(Scan {
        cloud: Some(CLOUD.into()),
        up: Some(UpAxis::Z),
        ..Scan::new(&folder.root, "uniground-task")
    })
}
