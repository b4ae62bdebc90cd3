//! E57 (ASTM E2807), by the `e57` crate: clouds of terrestrial scanners. All scans of a file are
//! transformed into the file's own frame.

use super::gathered::{CloudBounds, GREY};
use super::{CloudBuilder, catch_panics};
use crate::IngestError;
use ::e57::{CartesianCoordinate, E57Reader};
use camino::Utf8Path;
use std::fs::File;
use std::io::{BufReader, Read, Seek};
use std::panic::AssertUnwindSafe;

/// Minimum size of a point. A count that does not fit into the file is refused.
const LEAST_BYTES_PER_POINT: u64 = 2;
/// Maximum size of the XML that describes a file. Parsed, it takes many times its size. A file with
/// a thousand scans has two megabytes of XML.
const MAX_XML_BYTES: u64 = 8 << 20;
/// Offset of the XML's length in the header (ASTM E2807, table 1).
const XML_LENGTH_AT: usize = 32;

pub(super) fn check(
    root: &Utf8Path,
    file: &Utf8Path,
    bounds: &CloudBounds,
) -> Result<(), IngestError> {
    catch_panics(file, AssertUnwindSafe(|| open(root, file, bounds).map(drop)))
}

pub(super) fn read(
    root: &Utf8Path,
    file: &Utf8Path,
    mut gathered: CloudBuilder,
) -> Result<CloudBuilder, IngestError> {
    let read = AssertUnwindSafe(move || {
        let malformed = |e: ::e57::Error| IngestError::malformed(file, e);
        let (mut reader, points) = open(root, file, &CloudBounds::OWN)?;
        gathered.expect(file, usize::try_from(points).unwrap_or(usize::MAX))?;
        let clouds = reader.pointclouds();
        gathered.set_has_color(clouds.iter().any(::e57::PointCloud::has_color));
        for cloud in clouds {
            let mut points = reader.pointcloud_simple(&cloud).map_err(malformed)?;
            points.apply_pose(true);
            points.spherical_to_cartesian(true);
            points.cartesian_to_spherical(false);
            points.intensity_to_color(false);
            for point in points {
                let point = point.map_err(malformed)?;
                let CartesianCoordinate::Valid { x, y, z } = point.cartesian else { continue };
                let color = point
                    .color
                    .map_or(GREY, |c| [c.red, c.green, c.blue].map(|c| (c * 255.0).round() as u8));
                gathered.push([x, y, z], color);
            }
        }
        Ok(gathered)
    });
    catch_panics(file, read)
}

fn open(
    root: &Utf8Path,
    file: &Utf8Path,
    bounds: &CloudBounds,
) -> Result<(E57Reader<BufReader<File>>, u64), IngestError> {
    let mut source =
        File::open(root.join(file)).map_err(|source| IngestError::reading(file, source))?;
    let mut header = [0; XML_LENGTH_AT + 8];
    source
        .read_exact(&mut header)
        .and_then(|()| source.rewind())
        .map_err(|source| IngestError::reading(file, source))?;
    let xml_bytes = u64::from_le_bytes(std::array::from_fn(|i| header[XML_LENGTH_AT + i]));
    let bytes = source.metadata().map_or(0, |m| m.len());
    let malformed = |reason: String| IngestError::malformed(file, reason);
    if xml_bytes > MAX_XML_BYTES {
        return Err(malformed(format!(
            "its XML section has {xml_bytes} bytes; the limit is {MAX_XML_BYTES}"
        )));
    }
    let reader = E57Reader::new(BufReader::new(source))
        .map_err(|e| malformed(format!("not an E57 file: {e}")))?;
    let points =
        reader.pointclouds().iter().fold(0_u64, |sum, cloud| sum.saturating_add(cloud.records));
    bounds.check(file, points)?;
    if points.saturating_mul(LEAST_BYTES_PER_POINT) > bytes {
        return Err(malformed(format!("it declares {points} points but has only {bytes} bytes")));
    }
    Ok((reader, points))
}
