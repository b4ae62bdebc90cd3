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
use serde::{Deserialize, Serialize};
use surfaces::Surfaces;
use utoipa::ToSchema;

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RgbdSettings {
    /// Every `stride`-th pixel of the depth image is looked at.
    pub stride: u32,
    /// CIELAB difference between neighbouring pixels that counts as one unit of edge.
    pub colour_edge: f32,
    /// Angle between neighbouring normals that counts as one unit of edge where the surface is concave, degrees.
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

/// The built-in mask source.
#[derive(Debug, Clone, Default)]
pub struct RgbdMasks {
    pub settings: RgbdSettings,
}

impl MaskSource for RgbdMasks {
    fn name(&self) -> &'static str {
        "rgbd-2"
    }

    fn masks(&self, frame: &Frame, _progress: &Progress) -> Result<IdImage, ParseError> {
        let surfaces = Surfaces::of(frame, self.settings.stride);
        let patches = patches::cut(&surfaces, &self.settings);
        let things = things::join(&surfaces, &patches, &self.settings);
        Ok(spread(&surfaces, &things, frame))
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
