//! Settings of progressive merging: affinity (paper, Eq. 1), stages, and merging of parts.

use serde::{Deserialize, Serialize};

/// Averaging of Eq. (1) over frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Normalisation {
    /// `sum(w s) / sum(w)`: visibility is a weight and does not lower the affinity.
    Normalised,
    /// `mean(w s)`, as printed in the paper. Rarely passes the thresholds. For ablations.
    Literal,
}

/// Merging of superpoints into regions in stages.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct MergeSettings {
    /// Minimum affinity per stage, 1 to 20 values. Default and paper: 0.9 0.8 0.7 0.6 0.5.
    pub thresholds: Vec<f32>,
    /// Maximum number of borders between neighboring superpoints, 1 to 4. Default and paper: 2.
    pub max_hop: u32,
    /// A neighbor at hop `h` has the weight `decay^(h-1)`. Default and paper: 0.5.
    pub hop_decay: f32,
    /// Minimum number of points of a region. Smaller ones join their most similar neighbor at the
    /// end. Default and paper: 50.
    pub min_points: u32,
    /// Averaging of Eq. (1) over frames. Default: `normalised`.
    pub normalisation: Normalisation,
    /// Never merges superpoints of different building planes, or of a plane and an object in front
    /// of it, and returns small patches to their plane. Default: `true`. Not in the paper.
    pub keep_planes_apart: bool,
    /// Separates superpoints with a small gap if frames see through the gap. Default: `true`. Not
    /// in the paper.
    pub split_at_depth_edges: bool,
}

impl Default for MergeSettings {
    fn default() -> Self {
        Self {
            thresholds: vec![0.9, 0.8, 0.7, 0.6, 0.5],
            max_hop: 2,
            hop_decay: 0.5,
            min_points: 50,
            normalisation: Normalisation::Normalised,
            keep_planes_apart: true,
            split_at_depth_edges: true,
        }
    }
}

/// Merging of legs, backs and feet with their furniture. Not in the paper.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct PartMergingSettings {
    /// Whether parts are merged. Default: `true`.
    pub enabled: bool,
    /// Maximum thickness of legs and poles, meters.
    pub leg_thickness_m: f32,
    /// Maximum thickness of a plate, meters.
    pub plate_thickness_m: f32,
    /// Minimum width of a back relative to the part below it. The maximum is the inverse.
    pub back_width: f32,
    /// Maximum length of furniture and its parts for this step, meters.
    pub longest_m: f32,
}

impl Default for PartMergingSettings {
    fn default() -> Self {
        Self {
            enabled: true,
            leg_thickness_m: 0.08,
            plate_thickness_m: 0.15,
            back_width: 0.6,
            longest_m: 3.0,
        }
    }
}
