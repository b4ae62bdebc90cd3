//! 2D masks: which pixels of a frame belong to the same thing.
//!
//! A [`MaskSource`] gives one id image per frame; what the ids mean is only known within that frame.

pub mod rgbd;
pub mod sam;

use super::ParseError;
use crate::progress::Progress;
use crate::scene::Frame;

/// One mask id per pixel of a frame's **depth** image, row-major; 0 = no mask.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct IdImage {
    /// Pixels, as of the depth image.
    pub width: u32,
    /// Pixels, as of the depth image.
    pub height: u32,
    /// `width * height` of them; ids mean nothing beyond this frame.
    pub ids: Vec<u16>,
}

impl IdImage {
    /// The mask of a pixel (column, row), 0 for none; the pixel must lie in the image.
    #[must_use]
    pub fn at(&self, (column, row): (u32, u32)) -> u16 {
        self.ids[(row * self.width + column) as usize]
    }

    /// How many different masks there are.
    #[must_use]
    pub fn count(&self) -> u32 {
        let mut seen = vec![false; usize::from(u16::MAX) + 1];
        self.ids.iter().for_each(|&id| seen[usize::from(id)] = true);
        seen[1..].iter().filter(|seen| **seen).count() as u32
    }
}

/// Where masks come from: built in (`rgbd`), a segmentation model, or annotations.
pub trait MaskSource: Send + Sync {
    /// Name and version, recorded with the parse.
    fn name(&self) -> &str;

    /// The masks of one frame, at the resolution of its depth image. A model takes seconds, so it checks `progress` between its calls.
    ///
    /// # Errors
    /// [`ParseError`] when a model fails or the caller has asked to stop; the built-in masks never fail.
    fn masks(&self, frame: &Frame, progress: &Progress) -> Result<IdImage, ParseError>;
}
