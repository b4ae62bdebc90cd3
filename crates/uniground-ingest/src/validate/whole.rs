//! Checks whether a picture file is complete, without decoding it. A truncated file would decode to
//! gray, or fail in the middle of a parse.

use crate::IngestError;
use camino::Utf8Path;
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};

/// Number of bytes at the end of a file in which the end marker must lie.
const TAIL: u64 = 4096;
const PNG: &[u8] = b"\x89PNG";
const PNG_END: &[u8] = b"IEND";
const JPEG: &[u8] = b"\xff\xd8";
const JPEG_END: &[u8] = b"\xff\xd9";

/// Refuses JPEG and PNG files without an end marker.
pub(super) fn check_is_complete(root: &Utf8Path, file: &Utf8Path) -> Result<(), IngestError> {
    let (head, tail) =
        ends(&root.join(file)).map_err(|source| IngestError::reading(file, source))?;
    let ends_with = |mark: &[u8]| tail.windows(mark.len()).any(|window| window == mark);
    let (kind, whole) = if head.starts_with(JPEG) {
        ("JPEG", ends_with(JPEG_END))
    } else if head.starts_with(PNG) {
        ("PNG", ends_with(PNG_END))
    } else {
        return Ok(());
    };
    match whole {
        true => Ok(()),
        false => Err(IngestError::malformed(
            file,
            format!("the {kind} is truncated: it has no end marker"),
        )),
    }
}

fn ends(path: &Utf8Path) -> io::Result<([u8; 4], Vec<u8>)> {
    let mut picture = File::open(path)?;
    let mut head = [0; 4];
    let read = picture.read(&mut head)?;
    head[read..].fill(0);
    let length = picture.metadata()?.len();
    picture.seek(SeekFrom::Start(length.saturating_sub(TAIL)))?;
    let mut tail = Vec::new();
    picture.take(TAIL).read_to_end(&mut tail)?;
    Ok((head, tail))
}
