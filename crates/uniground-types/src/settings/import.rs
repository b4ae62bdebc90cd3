//! Import settings.

use crate::geometry::up_axis::UpAxis;
use crate::numbers;
use crate::problem::FieldError;
use serde::{Deserialize, Serialize};
use std::ops::RangeInclusive;

/// Fusion of depth pictures into a cloud with a truncated signed distance volume.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct FusionSettings {
    /// Voxel size and approximate point distance, meters. Half of it for scans from less than 1.3 m
    /// away, a third below 0.8 m. Default: 0.018.
    pub voxel_m: f32,
    /// Truncation distance in voxels on each side of a surface. Larger values tolerate more noise,
    /// smaller ones separate thin objects better. Default: 5.
    pub truncation_voxels: f32,
    /// Maximum depth, meters. Consumer sensors are unreliable beyond it. Default: 8.
    pub max_depth_m: f32,
    /// Minimum number of observations of a point, as a share of the mean over all points. Rarely
    /// observed points are mostly noise. Default: 0.25.
    pub min_share_of_mean: f32,
    /// Relative depth difference to a neighboring pixel above which a pixel counts as a silhouette
    /// and is ignored. Default: 0.05.
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
    /// Returns the settings for a scan that is fused this many times as fine.
    #[must_use]
    pub fn in_detail(self, times: f32) -> Self {
        Self { voxel_m: self.voxel_m / times, ..self }
    }

    /// Returns the truncation distance, meters.
    #[must_use]
    pub fn truncation_m(&self) -> f32 {
        self.truncation_voxels * self.voxel_m
    }
}

/// Whether to level a tilted world.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum LevellingChoice {
    /// If floors and walls clearly show a tilt.
    #[default]
    Auto,
    /// Never. Keeps the up axis of the files.
    Off,
}

impl LevellingChoice {
    // The default is not serialized, so that older settings keep their hash.
    fn is_auto(&self) -> bool {
        *self == Self::Auto
    }
}

/// Accepted range for the length of one unit of a scan's files, meters.
const METRES_PER_UNIT: RangeInclusive<f64> = 1e-6..=1e6;

/// Checks the length of one unit of a scan's files.
///
/// # Errors
/// Returns a [`FieldError`] that names the field by `pointer`.
pub fn check_metres_per_unit(
    pointer: &str,
    metres_per_unit: Option<f64>,
) -> Result<(), FieldError> {
    metres_per_unit
        .map_or(Ok(()), |metres| numbers::check_in_range(pointer, metres, METRES_PER_UNIT))
}

/// Import settings. Part of the parse settings because they affect the result.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct ImportSettings {
    /// Axis of the files that points up. `null` uses the manifest, or without one the axis that the
    /// cameras hold up.
    pub up: Option<UpAxis>,
    /// Length of one unit of the files' clouds and poses, meters. `null` means meters, unless a
    /// cloud without cameras is far too large for that.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub metres_per_unit: Option<f64>,
    /// Whether to level a tilted world. Default: `auto`.
    #[serde(skip_serializing_if = "LevellingChoice::is_auto")]
    pub levelling: LevellingChoice,
    /// Fusion settings, used if the archive has no cloud of its own.
    pub fusion: FusionSettings,
}
