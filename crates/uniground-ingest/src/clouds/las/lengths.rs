//! Compares the lengths that a LAZ file announces with the file's size before its reader allocates
//! memory for them (LAS 1.4, sections 2.4 to 2.7, and `LASzip`).

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};

const HEADER_1_4: usize = 375;
/// Size of the header of an extended variable length record.
const EVLR_HEADER_BYTES: u64 = 60;
/// Minimum size of a chunk. It begins with an uncompressed point.
const LEAST_CHUNK_BYTES: u64 = 20;

/// Checks that the announced lengths fit into the file. The inner `Err` is the reason if they do
/// not. The position of `source` is undefined afterwards.
pub(super) fn check(source: &mut File) -> io::Result<Result<(), &'static str>> {
    let bytes = source.metadata()?.len();
    let mut header = Vec::new();
    source.rewind()?;
    source.by_ref().take(HEADER_1_4 as u64).read_to_end(&mut header)?;
    if header.len() >= HEADER_1_4 && header[25] >= 4 {
        let (first, count) = (u64_at(&header, 235), u32_at(&header, 243));
        if !records_fit(source, first, count, bytes)? {
            return Ok(Err("its extended records are longer than the file"));
        }
    }
    if header.len() < 100 {
        return Ok(Err("it ends within its header"));
    }
    chunks_fit(source, u64::from(u32_at(&header, 96)), bytes)
}

/// Returns whether consecutive extended records lie within the file.
fn records_fit(source: &mut File, first: u64, count: u32, bytes: u64) -> io::Result<bool> {
    let mut at = first;
    for _ in 0..count {
        if at.checked_add(EVLR_HEADER_BYTES).is_none_or(|end| end > bytes) {
            return Ok(false);
        }
        source.seek(SeekFrom::Start(at + 20))?;
        let mut length = [0; 8];
        source.read_exact(&mut length)?;
        let end = (at + EVLR_HEADER_BYTES).checked_add(u64::from_le_bytes(length));
        match end.filter(|end| *end <= bytes) {
            Some(end) => at = end,
            None => return Ok(false),
        }
    }
    Ok(true)
}

/// Checks that the file has room for the number of chunks. The point data begins with the position
/// of the chunk table; -1: the position is at the end of the file.
fn chunks_fit(source: &mut File, points: u64, bytes: u64) -> io::Result<Result<(), &'static str>> {
    let mut eight = [0; 8];
    let mut i64_from = |from: u64| -> io::Result<Option<i64>> {
        if from.checked_add(8).is_none_or(|end| end > bytes) {
            return Ok(None);
        }
        source.seek(SeekFrom::Start(from))?;
        source.read_exact(&mut eight)?;
        Ok(Some(i64::from_le_bytes(eight)))
    };
    let table = match i64_from(points)? {
        Some(-1) => i64_from(bytes.saturating_sub(8))?,
        offset => offset,
    };
    // Points without a chunk table are read one after another.
    let Some(table) =
        table.and_then(|table| u64::try_from(table).ok()).filter(|table| *table > points)
    else {
        return Ok(Ok(()));
    };
    let Some(version_and_count) = i64_from(table)? else {
        return Ok(Err("its chunk table is past the end of the file"));
    };
    let count = version_and_count.cast_unsigned() >> 32;
    let room = bytes.saturating_sub(points) / LEAST_CHUNK_BYTES;
    Ok(if count > room { Err("it declares more chunks than fit in the file") } else { Ok(()) })
}

fn u32_at(header: &[u8], from: usize) -> u32 {
    u32::from_le_bytes(std::array::from_fn(|i| header[from + i]))
}

fn u64_at(header: &[u8], from: usize) -> u64 {
    u64::from_le_bytes(std::array::from_fn(|i| header[from + i]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;

    /// Creates a file with a version 1.4 header, followed by `rest`. Points start directly after
    /// the header.
    fn file(first_evlr: u64, evlrs: u32, rest: &[u8]) -> File {
        let mut bytes = vec![0; HEADER_1_4];
        bytes[..4].copy_from_slice(b"LASF");
        (bytes[24], bytes[25]) = (1, 4);
        bytes[96..100].copy_from_slice(&(HEADER_1_4 as u32).to_le_bytes());
        bytes[235..243].copy_from_slice(&first_evlr.to_le_bytes());
        bytes[243..247].copy_from_slice(&evlrs.to_le_bytes());
        bytes.extend(rest);
        let mut file = tempfile::tempfile().unwrap();
        file.write_all(&bytes).unwrap();
        file
    }

    fn evlr(length: u64, data: &[u8]) -> Vec<u8> {
        let mut record = vec![0; 60];
        record[20..28].copy_from_slice(&length.to_le_bytes());
        record.extend(data);
        record
    }

    /// Creates point data: the position of the chunk table, some points, and the table.
    fn points(table: i64, chunks: u32) -> Vec<u8> {
        let mut bytes = table.to_le_bytes().to_vec();
        bytes.extend([0; 32]);
        bytes.extend([0; 4]);
        bytes.extend(chunks.to_le_bytes());
        bytes
    }

    #[test]
    fn lengths_beyond_the_file_are_refused() {
        let end = HEADER_1_4 as u64 + 48;
        let table = HEADER_1_4 as i64 + 40;
        for (evlrs, records, chunks, is_fine) in [
            (0, Vec::new(), 2, true),
            (1, evlr(4, b"data"), 2, true),
            (1, evlr(5, b"data"), 2, false),
            (1, evlr(1 << 40, b"data"), 2, false),
            (1, evlr(u64::MAX, b"data"), 2, false),
            (2, evlr(4, b"data"), 2, false),
            (u32::MAX, evlr(4, b"data"), 2, false),
            (0, Vec::new(), u32::MAX, false),
        ] {
            let mut file = file(end, evlrs, &[points(table, chunks), records.clone()].concat());
            let checked = check(&mut file).unwrap();
            assert_eq!(
                checked.is_ok(),
                is_fine,
                "{evlrs} records of {records:?}, {chunks} chunks: {checked:?}"
            );
        }
        assert!(check(&mut file(u64::MAX, 1, &points(table, 2))).unwrap().is_err());
        assert!(
            check(&mut file(0, 0, &points(1 << 50, 2))).unwrap().is_err(),
            "chunk table beyond the end of the file"
        );
        assert!(
            check(&mut file(0, 0, b"")).unwrap().is_ok(),
            "without points, the reader reports the error"
        );
    }
}
