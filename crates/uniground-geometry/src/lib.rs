//! Boxes, poses, voxels, statistics and colors, and the vocabulary of a 3D scan ([`scene`]).
//!
//! Lengths are meters, angles are radians and the world is right-handed with Z up, unless a name
//! says otherwise.

#![warn(missing_docs)]

pub mod background;
pub mod color;
pub mod least_axis;
pub mod lru_cache;
pub mod moments;
pub mod pose;
pub mod progress;
pub mod resize;
pub mod rotated_box;
pub mod scene;
pub mod statistics;
pub mod union_find;
pub mod voxels;

/// Maximum distance of any coordinate from the origin, meters: the limit of single precision and
/// voxel keys. Subtract an offset from map coordinates (UTM) first.
pub const MAX_COORDINATE_M: f32 = 10_000.0;

pub use nalgebra::{Isometry3, Matrix3, Matrix4, Point2, Point3, Vector2, Vector3};
pub use uniground_types::geometry::{boxes, up_axis};
