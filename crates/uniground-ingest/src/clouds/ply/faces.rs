//! Faces of a PLY file. Nearly all meshes of scans have a vertex every few centimeters, as accurate
//! as the scan: their vertices are the cloud. A modeled or simplified mesh has vertices only at its
//! corners: most of its surface lies in large triangles, and the cloud is sampled from them.

use super::rows::PlyRows;
use crate::clouds::CloudBuilder;
use crate::clouds::mesh::{MeshSampler, MeshVertex, Triangle};
use crate::guess_units;
use std::io::{BufRead, Seek, SeekFrom};
use uniground_geometry::scene::PointCloud;

/// Minimum length of the longest side of a large triangle, meters.
const LARGE_M: f64 = 0.1;

/// Replaces the vertices by points on the faces if more than half of the surface lies in large
/// triangles. Faces are read twice and never held in memory. Vertices that are thinned out or
/// incomplete stay unchanged.
pub(super) fn sample_if_sparse(
    rows: &PlyRows,
    source: &mut (impl BufRead + Seek),
    count: usize,
    gathered: &mut CloudBuilder,
) -> Result<(), String> {
    let Some(vertices) = gathered.as_complete() else { return Ok(()) };
    let metres_per_unit = guess_units::likeliest_meters_per_unit(&vertices.positions);
    let start = source.stream_position().map_err(|e| e.to_string())?;
    let (mut area, mut large_area) = (0.0, 0.0);
    for_each_triangle(rows, source, count, vertices, |triangle| {
        let own = triangle.area();
        area += own;
        if longest_side(triangle) * metres_per_unit > LARGE_M {
            large_area += own;
        }
    })?;
    let Some(mut sampling) =
        MeshSampler::for_area(area, metres_per_unit).filter(|_| large_area > area / 2.0)
    else {
        return Ok(());
    };
    source.seek(SeekFrom::Start(start)).map_err(|e| e.to_string())?;
    let mut sampled = PointCloud::default();
    for_each_triangle(rows, source, count, vertices, |triangle| {
        sampling.sample_triangle(triangle, &[], |position, color| {
            sampled.positions.push(position.map(|c| c as f32).into());
            sampled.colors.push(color);
        });
    })?;
    gathered.replace(sampled);
    Ok(())
}

/// Calls a function with every triangle. Polygons are split into fans.
fn for_each_triangle(
    rows: &PlyRows,
    source: &mut impl BufRead,
    count: usize,
    vertices: &PointCloud,
    mut show: impl FnMut(&Triangle),
) -> Result<(), String> {
    let corner = |index: f64| {
        let at = index as usize;
        // The comparison detects indices that are negative, too large or not a number.
        let position = vertices.positions.get(at).filter(|_| at as f64 == index);
        let position =
            position.ok_or_else(|| format!("{index} names a vertex that does not exist"))?;
        let tint = vertices.colors[at].map(|c| f32::from(c) / 255.0);
        Ok::<_, String>(MeshVertex {
            at: [position.x, position.y, position.z].map(f64::from),
            tint,
            uv: None,
        })
    };
    rows.for_each_face(source, count, |corners| {
        let [first, rest @ ..] = corners else { return Ok(()) };
        let first = corner(*first)?;
        for pair in rest.windows(2) {
            show(&Triangle { corners: [first, corner(pair[0])?, corner(pair[1])?], texture: None });
        }
        Ok(())
    })
}

fn longest_side(triangle: &Triangle) -> f64 {
    let [a, b, c] = triangle.corners.map(|corner| nalgebra::Point3::from(corner.at));
    nalgebra::distance(&a, &b).max(nalgebra::distance(&b, &c)).max(nalgebra::distance(&c, &a))
}

#[cfg(test)]
mod tests {
    use crate::IngestError;
    use crate::clouds::{self, CloudBounds, CoordinateOrigin, LoadedCloud};
    use camino::Utf8Path;

    fn read_bytes(bytes: &[u8]) -> Result<LoadedCloud, IngestError> {
        let folder = tempfile::tempdir().unwrap();
        let root = Utf8Path::from_path(folder.path()).unwrap();
        std::fs::write(root.join("mesh.ply"), bytes).unwrap();
        clouds::read(
            root,
            Utf8Path::new("mesh.ply"),
            &CloudBounds { announced: 1 << 30, kept: 1 << 30 },
            CoordinateOrigin::Free,
        )
    }

    /// Creates a square meter divided into `steps` squares per side, in one color, in ascii or
    /// binary, with or without faces.
    fn square(steps: usize, ascii: bool, faces: bool) -> Vec<u8> {
        let (corners, squares) = ((steps + 1) * (steps + 1), if faces { steps * steps } else { 0 });
        let encoding = if ascii { "ascii" } else { "binary_little_endian" };
        let mut bytes = format!(
            "ply\nformat {encoding} 1.0\nelement vertex {corners}\nproperty float x\nproperty float y\nproperty float z\n\
             property uchar red\nproperty uchar green\nproperty uchar blue\nelement face {squares}\nproperty uchar flags\n\
             property list uchar int vertex_indices\nend_header\n"
        )
        .into_bytes();
        let at = |i: usize| i as f32 / steps as f32;
        for i in 0..corners {
            let (x, y) = (at(i % (steps + 1)), at(i / (steps + 1)));
            if ascii {
                bytes.extend(format!("{x} {y} 0.5 250 0 50\n").bytes());
            } else {
                [x, y, 0.5].iter().for_each(|v| bytes.extend(v.to_le_bytes()));
                bytes.extend([250, 0, 50]);
            }
        }
        for i in 0..squares {
            let low = i / steps * (steps + 1) + i % steps;
            let around = [low, low + 1, low + steps + 2, low + steps + 1];
            if ascii {
                bytes.extend(
                    format!("7 4 {} {} {} {}\n", around[0], around[1], around[2], around[3])
                        .bytes(),
                );
            } else {
                bytes.extend([7, 4]);
                around.iter().for_each(|v| bytes.extend((*v as i32).to_le_bytes()));
            }
        }
        bytes
    }

    #[test]
    fn dense_meshes_are_read_as_their_vertices_unchanged() {
        for steps in [20, 50] {
            let (mesh, points) = (
                read_bytes(&square(steps, false, true)).unwrap(),
                read_bytes(&square(steps, false, false)).unwrap(),
            );
            assert_eq!(mesh.cloud.len(), (steps + 1) * (steps + 1));
            assert_eq!(
                (mesh.cloud.positions, mesh.cloud.colors),
                (points.cloud.positions, points.cloud.colors)
            );
        }
    }

    #[test]
    fn coarse_meshes_are_sampled_every_centimeter() {
        let [ascii, binary] =
            [true, false].map(|ascii| read_bytes(&square(2, ascii, true)).unwrap());
        assert_eq!((ascii.cloud.positions.len(), ascii.has_color), (10_000, true));
        assert!(ascii.cloud.colors.iter().all(|c| *c == [250, 0, 50]));
        for quarter in 0..4 {
            let inside = |p: &&uniground_geometry::Point3<f32>| {
                (p.x > 0.5) == (quarter % 2 == 1) && (p.y > 0.5) == (quarter / 2 == 1)
            };
            let count = ascii.cloud.positions.iter().filter(inside).count();
            assert!((2350..2650).contains(&count), "{count} in one quarter");
        }
        assert_eq!(ascii.cloud.positions, binary.cloud.positions);
    }

    #[test]
    fn invalid_indices_and_truncated_faces_are_refused() {
        let whole = square(2, false, true);
        let mut stray = whole.clone();
        let last = stray.len() - 4;
        stray[last..].copy_from_slice(&9_i32.to_le_bytes());
        let mut below = whole.clone();
        below[last..].copy_from_slice(&(-1_i32).to_le_bytes());
        for (bytes, expected) in [
            (&stray, "face: 9 names a vertex that does not exist"),
            (&below, "face: -1 names a vertex that does not exist"),
            (&whole[..last].to_vec(), "face: truncated"),
        ] {
            let message = read_bytes(bytes).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
    }
}
