//! Settings of neural models for instances: mask correction and appearance.

use serde::{Deserialize, Serialize};

/// Correction of instance outlines in pictures by a segmentation model.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct CorrectionSettings {
    /// Maximum number of prompts per view, at most 100. 0 disables the correction. Default: 2.
    /// Paper: 10.
    pub rounds: u32,
    /// Number of random visible pixels per prompt, 1 to 100. Default and paper: 5.
    pub points: u32,
    /// Minimum F-score between a mask and the projection. Default: 0.6.
    pub min_agreement: f32,
    /// F-score from which an existing mask of the frame is reused instead of a new prompt. `null`
    /// always prompts. Default: 0.8.
    pub known_agreement: Option<f32>,
}

impl Default for CorrectionSettings {
    fn default() -> Self {
        Self { rounds: 2, points: 5, min_agreement: 0.6, known_agreement: Some(0.8) }
    }
}

impl CorrectionSettings {
    /// Returns the settings of the paper.
    #[must_use]
    pub fn paper() -> Self {
        Self { rounds: 10, known_agreement: None, ..Self::default() }
    }
}

/// Pictures of an instance for the encoder.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct AppearanceSettings {
    /// Number of views per instance, best visible first, 1 to 100. Default: 5. Paper: 10.
    pub views: u32,
    /// Minimum share of the instance's points that a view must show. The best view is always used.
    /// Default and paper: 0.2.
    pub min_visible: f32,
    /// Number of crops per view, 1 to 16. Default: 1. Paper: 5.
    pub levels: u32,
    /// The first crop enlarges the tight box by this share of its width and height per side, 0 to
    /// 1. Default: 0.1. Paper: 0.
    // Parses of versions without this setting had no margin.
    #[serde(default)]
    pub margin: f32,
    /// Each further crop adds this share per side. Default and paper: 0.1.
    pub level_step: f32,
    /// Number of full frames to encode, spread over the scan, for content outside of instances. At
    /// most 1000. Default: 40. Paper: none.
    pub frames: u32,
}

impl Default for AppearanceSettings {
    fn default() -> Self {
        Self { views: 5, min_visible: 0.2, levels: 1, margin: 0.1, level_step: 0.1, frames: 40 }
    }
}

impl AppearanceSettings {
    /// Returns the settings of the paper.
    #[must_use]
    pub fn paper() -> Self {
        Self { views: 10, levels: 5, margin: 0.0, frames: 0, ..Self::default() }
    }
}
