//! How a scan becomes a scene.

use crate::geometry::up_axis::UpAxis;
use crate::numbers;
use crate::problem::FieldError;
use serde::{Deserialize, Serialize};
use std::ops::RangeInclusive;

/// How a cloud is fused from depth pictures: a truncated signed distance volume.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct FusionSettings {
    /// Edge of the voxels, metres; points come out about as far apart.
    pub voxel_m: f32,
    /// Distances are kept this many voxels to either side of a surface. More survives more noise,
    /// less keeps thin things apart.
    pub truncation_voxels: f32,
    /// Depth beyond this is not fused, metres: consumer sensors are noise out there.
    pub max_depth_m: f32,
    /// A place becomes a point when it was seen by at least this share of the frames that see a
    /// place on average: what hardly anybody saw is mostly noise.
    pub min_share_of_mean: f32,
    /// A pixel whose depth differs from a neighbour's by more than this share lies on a
    /// silhouette, where sensors smear.
    pub silhouette_tolerance: f32,
}

impl Default for FusionSettings {
    fn default() -> Self {
        Self {
            voxel_m: 0.018,
            truncation_voxels: 5.0,
            max_depth_m: 8.0,
            min_share_of_mean: 0.25,
            silhouette_tolerance: 0.05,
        }
    }
}

impl FusionSettings {
    /// Distances are kept this far to either side of a surface, metres.
    #[must_use]
    pub fn truncation_m(&self) -> f32 {
        self.truncation_voxels * self.voxel_m
    }
}

/// Whether a world that is tilted is turned level.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum LevellingChoice {
    /// When floors and walls clearly show that it is tilted.
    #[default]
    Auto,
    /// Never: the axis that is up in the files is up.
    Off,
}

impl LevellingChoice {
    // Left out of what is written, the settings of before it was there mean the same and hash the
    // same.
    fn is_auto(&self) -> bool {
        *self == Self::Auto
    }
}

/// Lengths of one unit of a scan's files that are accepted, metres.
const METRES_PER_UNIT: RangeInclusive<f64> = 1e-6..=1e6;

/// Checks the length of one unit of a scan's files.
///
/// # Errors
/// A [`FieldError`] naming the field, which is called `pointer` in the caller's request.
pub fn check_metres_per_unit(
    pointer: &str,
    metres_per_unit: Option<f64>,
) -> Result<(), FieldError> {
    metres_per_unit
        .map_or(Ok(()), |metres| numbers::check_in_range(pointer, metres, METRES_PER_UNIT))
}

/// How a scan becomes a scene; part of the parse settings, because they decide the result.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct ImportSettings {
    /// The world axis that points up in the files. `null`: what the manifest says; without one,
    /// the axis the cameras hold up.
    pub up: Option<UpAxis>,
    /// Length of one unit of the files' clouds and poses, metres. `null`: metres, unless a cloud
    /// without cameras is far too large for that.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub metres_per_unit: Option<f64>,
    /// Whether a world that is tilted is turned level.
    #[serde(skip_serializing_if = "LevellingChoice::is_auto")]
    pub levelling: LevellingChoice,
    /// Used when the archive has no cloud of its own.
    pub fusion: FusionSettings,
}
