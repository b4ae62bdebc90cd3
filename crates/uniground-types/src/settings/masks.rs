//! Settings of 2D masks: built-in ones and those of a segmentation model.

use serde::{Deserialize, Serialize};

/// Built-in masks: patches of uniform color and surface, merged into objects.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct RgbdSettings {
    /// Uses every `stride`-th pixel of the depth image, 1 to 16. Default: 2.
    pub stride: u32,
    /// CIELAB difference between neighboring pixels that counts as one unit of edge. Default: 12.
    pub colour_edge: f32,
    /// Angle between neighboring normals on a concave surface that counts as one unit of edge,
    /// degrees. Default: 25.
    pub concave_edge_deg: f32,
    /// The same for a convex surface, degrees. Larger because objects are convex. Default: 60.
    pub convex_edge_deg: f32,
    /// Felzenszwalb's k in units of edge times pixels. Larger values give larger patches. Default:
    /// 30.
    pub patch_scale: f32,
    /// Minimum size of a patch in grid pixels. Smaller ones join their most similar neighbor.
    /// Default: 20.
    pub min_patch_pixels: u32,
    /// Maximum border cost for merging patches into objects. Default: 0.8.
    pub join_cost: f32,
    /// Mean CIELAB difference of two patches that costs one unit. Default: 25.
    pub join_colour: f32,
    /// Concave angle between two patches that costs one unit, degrees. Default: 60.
    pub join_concave_deg: f32,
    /// Minimum area of a flat patch that counts as a supporting plane, square meters. Default:
    /// 0.35.
    pub plane_area_m2: f32,
}

impl Default for RgbdSettings {
    fn default() -> Self {
        Self {
            stride: 2,
            colour_edge: 12.0,
            concave_edge_deg: 25.0,
            convex_edge_deg: 60.0,
            patch_scale: 30.0,
            min_patch_pixels: 20,
            join_cost: 0.8,
            join_colour: 25.0,
            join_concave_deg: 60.0,
            plane_area_m2: 0.35,
        }
    }
}

/// Order in which overlapping masks are painted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum MaskOrder {
    /// By ascending quality: the mask with the highest predicted quality is painted last and stays
    /// complete.
    AscendingQuality,
    /// By descending size: parts stay visible on their objects.
    LargerFirst,
}

/// Prompt points of a promptable segmentation model.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum SamPrompts {
    /// All points of a grid, as its authors do.
    Grid,
    /// The centers of built-in masks that no confident mask of similar size covers, then uncovered
    /// grid points. Needs far fewer prompts.
    Segments,
}

/// Settings of a promptable segmentation model.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct SamSettings {
    /// Prompt points. Default: `segments`.
    pub prompts: SamPrompts,
    /// Points per side of the grid, 1 to 128. Default: 16.
    pub points_per_side: u32,
    /// Also segments four overlapping quarters of each picture, each with half the points per side.
    /// Finds smaller objects at five times the encoding cost. Default: `false`.
    pub quarters: bool,
    /// Minimum predicted quality (IoU) of a mask. Default: 0.5.
    pub min_predicted_iou: f32,
    /// Minimum overlap of a mask with itself when its threshold moves by `stability_margin` in both
    /// directions. Default: 0.7.
    pub min_stability: f32,
    /// Change of the mask threshold for the stability test, in logits. Default: 1.
    pub stability_margin: f32,
    /// IoU above which the worse of two overlapping masks is removed. Default: 0.7.
    pub max_overlap: f32,
    /// Minimum area of a mask as a share of the picture. Default: 0.0003.
    pub min_area: f32,
    /// Maximum area of a mask as a share of the picture. Default: 0.9.
    pub max_area: f32,
    /// Maximum number of masks per picture. Keeps the best. Default: 400.
    pub max_masks: u32,
    /// Order in which overlapping masks are painted. Default: `ascending_quality`.
    pub order: MaskOrder,
    /// Whether to vote with a second id image in which wholes cover their parts: masks up to a
    /// quarter of the picture, the largest painted last. Default: `true`.
    pub wholes: bool,
    /// Maximum disk space for encoded pictures during a parse, megabytes. Defect correction reuses
    /// them. Default: 4096.
    pub cache_mb: u32,
}

impl Default for SamSettings {
    fn default() -> Self {
        Self {
            prompts: SamPrompts::Segments,
            points_per_side: 16,
            quarters: false,
            min_predicted_iou: 0.5,
            min_stability: 0.7,
            stability_margin: 1.0,
            max_overlap: 0.7,
            min_area: 0.0003,
            max_area: 0.9,
            max_masks: 400,
            order: MaskOrder::AscendingQuality,
            wholes: true,
            cache_mb: 4096,
        }
    }
}

impl SamSettings {
    /// Returns the settings of the model's authors, which the paper also uses.
    #[must_use]
    pub fn paper() -> Self {
        Self {
            prompts: SamPrompts::Grid,
            wholes: false,
            points_per_side: 32,
            min_predicted_iou: 0.88,
            min_stability: 0.95,
            ..Self::default()
        }
    }
}
