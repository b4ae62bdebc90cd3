//! Readers with limits for untrusted input: the sizes that a file announces never decide how much
//! is read or held in memory.

use super::IngestError;
use camino::Utf8Path;
use std::cell::Cell;
use std::fs::File;
use std::io::{self, BufRead, Read, Seek, SeekFrom};
use std::rc::Rc;

/// Number of bytes that can still be read. Clones share it.
#[derive(Debug, Clone)]
pub(super) struct ReadLimit(Rc<Cell<u64>>);

impl ReadLimit {
    pub fn new(bytes: u64) -> Self {
        Self(Rc::new(Cell::new(bytes)))
    }

    /// Resets the limit to `bytes` more bytes.
    pub fn reset(&self, bytes: u64) {
        self.0.set(bytes);
    }

    /// Returns whether a reader exceeded the limit. All later reads fail.
    pub fn is_spent(&self) -> bool {
        self.0.get() == 0
    }
}

/// A reader that fails with an error when its limit is reached.
pub(super) struct LimitedReader<R> {
    inner: R,
    allowance: ReadLimit,
}

impl<R> LimitedReader<R> {
    pub fn new(inner: R, allowance: &ReadLimit) -> Self {
        Self { inner, allowance: allowance.clone() }
    }
}

impl<R: Read> Read for LimitedReader<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let n = self.inner.read(buffer)?;
        let left = self.allowance.0.get();
        // The last byte is never returned, so 0 means that the limit was exceeded.
        if n as u64 >= left {
            self.allowance.0.set(0);
            return Err(io::Error::other("there is more than may be read"));
        }
        self.allowance.0.set(left - n as u64);
        Ok(n)
    }
}

impl<R: Seek> Seek for LimitedReader<R> {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.inner.seek(to)
    }
}

/// Some editors put this before UTF-8 text.
pub(super) const BYTE_ORDER_MARK: &[u8] = b"\xef\xbb\xbf";

/// Reads a text file of at most `most` bytes, without a byte order mark.
pub(super) fn read_text(
    root: &Utf8Path,
    file: &Utf8Path,
    most: u64,
) -> Result<String, IngestError> {
    let mut text = String::new();
    File::open(root.join(file))
        .and_then(|source| source.take(most + 1).read_to_string(&mut text))
        .map_err(|source| IngestError::reading(file, source))?;
    match text.len() as u64 > most {
        true => Err(IngestError::malformed(file, format!("it is longer than {most} bytes"))),
        false => Ok(text.strip_prefix('\u{feff}').map(str::to_owned).unwrap_or(text)),
    }
}

/// Reads the next line without its line end, at most `most` bytes. Returns `false` at the end of
/// the file.
pub(super) fn read_line(
    source: &mut impl BufRead,
    line: &mut Vec<u8>,
    most: u64,
) -> io::Result<bool> {
    line.clear();
    source.take(most + 1).read_until(b'\n', line)?;
    if line.is_empty() {
        return Ok(false);
    }
    while line.ends_with(b"\n") || line.ends_with(b"\r") {
        line.pop();
    }
    if line.len() as u64 > most {
        return Err(io::Error::other(format!("a line is longer than {most} bytes")));
    }
    Ok(true)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn byte_order_mark_is_no_part_of_a_text() {
        let folder = tempfile::tempdir().unwrap();
        let root = Utf8Path::from_path(folder.path()).unwrap();
        std::fs::write(root.join("marked.txt"), b"\xef\xbb\xbf500 500").unwrap();
        assert_eq!(read_text(root, Utf8Path::new("marked.txt"), 100).unwrap(), "500 500");
    }

    #[test]
    fn input_beyond_the_limit_is_an_error() {
        let allowance = ReadLimit::new(101);
        let mut all = Vec::new();
        assert!(
            LimitedReader::new(&[7_u8; 100][..], &allowance).read_to_end(&mut all).is_ok()
                && !allowance.is_spent()
        );
        assert!(
            LimitedReader::new(&[7_u8; 100][..], &allowance).read_to_end(&mut all).is_err()
                && allowance.is_spent()
        );
        let mut line = Vec::new();
        let mut text = &b"ab\r\nabcde\n"[..];
        assert!(read_line(&mut text, &mut line, 4).unwrap() && line == b"ab");
        assert!(read_line(&mut text, &mut line, 4).is_err());
    }
}
