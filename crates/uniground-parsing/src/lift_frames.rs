//! Divides the cloud into superpoints and lifts the masks of every frame to them. A scan that has
//! grown is processed part by part, each frame lifted to the cloud of its time. So the work for
//! earlier parts comes from checkpoints.

use super::checkpoints::Checkpoints;
use super::frame_budget::FrameBudget;
use super::lifting::{Lifted, LiftingInput};
use super::masks::MaskSource;
use super::stage_shares::StageEnds;
use super::superpoints::{self, Superpoints};
use super::visibility::Visibility;
use super::{ParseError, Perception, StageOutcome, Stopwatch};
use super::{frame_selection, stage_shares};
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::{FrameRef, PointCloud, SceneBundle};
use uniground_types::settings::{
    FrameSamplingSettings, ParsingSettings, RgbdSettings, SamSettings, SuperpointSettings,
};

/// A scan in superpoints, with what its frames show of them.
pub(super) struct LiftedFrames {
    /// The cloud with everything that was added.
    pub cloud: PointCloud,
    /// The frames that were used.
    pub frames: Vec<FrameRef>,
    pub superpoints: Superpoints,
    /// One per frame, in order.
    pub lifted: Vec<Lifted>,
    /// Checkpoints for stages that depend on the whole scan.
    pub checkpoints: Checkpoints,
    /// Progress at which the stages end.
    pub ends: StageEnds,
    /// For the report.
    pub warnings: Vec<String>,
}

/// Returns the inputs that lifted masks depend on.
pub(super) fn lifting_dependencies<'a>(
    masks: &'a dyn MaskSource,
    settings: &'a ParsingSettings,
) -> LiftedWith<'a> {
    let mask_settings = (masks.name(), &settings.rgbd_masks, &settings.sam_masks);
    (&settings.superpoints, &settings.frame_sampling, mask_settings, settings.depth_tolerance)
}

type LiftedWith<'a> = (
    &'a SuperpointSettings,
    &'a FrameSamplingSettings,
    (&'a str, &'a RgbdSettings, &'a SamSettings),
    f32,
);

/// Computes the superpoints of a scan's cloud, and the masks of its frames lifted to them.
///
/// # Errors
/// [`ParseError`]: an unreadable frame, a mask source that fails, or cancellation.
pub(super) fn lift_scan(
    bundle: SceneBundle,
    perception: &Perception,
    settings: &ParsingSettings,
    checkpoints: &Checkpoints,
    progress: &Progress,
    watch: &mut Stopwatch,
) -> Result<LiftedFrames, ParseError> {
    let SceneBundle { mut cloud, frames, additions, report: _ } = bundle;
    let superpoints_end = stage_shares::superpoints_end(perception);
    let mut superpoints = watch.time("superpoints", |outcome| {
        let compute = || {
            superpoints::compute(
                &cloud,
                &settings.superpoints,
                &progress.sub_range(0.0, superpoints_end),
            )
        };
        let (superpoints, reused) =
            checkpoints.load_or_compute("superpoints", &settings.superpoints, compute)?;
        *outcome =
            StageOutcome { produced: superpoints.patches.len(), reused, ..StageOutcome::default() };
        Ok::<_, ParseError>(superpoints)
    })?;
    let lifting_of = |cloud: &PointCloud,
                      superpoints: &Superpoints,
                      stage: &str,
                      checkpoints: &Checkpoints,
                      frames: &[FrameRef],
                      progress: &Progress| {
        let visibility = Visibility::new(cloud, &superpoints.of_point, settings.depth_tolerance);
        let lifting = LiftingInput {
            visibility: &visibility,
            superpoint_of_point: &superpoints.of_point,
            masks: perception.masks,
        };
        lifting.lift_all(
            frames,
            checkpoints.open_log(stage, &lifting_dependencies(perception.masks, settings)),
            progress,
        )
    };
    let mut warnings = Vec::new();
    let mut select = |frames: &[FrameRef],
                      cloud: &PointCloud,
                      superpoints: &Superpoints,
                      checkpoints: &Checkpoints| {
        let selected = frame_selection::choose_frames(
            frames,
            cloud,
            &superpoints.patches,
            perception.masks,
            &settings.frame_sampling,
        );
        let budget = FrameBudget { perception, settings, superpoints: superpoints.patches.len() };
        let affordable = budget.fit(selected, checkpoints, progress)?;
        warnings.extend(affordable.warning);
        Ok::<_, ParseError>(affordable.frames)
    };
    let mut frames = select(&frames, &cloud, &superpoints, checkpoints)?;
    let all_frames = (frames.len()
        + additions.iter().map(|addition| addition.frames.len()).sum::<usize>())
    .max(1) as f32;
    let number = superpoints.patches.len();
    let ends = StageEnds::estimate(perception, settings, all_frames as usize, number);
    let lifting_progress = progress.sub_range(superpoints_end, ends.masks);
    let mut lifted = watch.time("masks_and_lifting", |outcome| {
        let looking = lifting_progress.sub_range(0.0, frames.len() as f32 / all_frames);
        let (lifted, reused) =
            lifting_of(&cloud, &superpoints, "lifting", checkpoints, &frames, &looking)?;
        *outcome = StageOutcome {
            produced: count_masks(&lifted),
            reused,
            models: perception.masks.take_model_times(),
        };
        Ok::<_, ParseError>(lifted)
    })?;
    let mut checkpoints = checkpoints.clone();
    for (addition, number) in additions.iter().zip(1..) {
        watch.time("growth", |outcome| {
            let before = frames.len() as f32 / all_frames;
            let share = addition.frames.len() as f32 / all_frames;
            let looking = lifting_progress.sub_range(before, before + share);
            checkpoints = checkpoints.with_dependency(&addition.made_of);
            cloud = addition.apply_to(&cloud);
            let compute = || {
                superpoints::grow_superpoints(
                    &superpoints,
                    addition,
                    &cloud,
                    &settings.superpoints,
                    &looking,
                )
            };
            let ((grown, renumbered), _) = checkpoints.load_or_compute(
                &format!("superpoints{number}"),
                &settings.superpoints,
                compute,
            )?;
            superpoints = grown;
            let new = select(&addition.frames, &cloud, &superpoints, &checkpoints)?;
            lifted.iter_mut().for_each(|lifted: &mut Lifted| lifted.renumber(&renumbered));
            let (more, reused) = lifting_of(
                &cloud,
                &superpoints,
                &format!("lifting{number}"),
                &checkpoints,
                &new,
                &looking,
            )?;
            *outcome = StageOutcome {
                produced: count_masks(&more),
                reused,
                models: perception.masks.take_model_times(),
            };
            lifted.extend(more);
            frames.extend(new);
            Ok::<_, ParseError>(())
        })?;
    }
    Ok(LiftedFrames { cloud, frames, superpoints, lifted, checkpoints, ends, warnings })
}

fn count_masks(lifted: &[Lifted]) -> usize {
    lifted.iter().flat_map(|lifted| &lifted.tables).map(|table| table.masks as usize).sum()
}
