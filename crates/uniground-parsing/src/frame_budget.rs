//! Limits the frames of a parse to what fits into a number of minutes.

use crate::checkpoints::Checkpoints;
use crate::frame_sampling::spread_along_path;
use crate::stage_shares::ModelSeconds;
use crate::{ParseError, ParsingSettings, Perception};
use std::time::Instant;
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::{FrameRef, stream_frames};

/// Fewest frames, however little time there is.
const LEAST: usize = 4;

/// The time that a parse may take.
pub(crate) struct FrameBudget<'a> {
    pub(crate) perception: &'a Perception<'a>,
    pub(crate) settings: &'a ParsingSettings,
    /// Number of superpoints, from which the time for names is estimated.
    pub(crate) superpoints: usize,
}

/// The frames that fit into the time.
pub(crate) struct AffordableFrames {
    pub(crate) frames: Vec<FrameRef>,
    /// For the report, when some were left out.
    pub(crate) warning: Option<String>,
}

impl FrameBudget<'_> {
    /// Returns as many of the frames as fit, spread evenly along the camera path. The number is
    /// stored in a checkpoint, so that an interrupted parse goes on with the same frames.
    ///
    /// # Errors
    /// [`ParseError`]: an unreadable frame, a mask source that fails, or cancellation.
    pub(crate) fn fit(
        &self,
        frames: Vec<FrameRef>,
        checkpoints: &Checkpoints,
        progress: &Progress,
    ) -> Result<AffordableFrames, ParseError> {
        let Some(minutes) = self.settings.max_minutes.filter(|_| frames.len() > LEAST) else {
            return Ok(AffordableFrames { frames, warning: None });
        };
        let depends_on = (self.perception.masks.name(), &self.settings.frame_sampling, minutes);
        let compute = || {
            let frame_s = self.measure_frame_s(&frames, progress)?;
            Ok::<_, ParseError>(self.affordable(minutes, frame_s, frames.len()))
        };
        let (number, _) = checkpoints.load_or_compute("frame_budget", &depends_on, compute)?;
        if number >= frames.len() {
            return Ok(AffordableFrames { frames, warning: None });
        }
        let chosen = spread_along_path(&frames, number);
        let warning = format!(
            "{number} of {} frames were used: as many as fit into parsing.max_minutes, {minutes}",
            frames.len()
        );
        let frames = chosen.into_iter().map(|frame| frames[frame].clone()).collect();
        Ok(AffordableFrames { frames, warning: Some(warning) })
    }

    /// Returns the number of frames for which there is time.
    fn affordable(&self, minutes: f32, frame_s: f32, all: usize) -> usize {
        let estimate = |frames| {
            ModelSeconds::estimate(self.perception, self.settings, frames, self.superpoints)
        };
        let seconds = |frames: usize| {
            let models = estimate(frames);
            frames as f32 * frame_s + models.appearance + models.frame_appearance
        };
        (LEAST..=all).rev().find(|frames| seconds(*frames) <= minutes * 60.0).unwrap_or(LEAST)
    }

    /// Computes the masks of one frame per thread, and returns the seconds per frame.
    fn measure_frame_s(&self, frames: &[FrameRef], progress: &Progress) -> Result<f32, ParseError> {
        let measured = &frames[..rayon::current_num_threads().min(frames.len())];
        let start = Instant::now();
        stream_frames(
            measured,
            |frame| {
                progress.check()?;
                self.perception.masks.masks(&frame.decode()?, progress)
            },
            |_, _| Ok::<_, ParseError>(()),
        )?;
        Ok(start.elapsed().as_secs_f32() / measured.len() as f32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::masks::rgbd::RgbdMasks;
    use uniground_geometry::Isometry3;
    use uniground_geometry::scene::{FrameIndex, Intrinsics, Optics};

    fn frames(number: u32) -> Vec<FrameRef> {
        let intrinsics = Intrinsics { width: 1, height: 1, fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 };
        (0..number)
            .map(|i| FrameRef {
                index: FrameIndex(i),
                time_s: None,
                color: "missing".into(),
                depth: "missing".into(),
                color_intrinsics: intrinsics,
                depth_intrinsics: intrinsics,
                depth_scale_m: 0.001,
                camera_to_world: Isometry3::translation(i as f32, 0.0, 0.0),
                optics: Optics::default(),
            })
            .collect()
    }

    #[test]
    fn as_many_frames_are_used_as_fit_but_never_too_few() {
        let (masks, settings) = (RgbdMasks::default(), ParsingSettings::default());
        let perception = Perception::with_masks(&masks);
        let budget = FrameBudget { perception: &perception, settings: &settings, superpoints: 900 };
        assert_eq!(budget.affordable(0.5, 1.0, 100), 30);
        assert_eq!(budget.affordable(10.0, 1.0, 100), 100);
        assert_eq!(budget.affordable(0.1, 60.0, 100), LEAST);
    }

    /// The measured number is read back instead of measured again: these frames cannot be read.
    #[test]
    fn number_of_frames_is_kept_across_an_interruption() {
        let folder = tempfile::tempdir().unwrap();
        let folder = camino::Utf8Path::from_path(folder.path()).unwrap();
        let checkpoints = Checkpoints::in_folder(folder, "scan");
        let masks = RgbdMasks::default();
        let settings = ParsingSettings { max_minutes: Some(1.0), ..ParsingSettings::default() };
        let perception = Perception::with_masks(&masks);
        let budget = FrameBudget { perception: &perception, settings: &settings, superpoints: 900 };
        let fit = |frames| budget.fit(frames, &checkpoints, &Progress::silent());
        assert!(matches!(fit(frames(40)), Err(ParseError::Frame(_))));
        let few = fit(frames(4)).unwrap();
        assert_eq!((few.frames.len(), few.warning), (4, None), "four frames are not measured");
        let depends_on = (perception.masks.name(), &settings.frame_sampling, 1.0_f32);
        let measured = || Ok::<usize, ParseError>(5);
        checkpoints.load_or_compute("frame_budget", &depends_on, measured).unwrap();
        let chosen = fit(frames(40)).unwrap();
        let indices: Vec<u32> = chosen.frames.iter().map(|frame| frame.index.0).collect();
        assert_eq!(indices, [0, 10, 20, 30, 39]);
        assert_eq!(
            chosen.warning.unwrap(),
            "5 of 40 frames were used: as many as fit into parsing.max_minutes, 1"
        );
    }
}
