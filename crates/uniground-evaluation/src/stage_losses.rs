//! Loss analysis of stage 1: how much of each annotated object is still recoverable after each
//! step. Improving the step with the largest loss pays off most.
//!
//! The steps down to the lifted masks use the annotations to choose the best of what the previous
//! step has left. They are upper bounds, not figures of the service.

use super::annotated::{AnnotatedMasks, AnnotatedRoom};
use super::segmentation::{AnnotatedObject, InstanceScore, recall, score_instances};
use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::{Frame, FrameIndex, InstanceId, PointCloud};
use uniground_parsing::checkpoints::Checkpoints;
use uniground_parsing::consensus::clusters::MaskCluster;
use uniground_parsing::consensus::observations::MaskObservations;
use uniground_parsing::consensus::{self, MaskedFrames, RegionsOfScan};
use uniground_parsing::labels::Labels;
use uniground_parsing::lifting::{FrameVisibility, Lifted, LiftingInput};
use uniground_parsing::masks::{IdImage, MaskSource};
use uniground_parsing::planes::{self, Planes};
use uniground_parsing::relief::FlatCandidates;
use uniground_parsing::separate_flat::{self, SuperpointsAndPlanes};
use uniground_parsing::superpoints::{self, Superpoints};
use uniground_parsing::views::{InstanceViews, LabeledPoints};
use uniground_parsing::visibility::Visibility;
use uniground_parsing::{
    ParseError, ParsingSettings, frame_selection, hierarchy, instances, merging, part_merging,
    refinement, split_supported, views,
};
use uniground_types::settings::InstanceSettings;

/// The name of the last step: the instances of the scene, on all levels.
pub const END: &str = "with parts and wholes";

/// The result of one step for all objects.
pub struct StageLoss {
    pub step: String,
    /// Number of superpoints, masks, regions or instances.
    pub pieces: usize,
    /// Best IoU of boxes per object. Empty if the pieces have no boxes.
    pub box_iou: Vec<f32>,
    /// Best IoU of point sets, or of pixels, per object.
    pub point_iou: Vec<f32>,
}

impl StageLoss {
    /// Returns the share of objects recoverable at each of
    /// [`IOU_THRESHOLDS`](super::segmentation::IOU_THRESHOLDS), by boxes and by points.
    #[must_use]
    pub fn recall(&self) -> ([f32; 2], [f32; 2]) {
        (recall(&self.box_iou), recall(&self.point_iou))
    }
}

/// Computes all steps from the cloud to the boxes, with one source of masks.
///
/// # Errors
/// Returns [`ParseError`] when a frame cannot be read or a model fails.
pub fn measure_stage_losses(
    room: &AnnotatedRoom,
    masks: &dyn MaskSource,
    settings: &ParsingSettings,
    min_points: u32,
) -> Result<Vec<StageLoss>, ParseError> {
    let quiet = Progress::silent();
    let cloud = &room.bundle.cloud;
    let objects = room.objects(min_points);
    let superpoints = superpoints::compute(cloud, &settings.superpoints, &quiet)?;
    let frames = frame_selection::choose_frames(
        &room.bundle.frames,
        cloud,
        &superpoints.patches,
        masks,
        &settings.frame_sampling,
    );
    let cameras: Vec<_> =
        frames.iter().map(|f| f.camera_to_world.translation.vector.into()).collect();
    let planes = planes::find(cloud, &superpoints, &cameras, &quiet)?;
    // Without sightings no instance is dropped.
    let score_regions = |region_of: &[u32],
                         superpoints: &Superpoints,
                         planes: &Planes|
     -> Result<InstanceScore, ParseError> {
        let labels = Labels::from_regions(region_of, superpoints, Vec::new());
        let built = instances::build(
            cloud,
            superpoints,
            planes,
            labels,
            InstanceViews::default(),
            &settings.instances,
            &quiet,
        )?;
        Ok(score_instances(&built.instances, &built.labels.thing_of_point, &objects, &room.truth))
    };
    let score_superpoints = |region_of: &[u32], superpoints: &Superpoints, planes: &Planes| {
        score_regions(&superpoints.regions_of_points(region_of), superpoints, planes)
    };
    let mut rungs = Vec::new();
    let mut push = |step: &str, pieces: usize, score: InstanceScore| {
        rungs.push(StageLoss {
            step: step.to_owned(),
            pieces,
            box_iou: score.box_iou,
            point_iou: score.point_iou,
        });
    };

    push("cloud", cloud.len(), score_regions(&room.truth, &superpoints, &planes)?);
    push(
        "superpoints",
        superpoints.patches.len(),
        score_superpoints(&majority_objects(&superpoints, &room.truth), &superpoints, &planes)?,
    );

    let judged = ScoredMaskSource { masks, truth: room.masks(), best: Mutex::default() };
    let visibility = Visibility::new(cloud, &superpoints.of_point, settings.depth_tolerance);
    let lifting = LiftingInput {
        visibility: &visibility,
        superpoint_of_point: &superpoints.of_point,
        masks: &judged,
    };
    let (lifted, _) =
        lifting.lift_all(&frames, Checkpoints::disabled().open_log("lifting", &()), &quiet)?;
    let (tables, masks_of, _) = Lifted::split(lifted);
    let best = judged.best.into_inner().unwrap_or_else(PoisonError::into_inner);
    let pixels = objects.iter().map(|object| mean_iou_of_best_views(&best, object.id)).collect();
    let count = tables.iter().map(|t| t.masks as usize).sum();
    push(
        "masks",
        count,
        InstanceScore {
            objects: objects.len(),
            instances: count,
            box_iou: Vec::new(),
            reachable_box_iou: Vec::new(),
            point_iou: pixels,
            ap50: 0.0,
        },
    );
    push(
        "lifted masks",
        count,
        score_superpoints(&vote_superpoints(&superpoints, &tables, &best), &superpoints, &planes)?,
    );
    let observations =
        MaskObservations::collect(cloud.len(), &visibility, &frames, &masks_of, &quiet)?;
    let clusters = consensus::find_clusters(cloud, &observations, &quiet)?;
    push("clusters of masks", clusters.len(), score_clusters(&clusters, cloud, &objects, room));

    let masked =
        MaskedFrames { cloud, visibility: &visibility, frames: &frames, masks_of: &masks_of };
    let before = SuperpointsAndPlanes { superpoints, planes, tables };
    let SuperpointsAndPlanes { superpoints, planes, tables } =
        match settings.merging.keep_planes_apart {
            true => separate_flat::separate_flat_things(masked, before, &quiet)?,
            false => before,
        };
    let merged = merging::merge(&superpoints, &planes, &tables, &settings.merging, &quiet)?;
    let mut any: Option<InstanceScore> = None;
    let labels = |region_of: &[u32]| region_of.iter().max().map_or(0, |&r| r as usize + 1);
    let (freed, joined) = free_and_join(cloud, &superpoints, &planes, merged.last(), settings)?;
    let steps =
        settings.merging.thresholds.iter().map(|threshold| format!("merged at {threshold}"));
    let steps = steps.chain(["small ones absorbed".to_owned()]).zip(&merged.levels).chain([
        ("what stands on tops set free".to_owned(), &freed),
        ("parts joined".to_owned(), &joined),
    ]);
    for (step, region_of) in steps {
        let here = score_superpoints(region_of, &superpoints, &planes)?;
        let pieces = labels(region_of);
        let sum = any.get_or_insert_with(|| here.clone());
        let better = |so_far: &mut Vec<f32>, now: &[f32]| {
            so_far.iter_mut().zip(now).for_each(|(a, b)| *a = a.max(*b));
        };
        better(&mut sum.box_iou, &here.box_iou);
        better(&mut sum.point_iou, &here.point_iou);
        push(&step, pieces, here);
    }
    let before = RegionsOfScan {
        superpoints: superpoints.clone(),
        planes: planes.clone(),
        levels: merged,
        tables,
        region_of: joined,
        clusters: Vec::new(),
    };
    let grouped = consensus::regroup(masked, before, settings, &quiet)?;
    let region_of = grouped.superpoints.regions_of_points(&grouped.region_of);
    let regrouped = score_regions(&region_of, &grouped.superpoints, &grouped.planes)?;
    push("regrouped by masks", labels(&grouped.region_of), regrouped);
    let refined = refinement::refine(cloud, &visibility, region_of, &frames, &masks_of, &quiet)?;
    let (superpoints, planes) = (&grouped.superpoints, &grouped.planes);
    push("refined", labels(&refined), score_regions(&refined, superpoints, planes)?);
    let proposals = hierarchy::propose(&grouped, settings, &quiet)?;
    let labels = Labels::from_regions(&refined, superpoints, proposals);
    let labeled = LabeledPoints { labels: &labels, visibility: &visibility };
    let flats =
        FlatCandidates::find(cloud, superpoints, planes, &labels, &cameras, &settings.instances);
    let sighted = views::compute_instance_views(labeled, Some(&flats), &frames, &masks_of, &quiet)?;
    let built =
        instances::build(cloud, superpoints, planes, labels, sighted, &settings.instances, &quiet)?;
    let shown =
        score_instances(&built.instances, &built.labels.thing_of_point, &objects, &room.truth);
    let point_iou = best_ious(&built.labels, &objects, &room.truth);
    let with_all =
        InstanceScore { box_iou: shown.reachable_box_iou.clone(), point_iou, ..shown.clone() };
    push("shown by masks", shown.instances, shown);
    push(END, built.instances.len(), with_all);
    if let Some(any) = any {
        push("any of these", 0, any);
    }
    Ok(rungs)
}

/// Returns the regions with what stands on tops set free, then with the parts of furniture joined.
fn free_and_join(
    cloud: &PointCloud,
    superpoints: &Superpoints,
    planes: &Planes,
    merged: &[u32],
    settings: &ParsingSettings,
) -> Result<(Vec<u32>, Vec<u32>), ParseError> {
    let quiet = Progress::silent();
    let (few, parts) = (settings.merging.min_points, &settings.part_merging);
    let freed =
        split_supported::split_supported(cloud, superpoints, planes, merged.to_vec(), few, &quiet)?;
    let joined =
        part_merging::join_parts(cloud, superpoints, planes, freed.clone(), parts, &quiet)?;
    Ok((freed, joined))
}

/// Scores clusters, which can overlap, by the samples they consist of.
fn score_clusters(
    clusters: &[MaskCluster],
    cloud: &PointCloud,
    objects: &[AnnotatedObject],
    room: &AnnotatedRoom,
) -> InstanceScore {
    let mut of_object: BTreeMap<u32, u32> = BTreeMap::new();
    for (point, &id) in room.truth.iter().enumerate() {
        *of_object.entry(id).or_default() += u32::from(MaskObservations::sample(point).is_some());
    }
    let mut score = InstanceScore {
        objects: objects.len(),
        instances: clusters.len(),
        box_iou: vec![0.0; objects.len()],
        reachable_box_iou: Vec::new(),
        point_iou: vec![0.0; objects.len()],
        ap50: 0.0,
    };
    for cluster in clusters {
        let points: Vec<u32> =
            cluster.samples.iter().map(|&s| MaskObservations::point(s) as u32).collect();
        let built = instances::build_from_points(cloud, &points, &[], &InstanceSettings::default());
        let mut shared: BTreeMap<u32, u32> = BTreeMap::new();
        points.iter().for_each(|&p| *shared.entry(room.truth[p as usize]).or_default() += 1);
        for (i, object) in objects.iter().enumerate() {
            let both = shared.get(&object.id).copied().unwrap_or(0);
            let all = points.len() as u32 + of_object[&object.id] - both;
            score.point_iou[i] = score.point_iou[i].max(both as f32 / all as f32);
            score.box_iou[i] = score.box_iou[i].max(built.aabb.iou(&object.aabb));
        }
    }
    score
}

/// Returns the best IoU of point sets per object. Parts and wholes count as instances too.
fn best_ious(labels: &Labels, objects: &[AnnotatedObject], truth: &[u32]) -> Vec<f32> {
    let (mut shared, mut of_instance, mut of_object) =
        (BTreeMap::new(), vec![0_u32; labels.len() + 1], BTreeMap::new());
    for (point, &object) in truth.iter().enumerate() {
        *of_object.entry(object).or_insert(0_u32) += 1;
        for instance in labels.instances_of_point(point) {
            of_instance[instance.0 as usize] += 1;
            *shared.entry((object, instance)).or_insert(0_u32) += 1;
        }
    }
    let best = |object: &AnnotatedObject| {
        let overlaps = shared.range((object.id, InstanceId(0))..=(object.id, InstanceId(u32::MAX)));
        overlaps
            .map(|((_, instance), both)| {
                *both as f32
                    / (of_instance[instance.0 as usize] + of_object[&object.id] - both) as f32
            })
            .fold(0.0, f32::max)
    };
    objects.iter().map(best).collect()
}

/// Returns the object of the majority of each superpoint's annotated points, 0 = none.
fn majority_objects(superpoints: &Superpoints, truth: &[u32]) -> Vec<u32> {
    let mut votes: Vec<BTreeMap<u32, u32>> = vec![BTreeMap::new(); superpoints.patches.len()];
    for (&superpoint, &id) in superpoints.of_point.iter().zip(truth) {
        *votes[superpoint as usize].entry(id).or_default() += 1;
    }
    votes.iter().map(|votes| most_voted(votes).map_or(0, |(id, _)| id)).collect()
}

fn most_voted(votes: &BTreeMap<u32, u32>) -> Option<(u32, u32)> {
    votes.iter().map(|(&id, &n)| (id, n)).max_by_key(|&(id, n)| (n, std::cmp::Reverse(id)))
}

/// The mask that shows an object best in one frame.
#[derive(Clone, Copy)]
struct BestMask {
    layer: u32,
    mask: u16,
    iou: f32,
    /// Number of pixels of the object in the frame.
    pixels: u32,
}

/// Best masks by frame and object.
type BestMasks = BTreeMap<(FrameIndex, u32), BestMask>;

/// A mask source that compares its masks with the annotations.
struct ScoredMaskSource<'a> {
    masks: &'a dyn MaskSource,
    truth: AnnotatedMasks,
    best: Mutex<BestMasks>,
}

impl MaskSource for ScoredMaskSource<'_> {
    fn name(&self) -> &str {
        self.masks.name()
    }

    fn masks(&self, frame: &Frame, progress: &Progress) -> Result<Vec<IdImage>, ParseError> {
        let (found, truth) =
            (self.masks.masks(frame, progress)?, self.truth.masks(frame, progress)?);
        (0..)
            .zip(&found)
            .for_each(|(layer, found)| self.record_masks(frame.index, (layer, found), &truth[0]));
        Ok(found)
    }
}

impl ScoredMaskSource<'_> {
    fn record_masks(&self, frame: FrameIndex, (layer, found): (u32, &IdImage), truth: &IdImage) {
        let (mut shared, mut of_mask, mut of_object) =
            (BTreeMap::new(), BTreeMap::new(), BTreeMap::new());
        for (&mask, &object) in found.ids.iter().zip(&truth.ids) {
            *shared.entry((object, mask)).or_insert(0_u32) += 1;
            *of_mask.entry(mask).or_insert(0_u32) += 1;
            *of_object.entry(object).or_insert(0_u32) += 1;
        }
        let mut best = self.best.lock().unwrap_or_else(PoisonError::into_inner);
        for (&(object, mask), &both) in
            shared.iter().filter(|((object, mask), _)| *object != 0 && *mask != 0)
        {
            let iou = both as f32 / (of_mask[&mask] + of_object[&object] - both) as f32;
            let so_far = best.entry((frame, u32::from(object))).or_insert(BestMask {
                layer,
                mask,
                iou,
                pixels: of_object[&object],
            });
            if iou > so_far.iou {
                *so_far = BestMask { layer, mask, iou, ..*so_far };
            }
        }
    }
}

/// Returns the mean IoU over the three views with the most pixels of the object. 0 if no mask
/// touches it.
fn mean_iou_of_best_views(best: &BestMasks, object: u32) -> f32 {
    const VIEWS: usize = 3;
    let mut views: Vec<&BestMask> =
        best.iter().filter(|((_, id), _)| *id == object).map(|(_, best)| best).collect();
    views.sort_by_key(|best| std::cmp::Reverse(best.pixels));
    views.truncate(VIEWS);
    views.iter().map(|best| best.iou).sum::<f32>() / views.len().max(1) as f32
}

/// Returns the object of each superpoint when every frame uses the best mask of every object: the
/// object whose masks cover more than half of the superpoint's sightings, 0 = none.
fn vote_superpoints(
    superpoints: &Superpoints,
    tables: &[FrameVisibility],
    best: &BestMasks,
) -> Vec<u32> {
    let mut votes: Vec<(u32, BTreeMap<u32, u32>)> =
        vec![Default::default(); superpoints.patches.len()];
    for table in tables {
        let mut objects_of: BTreeMap<u16, Vec<u32>> = BTreeMap::new();
        let of_frame = best.range((table.frame, 0)..=(table.frame, u32::MAX));
        for ((_, object), best) in of_frame.filter(|(_, best)| best.layer == table.layer) {
            objects_of.entry(best.mask).or_default().push(*object);
        }
        for row in &table.rows {
            let (visible, votes) = &mut votes[row.superpoint as usize];
            // Every id image of a frame shows the same points.
            *visible += if table.layer == 0 { row.visible } else { 0 };
            for (mask, n) in &row.masks {
                objects_of
                    .get(mask)
                    .into_iter()
                    .flatten()
                    .for_each(|&object| *votes.entry(object).or_default() += n);
            }
        }
    }
    let winner = |(visible, votes): &(u32, BTreeMap<u32, u32>)| {
        most_voted(votes).filter(|&(_, n)| 2 * n > *visible).map_or(0, |(id, _)| id)
    };
    votes.iter().map(winner).collect()
}
