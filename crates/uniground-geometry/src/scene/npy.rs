//! Two-dimensional arrays in numpy's format, version 1.

use std::io::{self, BufWriter, Write};

const MAGIC: &[u8] = b"\x93NUMPY\x01\x00";

/// Writes little-endian values of the type `descr`, row after row.
pub(super) fn write(
    out: impl Write,
    descr: &str,
    [rows, columns]: [usize; 2],
    bytes: impl Iterator<Item = u8>,
) -> io::Result<()> {
    let mut out = BufWriter::new(out);
    let header =
        format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': ({rows}, {columns}), }}");
    // Data begins at a multiple of 64 bytes; the header ends with a line break.
    let length = (MAGIC.len() + 2 + header.len() + 1).next_multiple_of(64) - MAGIC.len() - 2;
    out.write_all(MAGIC)?;
    out.write_all(&(length as u16).to_le_bytes())?;
    writeln!(out, "{header:<width$}", width = length - 1)?;
    for byte in bytes {
        out.write_all(&[byte])?;
    }
    out.flush()
}

/// Returns rows, columns and the value bytes of an array written by [`write`].
pub(super) fn read<'a>(bytes: &'a [u8], descr: &str) -> io::Result<([usize; 2], &'a [u8])> {
    let parse = || {
        let rest = bytes.strip_prefix(MAGIC)?;
        let (length, rest) = rest.split_first_chunk::<2>()?;
        let (header, values) = rest.split_at_checked(u16::from_le_bytes(*length).into())?;
        let header = std::str::from_utf8(header).ok()?;
        let shape = header.split_once("'shape': (")?.1.split_once(')')?.0;
        let (rows, columns) = shape.split_once(", ")?;
        let shape = [rows.parse().ok()?, columns.parse().ok()?];
        let size: usize = descr[2..].parse().ok()?;
        let whole =
            header.contains(&format!("'{descr}'")) && values.len() == shape[0] * shape[1] * size;
        whole.then_some((shape, values))
    };
    parse().ok_or_else(|| {
        io::Error::new(io::ErrorKind::InvalidData, format!("not a complete array of {descr}"))
    })
}
