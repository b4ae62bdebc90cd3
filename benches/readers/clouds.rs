//! Large clouds in the most common formats.

use camino::Utf8Path;
use std::fs::File;
use std::io::{BufWriter, Write};

type WriteCloud = fn(&Utf8Path, usize);

pub const FORMATS: [(&str, WriteCloud); 5] = [
    ("cloud.ply", ply),
    ("doubles.ply", ply_doubles),
    ("cloud.pcd", pcd),
    ("cloud.las", las),
    ("cloud.laz", laz),
];

/// Returns a point of a surface with some noise, in meters; the same every time.
fn point(i: usize) -> ([f32; 3], [u8; 3]) {
    let noise = (i.wrapping_mul(2_654_435_761) >> 7) as u32;
    let share = |shift: u32| ((noise >> shift) & 0x3ff) as f32 / 1024.0;
    let (u, v) = ((i % 4000) as f32 / 400.0, (i / 4000) as f32 / 400.0);
    (
        [u + 0.002 * share(0), v + 0.002 * share(10), 0.01 * share(20)],
        [noise as u8, (noise >> 8) as u8, (i >> 8) as u8],
    )
}

fn create(file: &Utf8Path) -> BufWriter<File> {
    BufWriter::with_capacity(1 << 20, File::create(file).unwrap())
}

fn ply(file: &Utf8Path, points: usize) {
    let mut out = create(file);
    write!(
        out,
        "ply\nformat binary_little_endian 1.0\nelement vertex {points}\nproperty float x\nproperty float y\nproperty float z\n"
    )
    .unwrap();
    write!(out, "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n")
        .unwrap();
    for (at, color) in (0..points).map(point) {
        at.iter().for_each(|v| out.write_all(&v.to_le_bytes()).unwrap());
        out.write_all(&color).unwrap();
    }
    out.flush().unwrap();
}

/// With doubles and normals, as photogrammetry writes them.
fn ply_doubles(file: &Utf8Path, points: usize) {
    let mut out = create(file);
    write!(
        out,
        "ply\nformat binary_little_endian 1.0\nelement vertex {points}\nproperty double x\nproperty double y\nproperty double z\n"
    )
    .unwrap();
    write!(out, "property float nx\nproperty float ny\nproperty float nz\n").unwrap();
    write!(out, "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n")
        .unwrap();
    for (at, color) in (0..points).map(point) {
        at.iter().for_each(|v| out.write_all(&f64::from(*v).to_le_bytes()).unwrap());
        out.write_all(&[0; 12]).unwrap();
        out.write_all(&color).unwrap();
    }
    out.flush().unwrap();
}

fn pcd(file: &Utf8Path, points: usize) {
    let mut out = create(file);
    write!(out, "VERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n")
        .unwrap();
    write!(
        out,
        "WIDTH {points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA binary\n"
    )
    .unwrap();
    for (at, [r, g, b]) in (0..points).map(point) {
        at.iter().for_each(|v| out.write_all(&v.to_le_bytes()).unwrap());
        out.write_all(&[b, g, r, 0]).unwrap();
    }
    out.flush().unwrap();
}

fn las(file: &Utf8Path, points: usize) {
    las_of(file, points, false);
}

fn laz(file: &Utf8Path, points: usize) {
    las_of(file, points, true);
}

fn las_of(file: &Utf8Path, points: usize, compressed: bool) {
    let mut builder = las::Builder::from((1, 2));
    builder.point_format = las::point::Format::new(2).unwrap();
    builder.point_format.is_compressed = compressed;
    let to_millimetres = las::Transform { scale: 0.001, offset: 0.0 };
    builder.transforms = las::Vector { x: to_millimetres, y: to_millimetres, z: to_millimetres };
    let mut writer = las::Writer::new(create(file), builder.into_header().unwrap()).unwrap();
    for (at, color) in (0..points).map(point) {
        let [x, y, z] = at.map(f64::from);
        let [red, green, blue] = color.map(|c| u16::from(c) * 257);
        let color = Some(las::Color { red, green, blue });
        writer.write_point(las::Point { x, y, z, color, ..las::Point::default() }).unwrap();
    }
    writer.close().unwrap();
}
