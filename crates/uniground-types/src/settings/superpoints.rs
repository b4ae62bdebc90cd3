//! Settings of superpoints, the initial segmentation of the cloud.

use serde::{Deserialize, Serialize};

/// Segmentation into superpoints by region growing.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct SuperpointSettings {
    /// Voxel size, meters, 0.001 to 10. Smaller voxels follow object borders better. Sparse clouds
    /// use larger ones. Default: 0.025. Paper: 0.05.
    pub voxel_m: f32,
    /// Distance between seeds, meters, at most 100 voxels. Default: 0.15.
    pub seed_m: f32,
    /// Weight of the spatial distance, in units of the seed distance. Default: 0.4.
    pub spatial_weight: f32,
    /// Weight of the angle between normals (`1 - |cos|`). Default: 1.
    pub normal_weight: f32,
    /// Weight of the CIELAB distance, in units of 50. Default: 0.2.
    pub colour_weight: f32,
    /// Maximum angle between the normals of patches that region growing joins, degrees, 0 to 90.
    /// Default: 5.
    pub smoothness_deg: f32,
    /// Maximum roughness of patches that region growing crosses (surface variation, 0 for flat to
    /// 1/3 for isotropic). Default: 1.
    pub curvature: f32,
    /// Maximum mean CIELAB difference of patches that region growing joins. Default: 4.
    pub colour_tolerance: f32,
}

impl Default for SuperpointSettings {
    fn default() -> Self {
        Self {
            voxel_m: 0.025,
            seed_m: 0.15,
            spatial_weight: 0.4,
            normal_weight: 1.0,
            colour_weight: 0.2,
            smoothness_deg: 5.0,
            curvature: 1.0,
            colour_tolerance: 4.0,
        }
    }
}
