//! Progressive merging: affinity (paper, Eq. 1), the stages of merging, and the joining of parts.

use serde::{Deserialize, Serialize};

/// How Eq. (1) averages over frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Normalisation {
    /// `sum(w s) / sum(w)`: visibility weighs, but does not lower the affinity.
    Normalised,
    /// `mean(w s)`: as printed. Rarely passes the thresholds; kept for ablation.
    Literal,
}

/// How superpoints are merged into regions, stage by stage.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct MergeSettings {
    /// Affinity a neighbour must reach, one value per stage. Paper: 0.9 0.8 0.7 0.6 0.5.
    pub thresholds: Vec<f32>,
    /// Superpoints this many borders apart still count as neighbours. Paper: 2.
    pub max_hop: u32,
    /// A neighbour at hop `h` weighs `decay^(h-1)`. Paper: 0.5.
    pub hop_decay: f32,
    /// Regions with fewer points join their most affine neighbour at the end. Paper: 50.
    pub min_points: u32,
    /// How Eq. (1) averages over frames.
    pub normalisation: Normalisation,
    /// Superpoints on different planes of the building, or on one and before it, are never joined,
    /// and small patches of a plane return to it. Not in the paper.
    pub keep_planes_apart: bool,
    /// Superpoints with a small gap between them are no neighbours where frames see through it.
    /// Not in the paper.
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

/// How legs, backs and feet join the furniture they belong to. Not in the paper.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct PartMergingSettings {
    /// Whether parts are joined at all.
    pub enabled: bool,
    /// Legs and poles are no thicker than this, metres.
    pub leg_thickness_m: f32,
    /// A plate is no thicker than this, metres.
    pub plate_thickness_m: f32,
    /// A back is at least this share as wide as what it stands on, and at most the inverse.
    pub back_width: f32,
    /// Nothing longer than this is a part of furniture or is given parts, metres.
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
