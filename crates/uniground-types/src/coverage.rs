//! Which part of a room the cameras of a scan saw.

use crate::geometry::boxes::Aabb;
use serde::{Deserialize, Serialize};

/// Which part of the room the cameras of the scan saw, from the floor to 2 m above it. Voxels of 15
/// cm. The room is the upright box around the scan's points, without what lies behind walls and
/// inside of furniture. What is beyond a wall that no camera saw is unknown.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Coverage {
    /// Share of the room's volume that a camera saw, `0..=1`. With `within` in the question, the
    /// share of that part of the room.
    pub seen_share: f32,
    /// Volume that no camera saw, cubic meters.
    pub unseen_m3: f32,
    /// Floor area that no camera saw, square meters. Floor under closed furniture does not count.
    pub unseen_floor_m2: f32,
    /// `true`: the object may be where no camera looked, because `seen_share` is below 0.95.
    /// `false`: it is not there, as far as a scan can tell.
    pub may_be_unseen: bool,
    /// Unseen parts of the room, the largest first, at most 8, without parts below 0.05 cubic
    /// meters. With `within` in the question, those that reach into it. Ask
    /// `/v1/scenes/{id}/approach` with `unseen_region` for poses that look at one of them.
    pub regions: Vec<UnseenRegion>,
}

/// A part of the room that no camera saw.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct UnseenRegion {
    /// Number of the region in this version of the scene, from 1.
    pub number: u32,
    /// Axis-aligned box around it; meters, world frame (Z up). The region need not fill it.
    #[serde(rename = "box")]
    pub aabb: Aabb,
    /// Its volume, cubic meters.
    pub volume_m3: f32,
    /// Floor area in it, square meters.
    pub floor_m2: f32,
}
