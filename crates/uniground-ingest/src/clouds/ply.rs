//! PLY: ascii, little and big endian; properties by name in any order. Dense meshes are read as
//! their vertices. Coarse meshes are sampled.
//!
//! The `ply-rs-bw` crate parses the header. Rows are read here, one block or line at a time: this
//! is faster, accepts `nan` in ascii files, and never allocates memory based on the header alone.

mod faces;
mod rows;

use super::CloudBuilder;
use super::color_range::{ColorRange, channel_of_name};
use super::gathered::{CloudBounds, GREY};
use crate::IngestError;
use crate::limited_reader::BYTE_ORDER_MARK;
use camino::Utf8Path;
use ply_rs_bw::parser::{Parser, Reader};
use ply_rs_bw::ply::{DefaultElement, ElementDef, Header, PropertyDef, PropertyType, ScalarType};
use rows::PlyRows;
use std::fs::File;
use std::io::{self, BufRead, BufReader, Read};
use uniground_types::findings::{Finding, FindingSubject};

const MAX_HEADER_BYTES: usize = 64 << 10;
/// Maximum number of properties of all elements together.
const MAX_PROPERTIES: usize = 256;

/// Checks the header of a PLY file: whether its vertices can be read, and how many it announces.
///
/// # Errors
/// Returns an [`IngestError`] that names `file` (a path below `root`).
pub fn check(root: &Utf8Path, file: &Utf8Path, bounds: &CloudBounds) -> Result<(), IngestError> {
    let (header, _) = open(root, file)?;
    bounds.check(file, header.elements.get("vertex").map_or(0, |vertex| vertex.count as u64))
}

/// Reads the vertices of a PLY file, or points on its faces if its vertices are sparse. Points
/// without color become mid-gray.
///
/// # Errors
/// Returns an [`IngestError`] that names `file` (a path below `root`).
pub fn read(
    root: &Utf8Path,
    file: &Utf8Path,
    mut gathered: CloudBuilder,
) -> Result<CloudBuilder, IngestError> {
    let malformed = |reason: String| IngestError::malformed(file, reason);
    let (header, mut source) = open(root, file)?;
    let mut has_vertices = false;
    for element in header.elements.values() {
        let rows = PlyRows::new(element, &header.encoding);
        let named = |e: String| malformed(format!("{}: {e}", element.name));
        if has_vertices && rows.has_corners() && element.count > 0 {
            faces::sample_if_sparse(&rows, &mut source, element.count, &mut gathered)
                .map_err(named)?;
            break;
        }
        if element.name != "vertex" {
            rows.skip(&mut source, element.count).map_err(named)?;
            continue;
        }
        let of_channel = |channel: usize| {
            let is_channel = |property: &&PropertyDef| {
                Field::from_name(&property.name).and_then(Field::channel) == Some(channel)
            };
            element.properties.values().find(is_channel)
        };
        gathered.set_has_color((0..3).all(|channel| of_channel(channel).is_some()));
        let is_float = |property: &PropertyDef| {
            matches!(
                property.data_type,
                PropertyType::Scalar(ScalarType::Float | ScalarType::Double)
            )
        };
        let floats = of_channel(0).is_some_and(is_float);
        gathered.set_color_range(if floats { ColorRange::Unit } else { ColorRange::Bytes });
        let in_doubles = |axis: &&str| matches!(element.properties.get(*axis), Some(p) if p.data_type == PropertyType::Scalar(ScalarType::Double));
        if !["x", "y", "z"].iter().any(in_doubles) {
            gathered.set_single_precision();
        }
        if HARMONICS.iter().all(|name| element.properties.contains_key(*name)) {
            let text = "it holds Gaussian splats: their centers are read as points, with their colors. Splats that float in the air become points as well";
            gathered.add_finding(Finding::assumed(FindingSubject::Cloud, text));
        }
        gathered.expect(file, element.count)?;
        rows.read(&mut source, element.count, &mut gathered).map_err(malformed)?;
        has_vertices = true;
        if header.elements.values().next_back().is_some_and(|last| last.name == element.name) {
            let surplus =
                count_surplus(&mut source).map_err(|source| IngestError::reading(file, source))?;
            if surplus > 0 {
                let text = format!(
                    "{surplus} bytes after the {} points that the header declares are not read: does it declare too few?",
                    element.count
                );
                gathered.add_finding(Finding::left_out(FindingSubject::Cloud, text));
            }
        }
        if !header
            .elements
            .values()
            .any(|element| PlyRows::new(element, &header.encoding).has_corners())
        {
            break;
        }
    }
    Ok(gathered)
}

/// Returns the number of bytes up to the end of the file, without white space.
fn count_surplus(source: &mut impl BufRead) -> io::Result<u64> {
    let mut surplus = 0;
    loop {
        let block = source.fill_buf()?;
        if block.is_empty() {
            return Ok(surplus);
        }
        surplus += block.iter().filter(|byte| !byte.is_ascii_whitespace()).count() as u64;
        let read = block.len();
        source.consume(read);
    }
}

/// Returns the checked header, and the file positioned at the first row.
fn open(root: &Utf8Path, file: &Utf8Path) -> Result<(Header, BufReader<File>), IngestError> {
    let malformed = |reason: String| IngestError::malformed(file, reason);
    let source =
        File::open(root.join(file)).map_err(|source| IngestError::reading(file, source))?;
    let bytes = source.metadata().map_or(u64::MAX, |m| m.len());
    let mut source = BufReader::with_capacity(1 << 20, source);
    let text = header_text(&mut source).map_err(|e| malformed(format!("not a PLY file: {e}")))?;
    let header = Parser::<DefaultElement>::new()
        .read_header(&mut Reader::new(&text[..]))
        .map_err(|e| malformed(format!("not a PLY file: {e}")))?;
    let properties: usize = header.elements.values().map(|element| element.properties.len()).sum();
    if properties > MAX_PROPERTIES {
        return Err(malformed(format!(
            "it declares {properties} properties; the limit is {MAX_PROPERTIES}"
        )));
    }
    let vertex = header
        .elements
        .get("vertex")
        .ok_or_else(|| malformed("it has no vertex element".into()))?;
    for axis in ["x", "y", "z"] {
        if !vertex.properties.contains_key(axis) {
            return Err(malformed(format!("its vertices have no property {axis}")));
        }
    }
    // The shortest row takes three bytes. A count that does not fit into the file must not cause an
    // allocation.
    if vertex.count as u64 > bytes / 3 {
        return Err(malformed(format!(
            "it declares {} vertices but has only {bytes} bytes",
            vertex.count
        )));
    }
    // The same check for elements before the vertices: their rows are read too.
    let lies = |e: &&ElementDef| e.count as u64 > bytes || (e.properties.is_empty() && e.count > 0);
    if let Some(liar) = header.elements.values().find(lies) {
        return Err(malformed(format!(
            "it declares {} rows of {:?} but has only {bytes} bytes",
            liar.count, liar.name
        )));
    }
    Ok((header, source))
}

/// Reads the lines up to and including `end_header`, without comments: they can be in any encoding.
fn header_text(source: &mut impl BufRead) -> io::Result<Vec<u8>> {
    let (mut text, mut skipped) = (Vec::new(), 0);
    loop {
        let line_start = text.len();
        let most = MAX_HEADER_BYTES.saturating_sub(text.len() + skipped) as u64;
        if source.take(most).read_until(b'\n', &mut text)? == 0 {
            let reason = if most == 0 {
                "its header has no end_header"
            } else {
                "it ends within its header"
            };
            return Err(io::Error::other(reason));
        }
        match text[line_start..].trim_ascii() {
            b"end_header" => return Ok(text),
            line if line_start == 0 && line != b"ply" => {
                let Some(b"ply") = line.strip_prefix(BYTE_ORDER_MARK) else {
                    return Err(io::Error::other("it does not begin with \"ply\""));
                };
                text.drain(..BYTE_ORDER_MARK.len());
            }
            line if line.starts_with(b"comment") || line.starts_with(b"obj_info") => {
                skipped += text.len() - line_start;
                text.truncate(line_start);
            }
            _ => {}
        }
    }
}

impl Vertex {
    fn push_to(&self, gathered: &mut CloudBuilder) {
        match gathered.has_color() {
            false => gathered.push(self.position, GREY),
            true => gathered.push_channels(self.position, self.channels),
        }
    }
}

/// One vertex.
#[derive(Clone, Copy)]
struct Vertex {
    position: [f64; 3],
    /// Red, green and blue as they are in the file.
    channels: [f64; 3],
}

/// A property that is used.
#[derive(Clone, Copy)]
enum Field {
    Coordinate(usize),
    Channel(usize),
    /// The constant part of the color of a Gaussian, in spherical harmonics.
    Harmonic(usize),
}

impl Field {
    fn from_name(name: &str) -> Option<Self> {
        let coordinate = ["x", "y", "z"].iter().position(|known| *known == name);
        let harmonic = || HARMONICS.iter().position(|known| *known == name).map(Self::Harmonic);
        coordinate
            .map(Self::Coordinate)
            .or_else(|| channel_of_name(name).map(Self::Channel))
            .or_else(harmonic)
    }

    fn channel(self) -> Option<usize> {
        match self {
            Self::Coordinate(_) => None,
            Self::Channel(channel) | Self::Harmonic(channel) => Some(channel),
        }
    }
}

/// Properties of Gaussian splats that hold their color, and the value of the constant spherical
/// harmonic.
const HARMONICS: [&str; 3] = ["f_dc_0", "f_dc_1", "f_dc_2"];
const CONSTANT_HARMONIC: f64 = 0.282_094_791_773_878_14;

impl Vertex {
    fn new() -> Self {
        Self { position: [f64::NAN; 3], channels: [f64::NAN; 3] }
    }

    #[inline]
    fn set(&mut self, field: Field, value: f64) {
        match field {
            Field::Coordinate(axis) => self.position[axis] = value,
            Field::Channel(channel) => self.channels[channel] = value,
            Field::Harmonic(channel) => {
                self.channels[channel] = (0.5 + CONSTANT_HARMONIC * value).clamp(0.0, 1.0);
            }
        }
    }
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
        std::fs::write(root.join("cloud.ply"), bytes).unwrap();
        clouds::read(
            root,
            Utf8Path::new("cloud.ply"),
            &CloudBounds { announced: 1 << 30, kept: 1 << 30 },
            CoordinateOrigin::Free,
        )
    }

    fn header(encoding: &str, count: usize, properties: &str) -> Vec<u8> {
        format!("ply\nformat {encoding} 1.0\nelement vertex {count}\n{properties}end_header\n")
            .into_bytes()
    }

    const XYZ_RGB: &str = "property float x\nproperty float y\nproperty float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n";

    #[test]
    fn all_encodings_give_the_same_cloud() {
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
            assert_eq!(loaded.cloud.colors, points.map(|(_, c)| c));
        }
    }

    #[test]
    fn any_property_order_doubles_and_extra_properties_are_supported() {
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
        assert_eq!(
            (loaded.cloud.positions[0], loaded.cloud.colors[0]),
            (Point3::new(1.0, 2.0, 3.0), [1, 2, 3])
        );
    }

    #[test]
    fn color_channels_have_several_usual_names() {
        for [red, green, blue] in
            [["r", "g", "b"], ["diffuse_red", "diffuse_green", "diffuse_blue"], ["R", "G", "B"]]
        {
            let names = XYZ_RGB.replace("red", red).replace("green", green).replace("blue", blue);
            let bytes = [&header("ascii", 1, &names)[..], b"1 2 3 10 20 30\n"].concat();
            let loaded = read_bytes(&bytes).unwrap();
            assert!(loaded.has_color && loaded.cloud.colors == [[10, 20, 30]], "{red}");
        }
    }

    #[test]
    fn gaussian_splats_are_read_as_colored_points() {
        let names = XYZ_RGB
            .replace("uchar red", "float f_dc_0")
            .replace("uchar green", "float f_dc_1")
            .replace("uchar blue", "float f_dc_2");
        let bytes = [&header("ascii", 1, &names)[..], b"1 2 3 0 1.7724539 -9\n"].concat();
        let loaded = read_bytes(&bytes).unwrap();
        assert!(loaded.has_color && loaded.cloud.colors == [[128, 255, 0]], "{loaded:?}");
        assert!(loaded.findings[0].text.contains("Gaussian splats"), "{:?}", loaded.findings);
    }

    #[test]
    fn data_after_the_declared_points_is_named() {
        let rows = b"1 2 3 10 20 30\n4 5 6 10 20 30\n\n";
        let findings = |count| {
            let bytes = [&header("ascii", count, XYZ_RGB)[..], rows].concat();
            read_bytes(&bytes).unwrap().findings
        };
        assert_eq!(findings(2), []);
        let [finding] = &findings(1)[..] else { panic!() };
        assert!(finding.text.contains("after the 1 points"), "{}", finding.text);
    }

    #[test]
    fn points_that_are_not_finite_are_dropped_and_counted() {
        let mut bytes = header("ascii", 2, XYZ_RGB);
        bytes.extend(b"nan 2 3 10 20 30\n1 1 1 0 0 0\n");
        let loaded = read_bytes(&bytes).unwrap();
        assert_eq!((loaded.cloud.len(), loaded.dropped), (1, 1));
    }

    #[test]
    fn colors_that_are_not_numbers_become_gray_and_are_counted() {
        let mut bytes = header(
            "ascii",
            2,
            "property float x\nproperty float y\nproperty float z\nproperty float red\nproperty float green\nproperty float blue\n",
        );
        bytes.extend(b"1 2 3 nan 0.5 1\n1 1 1 0 0 0\n");
        let loaded = read_bytes(&bytes).unwrap();
        assert_eq!((loaded.cloud.len(), loaded.without_color), (2, 1));
        assert_eq!(loaded.cloud.colors, [[128, 128, 255], [0; 3]]);
    }

    #[test]
    fn range_of_color_channels_is_told_from_the_values() {
        let colors = |kind: &str, rows: &str| {
            let properties = ["red", "green", "blue"].map(|c| format!("property {kind} {c}\n"));
            let xyz = "property float x\nproperty float y\nproperty float z\n";
            let count = rows.lines().count();
            let mut bytes = header("ascii", count, &format!("{xyz}{}", properties.concat()));
            bytes.extend(rows.bytes());
            read_bytes(&bytes).unwrap().cloud.colors
        };
        let (unit, bytes) = ("1 2 3 0 0.4 1\n", "1 2 3 0 1 1\n1 2 3 4 102 255\n");
        assert_eq!(colors("float", unit), [[0, 102, 255]]);
        assert_eq!(colors("float", bytes), [[0, 1, 1], [4, 102, 255]]);
        assert_eq!(colors("ushort", bytes), [[0, 1, 1], [4, 102, 255]]);
        assert_eq!(colors("float", "1 2 3 0 0.4 inf\n"), [[0, 102, 255]]);
        let words = "1 2 3 0 100 200\n1 2 3 257 25700 65535\n";
        assert_eq!(colors("ushort", words), [[0, 0, 1], [1, 100, 255]]);
        assert_eq!(colors("double", words), [[0, 0, 1], [1, 100, 255]]);
    }

    #[test]
    fn comments_in_any_encoding_and_byte_order_marks_are_skipped() {
        let rows = [&header("ascii", 1, XYZ_RGB)[..], b"1 2 3 10 20 30\n"].concat();
        let commented = |comment: &[u8]| [b"ply\n", comment, b"\n", &rows[4..]].concat();
        for bytes in [
            commented(b"comment caf\xe9"),
            commented(b"obj_info \xb7\xbf\xbc\xe4"),
            [b"\xef\xbb\xbf", &rows[..]].concat(),
        ] {
            assert_eq!(read_bytes(&bytes).unwrap().cloud.colors, [[10, 20, 30]]);
        }
    }

    /// Lists among the vertices, and faces before them, are skipped in all encodings.
    #[test]
    fn lists_and_other_elements_are_skipped() {
        let layout = |encoding: &str| {
            format!(
                "ply\nformat {encoding} 1.0\nelement face 2\nproperty list uchar int vertex_indices\nelement vertex 2\nproperty float x\n\
                 property list uchar float quality\nproperty float y\nproperty float z\nend_header\n"
            )
            .into_bytes()
        };
        let mut ascii = layout("ascii");
        ascii.extend(b"3 0 1 0\n0\n1 2 9 9 2 3\n4 0 5 6\n");
        let mut little = layout("binary_little_endian");
        little.push(3);
        little.extend([0_i32, 1, 0].iter().flat_map(|v| v.to_le_bytes()));
        little.push(0);
        for (x, quality, y, z) in
            [(1.0_f32, &[9.0_f32, 9.0][..], 2.0_f32, 3.0_f32), (4.0, &[], 5.0, 6.0)]
        {
            little.extend(x.to_le_bytes());
            little.push(quality.len() as u8);
            quality.iter().for_each(|q| little.extend(q.to_le_bytes()));
            little.extend(y.to_le_bytes());
            little.extend(z.to_le_bytes());
        }
        for bytes in [ascii, little] {
            let loaded = read_bytes(&bytes).unwrap();
            assert_eq!(
                loaded.cloud.positions,
                [Point3::new(1.0, 2.0, 3.0), Point3::new(4.0, 5.0, 6.0)]
            );
            assert!(!loaded.has_color);
        }
    }

    /// Limits apply before memory is allocated.
    #[test]
    fn oversized_headers_lines_and_counts_are_refused() {
        let columns: String = (0..300).map(|i| format!("property double c{i}\n")).collect();
        let endless_line = [header("ascii", 1, XYZ_RGB), vec![b'1'; 1 << 20]].concat();
        let endless_header = [&b"ply\ncomment "[..], &vec![b'x'; 1 << 20]].concat();
        for (bytes, expected) in [
            (header("binary_little_endian", 1, &format!("{XYZ_RGB}{columns}")), "306 properties"),
            (endless_line, "longer than 65536 bytes"),
            (endless_header, "header has no end_header"),
        ] {
            let message = read_bytes(&bytes).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
        let folder = tempfile::tempdir().unwrap();
        let root = Utf8Path::from_path(folder.path()).unwrap();
        std::fs::write(root.join("cloud.ply"), header("binary_little_endian", 9, XYZ_RGB)).unwrap();
        let message =
            check(root, Utf8Path::new("cloud.ply"), &CloudBounds { announced: 8, kept: 8 })
                .unwrap_err()
                .to_string();
        assert!(message.contains("declares 9 points"), "{message}");
    }

    #[test]
    fn invalid_files_are_refused_with_the_reason() {
        for (bytes, expected) in [
            (b"hello".to_vec(), "not a PLY file"),
            (header("binary_little_endian", 1_000_000_000, XYZ_RGB), "declares 1000000000 vertices"),
            ([header("binary_little_endian", 3, XYZ_RGB), vec![0; 20]].concat(), "truncated"),
            ([header("ascii", 2, XYZ_RGB), b"1 2 3 4 5 6\n".to_vec()].concat(), "1 of 2 rows"),
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
        fn random_data_never_panics(bytes in prop::collection::vec(any::<u8>(), 0..300), count in 0_usize..9) {
            let _ = read_bytes(&[header("binary_little_endian", count, XYZ_RGB), bytes.clone()].concat());
            let _ = read_bytes(&[header("ascii", count, XYZ_RGB), bytes].concat());
        }
    }
}
