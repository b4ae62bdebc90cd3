//! Measures of a segmented cloud: superpoints against annotated points, instances against annotated
//! objects.

use std::collections::BTreeMap;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::scene::{Instance, InstanceId, Level, Structure};

/// The two IoU thresholds that are commonly reported.
pub const IOU_THRESHOLDS: [f32; 2] = [0.25, 0.5];

/// How well superpoints respect the borders of annotated instances.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SuperpointScore {
    pub superpoints: usize,
    /// Share of the annotated points whose instance is the majority instance of their superpoint.
    pub purity: f32,
    /// Mean over instances of the IoU when every superpoint takes its majority instance.
    pub achievable_iou: f32,
}

/// Scores labels against annotated instance ids, point by point. Id 0 = not annotated.
///
/// # Panics
/// Panics when the two slices differ in length.
#[must_use]
pub fn score_superpoints(labels: &[u32], truth: &[u32]) -> SuperpointScore {
    assert_eq!(labels.len(), truth.len(), "one label and one annotation per point");
    let mut shared: BTreeMap<(u32, u32), u64> = BTreeMap::new();
    for (&label, &id) in labels.iter().zip(truth) {
        *shared.entry((label, id)).or_default() += 1;
    }
    // Majority of each superpoint. Ties go to the lower id, as in numpy's argmax.
    let mut majority: BTreeMap<u32, (u64, u32)> = BTreeMap::new();
    for (&(label, id), &n) in &shared {
        let best = majority.entry(label).or_insert((0, 0));
        if n > best.0 {
            *best = (n, id);
        }
    }
    // Per instance: its own points, points of superpoints assigned to it, and the overlap.
    let mut tally: BTreeMap<u32, [u64; 3]> = BTreeMap::new();
    for (&(label, id), &n) in &shared {
        let winner = majority[&label].1;
        tally.entry(id).or_default()[0] += n;
        tally.entry(winner).or_default()[1] += n;
        if winner == id {
            tally.entry(id).or_default()[2] += n;
        }
    }
    tally.remove(&0);
    let sum = |i: usize| tally.values().map(|t| t[i]).sum::<u64>() as f32;
    let ious = tally.values().map(|[own, won, both]| *both as f32 / (own + won - both) as f32);
    SuperpointScore {
        superpoints: majority.len(),
        purity: sum(2) / sum(0),
        achievable_iou: ious.sum::<f32>() / tally.len().max(1) as f32,
    }
}

/// An annotated object.
#[derive(Debug, Clone, PartialEq)]
pub struct AnnotatedObject {
    pub id: u32,
    pub name: String,
    pub aabb: Aabb,
    pub points: u32,
}

/// How well instances cover annotated objects, class-agnostic. Pairs are at [`IOU_THRESHOLDS`].
#[derive(Debug, Clone, PartialEq)]
pub struct InstanceScore {
    pub objects: usize,
    pub instances: usize,
    /// Best IoU of axis-aligned boxes between each object and any thing, in the order given.
    pub box_iou: Vec<f32>,
    /// The same, with parts and wholes counted as instances.
    pub reachable_box_iou: Vec<f32>,
    /// Best IoU of point sets per object.
    pub point_iou: Vec<f32>,
    /// Average precision at a point-set IoU of 0.5. Instances are ranked by their number of points.
    /// Those that lie mostly on something that is not among the objects (structure, small things)
    /// are ignored.
    pub ap50: f32,
}

impl InstanceScore {
    #[must_use]
    pub fn box_recall(&self) -> [f32; 2] {
        recall(&self.box_iou)
    }

    /// Returns the share of objects that are covered by an instance which a question can refer to.
    #[must_use]
    pub fn reachable_recall(&self) -> [f32; 2] {
        recall(&self.reachable_box_iou)
    }

    #[must_use]
    pub fn point_recall(&self) -> [f32; 2] {
        recall(&self.point_iou)
    }
}

/// How well structure is distinguished from things, by points.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StructureScore {
    /// Share of the points annotated as floor, wall or ceiling that lie in an instance of that
    /// kind.
    pub recall: f32,
    /// Share of the points in structural instances that are annotated as structure.
    pub precision: f32,
}

/// Scores structural flags. `kinds` holds the annotated ids of structure, `truth` the annotated id
/// of each point.
#[must_use]
pub fn score_structure(
    instances: &[Instance],
    of_point: &[InstanceId],
    kinds: &BTreeMap<u32, Structure>,
    truth: &[u32],
) -> StructureScore {
    let (mut annotated, mut flagged, mut right, mut hit) = (0_u32, 0_u32, 0_u32, 0_u32);
    for (instance, id) in of_point.iter().zip(truth) {
        let found = (instance.0 as usize).checked_sub(1).and_then(|i| instances[i].structure);
        let kind = kinds.get(id).copied();
        annotated += u32::from(kind.is_some());
        flagged += u32::from(found.is_some());
        right += u32::from(kind.is_some() && found == kind);
        hit += u32::from(kind.is_some() && found.is_some());
    }
    StructureScore {
        recall: right as f32 / annotated.max(1) as f32,
        precision: hit as f32 / flagged.max(1) as f32,
    }
}

/// Returns the share of `ious` at or above each threshold.
pub(super) fn recall(ious: &[f32]) -> [f32; 2] {
    IOU_THRESHOLDS
        .map(|at| ious.iter().filter(|iou| **iou >= at).count() as f32 / ious.len().max(1) as f32)
}

/// Scores instances, given in order of id with the thing each point belongs to. `truth` holds the
/// annotated id of each point, 0 = none.
///
/// # Panics
/// Panics when `truth` does not have one id per point.
#[must_use]
pub fn score_instances(
    instances: &[Instance],
    of_point: &[InstanceId],
    objects: &[AnnotatedObject],
    truth: &[u32],
) -> InstanceScore {
    assert_eq!(of_point.len(), truth.len(), "one annotation per point");
    let mut shared: BTreeMap<(InstanceId, u32), u64> = BTreeMap::new();
    let mut annotated: BTreeMap<u32, u64> = BTreeMap::new();
    for (&instance, &id) in of_point.iter().zip(truth) {
        *shared.entry((instance, id)).or_default() += 1;
        *annotated.entry(id).or_default() += 1;
    }
    let iou = |instance: InstanceId, object: u32| {
        let both = shared.get(&(instance, object)).copied().unwrap_or(0);
        let all = u64::from(instances[instance.0 as usize - 1].point_count)
            + annotated.get(&object).copied().unwrap_or(0);
        both as f32 / (all - both).max(1) as f32
    };
    let things = || instances.iter().filter(|i| i.level == Level::Thing);
    let box_iou =
        objects.iter().map(|o| things().map(|i| i.aabb.iou(&o.aabb)).fold(0.0, f32::max)).collect();
    let reachable_box_iou = objects
        .iter()
        .map(|o| instances.iter().map(|i| i.aabb.iou(&o.aabb)).fold(0.0, f32::max))
        .collect();
    let point_iou =
        objects.iter().map(|o| things().map(|i| iou(i.id, o.id)).fold(0.0, f32::max)).collect();

    // Instances are numbered by descending number of points. That is their rank.
    let wanted: BTreeMap<u32, usize> = objects.iter().enumerate().map(|(i, o)| (o.id, i)).collect();
    let mut found = vec![false; objects.len()];
    let mut hits = Vec::new();
    for instance in things() {
        let overlaps = shared.range((instance.id, 0)..=(instance.id, u32::MAX));
        let Some((&(_, majority), _)) =
            overlaps.max_by_key(|&(&(_, id), &n)| (n, std::cmp::Reverse(id)))
        else {
            continue;
        };
        let Some(&object) = wanted.get(&majority) else { continue };
        let hit = !found[object] && iou(instance.id, majority) >= IOU_THRESHOLDS[1];
        found[object] |= hit;
        hits.push(hit);
    }
    InstanceScore {
        objects: objects.len(),
        instances: things().count(),
        box_iou,
        reachable_box_iou,
        point_iou,
        ap50: average_precision(&hits, objects.len()),
    }
}

/// Returns the area under the precision-recall curve, with precision made monotone from the right
/// (Pascal VOC 2010 and later).
fn average_precision(hits: &[bool], objects: usize) -> f32 {
    let mut precisions = Vec::new();
    let mut right = 0;
    for (i, &hit) in hits.iter().enumerate() {
        if hit {
            right += 1;
            precisions.push(right as f32 / (i + 1) as f32);
        }
    }
    let mut best = 0.0_f32;
    let area: f32 = precisions
        .iter()
        .rev()
        .map(|&p| {
            best = best.max(p);
            best
        })
        .sum();
    area / objects.max(1) as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn superpoint_scores_match_hand_computed_values() {
        // Superpoint 0 covers all of object 1 and one point of 2; superpoint 1 the rest of 2;
        // superpoint 2 is not annotated.
        let labels = [0, 0, 0, 0, 1, 1, 1, 2];
        let truth = [1, 1, 1, 2, 2, 2, 2, 0];
        let score = score_superpoints(&labels, &truth);
        assert_eq!(score.superpoints, 3);
        assert!((score.purity - 6.0 / 7.0).abs() < 1e-6, "{score:?}");
        assert!((score.achievable_iou - 0.75).abs() < 1e-6, "{score:?}");
    }

    #[test]
    fn average_precision_matches_hand_computed_values() {
        assert_eq!(average_precision(&[true, true], 2), 1.0);
        assert_eq!(average_precision(&[], 2), 0.0);
        // Hits at ranks 1 and 3 of two objects: (1 + 2/3) / 2.
        assert!((average_precision(&[true, false, true], 2) - 5.0 / 6.0).abs() < 1e-6);
    }
}
