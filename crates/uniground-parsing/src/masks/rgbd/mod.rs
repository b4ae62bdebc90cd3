//! Built-in masks from color, depth and normals, without a model.
//!
//! Three steps on a grid of every second pixel: surfaces (position, normal, color), small even
//! patches cut along edges, and patches joined into things by local convexity (LCCP: patches that
//! meet concavely belong to different objects) and color. Large planes stay separate: things stand
//! on floors and tables and hang on walls.

mod patches;
mod surfaces;
mod things;

use super::{IdImage, MaskSource};
use crate::ParseError;
use surfaces::SurfaceGrid;
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::Frame;
use uniground_types::settings::RgbdSettings;

/// The built-in mask source.
#[derive(Debug, Clone, Default)]
pub struct RgbdMasks {
    /// Thresholds for cutting patches and joining them (docs/METHOD.md, section 1.3).
    pub settings: RgbdSettings,
}

impl MaskSource for RgbdMasks {
    fn name(&self) -> &'static str {
        super::BUILTIN_NAME
    }

    fn masks(&self, frame: &Frame, _progress: &Progress) -> Result<Vec<IdImage>, ParseError> {
        Ok(vec![self.id_image(frame)])
    }
}

impl RgbdMasks {
    /// Returns the masks of one frame.
    #[must_use]
    pub fn id_image(&self, frame: &Frame) -> IdImage {
        let surfaces = SurfaceGrid::from_frame(frame, self.settings.stride);
        let patches = patches::cut_patches(&surfaces, &self.settings);
        let things = things::join_patches(&surfaces, &patches, &self.settings);
        to_id_image(&surfaces, &things, frame)
    }
}

impl RgbdMasks {
    /// Returns the masks of one frame from coarse to fine: things, then their even patches, one
    /// image for each of these multiples of the settings' unevenness.
    #[must_use]
    pub fn levels(&self, frame: &Frame, unevenness: &[f32]) -> Vec<IdImage> {
        let surfaces = SurfaceGrid::from_frame(frame, self.settings.stride);
        let things = things::join_patches(
            &surfaces,
            &patches::cut_patches(&surfaces, &self.settings),
            &self.settings,
        );
        let finer = unevenness.iter().map(|times| {
            let settings =
                RgbdSettings { patch_scale: self.settings.patch_scale * times, ..self.settings };
            patches::cut_patches(&surfaces, &settings)
        });
        std::iter::once(things)
            .chain(finer)
            .map(|labels| to_id_image(&surfaces, &labels, frame))
            .collect()
    }
}

/// Converts grid labels to an id image at full depth resolution. Pixels without depth, and ids past
/// `u16`, get no mask.
fn to_id_image(surfaces: &SurfaceGrid, things: &[u32], frame: &Frame) -> IdImage {
    let (width, height) = (frame.depth.width, frame.depth.height);
    let mut ids = vec![0; (width * height) as usize];
    for v in 0..height {
        for u in 0..width {
            let cell = surfaces.cell_of(u, v);
            if surfaces.depth_m[cell] > 0.0 && frame.depth.at((u, v)) > 0.0 {
                ids[(v * width + u) as usize] = u16::try_from(things[cell] + 1).unwrap_or(0);
            }
        }
    }
    IdImage { width, height, ids }
}
