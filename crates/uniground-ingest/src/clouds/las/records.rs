//! Point records of an uncompressed LAS file (ASPRS, 1.0 to 1.4).

use crate::IngestError;
use crate::clouds::CloudBuilder;
use crate::clouds::gathered::{CloudBounds, GREY};
use camino::Utf8Path;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};

/// Header size of version 1.0, and of version 1.4 with its 64-bit count.
const SHORT_HEADER: usize = 227;
const LONG_HEADER: usize = 375;
const BLOCK_BYTES: usize = 256 << 10;

/// An opened file, positioned at its first record.
pub(super) struct LasRecords {
    source: BufReader<File>,
    points: u64,
    bytes: usize,
    /// Number of bytes of the file from its first record on.
    file_bytes: u64,
    /// Offset of red, green and blue, 16 bits each.
    color: Option<usize>,
    scale: [f64; 3],
    offset: [f64; 3],
}

impl LasRecords {
    /// Opens a file. Returns `None` for a compressed one.
    pub fn open(root: &Utf8Path, file: &Utf8Path) -> Result<Option<Self>, IngestError> {
        let io = |source| IngestError::reading(file, source);
        let malformed = |reason: &str| IngestError::malformed(file, reason);
        let mut source = File::open(root.join(file)).map_err(io)?;
        let mut header = Vec::new();
        (&mut source).take(LONG_HEADER as u64).read_to_end(&mut header).map_err(io)?;
        if header.len() < SHORT_HEADER {
            return Err(malformed("not a LAS file: it ends within its header"));
        }
        let format = header[104];
        if format & 0b1100_0000 != 0 {
            return Ok(None);
        }
        fn bytes_at<const N: usize>(header: &[u8], from: usize) -> [u8; N] {
            std::array::from_fn(|i| header[from + i])
        }
        let three =
            |from: usize| [0, 1, 2].map(|i| f64::from_le_bytes(bytes_at(&header, from + 8 * i)));
        let bytes = usize::from(u16::from_le_bytes(bytes_at(&header, 105)));
        let color = match format {
            2 => Some(20),
            3 | 5 => Some(28),
            7 | 8 | 10 => Some(30),
            0 | 1 | 4 | 6 | 9 => None,
            _ => return Err(malformed("its point format is not supported")),
        };
        if bytes < color.map_or(20, |color| color + 6) {
            return Err(malformed("its point records are too short"));
        }
        let is_long = header[25] >= 4 && header.len() == LONG_HEADER;
        let points = match is_long {
            true => u64::from_le_bytes(bytes_at(&header, 247)),
            false => u64::from(u32::from_le_bytes(bytes_at(&header, 107))),
        };
        let start = u64::from(u32::from_le_bytes(bytes_at(&header, 96)));
        let file_bytes = source.metadata().map_err(io)?.len().saturating_sub(start);
        source.seek(SeekFrom::Start(start)).map_err(io)?;
        let source = BufReader::with_capacity(BLOCK_BYTES, source);
        Ok(Some(Self {
            source,
            points,
            bytes,
            file_bytes,
            color,
            scale: three(131),
            offset: three(155),
        }))
    }

    /// Checks that the announced number of points is allowed and fits into the file.
    pub fn check(&self, file: &Utf8Path, bounds: &CloudBounds) -> Result<(), IngestError> {
        bounds.check(file, self.points)?;
        self.check_length(file)
    }

    fn check_length(&self, file: &Utf8Path) -> Result<(), IngestError> {
        match self.points.saturating_mul(self.bytes as u64) > self.file_bytes {
            true => {
                let reason = format!(
                    "it declares {} points but has only {} bytes of them",
                    self.points, self.file_bytes
                );
                Err(IngestError::malformed(file, reason))
            }
            false => Ok(()),
        }
    }

    pub fn read(
        mut self,
        file: &Utf8Path,
        mut gathered: CloudBuilder,
    ) -> Result<CloudBuilder, IngestError> {
        // Before memory is allocated for them.
        self.check_length(file)?;
        gathered.expect(file, usize::try_from(self.points).unwrap_or(usize::MAX))?;
        gathered.set_has_color(self.color.is_some());
        let per_block = (BLOCK_BYTES / self.bytes).max(1);
        let mut block = vec![0; per_block * self.bytes];
        let mut wide: Vec<[u16; 3]> = Vec::new();
        let mut left = self.points;
        while left > 0 {
            let rows = left.min(per_block as u64) as usize;
            let block = &mut block[..rows * self.bytes];
            let done = self.points - left;
            let truncated = |_| {
                IngestError::malformed(
                    file,
                    format!("truncated: about {done} of {} points", self.points),
                )
            };
            self.source.read_exact(block).map_err(truncated)?;
            for row in block.chunks_exact(self.bytes) {
                let axis = |i: usize| {
                    let raw = i32::from_le_bytes(std::array::from_fn(|k| row[4 * i + k]));
                    f64::from(raw) * self.scale[i] + self.offset[i]
                };
                let before = gathered.len();
                gathered.push([axis(0), axis(1), axis(2)], GREY);
                if let Some(color) = self.color
                    && gathered.len() > before
                {
                    wide.push(
                        [0, 2, 4].map(|i| u16::from_le_bytes([row[color + i], row[color + i + 1]])),
                    );
                }
            }
            left -= rows as u64;
        }
        if self.color.is_some() {
            gathered.set_wide_colors(&wide);
        }
        Ok(gathered)
    }
}

#[cfg(test)]
mod tests {
    use crate::clouds::{self, CloudBounds, CoordinateOrigin};
    use camino::Utf8Path;
    use proptest::prelude::*;

    /// Creates a file of version 1.2, format 2, with two points.
    fn las() -> Vec<u8> {
        let mut bytes = vec![0; 227];
        bytes[..4].copy_from_slice(b"LASF");
        (bytes[24], bytes[25], bytes[104]) = (1, 2, 2);
        bytes[94..96].copy_from_slice(&227_u16.to_le_bytes());
        bytes[96..100].copy_from_slice(&227_u32.to_le_bytes());
        bytes[105..107].copy_from_slice(&26_u16.to_le_bytes());
        bytes[107..111].copy_from_slice(&2_u32.to_le_bytes());
        for i in 0..3 {
            bytes[131 + 8 * i..139 + 8 * i].copy_from_slice(&0.001_f64.to_le_bytes());
        }
        for p in [[1000_i32, 2000, 3000], [1500, 2500, 3500]] {
            p.iter().for_each(|v| bytes.extend(v.to_le_bytes()));
            bytes.extend([0; 8]);
            [10_u16, 20, 200].iter().for_each(|v| bytes.extend(v.to_le_bytes()));
        }
        bytes
    }

    fn read(bytes: &[u8]) -> Result<clouds::LoadedCloud, crate::IngestError> {
        let folder = tempfile::tempdir().unwrap();
        let root = Utf8Path::from_path(folder.path()).unwrap();
        std::fs::write(root.join("a.las"), bytes).unwrap();
        let (file, bounds) = (Utf8Path::new("a.las"), CloudBounds { announced: 1000, kept: 1000 });
        clouds::check(root, file, &bounds)?;
        clouds::read(root, file, &bounds, CoordinateOrigin::Free)
    }

    #[test]
    fn eight_bit_colors_are_not_scaled() {
        let loaded = read(&las()).unwrap();
        assert_eq!((loaded.cloud.positions[1].z, loaded.cloud.colors[0]), (3.5, [10, 20, 200]));
    }

    #[test]
    fn false_point_counts_are_refused() {
        let mut many = las();
        many[107..111].copy_from_slice(&900_u32.to_le_bytes());
        assert!(
            read(&many)
                .unwrap_err()
                .to_string()
                .contains("declares 900 points but has only 52 bytes")
        );
        // Also where the number of points has no limit.
        let folder = tempfile::tempdir().unwrap();
        let file = Utf8Path::from_path(folder.path()).unwrap().join("a.las");
        many[107..111].copy_from_slice(&u32::MAX.to_le_bytes());
        std::fs::write(&file, &many).unwrap();
        assert!(crate::read_cloud(&file).unwrap_err().to_string().contains("only 52 bytes"));
        // Found by fuzzing: a version 1.4 count whose size in bytes overflows.
        let mut endless = las();
        endless.splice(227..227, [0; 148]);
        endless[25] = 4;
        endless[94..96].copy_from_slice(&375_u16.to_le_bytes());
        endless[96..100].copy_from_slice(&375_u32.to_le_bytes());
        endless[247..255].copy_from_slice(&(u64::MAX / 2).to_le_bytes());
        assert!(read(&endless).unwrap_err().to_string().contains("the limit is 1000"));
    }

    proptest! {
        #[test]
        fn damaged_files_never_panic(at in 0_usize..280, with in prop::collection::vec(any::<u8>(), 1..8)) {
            let mut bytes = las();
            for (i, byte) in with.iter().enumerate() {
                if let Some(own) = bytes.get_mut(at + i) {
                    *own = *byte;
                }
            }
            let _ = read(&bytes);
        }
    }
}
