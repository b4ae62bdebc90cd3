//! Superpoints: how finely the cloud is cut before anything is merged.

use serde::{Deserialize, Serialize};

/// How finely the cloud is cut, and which patches grow together.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct SuperpointSettings {
    /// Edge of a voxel, metres. Paper: 0.05. Finer follows object borders better; sparse clouds
    /// are cut coarser.
    pub voxel_m: f32,
    /// Distance between seeds, metres.
    pub seed_m: f32,
    /// Weight of the distance in space, in units of the seed distance.
    pub spatial_weight: f32,
    /// Weight of the angle between normals (`1 - |cos|`).
    pub normal_weight: f32,
    /// Weight of the CIELAB distance, in units of 50.
    pub colour_weight: f32,
    /// Region growing joins patches whose normals differ by less than this, degrees.
    pub smoothness_deg: f32,
    /// Region growing does not cross patches rougher than this (surface variation, 0 flat to 1/3
    /// isotropic).
    pub curvature: f32,
    /// Region growing joins patches whose mean CIELAB colours differ by less than this.
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
