//! The cloud for viewers over a network: twelve bytes per point, in an order of which every prefix
//! is an even sample.
//!
//! ```text
//!  0  4 bytes  "UGP1"
//!  4  u32      number of points
//!  8  u32      bytes per point: 12
//! 12  u32      0
//! 16  3 f32    origin, meters
//! 28  f32      step, meters
//! 32  points   3 u16: position = origin + step * (x, y, z); 3 u8: red, green, blue;
//!              u24: id of the thing it belongs to, 0 for none
//! ```
//! Little-endian, world frame (Z up). The step is the longest side of the cloud's box divided by
//! 65,535: about a seventh of a millimeter in a room of ten meters.

use super::{InstanceId, PointCloud};
use crate::Point3;
use crate::boxes::Aabb;
use rayon::prelude::*;
use std::io::{self, Write};

/// Number of steps along the longest side.
const STEPS: f32 = 65_535.0;
const BYTES_PER_POINT: u32 = 12;
/// Step size if all points are in one place.
const SMALLEST_STEP_M: f32 = 1e-6;

/// Writes the cloud with the thing that each point belongs to.
///
/// # Errors
/// Returns I/O errors of `out`.
pub fn write_even_points(
    cloud: &PointCloud,
    instance_of_point: &[InstanceId],
    out: impl Write,
) -> io::Result<()> {
    let steps = GridStep::covering(&cloud.positions);
    let GridStep { origin, step } = steps;
    let mut out = io::BufWriter::new(out);
    out.write_all(b"UGP1")?;
    for word in [cloud.len() as u32, BYTES_PER_POINT, 0] {
        out.write_all(&word.to_le_bytes())?;
    }
    for number in [origin.x, origin.y, origin.z, step] {
        out.write_all(&number.to_le_bytes())?;
    }
    for point in evenly_spread_order(&cloud.positions) {
        for steps in steps.quantize(&cloud.positions[point]) {
            out.write_all(&steps.to_le_bytes())?;
        }
        out.write_all(&cloud.colors[point])?;
        out.write_all(&instance_of_point[point].0.to_le_bytes()[..3])?;
    }
    out.flush()
}

/// Returns the indices of all points, in an order of which every prefix is an even sample of the
/// whole. The order is always the same.
pub fn evenly_spread_order(positions: &[Point3<f32>]) -> impl Iterator<Item = usize> {
    let steps = GridStep::covering(positions);
    let mut along_curve: Vec<(u64, u32)> = positions
        .par_iter()
        .map(|p| morton_code(steps.quantize(p)))
        .zip(0..positions.len() as u32)
        .collect();
    along_curve.par_sort_unstable();
    bit_reversed_order(positions.len()).map(move |place| along_curve[place].1 as usize)
}

/// Steps from the minimum corner of a cloud's box.
#[derive(Clone, Copy)]
struct GridStep {
    origin: Point3<f32>,
    step: f32,
}

impl GridStep {
    fn covering(positions: &[Point3<f32>]) -> Self {
        let extent = Aabb::around(positions)
            .unwrap_or(Aabb { center: Point3::origin(), size: crate::Vector3::zeros() });
        Self { origin: extent.min(), step: (extent.size.max() / STEPS).max(SMALLEST_STEP_M) }
    }

    fn quantize(&self, p: &Point3<f32>) -> [u16; 3] {
        <[f32; 3]>::from((p - self.origin) / self.step)
            .map(|steps| steps.round().clamp(0.0, STEPS) as u16)
    }
}

/// Returns the position along a space-filling curve: neighbors on it are neighbors in space.
/// Interleaves the bits of the three numbers.
fn morton_code(steps: [u16; 3]) -> u64 {
    let spread = |number: u16| {
        let mut bits = u64::from(number);
        for (shift, mask) in
            [(16, 0xff00_00ff), (8, 0x00f0_0f00_f00f), (4, 0x0c30_c30c_30c3), (2, 0x2492_4924_9249)]
        {
            bits = (bits | bits << shift) & mask;
        }
        bits
    };
    let [x, y, z] = steps.map(spread);
    x | y << 1 | z << 2
}

/// Returns `0..count` in an order of which every prefix is spread evenly over the whole, by
/// reversing the bits of a counter.
fn bit_reversed_order(count: usize) -> impl Iterator<Item = usize> {
    let bits = usize::BITS - count.saturating_sub(1).leading_zeros();
    let reversed = move |counter: usize| {
        if bits == 0 { 0 } else { counter.reverse_bits() >> (usize::BITS - bits) }
    };
    (0..1_usize << bits).map(reversed).filter(move |&place| place < count)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Vector3;
    use proptest::prelude::*;

    /// Decodes a file: positions, colors and ids.
    fn read(bytes: &[u8]) -> Vec<(Point3<f32>, [u8; 3], u32)> {
        let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
        let number = |at: usize| f32::from_bits(word(at));
        assert_eq!((&bytes[..4], word(8), word(12)), (&b"UGP1"[..], 12, 0));
        let (origin, step) = (Vector3::new(number(16), number(20), number(24)), number(28));
        let points: Vec<_> = bytes[32..].chunks_exact(12).collect();
        assert_eq!(points.len(), word(4) as usize);
        let read = |p: &&[u8]| {
            let steps: [f32; 3] = std::array::from_fn(|axis| {
                f32::from(u16::from_le_bytes([p[axis * 2], p[axis * 2 + 1]]))
            });
            let id = u32::from_le_bytes([p[9], p[10], p[11], 0]);
            (Point3::from(origin + Vector3::from(steps) * step), [p[6], p[7], p[8]], id)
        };
        points.iter().map(read).collect()
    }

    fn write_to_bytes(cloud: &PointCloud, ids: &[InstanceId]) -> Vec<u8> {
        let mut bytes = Vec::new();
        write_even_points(cloud, ids, &mut bytes).unwrap();
        bytes
    }

    #[test]
    fn every_prefix_is_an_even_sample() {
        // A floor of 64 x 64 points, listed row by row.
        let positions: Vec<Point3<f32>> =
            (0..4096).map(|i| Point3::new((i % 64) as f32, (i / 64) as f32, 0.0)).collect();
        let cloud = PointCloud { colors: vec![[1, 2, 3]; positions.len()], positions };
        let ids: Vec<InstanceId> = (0..4096).map(InstanceId).collect();
        let points = read(&write_to_bytes(&cloud, &ids));
        for beginning in [64, 300, 1000] {
            let mut squares = [0; 16];
            for (p, ..) in &points[..beginning] {
                squares[p.x.round() as usize / 16 + p.y.round() as usize / 16 * 4] += 1;
            }
            let even = beginning as f32 / 16.0;
            assert!(
                squares.iter().all(|&n| (n as f32) > even * 0.6 && (n as f32) < even * 1.5),
                "{beginning}: {squares:?}"
            );
        }
        // Ids stay with their points.
        assert!(
            points.iter().all(|(p, _, id)| (p.x.round() as u32 + 64 * p.y.round() as u32) == *id)
        );
    }

    #[test]
    fn empty_clouds_and_identical_points_are_written_and_read_back() {
        assert_eq!(read(&write_to_bytes(&PointCloud::default(), &[])), []);
        let one = PointCloud {
            positions: vec![Point3::new(1.0, 2.0, 3.0); 3],
            colors: vec![[9, 8, 7]; 3],
        };
        let points =
            read(&write_to_bytes(&one, &[InstanceId(0), InstanceId(70_000), InstanceId(2)]));
        assert!(
            points
                .iter()
                .all(|(p, rgb, _)| (p - one.positions[0]).norm() < 1e-5 && *rgb == [9, 8, 7])
        );
        assert_eq!(points.iter().map(|(.., id)| id).max(), Some(&70_000));
    }

    proptest! {
        #[test]
        fn every_point_is_written_once_at_its_position(positions in prop::collection::vec(prop::array::uniform3(-50.0_f32..50.0), 1..200)) {
            let positions: Vec<Point3<f32>> = positions.into_iter().map(Point3::from).collect();
            let ids: Vec<InstanceId> = (0..positions.len() as u32).map(InstanceId).collect();
            let cloud = PointCloud { colors: vec![[0; 3]; positions.len()], positions };
            let mut points = read(&write_to_bytes(&cloud, &ids));
            points.sort_by_key(|(.., id)| *id);
            prop_assert_eq!(points.len(), cloud.len());
            for ((p, ..), original) in points.iter().zip(&cloud.positions) {
                prop_assert!((p - original).norm() < 100.0 / STEPS * 1.8);
            }
        }
    }
}
