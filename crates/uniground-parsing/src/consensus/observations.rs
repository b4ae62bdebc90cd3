//! Which points of the cloud every mask of every frame shows.

use crate::ParseError;
use crate::lifting::MasksOfFrames;
use crate::visibility::Visibility;
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::{FrameRef, stream_frames};

/// One in this many points of the cloud is looked up: a thing of 200 points has 100 samples.
const EVERY: u32 = 2;

/// The sampled points that one frame shows, with their masks.
#[derive(Debug)]
pub struct ObservedFrame {
    /// Samples, ascending.
    pub samples: Vec<u32>,
    /// By id image: the mask of each of these samples, 0 for none.
    pub masks: Vec<Vec<u16>>,
}

/// What all frames show of a sample of the cloud's points. A sample is numbered from 0; see
/// [`point`](Self::point).
#[derive(Debug)]
pub struct MaskObservations {
    /// One per frame, in order.
    pub frames: Vec<ObservedFrame>,
    /// Number of id images per frame.
    pub layers: usize,
    /// Number of samples.
    pub samples: usize,
}

impl ObservedFrame {
    /// Returns the samples that the frame shows, and their masks in one id image.
    pub fn points(&self, layer: usize) -> impl Iterator<Item = (u32, u16)> + '_ {
        self.samples.iter().copied().zip(self.masks[layer].iter().copied())
    }
}

impl MaskObservations {
    /// Number of points of the cloud that a sample stands for.
    pub const WEIGHT: u32 = EVERY;

    /// Looks a cloud of this many points up in the masks of all frames. Decodes their depth.
    ///
    /// # Errors
    /// [`ParseError`]: an unreadable frame, or cancellation.
    pub fn collect(
        points: usize,
        visibility: &Visibility,
        frames: &[FrameRef],
        masks: &MasksOfFrames,
        progress: &Progress,
    ) -> Result<Self, ParseError> {
        let mut observed = Vec::with_capacity(frames.len());
        stream_frames(
            frames,
            |frame| {
                progress.check()?;
                let seen = visibility.in_frame(&frame.depth_camera(), &frame.decode_depth()?);
                let mut seen: Vec<(u32, (u32, u32))> = seen
                    .iter()
                    .filter_map(|seen| Some((Self::sample(seen.point as usize)?, seen.cell)))
                    .collect();
                seen.sort_unstable();
                let masks = masks[&frame.index].iter().map(|masks| {
                    let image = masks.to_image();
                    seen.iter().map(|&(_, cell)| image.at(cell)).collect()
                });
                let masks = masks.collect();
                let samples = seen.iter().map(|(sample, _)| *sample).collect();
                Ok::<_, ParseError>(ObservedFrame { samples, masks })
            },
            |_, frame| {
                observed.push(frame);
                Ok(())
            },
        )?;
        let layers = observed.iter().map(|frame| frame.masks.len()).min().unwrap_or(0);
        Ok(Self { frames: observed, layers, samples: points.div_ceil(EVERY as usize) })
    }

    /// Returns the index in the cloud of a sample.
    #[must_use]
    pub fn point(sample: u32) -> usize {
        sample as usize * EVERY as usize
    }

    /// Returns the sample of a point of the cloud, if it is one.
    #[must_use]
    pub fn sample(point: usize) -> Option<u32> {
        let point = point as u32;
        point.is_multiple_of(EVERY).then_some(point / EVERY)
    }
}
