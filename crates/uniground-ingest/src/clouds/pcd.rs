//! PCD 0.7 (Point Cloud Library): ascii, binary and `binary_compressed`, with fields of any type in
//! any order.
//!
//! Color is `rgb` or `rgba`, packed into the four bytes of a float or an integer, or three fields
//! `r`, `g` and `b`. The viewpoint is the sensor's position and does not transform the points.

use super::CloudBuilder;
use super::color_range::{ColorRange, channel_of_name};
use super::gathered::{CloudBounds, GREY};
use crate::IngestError;
use crate::limited_reader::read_line;
use camino::Utf8Path;
use std::fs::File;
use std::io::{BufRead, BufReader, Read};

/// Maximum length of a line of the header or of an ascii body.
const MAX_LINE_BYTES: u64 = 16 << 10;
const MAX_HEADER_LINES: usize = 64;
const MAX_FIELDS: usize = 128;
/// Number of bytes of rows that are read at once.
const BLOCK_BYTES: usize = 256 << 10;
/// LZF compresses at best 264 bytes to three.
const BEST_RATIO: u64 = 100;

#[derive(Debug, Clone, Copy, PartialEq)]
enum PcdFieldType {
    Float,
    Signed,
    Unsigned,
}

/// A field of a point: `count` numbers of `size` bytes.
#[derive(Debug, Clone)]
struct Field {
    name: String,
    size: usize,
    kind: PcdFieldType,
    count: usize,
    /// Offset in a row, bytes.
    offset: usize,
}

impl Field {
    fn size_bytes(&self) -> usize {
        self.size * self.count
    }

    fn read_number(&self, bytes: &[u8]) -> f64 {
        fn first_bytes<const N: usize>(bytes: &[u8]) -> [u8; N] {
            std::array::from_fn(|i| bytes[i])
        }
        match (self.kind, self.size) {
            (PcdFieldType::Float, 4) => f64::from(f32::from_le_bytes(first_bytes(bytes))),
            (PcdFieldType::Float, _) => f64::from_le_bytes(first_bytes(bytes)),
            (PcdFieldType::Signed, 1) => f64::from(bytes[0].cast_signed()),
            (PcdFieldType::Signed, 2) => f64::from(i16::from_le_bytes(first_bytes(bytes))),
            (PcdFieldType::Signed, 4) => f64::from(i32::from_le_bytes(first_bytes(bytes))),
            (PcdFieldType::Signed, _) => i64::from_le_bytes(first_bytes(bytes)) as f64,
            (PcdFieldType::Unsigned, 1) => f64::from(bytes[0]),
            (PcdFieldType::Unsigned, 2) => f64::from(u16::from_le_bytes(first_bytes(bytes))),
            (PcdFieldType::Unsigned, 4) => f64::from(u32::from_le_bytes(first_bytes(bytes))),
            (PcdFieldType::Unsigned, _) => u64::from_le_bytes(first_bytes(bytes)) as f64,
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum PcdEncoding {
    Ascii,
    Binary,
    Compressed,
}

struct Header {
    fields: Vec<Field>,
    points: usize,
    data: PcdEncoding,
    row_bytes: usize,
}

/// The fields of a point's color.
#[derive(Clone, Copy)]
enum ColorFields<'a> {
    None,
    /// Blue, green and red in the bytes of one number.
    Packed(&'a Field),
    /// Red, green and blue.
    Channels([&'a Field; 3]),
}

impl Header {
    fn field(&self, name: &str) -> Option<&Field> {
        self.fields.iter().find(|field| field.name == name)
    }

    /// Returns the fields x, y, z and those of the color.
    fn position_and_color(&self) -> Option<([&Field; 3], ColorFields<'_>)> {
        let xyz = [self.field("x")?, self.field("y")?, self.field("z")?];
        let packed =
            self.field("rgb").or_else(|| self.field("rgba")).filter(|field| field.size == 4);
        let channels = [0, 1, 2].map(|channel| {
            self.fields.iter().find(|field| channel_of_name(&field.name) == Some(channel))
        });
        Some((
            xyz,
            match (packed, channels) {
                (Some(packed), _) => ColorFields::Packed(packed),
                (None, [Some(r), Some(g), Some(b)]) => ColorFields::Channels([r, g, b]),
                _ => ColorFields::None,
            },
        ))
    }
}

/// Checks that the header can be read and that the number of announced points is allowed.
pub(super) fn check(
    root: &Utf8Path,
    file: &Utf8Path,
    bounds: &CloudBounds,
) -> Result<(), IngestError> {
    let (header, _) = open(root, file)?;
    bounds.check(file, header.points as u64)
}

pub(super) fn read(
    root: &Utf8Path,
    file: &Utf8Path,
    mut gathered: CloudBuilder,
) -> Result<CloudBuilder, IngestError> {
    let malformed = |reason: String| IngestError::malformed(file, reason);
    let (header, mut source) = open(root, file)?;
    let (xyz, color) = header
        .position_and_color()
        .ok_or_else(|| malformed("its points have no fields x, y and z".into()))?;
    gathered.set_has_color(!matches!(color, ColorFields::None));
    if let ColorFields::Channels([red, ..]) = color {
        let floats = red.kind == PcdFieldType::Float;
        gathered.set_color_range(if floats { ColorRange::Unit } else { ColorRange::Bytes });
    }
    if header.data != PcdEncoding::Ascii && xyz.iter().all(|field| field.size < 8) {
        gathered.set_single_precision();
    }
    gathered.expect(file, header.points)?;
    match header.data {
        PcdEncoding::Ascii => read_ascii(&header, &mut source, &mut gathered),
        PcdEncoding::Binary => read_binary(&header, &mut source, &mut gathered),
        PcdEncoding::Compressed => read_compressed(&header, &mut source, &mut gathered),
    }
    .map_err(malformed)?;
    Ok(gathered)
}

fn open(root: &Utf8Path, file: &Utf8Path) -> Result<(Header, BufReader<File>), IngestError> {
    let source =
        File::open(root.join(file)).map_err(|source| IngestError::reading(file, source))?;
    let bytes = source.metadata().map_or(u64::MAX, |m| m.len());
    let mut source = BufReader::with_capacity(1 << 20, source);
    let header = read_header(&mut source)
        .map_err(|reason| IngestError::malformed(file, format!("not a PCD file: {reason}")))?;
    let least = match header.data {
        PcdEncoding::Ascii => header.points as u64 * 6,
        PcdEncoding::Binary => header.points as u64 * header.row_bytes as u64,
        PcdEncoding::Compressed => header.points as u64 * header.row_bytes as u64 / BEST_RATIO,
    };
    // A count that does not fit into the file must not cause an allocation. The last line can lack
    // its line end.
    if least > bytes.saturating_add(1) {
        return Err(IngestError::malformed(
            file,
            format!("it declares {} points but has only {bytes} bytes", header.points),
        ));
    }
    Ok((header, source))
}

fn read_header(source: &mut impl BufRead) -> Result<Header, String> {
    let mut line = Vec::new();
    let (mut names, mut sizes, mut kinds, mut counts) =
        (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    let (mut width, mut height, mut points) = (0_u64, 1_u64, None);
    for _ in 0..MAX_HEADER_LINES {
        if !read_line(source, &mut line, MAX_LINE_BYTES).map_err(|e| e.to_string())? {
            return Err("it ends within its header".into());
        }
        let text = std::str::from_utf8(&line).map_err(|_| "its header is not text")?;
        let mut words = text.split_ascii_whitespace();
        let Some(key) = words.next().filter(|key| !key.starts_with('#')) else { continue };
        let words: Vec<&str> = words.take(MAX_FIELDS + 1).collect();
        if words.len() > MAX_FIELDS {
            return Err(format!("more than {MAX_FIELDS} fields"));
        }
        let number = |word: Option<&&str>| {
            word.and_then(|w| w.parse::<u64>().ok()).ok_or_else(|| format!("{key} is not a number"))
        };
        match key {
            "FIELDS" | "COLUMNS" => names = words.iter().map(|w| (*w).to_owned()).collect(),
            "SIZE" => sizes = words.iter().map(|w| number(Some(w))).collect::<Result<_, _>>()?,
            "TYPE" => kinds = words.iter().map(|w| (*w).to_owned()).collect(),
            "COUNT" => counts = words.iter().map(|w| number(Some(w))).collect::<Result<_, _>>()?,
            "WIDTH" => width = number(words.first())?,
            "HEIGHT" => height = number(words.first())?,
            "POINTS" => points = Some(number(words.first())?),
            "DATA" => {
                let data = match words.first() {
                    Some(&"ascii") => PcdEncoding::Ascii,
                    Some(&"binary") => PcdEncoding::Binary,
                    Some(&"binary_compressed") => PcdEncoding::Compressed,
                    other => {
                        return Err(format!(
                            "DATA is {:?}, not ascii, binary or binary_compressed",
                            other.copied().unwrap_or_default()
                        ));
                    }
                };
                let fields = parse_fields(names, &sizes, &kinds, &counts)?;
                let row_bytes = fields.iter().map(Field::size_bytes).sum();
                let points = points.unwrap_or(width.saturating_mul(height));
                let points =
                    usize::try_from(points).ok().filter(|n| n.checked_mul(row_bytes).is_some());
                return Ok(Header {
                    fields,
                    points: points.ok_or("it declares more points than are possible")?,
                    data,
                    row_bytes,
                });
            }
            _ => {}
        }
    }
    Err("its header has no DATA line".into())
}

fn parse_fields(
    names: Vec<String>,
    sizes: &[u64],
    kinds: &[String],
    counts: &[u64],
) -> Result<Vec<Field>, String> {
    if names.is_empty()
        || sizes.len() != names.len()
        || kinds.len() != names.len()
        || (!counts.is_empty() && counts.len() != names.len())
    {
        return Err("FIELDS, SIZE, TYPE and COUNT do not have the same number of words".into());
    }
    let mut offset = 0;
    let mut fields = Vec::new();
    for (i, name) in names.into_iter().enumerate() {
        let (kind, size) = match (kinds[i].as_str(), sizes[i]) {
            ("F", 4 | 8) => (PcdFieldType::Float, sizes[i] as usize),
            ("I", 1 | 2 | 4 | 8) => (PcdFieldType::Signed, sizes[i] as usize),
            ("U", 1 | 2 | 4 | 8) => (PcdFieldType::Unsigned, sizes[i] as usize),
            (kind, size) => {
                return Err(format!("{name} has the unsupported type {kind} with {size} bytes"));
            }
        };
        let count = counts.get(i).copied().unwrap_or(1);
        if count > 4096 || count == 0 {
            return Err(format!("COUNT of {name} is {count}; it must be 1 to 4096"));
        }
        let field = Field { name, size, kind, count: count as usize, offset };
        offset += field.size_bytes();
        fields.push(field);
    }
    Ok(fields)
}

/// Unpacks blue, green, red: the order of the packed bytes.
fn unpack_bgr([b, g, r, _]: [u8; 4]) -> [u8; 3] {
    [r, g, b]
}

fn read_ascii(
    header: &Header,
    source: &mut impl BufRead,
    gathered: &mut CloudBuilder,
) -> Result<(), String> {
    let Some((xyz, color_fields)) = header.position_and_color() else { return Ok(()) };
    // Column numbers. Fields of several numbers can precede them.
    let column = |field: &Field| {
        header.fields.iter().take_while(|f| f.name != field.name).map(|f| f.count).sum::<usize>()
    };
    let xyz = xyz.map(column);
    let (packed, rgb) = match color_fields {
        ColorFields::None => (None, None),
        ColorFields::Packed(field) => (Some((column(field), field.kind)), None),
        ColorFields::Channels(fields) => (None, Some(fields.map(column))),
    };
    let columns = xyz.into_iter().chain(packed.map(|p| p.0)).chain(rgb.into_iter().flatten());
    let most = columns.max().unwrap_or(0);
    let mut line = Vec::new();
    for row in 0..header.points {
        if !read_line(source, &mut line, MAX_LINE_BYTES).map_err(|e| format!("point {row}: {e}"))? {
            return Err(format!("truncated: {row} of {} points", header.points));
        }
        let text = std::str::from_utf8(&line).map_err(|_| format!("point {row}: not text"))?;
        let (mut position, mut color, mut found) = ([f64::NAN; 3], GREY, 0);
        let mut channels = [f64::NAN; 3];
        for (i, word) in text.split_ascii_whitespace().enumerate().take(most + 1) {
            found = i;
            let number = || {
                word.parse::<f64>().map_err(|_| format!("point {row}: {word:?} is not a number"))
            };
            if let Some(axis) = xyz.iter().position(|c| *c == i) {
                position[axis] = number()?;
            } else if let Some(channel) = rgb.and_then(|rgb| rgb.iter().position(|c| *c == i)) {
                channels[channel] = number()?;
            } else if let Some((_, kind)) = packed.filter(|(column, _)| *column == i) {
                // Written as an integer, or as the float with the same bytes.
                let bits = match (kind, word.parse::<u32>()) {
                    (PcdFieldType::Float, Ok(bits)) if bits > 0xff => bits,
                    (PcdFieldType::Float, _) => (number()? as f32).to_bits(),
                    (_, Ok(bits)) => bits,
                    (_, Err(_)) => number()? as u32,
                };
                color = unpack_bgr(bits.to_le_bytes());
            }
        }
        if found < most {
            return Err(format!(
                "point {row} has {} values; at least {} are needed",
                found + 1,
                most + 1
            ));
        }
        match rgb {
            Some(_) => gathered.push_channels(position, channels),
            None => gathered.push(position, color),
        }
    }
    Ok(())
}

fn read_binary(
    header: &Header,
    source: &mut impl Read,
    gathered: &mut CloudBuilder,
) -> Result<(), String> {
    let Some((xyz, color)) = header.position_and_color() else { return Ok(()) };
    let per_block = (BLOCK_BYTES / header.row_bytes).max(1);
    let mut block = vec![0; per_block * header.row_bytes];
    let mut left = header.points;
    while left > 0 {
        let rows = left.min(per_block);
        let block = &mut block[..rows * header.row_bytes];
        source.read_exact(block).map_err(|e| format!("truncated: {e}"))?;
        for row in block.chunks_exact(header.row_bytes) {
            let number = |field: &Field| field.read_number(&row[field.offset..]);
            match color {
                ColorFields::None => gathered.push(xyz.map(number), GREY),
                ColorFields::Channels(rgb) => {
                    gathered.push_channels(xyz.map(number), rgb.map(number));
                }
                ColorFields::Packed(Field { offset, .. }) => {
                    let color = unpack_bgr([row[*offset], row[*offset + 1], row[*offset + 2], 0]);
                    gathered.push(xyz.map(number), color);
                }
            }
        }
        left -= rows;
    }
    Ok(())
}

/// Reads data that is compressed as a whole, one field after another: all x, then all y and so on.
fn read_compressed(
    header: &Header,
    source: &mut impl Read,
    gathered: &mut CloudBuilder,
) -> Result<(), String> {
    let Some((xyz, color)) = header.position_and_color() else { return Ok(()) };
    let mut sizes = [0; 8];
    source.read_exact(&mut sizes).map_err(|e| format!("truncated: {e}"))?;
    let size = |at: usize| u32::from_le_bytes(std::array::from_fn(|i| sizes[at + i])) as usize;
    let (compressed, unpacked_bytes) = (size(0), size(4));
    if unpacked_bytes != header.points * header.row_bytes {
        return Err(format!(
            "it unpacks to {unpacked_bytes} bytes, but {} points need {}",
            header.points,
            header.points * header.row_bytes
        ));
    }
    let mut packed_bytes = Vec::new();
    source.take(compressed as u64).read_to_end(&mut packed_bytes).map_err(|e| e.to_string())?;
    if packed_bytes.len() != compressed {
        return Err(format!("truncated: {} of {compressed} bytes", packed_bytes.len()));
    }
    let bytes = decompress_lzf(&packed_bytes, unpacked_bytes)?;
    let column = |field: &Field| {
        &bytes[field.offset * header.points..][..field.size_bytes() * header.points]
    };
    for i in 0..header.points {
        let number = |field: &Field| field.read_number(&column(field)[i * field.size_bytes()..]);
        match color {
            ColorFields::None => gathered.push(xyz.map(number), GREY),
            ColorFields::Channels(rgb) => gathered.push_channels(xyz.map(number), rgb.map(number)),
            ColorFields::Packed(field) => {
                let packed = &column(field)[i * 4..];
                let color = unpack_bgr([packed[0], packed[1], packed[2], 0]);
                gathered.push(xyz.map(number), color);
            }
        }
    }
    Ok(())
}

/// Decompresses LibLZF: runs of literals, and copies of earlier output.
fn decompress_lzf(source: &[u8], expected: usize) -> Result<Vec<u8>, String> {
    let damaged = || "its compressed points are damaged".to_owned();
    let mut out: Vec<u8> = Vec::with_capacity(expected);
    let mut at = 0;
    while let Some(&control) = source.get(at) {
        at += 1;
        let control = usize::from(control);
        if control < 32 {
            let literals = source.get(at..at + control + 1).ok_or_else(damaged)?;
            out.extend_from_slice(literals);
            at += control + 1;
        } else {
            let mut length = control >> 5;
            if length == 7 {
                length += usize::from(*source.get(at).ok_or_else(damaged)?);
                at += 1;
            }
            let back =
                ((control & 31) << 8) + usize::from(*source.get(at).ok_or_else(damaged)?) + 1;
            at += 1;
            let start = out.len().checked_sub(back).ok_or_else(damaged)?;
            for i in start..start + length + 2 {
                out.push(out[i]);
            }
        }
        if out.len() > expected {
            return Err(damaged());
        }
    }
    if out.len() == expected { Ok(out) } else { Err(damaged()) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clouds::{self, CoordinateOrigin, LoadedCloud};
    use proptest::prelude::*;
    use uniground_geometry::Point3;

    fn read_bytes(bytes: &[u8]) -> Result<LoadedCloud, IngestError> {
        let folder = tempfile::tempdir().unwrap();
        let root = Utf8Path::from_path(folder.path()).unwrap();
        std::fs::write(root.join("cloud.pcd"), bytes).unwrap();
        clouds::read(
            root,
            Utf8Path::new("cloud.pcd"),
            &CloudBounds { announced: 1 << 30, kept: 1 << 30 },
            CoordinateOrigin::Free,
        )
    }

    fn header(points: usize, data: &str) -> Vec<u8> {
        format!(
            "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS rgb x y z\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH {points}\nHEIGHT 1\n\
             VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {data}\n"
        )
        .into_bytes()
    }

    #[test]
    fn all_encodings_give_the_same_cloud() {
        let points =
            [([10_u8, 20, 30], [1.0_f32, 2.0, 3.0]), ([40, 50, 60], [-1.0, 0.5, f32::NAN])];
        let packed = |[r, g, b]: [u8; 3]| u32::from_le_bytes([b, g, r, 0]);
        let (mut ascii, mut binary, mut columns) =
            (header(2, "ascii"), header(2, "binary"), Vec::new());
        for (c, p) in points {
            ascii.extend(
                format!("{:e} {} {} {}\n", f32::from_bits(packed(c)), p[0], p[1], p[2]).bytes(),
            );
            binary.extend(packed(c).to_le_bytes());
            p.iter().for_each(|v| binary.extend(v.to_le_bytes()));
        }
        points.iter().for_each(|(c, _)| columns.extend(packed(*c).to_le_bytes()));
        (0..3).for_each(|axis| {
            points.iter().for_each(|(_, p)| columns.extend(p[axis].to_le_bytes()));
        });
        // Literals only, which is valid LZF.
        let mut stored = Vec::new();
        for run in columns.chunks(32) {
            stored.push(run.len() as u8 - 1);
            stored.extend(run);
        }
        let mut compressed = header(2, "binary_compressed");
        compressed.extend((stored.len() as u32).to_le_bytes());
        compressed.extend((columns.len() as u32).to_le_bytes());
        compressed.extend(stored);
        for bytes in [ascii, binary, compressed] {
            let loaded = read_bytes(&bytes).unwrap();
            assert_eq!(
                (loaded.cloud.positions, loaded.cloud.colors, loaded.dropped),
                (vec![Point3::new(1.0, 2.0, 3.0)], vec![[10, 20, 30]], 1)
            );
        }
    }

    #[test]
    fn lzf_copies_repeat_earlier_output() {
        // "ab", then nine bytes copied from two bytes back.
        assert_eq!(
            decompress_lzf(&[1, b'a', b'b', 0b111_00000, 0, 1], 11).unwrap(),
            b"abababababa"
        );
        assert!(decompress_lzf(&[0b111_00000, 0, 1], 9).is_err(), "nothing to copy from");
        assert!(
            decompress_lzf(&[1, b'a', b'b', 0b111_00000, 255, 1], 11).is_err(),
            "longer than announced"
        );
    }

    #[test]
    fn color_in_three_fields_is_read() {
        let header = |data: &str| {
            format!(
                "VERSION 0.7\nFIELDS x y z r g b\nSIZE 4 4 4 1 1 1\nTYPE F F F U U U\nWIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA {data}\n"
            )
            .into_bytes()
        };
        let ascii = [&header("ascii")[..], b"1 2 3 10 20 255\n"].concat();
        let mut binary = header("binary");
        [1.0_f32, 2.0, 3.0].iter().for_each(|v| binary.extend(v.to_le_bytes()));
        binary.extend([10, 20, 255]);
        for bytes in [ascii, binary] {
            let loaded = read_bytes(&bytes).unwrap();
            assert!(loaded.has_color);
            assert_eq!(
                (loaded.cloud.positions, loaded.cloud.colors),
                (vec![Point3::new(1.0, 2.0, 3.0)], vec![[10, 20, 255]])
            );
        }
    }

    #[test]
    fn false_counts_and_invalid_rows_are_refused() {
        for (bytes, expected) in [
            (header(1_000_000_000, "binary"), "declares 1000000000 points"),
            (header(1_000_000_000, "binary_compressed"), "declares 1000000000 points"),
            (header(usize::MAX, "ascii"), "more points than are possible"),
            (header(0, "binary"), "no points"),
            ([header(2, "ascii"), b"0 1 2 3\n0 1 2 3 4 \xff\n".to_vec()].concat(), "not text"),
            ([header(3, "ascii"), b"0 1 2 3\n0 1 2 3\n".to_vec()].concat(), "2 of 3 points"),
        ] {
            let message = read_bytes(&bytes).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
    }

    proptest! {
        #[test]
        fn random_data_never_panics(bytes in prop::collection::vec(any::<u8>(), 0..300), count in 0_usize..9) {
            for data in ["ascii", "binary", "binary_compressed"] {
                let _ = read_bytes(&[header(count, data), bytes.clone()].concat());
            }
            let _ = decompress_lzf(&bytes, count * 16);
        }
    }
}
