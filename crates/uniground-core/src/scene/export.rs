//! Clouds as binary little-endian PLY, for any viewer.

use super::{InstanceId, ParsedScene, PointCloud};
use crate::geometry::Point3;
use std::io::{self, Write};

/// Writes the cloud in its own colours.
///
/// # Errors
/// Those of `out`.
pub fn write_cloud_ply(cloud: &PointCloud, out: impl Write) -> io::Result<()> {
    write(&cloud.positions, |i| (cloud.colours[i], None), out)
}

/// Writes the cloud with one colour per instance and the id as the property `instance`.
///
/// # Errors
/// Those of `out`.
pub fn write_instances_ply(scene: &ParsedScene, out: impl Write) -> io::Result<()> {
    write(&scene.cloud.positions, |i| (id_colour(scene.instance_of_point[i].0), Some(scene.instance_of_point[i])), out)
}

fn write(positions: &[Point3<f32>], of_point: impl Fn(usize) -> ([u8; 3], Option<InstanceId>), out: impl Write) -> io::Result<()> {
    let mut out = io::BufWriter::new(out);
    let labelled = !positions.is_empty() && of_point(0).1.is_some();
    write!(out, "ply\nformat binary_little_endian 1.0\ncomment metres, Z up\nelement vertex {}\n", positions.len())?;
    write!(
        out,
        "property float x\nproperty float y\nproperty float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n"
    )?;
    writeln!(out, "{}end_header", if labelled { "property int instance\n" } else { "" })?;
    for (i, p) in positions.iter().enumerate() {
        let (colour, instance) = of_point(i);
        for c in [p.x, p.y, p.z] {
            out.write_all(&c.to_le_bytes())?;
        }
        out.write_all(&colour)?;
        if let Some(InstanceId(id)) = instance {
            out.write_all(&id.to_le_bytes())?;
        }
    }
    out.flush()
}

/// A colour per id: steps of the golden angle around the hue circle, so that neighbours in number differ.
#[must_use]
pub fn id_colour(id: u32) -> [u8; 3] {
    let hue = (id as f32 * 0.618_034).fract() * 6.0;
    let value = if id.is_multiple_of(2) { 0.95 } else { 0.75 };
    [5.0, 3.0, 1.0].map(|n: f32| {
        let k = (n + hue) % 6.0;
        ((value - value * 0.7 * k.min(4.0 - k).clamp(0.0, 1.0)) * 255.0) as u8
    })
}
