//! Writes clouds as binary little-endian PLY, for any viewer.

use super::{InstanceId, ParsedScene, PointCloud};
use crate::Point3;
use std::io::{self, BufRead, Read, Write};

/// Writes the cloud in its own colors.
///
/// # Errors
/// Returns I/O errors of `out`.
pub fn write_cloud_ply(cloud: &PointCloud, out: impl Write) -> io::Result<()> {
    write(&[], &cloud.positions, |i| (cloud.colors[i], None), out)
}

/// Writes the cloud with one color per instance and the id as the property `instance`.
///
/// # Errors
/// Returns I/O errors of `out`.
pub fn write_instances_ply(scene: &ParsedScene, out: impl Write) -> io::Result<()> {
    write(
        &[],
        &scene.cloud.positions,
        |i| (id_color(scene.instance_of_point[i].0), Some(scene.instance_of_point[i])),
        out,
    )
}

/// Writes points, with one header line for each comment. Comments must be short and ASCII, as
/// programs expect.
///
/// # Errors
/// Returns I/O errors of `out`.
pub fn write<'a>(
    comments: &[String],
    positions: impl IntoIterator<Item = &'a Point3<f32>, IntoIter: ExactSizeIterator>,
    of_point: impl Fn(usize) -> ([u8; 3], Option<InstanceId>),
    out: impl Write,
) -> io::Result<()> {
    let mut out = io::BufWriter::new(out);
    let positions = positions.into_iter();
    let labeled = positions.len() > 0 && of_point(0).1.is_some();
    write!(out, "ply\nformat binary_little_endian 1.0\ncomment metres, Z up\n")?;
    comments.iter().try_for_each(|comment| writeln!(out, "comment {comment}"))?;
    writeln!(out, "element vertex {}", positions.len())?;
    write!(
        out,
        "property float x\nproperty float y\nproperty float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n"
    )?;
    writeln!(out, "{}end_header", if labeled { "property int instance\n" } else { "" })?;
    for (i, p) in positions.enumerate() {
        let (color, instance) = of_point(i);
        for c in [p.x, p.y, p.z] {
            out.write_all(&c.to_le_bytes())?;
        }
        out.write_all(&color)?;
        if let Some(InstanceId(id)) = instance {
            out.write_all(&id.to_le_bytes())?;
        }
    }
    out.flush()
}

/// Reads the thing each point belongs to from the output of [`write_instances_ply`].
///
/// # Errors
/// Returns I/O errors of `file`, or an error for a file that [`write_instances_ply`] did not write.
pub fn read_instance_of_point(mut file: impl BufRead) -> io::Result<Vec<InstanceId>> {
    let malformed =
        || io::Error::new(io::ErrorKind::InvalidData, "not a complete PLY with instances");
    let (mut line, mut count) = (String::new(), None);
    while line != "end_header\n" {
        line.clear();
        if Read::by_ref(&mut file).take(LONGEST_LINE).read_line(&mut line)? == 0 {
            return Err(malformed());
        }
        if let Some(number) = line.strip_prefix("element vertex ") {
            count = number.trim_end().parse::<usize>().ok();
        }
    }
    let mut bytes = Vec::new();
    file.read_to_end(&mut bytes)?;
    let (points, rest) = bytes.as_chunks::<LABELED_BYTES>();
    if !rest.is_empty() || Some(points.len()) != count {
        return Err(malformed());
    }
    Ok(points
        .iter()
        .map(|&[.., a, b, c, d]| InstanceId(u32::from_le_bytes([a, b, c, d])))
        .collect())
}

/// Maximum length of a header line.
const LONGEST_LINE: u64 = 200;
/// Bytes per point: three coordinates, three colors, an id.
const LABELED_BYTES: usize = 19;

/// Returns a color for an id: steps of the golden angle around the hue circle, so that consecutive
/// ids differ.
#[must_use]
pub fn id_color(id: u32) -> [u8; 3] {
    let hue = (id as f32 * 0.618_034).fract() * 6.0;
    let value = if id.is_multiple_of(2) { 0.95 } else { 0.75 };
    [5.0, 3.0, 1.0].map(|n: f32| {
        let k = (n + hue) % 6.0;
        ((value - value * 0.7 * k.min(4.0 - k).clamp(0.0, 1.0)) * 255.0) as u8
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Point3;

    #[test]
    fn instance_ids_are_read_back_from_ply() {
        let positions: Vec<Point3<f32>> = (0..3).map(|i| Point3::new(i as f32, 0.0, 1.0)).collect();
        let ids = [0, 70_000, 2].map(InstanceId);
        let mut bytes = Vec::new();
        write(&[], &positions, |i| (id_color(ids[i].0), Some(ids[i])), &mut bytes).unwrap();
        assert_eq!(read_instance_of_point(&*bytes).unwrap(), ids);
        assert!(
            read_instance_of_point(&bytes[..bytes.len() - 1]).is_err()
                && read_instance_of_point(&b"ply\n"[..]).is_err()
        );
    }
}
