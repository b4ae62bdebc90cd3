//! What networks do for instances: correction of projected masks, and appearance.

use serde::{Deserialize, Serialize};

/// How a segmentation model corrects the outlines of instances in pictures.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct CorrectionSettings {
    /// Prompts tried per view. Paper: 10. 0 leaves the projection as it is.
    pub rounds: u32,
    /// Random visible pixels per prompt. Paper: 5.
    pub points: u32,
    /// A mask agrees with the projection from this F-score on: it holds its pixels and not much
    /// else.
    pub min_agreement: f32,
    /// From this F-score on a mask that was found in the frame anyway is believed, and the
    /// segmenter not asked again. `null`: always ask.
    pub known_agreement: Option<f32>,
}

impl Default for CorrectionSettings {
    fn default() -> Self {
        Self { rounds: 2, points: 5, min_agreement: 0.6, known_agreement: Some(0.8) }
    }
}

impl CorrectionSettings {
    /// As many rounds as the paper makes.
    #[must_use]
    pub fn paper() -> Self {
        Self { rounds: 10, known_agreement: None, ..Self::default() }
    }
}

/// Which pictures of an instance an encoder looks at.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct AppearanceSettings {
    /// Views looked at per instance, those that show most. Paper: 10.
    pub views: u32,
    /// Least share of its points a view must show; the best view always counts. Paper: 0.2.
    pub min_visible: f32,
    /// Crops per view. Paper: 5.
    pub levels: u32,
    /// Level `l` grows the tight box by `l` times this share of its width and height, per side.
    /// Paper: 0.1.
    pub level_step: f32,
    /// Frames looked at as a whole, spread over the scan: for what is in no instance. Paper: none.
    pub frames: u32,
}

impl Default for AppearanceSettings {
    fn default() -> Self {
        Self { views: 5, min_visible: 0.2, levels: 3, level_step: 0.1, frames: 40 }
    }
}

impl AppearanceSettings {
    /// As many views and crops as the paper takes.
    #[must_use]
    pub fn paper() -> Self {
        Self { views: 10, levels: 5, frames: 0, ..Self::default() }
    }
}
