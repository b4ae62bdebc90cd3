//! Stage 1, Global Candidate Filtering: a [`SceneBundle`] to a [`ParsedScene`] (paper, section 3.2;
//! docs/METHOD.md, section 1).
//!
//! ```text
//! cloud  -> superpoints -> planes ─┐
//! frames -> masks -> lifting -> affinity -> merging -> part merging -> consensus -> refinement -> views
//!        -> instances -> appearance -> names
//! ```
//! Frames are decoded a few at a time: for masks and lifting, then their depth for gaps, flat things,
//! consensus (with a segmentation model only), refinement and views. Where networks take part, the chosen views are read
//! once more. Same input and settings give the same instances, whatever the number of threads.

#![warn(missing_docs)]

pub mod affinity;
pub mod appearance;
pub mod changes;
pub mod checkpoints;
mod close_range;
pub mod consensus;
pub mod correction;
pub mod evidence;
pub mod frame_appearance;
pub mod frame_sampling;
pub mod frame_selection;
pub mod gaps;
pub mod hierarchy;
pub mod instances;
pub mod labels;
pub mod lifting;
pub mod masks;
pub mod merging;
pub mod model_clock;
pub mod observation;
pub mod outline;
pub mod part_merging;

mod frame_budget;
mod frame_masks;
mod lift_frames;
pub mod planes;
pub mod pointed;
pub mod refinement;
pub mod relief;
pub mod report_pictures;
pub mod scan;
pub mod separate_flat;
pub mod sharpness;
pub mod split_supported;
mod stage_shares;
mod stopwatch;
pub mod superpoints;
pub mod views;
pub mod visibility;

use appearance::Correction;
use checkpoints::Checkpoints;
use close_range::Enlargement;
use consensus::{MaskedFrames, RegionsOfScan};
use correction::Corrector;
use hierarchy::Proposal;
use instances::BuiltInstances;
use labels::Labels;
use lift_frames::LiftedFrames;
use lifting::{FrameVisibility, Lifted, MasksOfFrames};
use masks::MaskSource;
use model_clock::PictureEncoder;
use planes::Planes;
use relief::FlatCandidates;
use separate_flat::SuperpointsAndPlanes;
use stage_shares::StageEnds;
pub use stopwatch::{StageOutcome, Stopwatch};
use superpoints::Superpoints;
use uniground_geometry::Point3;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::progress::{Cancelled, Progress};
use uniground_geometry::scene::{
    FrameEmbeddings, FrameError, FrameRef, ParseReport, ParsedScene, PointCloud, SceneBundle,
};
use uniground_models::neural::{DualEncoder, ModelError};
use uniground_models::{attributes, calibration};
pub use uniground_types::settings::ParsingSettings;
use views::LabeledPoints;
use visibility::Visibility;

/// Why a scene could not be parsed into instances.
#[derive(Debug, thiserror::Error)]
pub enum ParseError {
    /// A picture of a frame cannot be read.
    #[error(transparent)]
    Frame(#[from] FrameError),
    /// A segmenter or encoder failed.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// The cloud is empty.
    #[error("the cloud has no points")]
    NoPoints,
    /// The caller asked to stop.
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
}

/// The models and built-in methods that interpret pictures.
pub struct Perception<'a> {
    /// Segments frames into masks.
    pub masks: &'a dyn MaskSource,
    /// Corrects outlines of single instances; `None`: projected boxes are used.
    pub corrector: Option<Corrector<'a>>,
    /// Compares pictures and words; `None`: the built-in attributes name instances.
    pub encoder: Option<&'a DualEncoder>,
}

impl<'a> Perception<'a> {
    /// Uses masks of this source, names from the built-in attributes, and no correction.
    #[must_use]
    pub fn with_masks(masks: &'a dyn MaskSource) -> Self {
        Self { masks, corrector: None, encoder: None }
    }

    fn is_neural(&self) -> bool {
        self.corrector.is_some() || self.encoder.is_some()
    }
}

/// Parses a scene into instances. Stages found in `checkpoints` are loaded from there.
///
/// # Errors
/// [`ParseError`]: an unreadable frame (named), an empty cloud, or cancellation.
pub fn parse(
    bundle: SceneBundle,
    perception: &Perception,
    settings: &ParsingSettings,
    checkpoints: &Checkpoints,
    progress: &Progress,
) -> Result<ParsedScene, ParseError> {
    if bundle.cloud.is_empty() {
        return Err(ParseError::NoPoints);
    }
    let enlargement = Enlargement::of(&bundle.report);
    let (bundle, checkpoints) =
        (enlargement.enlarge(bundle), &enlargement.separate_checkpoints(checkpoints));
    let mut watch = Stopwatch::default();
    let LiftedFrames {
        mut cloud,
        frames,
        mut superpoints,
        lifted,
        checkpoints,
        ends,
        mut warnings,
    } = lift_frames::lift_scan(bundle, perception, settings, checkpoints, progress, &mut watch)?;
    let extent = Aabb::around(&cloud.positions).ok_or(ParseError::NoPoints)?;
    let visibility = Visibility::new(&cloud, &superpoints.of_point, settings.depth_tolerance);
    let (tables, masks_of, sharpness_of) = Lifted::split(lifted);
    let blind: Vec<String> = tables
        .iter()
        .filter(|t| t.layer == 0 && t.rows.is_empty())
        .map(|t| t.frame.to_string())
        .collect();
    if settings.merging.split_at_depth_edges {
        superpoints.adjacent = watch.time("gaps", |outcome| {
            let frames = &frames[..];
            let kept = split_at_depth_edges(&cloud, &superpoints, frames, settings, progress)?;
            outcome.produced = superpoints.adjacent.len() - kept.len();
            Ok::<_, ParseError>(kept)
        })?;
    }
    let seen = ScanObservations {
        cloud: &cloud,
        frames: &frames,
        superpoints,
        visibility: &visibility,
        tables,
        masks_of: &masks_of,
        ends,
    };
    let RegionGrouping { superpoints, planes, region_of, proposals } =
        group_superpoints(seen, perception, settings, &checkpoints, progress, &mut watch)?;
    let labels = Labels::from_regions(&region_of, &superpoints, proposals);
    let sighted = watch.time("views", |outcome| {
        let viewing = progress.sub_range(ends.refinement, ends.views);
        let labeled = LabeledPoints { labels: &labels, visibility: &visibility };
        let flats = FlatCandidates::find(
            &cloud,
            &superpoints,
            &planes,
            &labels,
            &camera_centers(&frames),
            &settings.instances,
        );
        let sighted =
            views::compute_instance_views(labeled, Some(&flats), &frames, &masks_of, &viewing)?;
        outcome.produced = sighted.sightings.len();
        Ok::<_, ParseError>(sighted)
    })?;
    let built = watch.time("instances", |outcome| {
        let building = progress.sub_range(ends.views, ends.instances);
        let built = instances::build(
            &cloud,
            &superpoints,
            &planes,
            labels,
            sighted,
            &settings.instances,
            &building,
        )?;
        outcome.produced = built.instances.len();
        Ok::<_, ParseError>(built)
    })?;
    let BuiltInstances { mut instances, labels, sightings, dropped, specks } = built;
    let looked_at = appearance::choose_frames(&instances, &sightings, &settings.appearance);
    views::choose_views(&mut instances, sightings, &frames, &sharpness_of, &settings.views);
    let pictures = perception.encoder.map(PictureEncoder::new);
    let rows = match perception.is_neural() {
        false => Vec::new(),
        true => watch.time("appearance", |outcome| {
            let labeled = LabeledPoints { labels: &labels, visibility: &visibility };
            let looking = progress.sub_range(ends.instances, ends.appearance);
            let (rows, outlines) = appearance::embed_instances(
                &frames,
                &instances,
                &looked_at,
                labeled,
                (
                    perception
                        .corrector
                        .as_ref()
                        .map(|corrector| Correction { corrector, known: &masks_of }),
                    pictures.as_ref(),
                ),
                &settings.appearance,
                &looking,
            )?;
            views::apply_outlines(&mut instances, &outlines);
            outcome.models = perception.masks.take_model_times();
            outcome.models.extend(pictures.iter().flat_map(|pictures| pictures.clock.take()));
            outcome.produced = looked_at.values().map(std::collections::BTreeMap::len).sum();
            Ok::<_, ParseError>(rows)
        })?,
    };
    enlargement.reduce_instances(&mut instances);
    attributes::name_all(&mut instances);
    let embeddings = perception
        .encoder
        .map(|encoder| calibration::name_all(&mut instances, encoder, &rows))
        .transpose()?;

    let frame_embeddings = match &pictures {
        None => None,
        Some(pictures) => watch.time("frame_appearance", |outcome| {
            let seen = frame_appearance::embed_frames(
                &frames,
                pictures,
                &settings.appearance,
                &progress.sub_range(ends.appearance, 1.0),
            )?;
            outcome.models = pictures.clock.take();
            outcome.produced = seen.as_ref().map_or(0, FrameEmbeddings::len);
            Ok::<_, ParseError>(seen)
        })?,
    };
    warnings.extend(blind_frame_warnings(frames.len(), &blind));
    let report = ParseReport {
        points: cloud.len() as u64,
        frames_used: frames.len() as u32,
        superpoints: superpoints.patches.len() as u32,
        instances: labels.things,
        parts_and_wholes: labels.compounds.len() as u32,
        structural: instances.iter().filter(|i| i.structure.is_some()).count() as u32,
        dropped,
        specks,
        without_views: instances.iter().filter(|i| i.views.is_empty()).count() as u32,
        stages: watch.stages,
        warnings,
    };
    enlargement.reduce_cloud(&mut cloud);
    Ok(ParsedScene {
        cloud,
        instance_of_point: labels.thing_of_point.into_owned(),
        superpoint_of_point: superpoints.of_point,
        instances,
        embeddings,
        frame_embeddings,
        extent: enlargement.reduce(extent),
        report,
    })
}

/// Returns the pairs of adjacent superpoints that no depth edge separates.
fn split_at_depth_edges(
    cloud: &PointCloud,
    superpoints: &Superpoints,
    frames: &[FrameRef],
    settings: &ParsingSettings,
    progress: &Progress,
) -> Result<Vec<(u32, u32)>, ParseError> {
    let voxel_m = superpoints::voxel_m(cloud, &settings.superpoints);
    gaps::remove_pairs_across_gaps(
        cloud,
        superpoints,
        voxel_m,
        frames,
        settings.depth_tolerance,
        progress,
    )
}

/// A scan in superpoints, with what its frames show of them.
struct ScanObservations<'a> {
    cloud: &'a PointCloud,
    frames: &'a [FrameRef],
    superpoints: Superpoints,
    visibility: &'a Visibility,
    tables: Vec<FrameVisibility>,
    masks_of: &'a MasksOfFrames,
    ends: StageEnds,
}

/// The points of a scan grouped into regions, each a candidate for an instance.
struct RegionGrouping {
    superpoints: Superpoints,
    planes: Planes,
    /// One region per point of the cloud.
    region_of: Vec<u32>,
    /// Parts of regions, and wholes of several regions.
    proposals: Vec<Proposal>,
}

/// Finds planes and merges superpoints into regions.
fn group_superpoints(
    seen: ScanObservations,
    perception: &Perception,
    settings: &ParsingSettings,
    checkpoints: &Checkpoints,
    progress: &Progress,
    watch: &mut Stopwatch,
) -> Result<RegionGrouping, ParseError> {
    let ScanObservations { cloud, frames, superpoints, visibility, tables, masks_of, ends } = seen;
    let SuperpointsAndPlanes { superpoints, planes, tables } = watch.time("planes", |outcome| {
        let planes = planes::find(
            cloud,
            &superpoints,
            &camera_centers(frames),
            &progress.sub_range(ends.masks, ends.planes),
        )?;
        outcome.produced = planes.planes.len();
        let found = SuperpointsAndPlanes { superpoints, planes, tables };
        if !settings.merging.keep_planes_apart {
            return Ok(found);
        }
        let masked = MaskedFrames { cloud, visibility, frames, masks_of };
        let separating = progress.sub_range(ends.planes, ends.planes);
        separate_flat::separate_flat_things(masked, found, &separating)
    })?;
    let lifted_with = lift_frames::lifting_dependencies(perception.masks, settings);
    let regions = watch.time("merging", |outcome| {
        let compute = || {
            merging::merge(
                &superpoints,
                &planes,
                &tables,
                &settings.merging,
                &progress.sub_range(ends.planes, ends.merging),
            )
        };
        let (regions, reused) =
            checkpoints.load_or_compute("merging", &(lifted_with, &settings.merging), compute)?;
        *outcome = StageOutcome {
            produced: count_labels(regions.last()),
            reused,
            ..StageOutcome::default()
        };
        Ok::<_, ParseError>(regions)
    })?;
    let region_of = watch.time("part_merging", |outcome| {
        let freed = match settings.part_merging.enabled {
            false => regions.last().to_vec(),
            true => split_supported::split_supported(
                cloud,
                &superpoints,
                &planes,
                regions.last().to_vec(),
                settings.merging.min_points,
                progress,
            )?,
        };
        let joined = part_merging::join_parts(
            cloud,
            &superpoints,
            &planes,
            freed,
            &settings.part_merging,
            &progress.sub_range(ends.merging, ends.part_merging),
        )?;
        outcome.produced = count_labels(&joined);
        Ok::<_, ParseError>(joined)
    })?;
    let mut grouped = RegionsOfScan {
        superpoints,
        planes,
        levels: regions,
        tables,
        region_of,
        clusters: Vec::new(),
    };
    // Built-in masks divide things so much that their clusters gain nothing.
    if settings.part_merging.enabled && !masks::is_builtin(perception.masks.name()) {
        grouped = watch.time("regrouping", |outcome| {
            let masked = MaskedFrames { cloud, visibility, frames, masks_of };
            let regrouping = progress.sub_range(ends.part_merging, ends.part_merging);
            let regrouped = consensus::regroup(masked, grouped, settings, &regrouping)?;
            outcome.produced = count_labels(&regrouped.region_of);
            Ok::<_, ParseError>(regrouped)
        })?;
    }
    let proposals = watch.time("hierarchy", |outcome| {
        let proposing = progress.sub_range(ends.part_merging, ends.part_merging);
        let proposals = hierarchy::propose(&grouped, settings, &proposing)?;
        outcome.produced = proposals.len();
        Ok::<_, ParseError>(proposals)
    })?;
    let RegionsOfScan { superpoints, planes, region_of, .. } = grouped;
    let region_of = superpoints.regions_of_points(&region_of);
    let region_of = match settings.refine_borders {
        false => region_of,
        true => watch.time("refinement", |outcome| {
            let refining = progress.sub_range(ends.part_merging, ends.refinement);
            let refined =
                refinement::refine(cloud, visibility, region_of, frames, masks_of, &refining)?;
            outcome.produced = count_labels(&refined);
            Ok::<_, ParseError>(refined)
        })?,
    };
    Ok(RegionGrouping { superpoints, planes, region_of, proposals })
}

/// Returns the camera positions, meters, world frame.
fn camera_centers(frames: &[FrameRef]) -> Vec<Point3<f32>> {
    frames.iter().map(|frame| frame.camera_to_world.translation.vector.into()).collect()
}

/// Returns the warnings for the report, given the frames that see no point of the cloud.
fn blind_frame_warnings(frames: usize, blind: &[String]) -> Vec<String> {
    let mut warnings = Vec::new();
    if frames == 0 {
        warnings.push("the scan has no frames: instances come from geometry and point color alone and have no pictures".into());
    }
    if !blind.is_empty() {
        warnings.push(format!(
            "{} of {frames} frames see no point of the cloud: {}",
            blind.len(),
            shorten_list(blind)
        ));
    }
    warnings
}

fn shorten_list(names: &[String]) -> String {
    const SHOWN: usize = 10;
    let shown = names.iter().take(SHOWN).cloned().collect::<Vec<_>>().join(", ");
    if names.len() > SHOWN { format!("{shown}, ...") } else { shown }
}

/// Returns the number of labels `0..n`.
fn count_labels(labels: &[u32]) -> usize {
    labels.iter().max().map_or(0, |&l| l as usize + 1)
}
