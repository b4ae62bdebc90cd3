//! Settings for frame sampling, instances and their views.

use serde::{Deserialize, Serialize};

/// Selection of the frames to process.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct FrameSamplingSettings {
    /// Uses every `max(1, floor(frames / this))`-th frame. Default and paper: 1000.
    pub stride_frames: u32,
    /// Maximum number of frames, spread evenly along the camera path. `null`: no limit. Default:
    /// 400.
    pub max_frames: Option<u32>,
    /// Number of frames in which each part of the scan is wanted. Of the frames left so far, only so
    /// many are used that nine tenths of this is reached, spread evenly along the camera path. At
    /// least 100 with built-in masks. `null`: all frames. Default: 4. Not in the paper.
    // Parses of versions without this setting used all frames.
    #[serde(default)]
    pub views_per_part: Option<u32>,
}

impl Default for FrameSamplingSettings {
    fn default() -> Self {
        Self { stride_frames: 1000, max_frames: Some(400), views_per_part: Some(4) }
    }
}

/// Filter for regions, and removal of outlier points and sensor noise from boxes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct InstanceSettings {
    /// Share of the points at both ends of each axis that is ignored for the bounds. Default:
    /// 0.001.
    pub stray_share: f32,
    /// Extents up to this many standard deviations of the sensor noise count as thin. The noise is
    /// estimated from the scan. Default: 12.
    pub thin_sigmas: f32,
    /// Number of standard deviations by which the bounds of thin extents shrink. Default: 1.5.
    pub noise_sigmas: f32,
    /// Maximum share of the points that this excludes at each end of each axis. Default: 0.02.
    pub trim: f32,
    /// Minimum number of neighbors in a point's voxel and the 26 around it. Points with fewer are
    /// outliers. Default: 4.
    pub stray_neighbours: u32,
    /// Voxel size of the outlier search, meters, 0.001 to 10. Default: 0.03.
    pub stray_voxel_m: f32,
    /// Minimum agreement of a region with its best mask (IoU over visible points, mean over
    /// frames). Default: 0.2. Not in the paper.
    pub min_agreement: f32,
    /// Minimum number of points of a region that no frame shows on 16 x 16 pixels. Smaller ones are
    /// dropped as specks. 0 keeps all. Default: 50. Not in the paper.
    pub min_points: u32,
    /// Maximum number of parts and wholes per object, 0 to 10. 0 disables them. Default: 1.5. Not
    /// in the paper.
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

/// Selection of the views stored as pictures.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct ViewSettings {
    /// Number of views stored per instance, 1 to 16. Default and paper: 3.
    pub count: u32,
    /// Minimum visibility of a view, as a share of the best view's. Default: 0.4.
    pub min_share_of_best: f32,
}

impl Default for ViewSettings {
    fn default() -> Self {
        Self { count: 3, min_share_of_best: 0.4 }
    }
}
