//! The same room as a bare cloud in every format.

use crate::room::{Points, cloud, mesh};
use crate::writers::Out;
use nalgebra::{Matrix4, Point3};
use std::fmt::Write;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::progress::Progress;
use uniground_geometry::up_axis::UpAxis;
use uniground_ingest::InspectedScan;
use uniground_types::settings::ImportSettings;

fn xyz(points: &Points) -> Vec<u8> {
    let mut text = String::new();
    points.iter().for_each(|(p, [r, g, b])| {
        writeln!(text, "{:.4} {:.4} {:.4} {r} {g} {b}", p.x, p.y, p.z).unwrap();
    });
    text.into_bytes()
}

fn obj(points: &Points) -> Vec<u8> {
    let mut text = String::from("# vertices\n");
    points.iter().for_each(|(p, c)| {
        writeln!(
            text,
            "v {:.4} {:.4} {:.4} {:.3} {:.3} {:.3}",
            p.x,
            p.y,
            p.z,
            f64::from(c[0]) / 255.0,
            f64::from(c[1]) / 255.0,
            f64::from(c[2]) / 255.0
        )
        .unwrap();
    });
    text.into_bytes()
}

fn pcd(points: &Points) -> Vec<u8> {
    let n = points.len();
    let mut bytes =
        format!("VERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH {n}\nHEIGHT 1\nPOINTS {n}\nDATA binary\n")
            .into_bytes();
    for (p, [r, g, b]) in points {
        [p.x, p.y, p.z].iter().for_each(|v| bytes.extend((*v as f32).to_le_bytes()));
        bytes.extend([*b, *g, *r, 0]);
    }
    bytes
}

pub fn ply(points: &Points) -> Vec<u8> {
    let mut bytes = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty double x\nproperty double y\nproperty double z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n",
        points.len()
    )
    .into_bytes();
    for (p, c) in points {
        [p.x, p.y, p.z].iter().for_each(|v| bytes.extend(v.to_le_bytes()));
        bytes.extend(c);
    }
    bytes
}

fn las(points: &Points, compressed: bool) -> Vec<u8> {
    let mut builder = las::Builder::from((1, 4));
    builder.point_format = las::point::Format::new(2).unwrap();
    builder.point_format.is_compressed = compressed;
    let at = |offset: f64| las::Transform { scale: 0.0001, offset };
    let first = points[0].0;
    builder.transforms =
        las::Vector { x: at(first.x.round()), y: at(first.y.round()), z: at(first.z.round()) };
    let mut writer =
        las::Writer::new(std::io::Cursor::new(Vec::new()), builder.into_header().unwrap()).unwrap();
    for (p, c) in points {
        let [red, green, blue] = c.map(|c| u16::from(c) * 257);
        writer
            .write_point(las::Point {
                x: p.x,
                y: p.y,
                z: p.z,
                color: Some(las::Color { red, green, blue }),
                ..las::Point::default()
            })
            .unwrap();
    }
    writer.into_inner().unwrap().into_inner()
}

fn e57(points: &Points) -> Vec<u8> {
    use e57::{E57Writer, Record, RecordValue};
    let file = tempfile::NamedTempFile::new().unwrap();
    let mut writer = E57Writer::from_file(file.path(), "test").unwrap();
    let prototype = vec![
        Record::CARTESIAN_X_F64,
        Record::CARTESIAN_Y_F64,
        Record::CARTESIAN_Z_F64,
        Record::COLOR_RED_U8,
        Record::COLOR_GREEN_U8,
        Record::COLOR_BLUE_U8,
    ];
    let mut cloud = writer.add_pointcloud("cloud", prototype).unwrap();
    for (p, c) in points {
        let mut values: Vec<RecordValue> = [p.x, p.y, p.z].map(RecordValue::Double).to_vec();
        values.extend(c.map(|c| RecordValue::Integer(i64::from(c))));
        cloud.add_point(values).unwrap();
    }
    cloud.finalize().unwrap();
    writer.finalize().unwrap();
    std::fs::read(file.path()).unwrap()
}

fn transform_points(points: &Points, by: impl Fn(&Point3<f64>) -> Point3<f64>) -> Points {
    points.iter().map(|(p, c)| (by(p), *c)).collect()
}

fn read(name: &str, bytes: &[u8]) -> InspectedScan {
    crate::with_import(
        |out: &Out| out.put(name, bytes),
        |found| found.unwrap_or_else(|e| panic!("{name}: {e}")),
    )
}

/// Checks that the cloud is the room up to sampling and rounding: its box to a centimeter, its red
/// points, and the floor below.
fn check(what: &str, found: &InspectedScan) {
    check_shape(what, found);
    let colors = &found.cloud.as_ref().unwrap().colors;
    let reds = colors.iter().filter(|c| c[0].abs_diff(190) < 3 && c[1] < 40).count();
    assert!(reds > 500, "{what}: {reds} red points");
}

fn check_shape(what: &str, found: &InspectedScan) {
    let cloud = found.cloud.as_ref().unwrap();
    let extent = Aabb::around(&cloud.positions).unwrap();
    for (side, expected) in [(extent.size.x, 5.2), (extent.size.y, 4.2), (extent.size.z, 2.5)] {
        assert!((side - expected).abs() < 0.01, "{what}: {extent:?} {:?}", found.report);
    }
    // The floor is at the bottom.
    let low = cloud
        .positions
        .iter()
        .filter(|p| p.z < extent.center.z - extent.size.z / 2.0 + 0.02)
        .count();
    let high = cloud
        .positions
        .iter()
        .filter(|p| p.z > extent.center.z + extent.size.z / 2.0 - 0.02)
        .count();
    assert!(low > 5 * high, "{what}: {low} points below, {high} above: {:?}", found.report);
}

#[test]
fn every_format_gives_the_same_cloud() {
    let points = cloud();
    for (name, bytes) in [
        ("room.ply", ply(&points)),
        ("room.pcd", pcd(&points)),
        ("room.xyz", xyz(&points)),
        ("room.obj", obj(&points)),
        ("room.las", las(&points, false)),
        ("room.laz", las(&points, true)),
        ("room.e57", e57(&points)),
    ] {
        let found = read(name, &bytes);
        check(name, &found);
        assert_eq!(found.report.cloud_points, Some(points.len() as u64), "{name}");
    }
}

/// A mesh with few vertices is sampled, so it gives the same cloud as a dense one.
#[test]
fn meshes_with_few_vertices_give_the_same_cloud() {
    let (corners, squares) = mesh();
    let mut in_obj = obj(&corners);
    let mut in_ply = String::from_utf8_lossy(&ply(&corners))
        .split("end_header")
        .next()
        .unwrap()
        .to_owned()
        .into_bytes();
    in_ply.extend(
        format!(
            "element face {}\nproperty list uchar uint vertex_indices\nend_header\n",
            squares.len()
        )
        .bytes(),
    );
    for (p, c) in &corners {
        [p.x, p.y, p.z].iter().for_each(|v| in_ply.extend(v.to_le_bytes()));
        in_ply.extend(c);
    }
    for square in &squares {
        in_obj.extend(
            format!("f {} {} {} {}\n", square[0] + 1, square[1] + 1, square[2] + 1, square[3] + 1)
                .bytes(),
        );
        in_ply.push(4);
        square.iter().for_each(|i| in_ply.extend((*i as u32).to_le_bytes()));
    }
    let sampled: Vec<InspectedScan> = [("room.obj", in_obj), ("room.ply", in_ply)]
        .into_iter()
        .map(|(name, bytes)| {
            let found = read(name, &bytes);
            check(name, &found);
            found
        })
        .collect();
    let points =
        sampled.iter().map(|found| found.cloud.as_ref().unwrap().len()).collect::<Vec<_>>();
    assert!(points[0].abs_diff(points[1]) < 2 && points[0] > 500_000, "{points:?}");
}

#[test]
fn rotated_and_scaled_clouds_are_leveled_and_converted_to_meters() {
    let points = cloud();
    let y_up = crate::room::y_up();
    // The axes of a camera that looks down at an angle: x right, y down, z forward.
    let camera = crate::pose(2).inverse().to_homogeneous();
    let with = |m: Matrix4<f64>| transform_points(&points, |p| m.transform_point(p));
    for (what, turned) in [
        ("Y up", with(y_up)),
        ("seen from a camera", with(camera)),
        ("millimeters", transform_points(&points, |p| p * 1000.0)),
    ] {
        let found = read("room.ply", &ply(&turned));
        let cloud = found.cloud.as_ref().unwrap();
        let height = Aabb::around(&cloud.positions).unwrap().size.z;
        assert!((height - 2.5).abs() < 0.05, "{what}: {height} m high: {:?}", found.report);
        if what != "seen from a camera" {
            check(what, &found);
        }
        let way = found.report.source_to_scene.unwrap();
        for (source, p) in turned.iter().zip(&cloud.positions).step_by(997) {
            let scene = way.apply([source.0.x, source.0.y, source.0.z]);
            assert!(
                (0..3).all(|i| (scene[i] - f64::from(p[i])).abs() < 1e-3),
                "{what}: {scene:?} {p}"
            );
        }
    }
}

/// A binary glTF of points.
fn glb(points: &Points) -> Vec<u8> {
    let mut buffer = Vec::new();
    points
        .iter()
        .for_each(|(p, _)| p.iter().for_each(|v| buffer.extend((*v as f32).to_le_bytes())));
    let colors_at = buffer.len();
    points.iter().for_each(|(_, [r, g, b])| buffer.extend([*r, *g, *b, 255]));
    let bounds = Aabb::around(&points.iter().map(|(p, _)| p.cast()).collect::<Vec<_>>()).unwrap();
    let (low, high) = (bounds.center - bounds.size / 2.0, bounds.center + bounds.size / 2.0);
    let mut text = serde_json::json!({
        "asset": {"version": "2.0"},
        "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"mode": 0, "attributes": {"POSITION": 0, "COLOR_0": 1}}]}],
        "buffers": [{"byteLength": buffer.len()}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": colors_at},
            {"buffer": 0, "byteOffset": colors_at, "byteLength": buffer.len() - colors_at}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": points.len(), "type": "VEC3",
             "min": [low.x, low.y, low.z], "max": [high.x, high.y, high.z]},
            {"bufferView": 1, "componentType": 5121, "normalized": true, "count": points.len(),
             "type": "VEC4"}],
    })
    .to_string();
    while !text.len().is_multiple_of(4) {
        text.push(' ');
    }
    let length = |bytes: usize| (bytes as u32).to_le_bytes();
    let mut file = b"glTF\x02\0\0\0".to_vec();
    file.extend(length(28 + text.len() + buffer.len()));
    file.extend(length(text.len()));
    file.extend(b"JSON");
    file.extend(text.bytes());
    file.extend(length(buffer.len()));
    file.extend(b"BIN\0");
    file.extend(buffer);
    file
}

/// glTF defines Y up. Programs write clouds with Z up into it nevertheless.
#[test]
fn a_gltf_that_stands_along_another_axis_is_found_out() {
    let points = cloud();
    let y_up = crate::room::y_up();
    let by_the_format = transform_points(&points, |p| y_up.transform_point(p));
    for (points, up, warned) in [(&by_the_format, "y", false), (&points, "z", true)] {
        let found = read("room.glb", &glb(points));
        assert_eq!(found.report.up.name(), up, "{:?}", found.report);
        check_shape("glb", &found);
        let told = found.report.warnings.iter().any(|w| w.contains("the format defines y up"));
        assert_eq!(told, warned, "{:?}", found.report);
    }
}

#[test]
fn a_few_wrong_colors_do_not_darken_the_others() {
    let points = cloud();
    let mut text = String::new();
    for (i, (p, color)) in points.iter().enumerate() {
        let [r, g, b] = color.map(|c| f64::from(c) / 255.0);
        let r = if i == 5000 { 90.0 } else { r };
        writeln!(text, "{:.4} {:.4} {:.4} {r:.4} {g:.4} {b:.4}", p.x, p.y, p.z).unwrap();
    }
    let found = read("room.xyz", text.as_bytes());
    check("colors", &found);
    assert!(found.report.warnings.iter().any(|w| w.contains("colors of 1 points")));
}

#[test]
fn map_coordinates_are_recovered_to_the_millimeter() {
    let points = cloud();
    let there =
        transform_points(&points, |p| p + nalgebra::Vector3::new(412_345.678, 5_654_321.123, 87.5));
    for (name, bytes) in
        [("site.las", las(&there, false)), ("site.ply", ply(&there)), ("site.xyz", xyz(&there))]
    {
        let found = read(name, &bytes);
        check(name, &found);
        let way = found.report.source_to_scene.unwrap();
        let p = found.cloud.as_ref().unwrap().positions[1234];
        let back = way.invert([p.x, p.y, p.z].map(f64::from));
        let expected = there[1234].0;
        assert!(
            (0..3).all(|i| (back[i] - expected[i]).abs() < 1e-3),
            "{name}: {back:?} instead of {expected}"
        );
    }
}

/// The up axis of half a room cannot be determined, so the error asks for it.
#[test]
fn a_partial_cloud_is_refused_and_asks_for_the_up_axis() {
    let wall: Points = cloud()
        .into_iter()
        .filter(|(p, _)| p.y > 2.05)
        .map(|(p, c)| (Point3::new(p.x, p.z, -p.y), c))
        .collect();
    crate::with_import(
        |out: &Out| out.put("wall.ply", ply(&wall)),
        |found| {
            let message = found.map(|found| found.report).unwrap_err().to_string();
            assert!(message.ends_with("Set up=z or up=-z"), "{message}");
        },
    );
}

/// A stated axis is used, whatever the cloud shows.
#[test]
fn a_stated_up_axis_that_the_cloud_contradicts_is_a_warning() {
    let folder = tempfile::tempdir().unwrap();
    let root = camino::Utf8Path::from_path(folder.path()).unwrap();
    Out(root).put("room.ply", ply(&cloud()));
    let scan = uniground_ingest::open(root).unwrap();
    for (up, warned) in [(UpAxis::X, true), (UpAxis::Z, false)] {
        let settings = ImportSettings { up: Some(up), ..ImportSettings::default() };
        let found = uniground_ingest::inspect(&scan, &settings, &Progress::silent()).unwrap();
        assert_eq!(found.report.up, up);
        let warnings = &found.report.warnings;
        assert_eq!(warnings.iter().any(|w| w.contains("set up=z")), warned, "{warnings:?}");
    }
}

#[test]
fn odd_points_and_colors_are_named() {
    let warnings = |points: &Points| read("room.ply", &ply(points)).report.warnings.join("; ");
    let plain = cloud();
    assert!(!warnings(&plain).contains("room.ply"), "{}", warnings(&plain));
    let mut zeros = plain.clone();
    zeros.extend(std::iter::repeat_n((Point3::origin(), [9, 9, 9]), plain.len() / 4));
    assert!(warnings(&zeros).contains("at exactly 0 0 0"), "{}", warnings(&zeros));
    let gray: Points = plain.iter().map(|(p, _)| (*p, [77; 3])).collect();
    assert!(warnings(&gray).contains("the same color"), "{}", warnings(&gray));
    let dark: Points = plain.iter().map(|(p, c)| (*p, c.map(|v| v / 20))).collect();
    assert!(warnings(&dark).contains("nearly all points are black"), "{}", warnings(&dark));
}

/// A cloud without walls is assumed to be Z up if its objects stand that way. Rotated onto its
/// side, it is refused.
#[test]
fn a_floor_with_objects_is_assumed_to_be_z_up() {
    let floor: Points = cloud()
        .into_iter()
        .filter(|(p, _)| p.z < 0.9 && p.x.abs() < 2.5 && p.y.abs() < 2.0)
        .collect();
    let found = read("floor.ply", &ply(&floor));
    assert_eq!(found.report.up.name(), "z", "{:?}", found.report);
    let side = transform_points(&floor, |p| Point3::new(p.z, p.x, p.y));
    crate::with_import(
        |out: &Out| out.put("floor.ply", ply(&side)),
        |found| assert!(found.is_err()),
    );
}
