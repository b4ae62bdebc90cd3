//! PLY: ascii, little and big endian; properties by name in any order; faces are skipped.
//!
//! The header, and files whose vertices hold lists or come after other elements, go through the `ply-rs-bw` parser. What
//! scanners write, scalar vertices first, is read row by row here: it is faster, and ascii may hold `nan`.

use crate::geometry::{MAX_COORDINATE_M, Point3};
use crate::ingest::IngestError;
use crate::scene::PointCloud;
use camino::Utf8Path;
use ply_rs_bw::parser::{Parser, Reader};
use ply_rs_bw::ply::{ElementDef, Encoding, Property, PropertyAccess, PropertyAccessResult, PropertyType, ScalarType};
use std::fs::File;
use std::io::{BufRead, BufReader};

/// A cloud and how many of its points were dropped for coordinates that are not finite.
#[derive(Debug)]
pub struct Loaded {
    pub cloud: PointCloud,
    pub dropped: usize,
    /// Points whose colour is not a number and was taken as grey.
    pub without_colour: usize,
    pub has_colour: bool,
}

/// Reads a PLY file. Points without colour come out mid-grey.
///
/// # Errors
/// [`IngestError`] naming `file` (a path below `root`).
pub fn read(root: &Utf8Path, file: &Utf8Path) -> Result<Loaded, IngestError> {
    let malformed = |reason: String| IngestError::malformed(file, reason);
    let source = File::open(root.join(file)).map_err(|source| IngestError::Io { file: file.to_owned(), source })?;
    let bytes = source.metadata().map_or(u64::MAX, |m| m.len());
    let mut reader = Reader::new(BufReader::with_capacity(1 << 20, source));
    let parser = Parser::<Vertex>::new();
    let header = parser.read_header(&mut reader).map_err(|e| malformed(format!("not a PLY file: {e}")))?;
    let vertex = header.elements.get("vertex").ok_or_else(|| malformed("it has no vertex element".into()))?;
    for axis in ["x", "y", "z"] {
        if !vertex.properties.contains_key(axis) {
            return Err(malformed(format!("its vertices have no property {axis}")));
        }
    }
    // Even the tersest row takes three bytes: a count that can not be there is a lie, not a reason to allocate.
    if vertex.count as u64 > bytes / 3 {
        return Err(malformed(format!("it announces {} vertices but has only {bytes} bytes", vertex.count)));
    }
    // The same for what comes before the vertices: those rows are read too.
    if let Some(liar) = header
        .elements
        .values()
        .find(|e| e.count as u64 > bytes || (e.properties.is_empty() && e.count > 0))
    {
        return Err(malformed(format!("it announces {} rows of {:?} but has only {bytes} bytes", liar.count, liar.name)));
    }
    let has_colour = ["red", "green", "blue"].iter().all(|c| vertex.properties.contains_key(*c));
    let vertices_first = header.elements.values().next().is_some_and(|e| e.name == "vertex");
    let mut loaded = Loaded { cloud: PointCloud::default(), dropped: 0, without_colour: 0, has_colour };
    if vertices_first && let Some(row) = Row::of(vertex) {
        row.read(reader.into_inner(), vertex.count, &header.encoding, &mut loaded).map_err(malformed)?;
    } else {
        for element in header.elements.values() {
            let rows = parser
                .read_payload_for_element(&mut reader, element, &header)
                .map_err(|e| malformed(e.to_string()))?;
            if element.name == "vertex" {
                rows.iter().for_each(|v| loaded.push(v));
                break;
            }
        }
    }
    let far = |p: &&Point3<f32>| p.iter().any(|c| c.abs() > MAX_COORDINATE_M);
    if let Some(p) = loaded.cloud.positions.iter().find(far) {
        return Err(malformed(format!(
            "the point ({}, {}, {}) lies more than 10 km from the origin: take an offset off the whole scan first",
            p.x, p.y, p.z
        )));
    }
    if loaded.cloud.is_empty() {
        return Err(IngestError::EmptyCloud { file: file.to_owned() });
    }
    Ok(loaded)
}

impl Loaded {
    fn push(&mut self, vertex: &Vertex) {
        let [x, y, z] = vertex.position;
        if !(x.is_finite() && y.is_finite() && z.is_finite()) {
            self.dropped += 1;
            return;
        }
        self.without_colour += usize::from(vertex.nan_colour);
        self.cloud.positions.push(Point3::new(x, y, z));
        self.cloud.colours.push(vertex.colour);
    }
}

/// One vertex; what is not said stays mid-grey.
struct Vertex {
    position: [f32; 3],
    colour: [u8; 3],
    /// Whether a colour channel was NaN.
    nan_colour: bool,
}

const GREY: u8 = 128;

impl PropertyAccess for Vertex {
    fn new() -> Self {
        Self { position: [f32::NAN; 3], colour: [GREY; 3], nan_colour: false }
    }

    fn set_property(&mut self, name: &str, property: Property) -> PropertyAccessResult {
        let value = match property {
            Property::Char(v) => f64::from(v),
            Property::UChar(v) => f64::from(v),
            Property::Short(v) => f64::from(v),
            Property::UShort(v) => f64::from(v),
            Property::Int(v) => f64::from(v),
            Property::UInt(v) => f64::from(v),
            Property::Float(v) => f64::from(v),
            Property::Double(v) => v,
            _ => return PropertyAccessResult::Ignored,
        };
        let scale = ColourScale::of(&property);
        self.set(name, value, scale);
        PropertyAccessResult::Set
    }
}

/// How a colour channel's type maps to 8 bits: bytes as they are, 16-bit by 1/257, floats from `0..=1`.
#[derive(Clone, Copy)]
struct ColourScale(f64);

impl ColourScale {
    fn of(property: &Property) -> Self {
        Self(match property {
            Property::UShort(_) | Property::Short(_) => 1.0 / 257.0,
            Property::Float(_) | Property::Double(_) => 255.0,
            _ => 1.0,
        })
    }

    fn of_type(scalar: &ScalarType) -> Self {
        Self(match scalar {
            ScalarType::UShort | ScalarType::Short => 1.0 / 257.0,
            ScalarType::Float | ScalarType::Double => 255.0,
            _ => 1.0,
        })
    }
}

impl Vertex {
    fn set(&mut self, name: &str, value: f64, scale: ColourScale) {
        // Out-of-range channels saturate: `as` clamps.
        let channel = if value.is_nan() { GREY } else { (value * scale.0).round() as u8 };
        self.nan_colour |= value.is_nan() && matches!(name, "red" | "green" | "blue");
        match name {
            "x" => self.position[0] = value as f32,
            "y" => self.position[1] = value as f32,
            "z" => self.position[2] = value as f32,
            "red" => self.colour[0] = channel,
            "green" => self.colour[1] = channel,
            "blue" => self.colour[2] = channel,
            _ => {}
        }
    }
}

/// Layout of a vertex row made of scalars only.
struct Row {
    bytes: usize,
    columns: usize,
    /// The properties that matter: name, column, offset in bytes, type.
    fields: Vec<(String, usize, usize, ScalarType)>,
}

impl Row {
    fn of(vertex: &ElementDef) -> Option<Self> {
        let mut row = Self { bytes: 0, columns: 0, fields: Vec::new() };
        for property in vertex.properties.values() {
            let PropertyType::Scalar(scalar) = &property.data_type else { return None };
            if ["x", "y", "z", "red", "green", "blue"].contains(&property.name.as_str()) {
                row.fields.push((property.name.clone(), row.columns, row.bytes, scalar.clone()));
            }
            row.columns += 1;
            row.bytes += match scalar {
                ScalarType::Char | ScalarType::UChar => 1,
                ScalarType::Short | ScalarType::UShort => 2,
                ScalarType::Int | ScalarType::UInt | ScalarType::Float => 4,
                ScalarType::Double => 8,
            };
        }
        Some(row)
    }

    fn read(&self, source: impl BufRead, count: usize, encoding: &Encoding, loaded: &mut Loaded) -> Result<(), String> {
        match encoding {
            Encoding::Ascii => self.read_ascii(source, count, loaded),
            Encoding::BinaryLittleEndian => self.read_binary(source, count, little_endian, loaded),
            Encoding::BinaryBigEndian => self.read_binary(source, count, big_endian, loaded),
        }
    }

    fn read_ascii(&self, source: impl BufRead, count: usize, loaded: &mut Loaded) -> Result<(), String> {
        let mut lines = source.lines();
        for row in 0..count {
            let line = lines
                .next()
                .ok_or_else(|| format!("truncated: {row} of {count} vertices"))?
                .map_err(|e| format!("vertex {row}: {e}"))?;
            let words: Vec<&str> = line.split_ascii_whitespace().collect();
            if words.len() < self.columns {
                return Err(format!("vertex {row} has {} values, its header announces {}", words.len(), self.columns));
            }
            let mut vertex = Vertex::new();
            for (name, column, _, scalar) in &self.fields {
                let value = words[*column].parse().map_err(|_| format!("vertex {row}: {:?} is not a number", words[*column]))?;
                vertex.set(name, value, ColourScale::of_type(scalar));
            }
            loaded.push(&vertex);
        }
        Ok(())
    }

    fn read_binary(
        &self,
        mut source: impl BufRead,
        count: usize,
        number: fn(&[u8], &ScalarType) -> f64,
        loaded: &mut Loaded,
    ) -> Result<(), String> {
        const BLOCK: usize = 4096;
        let mut block = vec![0; self.bytes * BLOCK];
        let mut left = count;
        while left > 0 {
            let rows = left.min(BLOCK);
            let bytes = &mut block[..rows * self.bytes];
            source.read_exact(bytes).map_err(|e| format!("truncated: {e}"))?;
            for row in bytes.chunks_exact(self.bytes) {
                let mut vertex = Vertex::new();
                for (name, _, offset, scalar) in &self.fields {
                    vertex.set(name, number(&row[*offset..], scalar), ColourScale::of_type(scalar));
                }
                loaded.push(&vertex);
            }
            left -= rows;
        }
        Ok(())
    }
}

fn first<const N: usize>(bytes: &[u8]) -> [u8; N] {
    std::array::from_fn(|i| bytes[i])
}

fn little_endian(bytes: &[u8], scalar: &ScalarType) -> f64 {
    match scalar {
        ScalarType::Char => f64::from(i8::from_le_bytes(first(bytes))),
        ScalarType::UChar => f64::from(bytes[0]),
        ScalarType::Short => f64::from(i16::from_le_bytes(first(bytes))),
        ScalarType::UShort => f64::from(u16::from_le_bytes(first(bytes))),
        ScalarType::Int => f64::from(i32::from_le_bytes(first(bytes))),
        ScalarType::UInt => f64::from(u32::from_le_bytes(first(bytes))),
        ScalarType::Float => f64::from(f32::from_le_bytes(first(bytes))),
        ScalarType::Double => f64::from_le_bytes(first(bytes)),
    }
}

fn big_endian(bytes: &[u8], scalar: &ScalarType) -> f64 {
    match scalar {
        ScalarType::Char => f64::from(i8::from_be_bytes(first(bytes))),
        ScalarType::UChar => f64::from(bytes[0]),
        ScalarType::Short => f64::from(i16::from_be_bytes(first(bytes))),
        ScalarType::UShort => f64::from(u16::from_be_bytes(first(bytes))),
        ScalarType::Int => f64::from(i32::from_be_bytes(first(bytes))),
        ScalarType::UInt => f64::from(u32::from_be_bytes(first(bytes))),
        ScalarType::Float => f64::from(f32::from_be_bytes(first(bytes))),
        ScalarType::Double => f64::from_be_bytes(first(bytes)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn read_bytes(bytes: &[u8]) -> Result<Loaded, IngestError> {
        let folder = tempfile::tempdir().unwrap();
        let root = Utf8Path::from_path(folder.path()).unwrap();
        std::fs::write(root.join("cloud.ply"), bytes).unwrap();
        read(root, Utf8Path::new("cloud.ply"))
    }

    fn header(encoding: &str, count: usize, properties: &str) -> Vec<u8> {
        format!("ply\nformat {encoding} 1.0\nelement vertex {count}\n{properties}end_header\n").into_bytes()
    }

    const XYZ_RGB: &str =
        "property float x\nproperty float y\nproperty float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n";

    #[test]
    fn the_three_encodings_read_alike() {
        let mut ascii = header("ascii", 2, XYZ_RGB);
        ascii.extend(b"1 2 3 10 20 30\n-1 0.5 2 40 50 60\n");
        let points = [([1.0_f32, 2.0, 3.0], [10_u8, 20, 30]), ([-1.0, 0.5, 2.0], [40, 50, 60])];
        let mut little = header("binary_little_endian", 2, XYZ_RGB);
        let mut big = header("binary_big_endian", 2, XYZ_RGB);
        for (p, c) in points {
            p.iter().for_each(|v| {
                little.extend(v.to_le_bytes());
                big.extend(v.to_be_bytes());
            });
            little.extend(c);
            big.extend(c);
        }
        for bytes in [ascii, little, big] {
            let loaded = read_bytes(&bytes).unwrap();
            assert_eq!(loaded.cloud.positions, points.map(|(p, _)| Point3::from(p)));
            assert_eq!(loaded.cloud.colours, points.map(|(_, c)| c));
        }
    }

    #[test]
    fn property_order_doubles_and_extra_properties_are_fine() {
        let mut bytes = header(
            "binary_little_endian",
            1,
            "property uchar blue\nproperty double z\nproperty float nx\nproperty double x\nproperty double y\nproperty uchar red\nproperty uchar green\n",
        );
        bytes.push(3);
        bytes.extend(3.0_f64.to_le_bytes());
        bytes.extend(9.0_f32.to_le_bytes());
        bytes.extend(1.0_f64.to_le_bytes());
        bytes.extend(2.0_f64.to_le_bytes());
        bytes.extend([1, 2]);
        let loaded = read_bytes(&bytes).unwrap();
        assert_eq!((loaded.cloud.positions[0], loaded.cloud.colours[0]), (Point3::new(1.0, 2.0, 3.0), [1, 2, 3]));
    }

    #[test]
    fn points_that_are_not_finite_are_dropped_and_counted() {
        let mut bytes = header("ascii", 2, XYZ_RGB);
        bytes.extend(b"nan 2 3 10 20 30\n1 1 1 0 0 0\n");
        let loaded = read_bytes(&bytes).unwrap();
        assert_eq!((loaded.cloud.len(), loaded.dropped), (1, 1));
    }

    #[test]
    fn colours_that_are_not_numbers_are_grey_and_counted() {
        let mut bytes = header(
            "ascii",
            2,
            "property float x\nproperty float y\nproperty float z\nproperty float red\nproperty float green\nproperty float blue\n",
        );
        bytes.extend(b"1 2 3 nan 0.5 1\n1 1 1 0 0 0\n");
        let loaded = read_bytes(&bytes).unwrap();
        assert_eq!((loaded.cloud.len(), loaded.without_colour), (2, 1));
        assert_eq!(loaded.cloud.colours, [[128, 128, 255], [0; 3]]);
    }

    #[test]
    fn broken_files_are_named() {
        for (bytes, expected) in [
            (b"hello".to_vec(), "not a PLY file"),
            (header("binary_little_endian", 1_000_000_000, XYZ_RGB), "announces 1000000000 vertices"),
            ([header("binary_little_endian", 3, XYZ_RGB), vec![0; 20]].concat(), "truncated"),
            ([header("ascii", 2, XYZ_RGB), b"1 2 3 4 5 6\n".to_vec()].concat(), "1 of 2 vertices"),
            (b"ply\nformat binary_little_endian 1.0\nelement foo 400000000\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n".to_vec(), "400000000 rows"),
            ([header("ascii", 1, XYZ_RGB), b"500000 5400000 3 4 5 6\n".to_vec()].concat(), "10 km"),
            ([header("ascii", 1, XYZ_RGB), b"3e38 0 3 4 5 6\n".to_vec()].concat(), "10 km"),
            ([header("ascii", 1, "property float x\nproperty float y\n"), b"1 2\n".to_vec()].concat(), "no property z"),
            (header("ascii", 0, XYZ_RGB), "no points"),
        ] {
            let message = read_bytes(&bytes).unwrap_err().to_string();
            assert!(message.contains(expected) && message.contains("cloud.ply"), "{message}");
        }
    }

    proptest! {
        #[test]
        fn noise_never_panics(bytes in prop::collection::vec(any::<u8>(), 0..300), count in 0_usize..9) {
            let _ = read_bytes(&[header("binary_little_endian", count, XYZ_RGB), bytes.clone()].concat());
            let _ = read_bytes(&[header("ascii", count, XYZ_RGB), bytes].concat());
        }
    }
}
