//! Assigns names that annotators gave to objects from pictures alone to the instances that cover
//! the objects.

use crate::annotations::{Annotations, SceneObject};
use uniground_geometry::boxes::Aabb;
use uniground_geometry::scene::Instance;

/// Minimum IoU of boxes at which an instance gets the object's name.
const COVERS: f32 = 0.25;
/// Minimum share of an instance's box inside an object at which it is a part of that object.
const WITHIN: f32 = 0.6;

/// Names instances by what they cover: the object itself, or a part of one. An instance that covers
/// nothing gets no name.
pub fn name_as_seen(instances: &mut [Instance], annotations: &Annotations) {
    let things: Vec<&SceneObject> =
        annotations.objects.iter().filter(|o| o.structure().is_none()).collect();
    for instance in instances.iter_mut().filter(|i| i.structure.is_none()) {
        let best = |score: &dyn Fn(&Aabb) -> f32| {
            let scored = things.iter().map(|object| (score(&object.aabb), *object));
            scored.max_by(|a, b| a.0.total_cmp(&b.0).then(b.1.id.cmp(&a.1.id)))
        };
        let covered = best(&|aabb| instance.aabb.iou(aabb)).filter(|(iou, _)| *iou >= COVERS);
        let holds = || {
            let volume = instance.aabb.volume().max(f32::EPSILON);
            best(&|aabb| instance.aabb.shared_volume(aabb) / volume)
                .filter(|(share, _)| *share >= WITHIN)
        };
        instance.given_name = match (covered, holds()) {
            (Some((_, object)), _) => object.seen_as.clone(),
            (None, Some((_, object))) => {
                object.seen_as.as_ref().map(|name| format!("part of {name}"))
            }
            (None, None) => None,
        };
    }
}
