//! Writes USDZ: one text layer, `scene.usda`, stored in a zip as the format requires: uncompressed,
//! with its data at a multiple of 64 bytes.
//!
//! ```text
//! /Scene                 Z up, meters
//!   /mug_31              displayName "mug"; attributes uniground:id, uniground:name, …
//!     /points            Points
//!     /outline           BasisCurves: the twelve edges of its box
//!   …
//!   /rest_of_the_scan    Points that belong to no thing
//! ```
//! Positions are rounded to a tenth of a millimeter.

use super::{EDGES, Export, ObjectDescription, REST, box_corners, srgb_to_linear};
use std::fmt::{self, Display, Formatter};
use std::io::{self, BufWriter, Seek, Write};
use uniground_geometry::Point3;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::scene::{Instance, Support, id_color};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, DateTime, ZipWriter};

const LAYER: &str = "scene.usda";
const ALIGNMENT: u16 = 64;
/// Drawn width of points and lines, meters.
const POINT_WIDTH_M: f32 = 0.01;
const LINE_WIDTH_M: f32 = 0.005;

/// Writes a scene as USDZ.
///
/// # Errors
/// Returns errors of `out`.
pub fn write_usdz(export: &Export, out: impl Write + Seek) -> io::Result<()> {
    let options = SimpleFileOptions::default()
        .compression_method(CompressionMethod::Stored)
        .with_alignment(ALIGNMENT)
        // The same scene gives the same bytes at any time.
        .last_modified_time(DateTime::default());
    let mut archive = ZipWriter::new(out);
    archive.start_file(LAYER, options)?;
    let mut layer = BufWriter::new(&mut archive);
    write_layer(export, &mut layer)?;
    layer.flush()?;
    drop(layer);
    archive.finish()?.flush()
}

fn write_layer(export: &Export, out: &mut impl Write) -> io::Result<()> {
    let (things, rest) = export.group_points();
    let light: Vec<String> =
        (0..=255).map(|channel| format!("{:.4}", srgb_to_linear(channel))).collect();
    writeln!(
        out,
        "#usda 1.0\n(\n    defaultPrim = \"Scene\"\n    metersPerUnit = 1\n    upAxis = \"Z\"\n)\n"
    )?;
    writeln!(out, "def Xform \"Scene\" (\n    displayName = {}\n)\n{{", QuotedText(export.title))?;
    for (thing, points) in &things {
        let name = thing.label();
        writeln!(
            out,
            "    def Xform \"{}_{}\" (\n        displayName = {}\n    )\n    {{",
            to_identifier(name),
            thing.id,
            QuotedText(name)
        )?;
        write_attributes(&ObjectDescription::from_instance(thing), out)?;
        write_points(export, "points", points, &light, out)?;
        write_outline(thing, &light, out)?;
        writeln!(out, "    }}")?;
    }
    write_points(export, &to_identifier(REST), &rest, &light, out)?;
    writeln!(out, "}}")
}

fn write_attributes(of: &ObjectDescription, out: &mut impl Write) -> io::Result<()> {
    let ObjectDescription {
        id,
        name,
        label,
        confidence,
        level,
        structure,
        aabb,
        oriented_box,
        support,
    } = of;
    let mut attribute = |kind: &str, name: &str, value: &dyn Display| {
        writeln!(out, "        custom {kind} uniground:{name} = {value}")
    };
    attribute("int", "id", id)?;
    attribute("string", "name", &QuotedText(name))?;
    attribute("string", "label", &QuotedText(label))?;
    if let Some(confidence) = confidence {
        attribute("float", "confidence", confidence)?;
    }
    attribute("string", "level", &QuotedText(level.as_str()))?;
    if let Some(structure) = structure {
        attribute("string", "structure", &QuotedText(structure.as_str()))?;
    }
    attribute("float3", "box:center", &Vec3Text(aabb.center.into()))?;
    attribute("float3", "box:size", &Vec3Text(aabb.size.into()))?;
    attribute("float3", "oriented_box:center", &Vec3Text(oriented_box.center.into()))?;
    attribute("float3", "oriented_box:size", &Vec3Text(oriented_box.size.into()))?;
    attribute("float", "oriented_box:yaw_rad", &oriented_box.yaw_rad)?;
    let (on, id) = match support {
        Support::Floor => ("floor", None),
        Support::Instance { id } => ("instance", Some(id)),
        Support::Wall { id } => ("wall", Some(id)),
        Support::Nothing => ("nothing", None),
    };
    attribute("string", "support:on", &QuotedText(on))?;
    id.map_or(Ok(()), |id| attribute("int", "support:id", id))
}

fn write_points(
    export: &Export,
    name: &str,
    points: &[u32],
    light: &[String],
    out: &mut impl Write,
) -> io::Result<()> {
    let position = |point: &u32| export.cloud.positions[*point as usize];
    let positions: Vec<Point3<f32>> = points.iter().map(position).collect();
    let Some(extent) = Aabb::around(&positions) else { return Ok(()) };
    writeln!(out, "        def Points \"{name}\"\n        {{")?;
    write_extent(&extent, POINT_WIDTH_M, out)?;
    write_list("point3f[] points", positions.iter().map(|p| Vec3Text((*p).into())), out)?;
    let color = |point: &u32| PointColor(export.cloud.colors[*point as usize], light);
    write_spread("color3f[] primvars:displayColor", points.iter().map(color), "vertex", out)?;
    write_spread("float[] widths", [POINT_WIDTH_M], "constant", out)?;
    writeln!(out, "        }}")
}

fn write_outline(thing: &Instance, light: &[String], out: &mut impl Write) -> io::Result<()> {
    let corners = box_corners(&thing.oriented_box);
    writeln!(
        out,
        "        def BasisCurves \"outline\"\n        {{\n            uniform token type = \"linear\""
    )?;
    if let Some(extent) = Aabb::around(&corners) {
        write_extent(&extent, LINE_WIDTH_M, out)?;
    }
    write_list("int[] curveVertexCounts", EDGES.iter().map(|edge| edge.len()), out)?;
    write_list(
        "point3f[] points",
        EDGES.as_flattened().iter().map(|corner| Vec3Text(corners[usize::from(*corner)].into())),
        out,
    )?;
    write_spread(
        "color3f[] primvars:displayColor",
        [PointColor(id_color(thing.id.0), light)],
        "constant",
        out,
    )?;
    write_spread("float[] widths", [LINE_WIDTH_M], "constant", out)?;
    writeln!(out, "        }}")
}

/// Writes the extent of drawn geometry. Points and lines have a width.
fn write_extent(around: &Aabb, width_m: f32, out: &mut impl Write) -> io::Result<()> {
    let corner = |corner: Point3<f32>, sign: f32| {
        Vec3Text(corner.map(|at| at + sign * width_m / 2.0).into())
    };
    write_list("float3[] extent", [corner(around.min(), -1.0), corner(around.max(), 1.0)], out)
}

fn write_list<T: Display>(
    name: &str,
    values: impl IntoIterator<Item = T>,
    out: &mut impl Write,
) -> io::Result<()> {
    write_values(name, values, out)?;
    writeln!(out)
}

/// Writes a list like [`write_list`] does, for data with one value per point (`vertex`) or one for
/// all (`constant`).
fn write_spread<T: Display>(
    name: &str,
    values: impl IntoIterator<Item = T>,
    over: &str,
    out: &mut impl Write,
) -> io::Result<()> {
    write_values(name, values, out)?;
    // The format requires it on the line of the list.
    writeln!(out, " (\n                interpolation = \"{over}\"\n            )")
}

fn write_values<T: Display>(
    name: &str,
    values: impl IntoIterator<Item = T>,
    out: &mut impl Write,
) -> io::Result<()> {
    write!(out, "            {name} = [")?;
    for (at, value) in values.into_iter().enumerate() {
        write!(out, "{}{value}", if at == 0 { "" } else { ", " })?;
    }
    write!(out, "]")
}

/// Converts a name to a valid identifier of the format: ASCII letters, digits and underscores.
fn to_identifier(name: &str) -> String {
    const LONGEST: usize = 60;
    let mut identifier: String = name
        .chars()
        .take(LONGEST)
        .map(|c| if c.is_ascii_alphanumeric() { c } else { '_' })
        .collect();
    if !identifier.starts_with(|c: char| c.is_ascii_alphabetic()) {
        identifier.insert(0, '_');
    }
    identifier
}

/// Text in quotation marks, escaped.
struct QuotedText<'a>(&'a str);

impl Display for QuotedText<'_> {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        f.write_str("\"")?;
        for c in self.0.chars() {
            match c {
                '"' | '\\' => write!(f, "\\{c}")?,
                // Names are a single line.
                c if c.is_control() => f.write_str(" ")?,
                c => write!(f, "{c}")?,
            }
        }
        f.write_str("\"")
    }
}

struct Vec3Text([f32; 3]);

impl Display for Vec3Text {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let [x, y, z] = self.0;
        write!(f, "({x:.4}, {y:.4}, {z:.4})")
    }
}

/// A color, with the linear light of each channel as text.
struct PointColor<'a>([u8; 3], &'a [String]);

impl Display for PointColor<'_> {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let [red, green, blue] = self.0.map(|channel| &self.1[usize::from(channel)]);
        write!(f, "({red}, {green}, {blue})")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::{Room, room};
    use std::io::{Cursor, Read};
    use zip::ZipArchive;

    fn layer(room: &Room) -> String {
        let mut bytes = Cursor::new(Vec::new());
        write_usdz(
            &Export::new("my \"room\"", &room.cloud, &room.of_point, &room.instances, usize::MAX),
            &mut bytes,
        )
        .unwrap();
        let mut archive = ZipArchive::new(bytes).unwrap();
        let mut text = String::new();
        for at in 0..archive.len() {
            let mut file = archive.by_index(at).unwrap();
            assert_eq!(
                (file.compression(), file.data_start().unwrap() % 64),
                (CompressionMethod::Stored, 0),
                "{:?}",
                file.name()
            );
            file.read_to_string(&mut text).unwrap();
        }
        assert_eq!(archive.file_names().map(Result::unwrap).collect::<Vec<_>>(), [LAYER]);
        text
    }

    #[test]
    fn layer_contains_units_names_and_properties() {
        let mut room = room();
        room.instances[2].given_name = Some("3rd \"best\" m\u{fc}g".into());
        let text = layer(&room);
        assert!(text.starts_with("#usda 1.0\n"), "{text}");
        for expected in [
            "upAxis = \"Z\"",
            "metersPerUnit = 1",
            "displayName = \"my \\\"room\\\"\"",
            "def Xform \"coffee_table_2\"",
            "def Xform \"_3rd__best__m_g_3\"",
            "displayName = \"3rd \\\"best\\\" m\u{fc}g\"",
            "custom string uniground:label = \"mug\"",
            "custom string uniground:support:on = \"instance\"",
            "custom int uniground:support:id = 2",
            "custom float uniground:oriented_box:yaw_rad = 0.5",
            "def Points \"rest_of_the_scan\"",
            "widths = [0.01] (\n",
        ] {
            assert!(text.contains(expected), "{expected}: {text}");
        }
        assert_eq!(
            (text.matches('{').count(), text.matches("def Points").count()),
            (text.matches('}').count(), 4)
        );
        assert_eq!(text, layer(&room));
    }

    #[test]
    fn identifiers_are_valid_for_any_name() {
        for (name, expected) in [
            ("mug", "mug"),
            ("coffee table", "coffee_table"),
            ("3D", "_3D"),
            ("", "_"),
            ("\u{6905}", "__"),
        ] {
            assert_eq!(to_identifier(name), expected);
        }
    }
}
