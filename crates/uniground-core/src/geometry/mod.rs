//! Numbers with units: boxes, poses, voxels, union-find, robust statistics, colour.
//!
//! The bottom of the house: nothing here knows what a scene is. Lengths are metres, angles radians,
//! the world is right-handed with Z up, unless a name says otherwise.

pub mod colour;
pub mod least_axis;
pub mod moments;
pub mod pose;
pub mod rotated_box;
pub mod statistics;
pub mod union_find;
pub mod voxels;

/// Nothing may lie further from the origin than this, metres: single precision and voxel keys end
/// here. Map coordinates (UTM) need an offset taken off first.
pub const MAX_COORDINATE_M: f32 = 10_000.0;

pub use nalgebra::{Isometry3, Matrix3, Matrix4, Point2, Point3, Vector2, Vector3};
pub use uniground_types::geometry::{boxes, up_axis};
