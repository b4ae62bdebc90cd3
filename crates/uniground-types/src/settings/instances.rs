//! Which frames are looked at, how regions become instances, and which views of them are kept.

use serde::{Deserialize, Serialize};

/// Which frames of a scan are looked at.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct FrameSamplingSettings {
    /// Every `max(1, floor(frames / this))`-th frame is used. Paper: 1000.
    pub stride_frames: u32,
    /// At most this many frames, spread evenly along the camera path; `null` = no limit.
    pub max_frames: Option<u32>,
}

impl Default for FrameSamplingSettings {
    fn default() -> Self {
        Self { stride_frames: 1000, max_frames: Some(400) }
    }
}

/// Which regions become instances, and how stray points and the sensor's noise are kept out of
/// their boxes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct InstanceSettings {
    /// Share of the points at either end of each axis that bounds never rest on.
    pub stray_share: f32,
    /// An extent up to this many standard deviations of the sensor's noise is thin. The noise is
    /// measured on the scan itself.
    pub thin_sigmas: f32,
    /// Bounds of thin extents move inwards by this many standard deviations,
    pub noise_sigmas: f32,
    /// but leave at most this share of the points outside at either end of each axis.
    pub trim: f32,
    /// A point with fewer neighbours than this in its voxel and the 26 around is stray.
    pub stray_neighbours: u32,
    /// Edge of the voxels stray points are looked for in, metres.
    pub stray_voxel_m: f32,
    /// Regions with which no mask agrees better (IoU over their visible points, mean over frames)
    /// are no instances. Not in the paper.
    pub min_agreement: f32,
    /// Regions of fewer points than this that no frame shows on 16 x 16 pixels are specks and no
    /// instances; 0: none are. Not in the paper.
    pub min_points: u32,
    /// At most this many parts and wholes for each thing are offered beside the things; 0: none.
    /// Not in the paper.
    pub parts_and_wholes: f32,
}

impl Default for InstanceSettings {
    fn default() -> Self {
        Self {
            stray_share: 0.001,
            thin_sigmas: 12.0,
            noise_sigmas: 1.5,
            trim: 0.02,
            stray_neighbours: 4,
            stray_voxel_m: 0.03,
            min_agreement: 0.2,
            min_points: 50,
            parts_and_wholes: 1.5,
        }
    }
}

/// Which views of an instance are kept as pictures.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct ViewSettings {
    /// Views kept per instance. Paper: 3.
    pub count: u32,
    /// A view must show at least this share of what the best one shows.
    pub min_share_of_best: f32,
}

impl Default for ViewSettings {
    fn default() -> Self {
        Self { count: 3, min_share_of_best: 0.4 }
    }
}
