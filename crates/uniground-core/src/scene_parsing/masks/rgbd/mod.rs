//! Built-in masks from colour, depth and normals; no model.
//!
//! Three steps on a grid of every second pixel: surfaces (position, normal, colour), small even patches cut along edges,
//! and patches joined into things by local convexity (LCCP: patches that meet concavely belong to different objects)
//! and colour. Large planes stay apart: things stand on floors and tables and hang on walls.

mod patches;
mod surfaces;
mod things;

use super::{IdImage, MaskSource};
use crate::progress::Progress;
use crate::scene::Frame;
use crate::scene_parsing::ParseError;
use surfaces::Surfaces;
use uniground_types::settings::RgbdSettings;

/// The built-in mask source.
#[derive(Debug, Clone, Default)]
pub struct RgbdMasks {
    /// Where patches are cut and when they join (docs/METHOD.md, section 1.3).
    pub settings: RgbdSettings,
}

impl MaskSource for RgbdMasks {
    fn name(&self) -> &'static str {
        "rgbd-3"
    }

    fn masks(&self, frame: &Frame, _progress: &Progress) -> Result<Vec<IdImage>, ParseError> {
        Ok(self.id_images(frame))
    }
}

impl RgbdMasks {
    /// The masks of one frame, as things: the coarser of its [`id_images`](Self::id_images).
    #[must_use]
    pub fn id_image(&self, frame: &Frame) -> IdImage {
        let (surfaces, patches) = self.patches(frame);
        self.joined(&surfaces, &patches, self.settings.join_cost, frame)
    }

    /// Things, and what they fall into where less is joined: both vote on what belongs together, so that a drawer counts as well as its dresser.
    #[must_use]
    pub fn id_images(&self, frame: &Frame) -> Vec<IdImage> {
        let (surfaces, patches) = self.patches(frame);
        let costs = [self.settings.join_cost, self.settings.finer_join_cost];
        let told = costs.iter().filter(|cost| **cost > 0.0);
        told.map(|&cost| self.joined(&surfaces, &patches, cost, frame)).collect()
    }

    fn patches(&self, frame: &Frame) -> (Surfaces, Vec<u32>) {
        let surfaces = Surfaces::of(frame, self.settings.stride);
        let patches = patches::cut(&surfaces, &self.settings);
        (surfaces, patches)
    }

    fn joined(&self, surfaces: &Surfaces, patches: &[u32], join_cost: f32, frame: &Frame) -> IdImage {
        spread(surfaces, &things::join(surfaces, patches, &RgbdSettings { join_cost, ..self.settings }), frame)
    }

    /// The masks of one frame from coarse to fine: things, then the even patches they are made of, with these times the settings' unevenness.
    #[must_use]
    pub fn levels(&self, frame: &Frame, unevenness: &[f32]) -> Vec<IdImage> {
        let (surfaces, patches) = self.patches(frame);
        let things = things::join(&surfaces, &patches, &self.settings);
        let finer = unevenness.iter().map(|times| {
            let settings = RgbdSettings { patch_scale: self.settings.patch_scale * times, ..self.settings };
            patches::cut(&surfaces, &settings)
        });
        std::iter::once(things).chain(finer).map(|labels| spread(&surfaces, &labels, frame)).collect()
    }
}

/// Grid labels to an id image at full depth resolution. Pixels without depth get no mask; ids past `u16` neither.
fn spread(surfaces: &Surfaces, things: &[u32], frame: &Frame) -> IdImage {
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
