//! Stage 1, Global Candidate Filtering: a [`SceneBundle`] to a [`ParsedScene`] (paper, METHOD section 1).
//!
//! ```text
//! cloud  -> superpoints ─┐
//! frames -> masks -> lifting -> affinity -> merging -> instances -> views
//! ```
//! Frames pass twice, decoded a few at a time: once for masks and lifting, once for the views. Same input and settings give
//! the same instances, whatever the number of threads.

pub mod affinity;
pub mod evidence;
mod frame_sampling;
pub mod instances;
pub mod lifting;
pub mod masks;
pub mod merging;
mod settings;
pub mod superpoints;
pub mod views;
pub mod wholes;

use crate::geometry::boxes::Aabb;
use crate::models::attributes;
use crate::progress::{Cancelled, Progress};
use crate::scene::{FrameError, ParseReport, ParsedScene, SceneBundle, StageTiming, stream_frames};
use masks::MaskSource;
use rayon::prelude::*;
pub use settings::ParsingSettings;
use std::time::Instant;

#[derive(Debug, thiserror::Error)]
pub enum ParseError {
    #[error(transparent)]
    Frame(#[from] FrameError),
    #[error("the cloud has no points")]
    NoPoints,
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
}

/// Cuts a scene into instances.
///
/// # Errors
/// [`ParseError`]: an unreadable frame (named), an empty cloud, or cancellation.
pub fn parse(
    bundle: SceneBundle,
    masks: &dyn MaskSource,
    settings: &ParsingSettings,
    progress: &Progress,
) -> Result<ParsedScene, ParseError> {
    let SceneBundle { cloud, frames, report: _ } = bundle;
    let extent = Aabb::around(&cloud.positions).ok_or(ParseError::NoPoints)?;
    let frames = frame_sampling::sample(&frames, &settings.frame_sampling);
    let mut clock = Clock::default();

    let superpoints = clock.time("superpoints", || superpoints::compute(&cloud, &settings.superpoints, &progress.part(0.0, 0.35)))?;

    let lifting = progress.part(0.35, 0.75);
    let mut tables = Vec::with_capacity(frames.len());
    clock.time("masks_and_lifting", || {
        stream_frames(
            &frames,
            |frame| {
                lifting.check()?;
                let frame = frame.decode()?;
                let ids = masks.masks(&frame);
                Ok::<_, ParseError>(lifting::lift(&cloud, &superpoints.of_point, &frame, &ids, settings.depth_tolerance))
            },
            |i, table| {
                tables.push(table);
                Ok(lifting.report("masks_and_lifting", (i + 1) as f32 / frames.len() as f32)?)
            },
        )
    })?;
    let blind = tables
        .iter()
        .filter(|table| table.rows.is_empty())
        .map(|table| table.frame.to_string())
        .collect::<Vec<_>>();

    let region_of = clock.time("merging", || merging::merge(&superpoints, tables, &settings.merging, &progress.part(0.75, 0.83)))?;
    let region_of = clock.time("wholes", || wholes::join(&cloud, &superpoints, region_of, &settings.wholes, &progress.part(0.83, 0.85)))?;
    let (mut instances, instance_of_point) = clock.time("instances", || {
        instances::build(&cloud, &superpoints, &region_of, &settings.instances, &progress.part(0.85, 0.88))
    })?;

    let viewing = progress.part(0.88, 1.0);
    let mut sightings = Vec::new();
    clock.time("views", || {
        stream_frames(
            &frames,
            |frame| {
                viewing.check()?;
                Ok::<_, ParseError>(views::sightings(&cloud, &instance_of_point, &frame.decode()?, settings.depth_tolerance))
            },
            |i, seen| {
                sightings.extend(seen);
                Ok(viewing.report("views", (i + 1) as f32 / frames.len() as f32)?)
            },
        )
    })?;
    views::choose(&mut instances, sightings, &frames, &settings.views);
    instances.par_iter_mut().for_each(|instance| instance.names = attributes::name_guesses(instance));

    let mut warnings = Vec::new();
    if frames.is_empty() {
        warnings.push("the scan has no frames: instances come from geometry and point colour alone and have no pictures".into());
    }
    if !blind.is_empty() {
        warnings.push(format!("{} of {} frames see no point of the cloud: {}", blind.len(), frames.len(), shortened(&blind)));
    }
    let report = ParseReport {
        points: cloud.len() as u64,
        frames_used: frames.len() as u32,
        superpoints: superpoints.patches.len() as u32,
        instances: instances.len() as u32,
        structural: instances.iter().filter(|i| i.structure.is_some()).count() as u32,
        without_views: instances.iter().filter(|i| i.views.is_empty()).count() as u32,
        stages: clock.stages,
        warnings,
    };
    Ok(ParsedScene { cloud, instance_of_point, instances, extent, report })
}

fn shortened(names: &[String]) -> String {
    const SHOWN: usize = 10;
    let shown = names.iter().take(SHOWN).cloned().collect::<Vec<_>>().join(", ");
    if names.len() > SHOWN { format!("{shown}, ...") } else { shown }
}

/// Wall-clock seconds per stage, for the report only: nothing is decided by it.
#[derive(Default)]
struct Clock {
    stages: Vec<StageTiming>,
}

impl Clock {
    fn time<T>(&mut self, stage: &str, work: impl FnOnce() -> T) -> T {
        let start = Instant::now();
        let result = work();
        self.stages.push(StageTiming { stage: stage.into(), seconds: start.elapsed().as_secs_f32() });
        result
    }
}
