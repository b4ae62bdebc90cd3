//! Boxes and axes. Lengths in metres; angles in radians unless a name says otherwise.

pub mod boxes;
pub mod up_axis;

pub use nalgebra::{Isometry3, Matrix3, Matrix4, Point2, Point3, Vector2, Vector3};
