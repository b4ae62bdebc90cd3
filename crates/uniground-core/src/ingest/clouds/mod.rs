//! Point cloud files.

pub(super) mod ply;
