//! Boxes and axes. Lengths are in meters. Angles are in radians unless the name says otherwise.

pub mod boxes;
pub mod up_axis;

pub use nalgebra::{Isometry3, Matrix3, Matrix4, Point2, Point3, Vector2, Vector3};
