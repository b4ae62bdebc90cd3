//! 2D masks: which pixels of a frame belong to the same thing.
//!
//! A [`MaskSource`] returns one id image per frame, or several that all have a vote. Ids have a
//! meaning only within one image.

pub mod rgbd;
pub mod sam;

use super::ParseError;
use serde::{Deserialize, Serialize};
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::{Frame, ModelTime};

/// One mask id per pixel of a frame's **depth** image, row-major; 0 = no mask.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct IdImage {
    /// Pixels, same as the depth image.
    pub width: u32,
    /// Pixels, same as the depth image.
    pub height: u32,
    /// `width * height` ids, valid only within this frame.
    pub ids: Vec<u16>,
}

impl IdImage {
    /// Returns the mask of a pixel (column, row), 0 for none. The pixel must lie in the image.
    #[must_use]
    pub fn at(&self, (column, row): (u32, u32)) -> u16 {
        self.ids[(row * self.width + column) as usize]
    }

    /// Returns the number of different masks.
    #[must_use]
    pub fn count(&self) -> u32 {
        let mut seen = vec![false; usize::from(u16::MAX) + 1];
        self.ids.iter().for_each(|&id| seen[usize::from(id)] = true);
        seen[1..].iter().filter(|seen| **seen).count() as u32
    }
}

/// An id image as runs of equal ids: a few kilobytes, so that those of all frames fit in memory.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct IdRuns {
    width: u32,
    height: u32,
    /// Pairs of id and run length, row-major; runs continue across the ends of rows.
    runs: Vec<(u16, u32)>,
}

impl IdRuns {
    /// Compresses an image.
    #[must_use]
    pub fn from_image(image: &IdImage) -> Self {
        let runs =
            image.ids.chunk_by(|a, b| a == b).map(|run| (run[0], run.len() as u32)).collect();
        Self { width: image.width, height: image.height, runs }
    }

    /// Restores the image.
    #[must_use]
    pub fn to_image(&self) -> IdImage {
        let ids =
            self.runs.iter().flat_map(|&(id, n)| std::iter::repeat_n(id, n as usize)).collect();
        IdImage { width: self.width, height: self.height, ids }
    }
}

/// Name and version of the built-in masks.
pub(crate) const BUILTIN_NAME: &str = "rgbd-2";

/// Returns whether the name recorded with a parse is that of the built-in masks alone, in any
/// version.
#[must_use]
pub fn is_builtin(name: &str) -> bool {
    name.strip_prefix("rgbd-").is_some_and(|version| version.parse::<u32>().is_ok())
}

/// A source of masks: built in (`rgbd`), a segmentation model, or annotations.
pub trait MaskSource: Send + Sync {
    /// Returns the name and version, recorded with the parse.
    fn name(&self) -> &str;

    /// Returns the masks of one frame, at the resolution of its depth image. The number of id
    /// images is the same for every frame. A model takes seconds, so it checks `progress` between
    /// its calls.
    ///
    /// # Errors
    /// [`ParseError`] when a model fails or the caller has asked to stop; the built-in masks never
    /// fail.
    fn masks(&self, frame: &Frame, progress: &Progress) -> Result<Vec<IdImage>, ParseError>;

    /// Returns the estimated seconds that models take per frame, on all cores.
    fn model_s_per_frame(&self) -> f32 {
        0.0
    }

    /// Returns the time spent in models since the last call.
    fn take_model_times(&self) -> Vec<ModelTime> {
        Vec::new()
    }
}

/// Several mask sources that all have a vote (paper: Semantic-SAM and SAM).
pub struct CombinedMasks<'a> {
    /// In the order of their id images.
    pub sources: Vec<&'a dyn MaskSource>,
    /// The joined names of the sources.
    pub name: String,
}

impl MaskSource for CombinedMasks<'_> {
    fn name(&self) -> &str {
        &self.name
    }

    fn masks(&self, frame: &Frame, progress: &Progress) -> Result<Vec<IdImage>, ParseError> {
        let each = self.sources.iter().map(|source| source.masks(frame, progress));
        Ok(each.collect::<Result<Vec<_>, _>>()?.concat())
    }

    fn model_s_per_frame(&self) -> f32 {
        self.sources.iter().map(|source| source.model_s_per_frame()).sum()
    }

    fn take_model_times(&self) -> Vec<ModelTime> {
        self.sources.iter().flat_map(|source| source.take_model_times()).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn only_the_built_in_masks_alone_are_built_in() {
        let of = ["rgbd-2", "rgbd-1", "sam2-hiera-tiny+rgbd-2", "rgbd-sam", "none", ""];
        assert_eq!(of.map(is_builtin), [true, true, false, false, false, false]);
        assert!(is_builtin(BUILTIN_NAME));
    }

    proptest! {
        #[test]
        fn runs_restore_the_image(width in 1_u32..20, height in 1_u32..20, seed in any::<u64>()) {
            let ids = (0..width * height).map(|i| ((seed >> (i % 60)) & 3) as u16).collect();
            let image = IdImage { width, height, ids };
            prop_assert_eq!(IdRuns::from_image(&image).to_image(), image);
        }
    }
}
