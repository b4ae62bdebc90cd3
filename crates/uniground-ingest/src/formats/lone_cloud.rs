//! A single cloud or mesh without frames.

use super::color_depth_pose::CLOUD;
use super::files::FolderListing;
use crate::IngestError;
use crate::clouds::CloudKind;
use crate::scan::Scan;
use uniground_types::findings::{Finding, FindingSubject};

pub(super) fn can_read(folder: &FolderListing) -> bool {
    let posed = ["color", "depth", "pose"].iter().any(|name| folder.has_folder(name));
    !posed && !folder.clouds(&[]).is_empty()
}

/// Reads the cloud with a preferred name, or the largest file.
pub(super) fn read(folder: &FolderListing) -> Result<Scan, IngestError> {
    let clouds = folder.clouds(CLOUD);
    let Some(cloud) = clouds.first() else { return Err(IngestError::EmptyScene) };
    let mut scan = Scan::new(
        &folder.root,
        CloudKind::detect(&folder.root.join(cloud)).map_or("ply", CloudKind::name),
    );
    if clouds.len() > 1 {
        let text = format!(
            "{cloud} is used; {} other clouds are ignored, the first: {}",
            clouds.len() - 1,
            clouds[1]
        );
        scan.findings.push(
            Finding::left_out(FindingSubject::Cloud, text)
                .in_file(clouds[1].as_str())
                .counting(clouds.len() - 1),
        );
    }
    scan.cloud = Some(cloud.clone());
    Ok(scan)
}
