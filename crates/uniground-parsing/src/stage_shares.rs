//! Estimates how long each stage of a parse takes compared with the others. The remaining time of a
//! parse is computed from this. No result depends on it.

use crate::Perception;
use uniground_models::neural::DualEncoder;
use uniground_types::settings::{ParsingSettings, SamPrompts, SamSettings};

/// Progress at which each stage ends, as a share of the whole parse. The embeddings of frames end
/// at 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct StageEnds {
    pub(crate) masks: f32,
    pub(crate) planes: f32,
    pub(crate) merging: f32,
    pub(crate) part_merging: f32,
    pub(crate) refinement: f32,
    pub(crate) views: f32,
    pub(crate) instances: f32,
    pub(crate) appearance: f32,
}

/// Progress at which the superpoints end, which is known before anything else is.
pub(crate) fn superpoints_end(perception: &Perception) -> f32 {
    if perception.is_neural() { 0.01 } else { 0.3 }
}

/// Seconds of the stages between masks and appearance, with a margin.
const BETWEEN_S: f32 = 1.5;
/// Share of each of them, in order.
const BETWEEN: [f32; 6] = [0.1, 0.1, 0.1, 0.2, 0.2, 0.3];
/// Seconds per frame of masks without a model, and of everything but the model with one.
const FRAME_S: f32 = 0.1;
/// Prompts per frame at the middle of segments. Measured in five rooms.
const SEGMENT_PROMPTS: f32 = 78.0;
/// Views of instances that are embedded, per superpoint. Measured in the same rooms.
const VIEWS_PER_SUPERPOINT: f32 = 0.13;
/// Prompts to correct an outline, per view.
const CORRECTIONS_PER_VIEW: f32 = 0.7;
/// Crops of a frame that is embedded as a whole.
const CROPS_PER_FRAME: f32 = 7.0;

impl StageEnds {
    /// Estimates the ends for a scan with this number of selected frames and superpoints, from the
    /// speed that the models had when they were loaded.
    pub(crate) fn estimate(
        perception: &Perception,
        settings: &ParsingSettings,
        frames: usize,
        superpoints: usize,
    ) -> Self {
        if !perception.is_neural() {
            return Self {
                masks: 0.67,
                planes: 0.72,
                merging: 0.79,
                part_merging: 0.81,
                refinement: 0.88,
                views: 0.98,
                instances: 1.0,
                appearance: 1.0,
            };
        }
        let seconds = ModelSeconds::estimate(perception, settings, frames, superpoints);
        let stages = [seconds.masks]
            .into_iter()
            .chain(BETWEEN.map(|share| share * BETWEEN_S))
            .chain([seconds.appearance, seconds.frame_appearance]);
        let start = superpoints_end(perception);
        let total: f32 = stages.clone().sum();
        let mut done = 0.0;
        let mut ends = stages.map(|stage| {
            done += stage;
            // Rounding can exceed the end by a little.
            (start + (1.0 - start) * done / total).min(1.0)
        });
        let mut next = || ends.next().unwrap_or(1.0);
        Self {
            masks: next(),
            planes: next(),
            merging: next(),
            part_merging: next(),
            refinement: next(),
            views: next(),
            instances: next(),
            appearance: next(),
        }
    }
}

/// Estimated seconds of the stages that use models.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ModelSeconds {
    pub(crate) masks: f32,
    pub(crate) appearance: f32,
    pub(crate) frame_appearance: f32,
}

impl ModelSeconds {
    /// Estimates the seconds from the speed that the models had when they were loaded.
    pub(crate) fn estimate(
        perception: &Perception,
        settings: &ParsingSettings,
        frames: usize,
        superpoints: usize,
    ) -> Self {
        let frames = frames as f32;
        let embed_s = perception.encoder.map_or(0.0, DualEncoder::picture_s);
        let views = superpoints as f32 * VIEWS_PER_SUPERPOINT;
        let correction_s = perception.corrector.as_ref().map_or(0.0, |corrector| {
            CORRECTIONS_PER_VIEW * corrector.frames.segmenter().prompt_s()
        });
        let embedded_frames = frames.min(settings.appearance.frames as f32);
        Self {
            masks: frames * (FRAME_S + perception.masks.model_s_per_frame()),
            appearance: views * (settings.appearance.levels as f32 * embed_s + correction_s),
            frame_appearance: embedded_frames * CROPS_PER_FRAME * embed_s,
        }
    }
}

/// Estimates the pictures that a segmenter encodes for a frame, and the prompts it gets.
pub(crate) fn calls_per_frame(settings: &SamSettings) -> (f32, f32) {
    let grid = (settings.points_per_side * settings.points_per_side) as f32;
    let prompts = match settings.prompts {
        SamPrompts::Grid => grid,
        SamPrompts::Segments => SEGMENT_PROMPTS,
    };
    // Four quarters, each with half the points per side.
    if settings.quarters { (5.0, prompts + grid) } else { (1.0, prompts) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::masks::rgbd::RgbdMasks;
    use uniground_testing::tiny_encoder;

    #[test]
    fn ends_rise_to_one_and_masks_take_more_of_a_longer_scan() {
        let (masks, encoder) = (RgbdMasks::default(), tiny_encoder());
        let perception = Perception { encoder: Some(&encoder), ..Perception::with_masks(&masks) };
        let settings = ParsingSettings::default();
        let ends = |frames| StageEnds::estimate(&perception, &settings, frames, 4000);
        for ends in [ends(0), ends(30), ends(400)] {
            let StageEnds { masks, planes, merging, part_merging, refinement, views, .. } = ends;
            let all = [masks, planes, merging, part_merging, refinement, views];
            assert!(all.is_sorted() && views < ends.instances && ends.instances < ends.appearance);
            assert!(superpoints_end(&perception) <= masks && ends.appearance <= 1.0, "{ends:?}");
        }
        assert!(ends(400).masks > ends(30).masks);
    }

    #[test]
    fn quarters_take_four_more_pictures_and_their_own_grid() {
        let settings = SamSettings { points_per_side: 8, ..SamSettings::default() };
        assert_eq!(calls_per_frame(&settings), (1.0, SEGMENT_PROMPTS));
        let grid = SamSettings { prompts: SamPrompts::Grid, quarters: true, ..settings };
        assert_eq!(calls_per_frame(&grid), (5.0, 128.0));
    }
}
