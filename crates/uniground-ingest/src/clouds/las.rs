//! LAS and LAZ: surveying clouds, with Z up and often in map coordinates. The `las` crate unpacks
//! LAZ. This module reads LAS records, five times as fast.

mod lengths;
mod records;

use super::gathered::{CloudBounds, GREY};
use super::{CloudBuilder, catch_panics};
use crate::IngestError;
use camino::Utf8Path;
use std::fs::File;
use std::io::{BufReader, Seek};
use std::panic::AssertUnwindSafe;

/// Minimum size of 100 points. LAZ stores a point in one or two bytes at best.
const LEAST_BYTES_PER_100_POINTS: u64 = 20;

pub(super) fn check(
    root: &Utf8Path,
    file: &Utf8Path,
    bounds: &CloudBounds,
) -> Result<(), IngestError> {
    match records::LasRecords::open(root, file)? {
        Some(records) => records.check(file, bounds),
        None => catch_panics(file, AssertUnwindSafe(|| open(root, file, bounds).map(drop))),
    }
}

pub(super) fn read(
    root: &Utf8Path,
    file: &Utf8Path,
    gathered: CloudBuilder,
) -> Result<CloudBuilder, IngestError> {
    match records::LasRecords::open(root, file)? {
        Some(records) => records.read(file, gathered),
        None => read_compressed(root, file, gathered),
    }
}

fn read_compressed(
    root: &Utf8Path,
    file: &Utf8Path,
    mut gathered: CloudBuilder,
) -> Result<CloudBuilder, IngestError> {
    let read = AssertUnwindSafe(move || {
        let mut reader = open(root, file, &CloudBounds::OWN)?;
        let header = reader.header();
        let (points, colored) = (header.number_of_points(), header.point_format().has_color);
        gathered.expect(file, usize::try_from(points).unwrap_or(usize::MAX))?;
        gathered.set_has_color(colored);
        let mut wide: Vec<[u16; 3]> = Vec::new();
        for (row, point) in reader.points().enumerate() {
            let point =
                point.map_err(|e| IngestError::malformed(file, format!("point {row}: {e}")))?;
            let color = point.color.map(|c| [c.red, c.green, c.blue]);
            let before = gathered.len();
            gathered.push([point.x, point.y, point.z], GREY);
            if colored && gathered.len() > before {
                wide.push(color.unwrap_or_default());
            }
        }
        if (gathered.points_read() as u64) < points {
            return Err(IngestError::malformed(
                file,
                format!("truncated: {} of {points} points", gathered.points_read()),
            ));
        }
        if colored {
            gathered.set_wide_colors(&wide);
        }
        Ok(gathered)
    });
    catch_panics(file, read)
}

fn open(
    root: &Utf8Path,
    file: &Utf8Path,
    bounds: &CloudBounds,
) -> Result<las::Reader, IngestError> {
    let reading = |source| IngestError::reading(file, source);
    let mut source = File::open(root.join(file)).map_err(reading)?;
    let bytes = source.metadata().map_or(0, |m| m.len());
    let malformed = |reason: String| IngestError::malformed(file, reason);
    lengths::check(&mut source).map_err(reading)?.map_err(|reason| malformed(reason.into()))?;
    source.rewind().map_err(reading)?;
    let reader = las::Reader::new(BufReader::new(source))
        .map_err(|e| malformed(format!("not a LAS file: {e}")))?;
    let points = reader.header().number_of_points();
    bounds.check(file, points)?;
    if points / 100 * LEAST_BYTES_PER_100_POINTS > bytes {
        return Err(malformed(format!("it declares {points} points but has only {bytes} bytes")));
    }
    Ok(reader)
}
