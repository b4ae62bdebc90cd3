//! 2D masks: the built-in ones and those of a segmentation model.

use serde::{Deserialize, Serialize};

/// The built-in masks: even patches of colour and surface, joined into things.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct RgbdSettings {
    /// Every `stride`-th pixel of the depth image is looked at.
    pub stride: u32,
    /// CIELAB difference between neighbouring pixels that counts as one unit of edge.
    pub colour_edge: f32,
    /// Angle between neighbouring normals that counts as one unit of edge where the surface is
    /// concave, degrees.
    pub concave_edge_deg: f32,
    /// The same where it is convex: objects are allowed to bulge.
    pub convex_edge_deg: f32,
    /// How readily even areas grow across edges (Felzenszwalb's k, in units of edge times pixels).
    pub patch_scale: f32,
    /// Patches under this many grid pixels join their most similar neighbour.
    pub min_patch_pixels: u32,
    /// Patches join into things while the cost of the cheapest border stays below this.
    pub join_cost: f32,
    /// Mean CIELAB difference of two patches that costs one unit.
    pub join_colour: f32,
    /// Concave angle between two patches that costs one unit, degrees.
    pub join_concave_deg: f32,
    /// A flat patch of at least this area is a plane that things rest on, square metres.
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

/// How masks that overlap are painted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum MaskOrder {
    /// The mask the model is surest of comes last and stays whole.
    AscendingQuality,
    /// A part stays visible on what it is part of.
    LargerFirst,
}

/// Where a promptable segmenter is asked.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum SamPrompts {
    /// At every point of a grid, as its authors do.
    Grid,
    /// In the middle of each built-in mask that no sure mask of about its size covers yet, then at
    /// the points of the grid that no sure mask covers at all: a fraction of the questions.
    Segments,
}

/// Masks of a promptable segmentation model, asked at points of each picture.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct SamSettings {
    /// Where it is asked.
    pub prompts: SamPrompts,
    /// Points per side of the grid.
    pub points_per_side: u32,
    /// Also asks four overlapping quarters of each picture, each with half the points per side:
    /// small things, at five times the encoding.
    pub quarters: bool,
    /// Masks the model is less sure of are left out.
    pub min_predicted_iou: f32,
    /// Least overlap of a mask with itself when its threshold moves by `stability_margin` both
    /// ways.
    pub min_stability: f32,
    /// In logits.
    pub stability_margin: f32,
    /// Of two masks that overlap by more (IoU), the better stays.
    pub max_overlap: f32,
    /// Masks under this share of the picture are specks.
    pub min_area: f32,
    /// Masks over this share of the picture are the picture.
    pub max_area: f32,
    /// Masks kept per picture, the best.
    pub max_masks: u32,
    /// Which masks are painted last, over the others.
    pub order: MaskOrder,
    /// Whether a second id image has a vote, in which wholes cover their parts: masks up to a
    /// quarter of the picture, the largest last.
    pub wholes: bool,
    /// Encoded pictures are kept on disk until the parse is done, for the prompts of defect
    /// correction; at most so many megabytes.
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
    /// What the segmenter's authors use, as the paper does where it says nothing else.
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
