//! Boxes with any rotation (nine degrees of freedom), as `EmbodiedScan` and `ARKitScenes` annotate
//! them, and their exact overlap.

use super::boxes::{Aabb, OrientedBox};
use super::{Point3, Vector3};
use nalgebra::UnitQuaternion;

/// A box with center, full extent and any rotation. Meters, world frame (Z up).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RotatedBox {
    /// Center, meters, world frame.
    pub center: Point3<f32>,
    /// Full extent along the box's own axes.
    pub size: Vector3<f32>,
    /// Rotation from the box's axes to the world's.
    pub rotation: UnitQuaternion<f32>,
}

impl From<OrientedBox> for RotatedBox {
    fn from(OrientedBox { center, size, yaw_rad }: OrientedBox) -> Self {
        Self {
            center,
            size,
            rotation: UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw_rad),
        }
    }
}

impl From<Aabb> for RotatedBox {
    fn from(Aabb { center, size }: Aabb) -> Self {
        Self { center, size, rotation: UnitQuaternion::identity() }
    }
}

/// A convex polygon in space.
type Face = Vec<Point3<f64>>;

impl RotatedBox {
    /// Returns the axis-aligned box around this one.
    #[must_use]
    pub fn aabb(&self) -> Aabb {
        let turn = self.rotation.to_rotation_matrix();
        Aabb { center: self.center, size: turn.matrix().abs() * self.size }
    }

    /// Returns the intersection over union with another box, in `0..=1`; 0 for boxes without
    /// volume. Exact up to rounding.
    #[must_use]
    pub fn iou(&self, other: &Self) -> f32 {
        let [own, others] =
            [self, other].map(|b| f64::from(b.size.x) * f64::from(b.size.y) * f64::from(b.size.z));
        let shared = self.shared_volume(other).min(own).min(others);
        if shared <= 0.0 { 0.0 } else { (shared / (own + others - shared)) as f32 }
    }

    /// Returns the volume of the intersection: clips this box's faces by the six planes of the
    /// other.
    fn shared_volume(&self, other: &Self) -> f64 {
        // Coordinates relative to this box's center, so that rounding does not depend on the room's
        // position.
        let origin = self.center;
        let mut faces = self.faces(&origin);
        let turn = other.rotation.cast::<f64>();
        let center = (other.center - origin).cast::<f64>();
        for axis in 0..3 {
            for sign in [1.0, -1.0] {
                let normal = turn * (Vector3::ith(axis, sign));
                let offset = normal.dot(&center) + f64::from(other.size[axis]) / 2.0;
                faces = clip_to_plane(faces, &normal, offset);
            }
        }
        volume(&faces)
    }

    /// Returns the six faces, counter-clockwise from outside, relative to `origin`.
    fn faces(&self, origin: &Point3<f32>) -> Vec<Face> {
        // Corner i has bit 0 for +X, bit 1 for +Y, bit 2 for +Z.
        const FACES: [[usize; 4]; 6] =
            [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
        let turn = self.rotation.cast::<f64>();
        let (center, half) = ((self.center - origin).cast::<f64>(), self.size.cast::<f64>() / 2.0);
        let corner = |i: usize| {
            let sign = Vector3::new((i & 1) as f64, (i >> 1 & 1) as f64, (i >> 2 & 1) as f64) * 2.0
                - Vector3::repeat(1.0);
            Point3::from(center + turn * half.component_mul(&sign))
        };
        FACES.iter().map(|face| face.iter().map(|&i| corner(i)).collect()).collect()
    }
}

/// Returns the part of a convex body where `normal . p <= offset`, closed.
fn clip_to_plane(faces: Vec<Face>, normal: &Vector3<f64>, offset: f64) -> Vec<Face> {
    const ON_PLANE_M: f64 = 1e-9;
    let height = |p: &Point3<f64>| normal.dot(&p.coords) - offset;
    let mut kept: Vec<Face> = Vec::with_capacity(faces.len() + 1);
    let mut rim: Face = Vec::new();
    for face in faces {
        let mut inside: Face = Vec::with_capacity(face.len() + 2);
        for (i, a) in face.iter().enumerate() {
            let b = &face[(i + 1) % face.len()];
            let (ha, hb) = (height(a), height(b));
            if ha <= ON_PLANE_M {
                inside.push(*a);
            }
            if (ha > ON_PLANE_M) != (hb > ON_PLANE_M) {
                let crossing = a + (b - a) * (ha / (ha - hb)).clamp(0.0, 1.0);
                inside.push(crossing);
                rim.push(crossing);
            }
        }
        if inside.len() >= 3 {
            kept.push(inside);
        }
    }
    if rim.len() >= 3 {
        kept.push(sort_counter_clockwise(rim, normal));
    }
    kept
}

/// Sorts the points of a convex polygon counter-clockwise, seen against `normal`.
fn sort_counter_clockwise(mut points: Face, normal: &Vector3<f64>) -> Face {
    let middle =
        points.iter().fold(Vector3::zeros(), |sum, p| sum + p.coords) / points.len() as f64;
    let u = normal.cross(&Vector3::ith(normal.iamin(), 1.0)).normalize();
    let v = normal.cross(&u);
    let angle = |p: &Point3<f64>| (p.coords - middle).dot(&v).atan2((p.coords - middle).dot(&u));
    points.sort_by(|a, b| angle(a).total_cmp(&angle(b)));
    points
}

/// Returns the volume of a closed convex body (divergence theorem).
fn volume(faces: &[Face]) -> f64 {
    let of_face = |face: &Face| -> f64 {
        (1..face.len().max(2) - 1)
            .map(|i| face[0].coords.dot(&face[i].coords.cross(&face[i + 1].coords)))
            .sum()
    };
    faces.iter().map(of_face).sum::<f64>() / 6.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::f32::consts::{FRAC_PI_2, FRAC_PI_4};

    fn turned(center: [f32; 3], size: [f32; 3], euler: [f32; 3]) -> RotatedBox {
        let rotation = UnitQuaternion::from_euler_angles(euler[0], euler[1], euler[2]);
        RotatedBox { center: Point3::from(center), size: Vector3::from(size), rotation }
    }

    #[test]
    fn iou_matches_values_computed_by_hand() {
        let cube = turned([0.0; 3], [1.0; 3], [0.0; 3]);
        assert!((cube.iou(&cube) - 1.0).abs() < 1e-6);
        // A square and the same square rotated by 45 degrees: the octagon has 2 (sqrt 2 - 1) of the
        // area.
        let octagon = 2.0 * (2.0_f32.sqrt() - 1.0);
        let diamond = turned([0.0; 3], [1.0; 3], [0.0, 0.0, FRAC_PI_4]);
        assert!(
            (cube.iou(&diamond) - octagon / (2.0 - octagon)).abs() < 1e-5,
            "{}",
            cube.iou(&diamond)
        );
        // The same about another axis.
        let tipped = turned([0.0; 3], [1.0; 3], [FRAC_PI_4, 0.0, 0.0]);
        assert!((cube.iou(&tipped) - octagon / (2.0 - octagon)).abs() < 1e-5);
        // A quarter turn swaps extents.
        let long = turned([5.0, 1.0, 0.0], [2.0, 1.0, 1.0], [0.0; 3]);
        let wide = turned([5.0, 1.0, 0.0], [1.0, 2.0, 1.0], [0.0, 0.0, FRAC_PI_2]);
        assert!((long.iou(&wide) - 1.0).abs() < 1e-5);
        assert!((wide.aabb().size - Vector3::new(2.0, 1.0, 1.0)).norm() < 1e-5);
        assert_eq!(cube.iou(&long), 0.0);
        assert_eq!(cube.iou(&turned([0.0; 3], [1.0, 1.0, 0.0], [0.0; 3])), 0.0);
    }

    proptest! {
        /// Without rotation, the result is the benchmark's axis-aligned IoU.
        #[test]
        fn iou_of_aligned_boxes_matches_the_axis_aligned_formula(a in prop::array::uniform6(0.1_f32..2.0), b in prop::array::uniform6(0.1_f32..2.0)) {
            let make = |v: [f32; 6]| Aabb { center: Point3::new(v[0], v[1], v[2]), size: Vector3::new(v[3], v[4], v[5]) };
            let (a, b) = (make(a), make(b));
            let exact = RotatedBox::from(a).iou(&b.into());
            prop_assert!((exact - a.iou(&b)).abs() < 1e-4, "{exact} {}", a.iou(&b));
        }

        /// The IoU depends neither on the order of the boxes nor on the orientation of the world.
        #[test]
        fn iou_is_symmetric_and_independent_of_the_world_rotation(
            sizes in prop::array::uniform6(0.2_f32..2.0), at in prop::array::uniform3(-1.0_f32..1.0),
            turns in prop::array::uniform3(-3.0_f32..3.0), world in prop::array::uniform3(-3.0_f32..3.0),
        ) {
            let a = turned([0.0; 3], [sizes[0], sizes[1], sizes[2]], [0.0; 3]);
            let b = turned(at, [sizes[3], sizes[4], sizes[5]], turns);
            let iou = a.iou(&b);
            prop_assert!((0.0..=1.0).contains(&iou));
            prop_assert!((iou - b.iou(&a)).abs() < 1e-4);
            let turn = UnitQuaternion::from_euler_angles(world[0], world[1], world[2]);
            let moved = |c: &RotatedBox| RotatedBox { center: turn * c.center + Vector3::new(3.0, -2.0, 1.0), size: c.size, rotation: turn * c.rotation };
            prop_assert!((iou - moved(&a).iou(&moved(&b))).abs() < 1e-3);
        }
    }
}
