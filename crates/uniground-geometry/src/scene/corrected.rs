//! Applies people's corrections to instances. The results of stage 1 never change: corrections are
//! applied on top, in order of time, and can be undone.

use super::{Instance, InstanceId, Level, View};
use std::collections::BTreeMap;
use uniground_types::corrections::{Change, Correction};

/// Applies corrections to the instances of a parse, sorted by id. Instances that a merge created
/// are already among them.
pub fn correct(instances: &mut [Instance], corrections: &[Correction]) {
    for Correction { change, made, undone_at, .. } in corrections {
        if undone_at.is_some() {
            // The merged instance stays in the list, so that its id is never reused.
            modify_instances(instances, made, |instance| instance.dismissed = true);
            continue;
        }
        match change {
            Change::Rename { instance_id, name } => {
                modify_instances(instances, [instance_id], |instance| {
                    instance.given_name = Some(name.clone());
                });
            }
            Change::Dismiss { instance_ids } => {
                modify_instances(instances, instance_ids, |instance| instance.dismissed = true);
            }
            Change::Merge { instance_ids, name } => {
                // An instance created after the list was read is not in it yet.
                let Some(made) = made.filter(|made| made.0 as usize <= instances.len()) else {
                    continue;
                };
                modify_instances(instances, [&made], |instance| {
                    instance.given_name = name.clone().or(instance.given_name.take());
                });
                reassign_members(instances, instance_ids, &[made]);
                modify_instances(instances, instance_ids, |instance| {
                    instance.level = Level::Part;
                    instance.things = vec![made];
                });
            }
            Change::Split { instance_id } => {
                let parts = parts_of(instances, *instance_id);
                modify_instances(instances, [instance_id], |instance| instance.dismissed = true);
                modify_instances(instances, &parts, |instance| {
                    instance.level = Level::Thing;
                    instance.things.clear();
                });
                reassign_members(instances, &[*instance_id], &parts);
            }
        }
    }
}

/// Returns the parts of a thing.
#[must_use]
pub fn parts_of(instances: &[Instance], thing: InstanceId) -> Vec<InstanceId> {
    let is_part = |i: &&Instance| i.level == Level::Part && !i.dismissed && i.things == [thing];
    instances.iter().filter(is_part).map(|i| i.id).collect()
}

/// Returns the best views of several instances together, at most `most`, best first. A frame that
/// shows more than one of them appears once.
#[must_use]
pub fn merge_views(instances: &[&Instance], most: usize) -> Vec<View> {
    let mut by_frame: BTreeMap<_, View> = BTreeMap::new();
    for view in instances.iter().flat_map(|instance| &instance.views) {
        by_frame
            .entry(view.frame)
            .and_modify(|all| {
                let ([left, top, right, bottom], [l, t, r, b]) = (all.box_px, view.box_px);
                // The mask of one instance would hide the others.
                *all = View {
                    visible_points: all.visible_points + view.visible_points,
                    box_px: [left.min(l), top.min(t), right.max(r), bottom.max(b)],
                    mask: None,
                    ..all.clone()
                };
            })
            .or_insert_with(|| view.clone());
    }
    let mut views: Vec<View> = by_frame.into_values().collect();
    views.sort_by_key(|view| (std::cmp::Reverse(view.visible_points), view.frame));
    views.truncate(most);
    views
}

/// Modifies instances by their ids.
fn modify_instances<'a>(
    instances: &mut [Instance],
    ids: impl IntoIterator<Item = &'a InstanceId>,
    mut change: impl FnMut(&mut Instance),
) {
    for id in ids {
        if let Some(instance) = instances.get_mut((id.0 as usize).wrapping_sub(1)) {
            change(instance);
        }
    }
}

/// Replaces the things `before` by `now` in all parts and wholes.
fn reassign_members(instances: &mut [Instance], before: &[InstanceId], now: &[InstanceId]) {
    for compound in
        instances.iter_mut().filter(|i| i.things.iter().any(|thing| before.contains(thing)))
    {
        compound.things.retain(|thing| !before.contains(thing));
        compound.things.extend_from_slice(now);
        compound.things.sort_unstable();
        compound.things.dedup();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::boxes::Aabb;
    use crate::scene::{FrameIndex, Support};
    use crate::{Point3, Vector3};

    /// Creates a box on the floor, half a meter deep and high.
    fn thing(id: u32, x: f32, width: f32) -> Instance {
        let aabb = Aabb { center: Point3::new(x, 0.0, 0.25), size: Vector3::new(width, 0.5, 0.5) };
        Instance {
            point_count: 1000,
            support: Support::Floor,
            ..Instance::from_box(InstanceId(id), aabb)
        }
    }

    fn room() -> Vec<Instance> {
        let at = |id: u32, x: f32| thing(id, x, 0.5);
        let mut instances: Vec<Instance> = (1..=5).map(|id| at(id, id as f32)).collect();
        // 4 is a part of 1; 5 a whole of 1 and 2.
        instances[3] = Instance { level: Level::Part, things: vec![InstanceId(1)], ..at(4, 1.0) };
        instances[4] = Instance {
            level: Level::Whole,
            things: vec![InstanceId(1), InstanceId(2)],
            ..at(5, 1.5)
        };
        instances
    }

    fn corrected(
        mut instances: Vec<Instance>,
        changes: &[(Change, Option<u32>, bool)],
    ) -> Vec<Instance> {
        let corrections: Vec<Correction> = changes
            .iter()
            .map(|(change, made, undone)| Correction {
                id: String::new(),
                change: change.clone(),
                made: made.map(InstanceId),
                author: None,
                created_at: String::new(),
                undone_at: undone.then(String::new),
            })
            .collect();
        correct(&mut instances, &corrections);
        instances
    }

    fn ids<const N: usize>(ids: [u32; N]) -> Vec<InstanceId> {
        ids.map(InstanceId).to_vec()
    }

    #[test]
    fn renaming_and_dismissing_can_be_undone() {
        let rename = Change::Rename { instance_id: InstanceId(2), name: "red mug".into() };
        let junk = Change::Dismiss { instance_ids: ids([3, 99]) };
        let instances =
            corrected(room(), &[(rename.clone(), None, false), (junk.clone(), None, false)]);
        assert_eq!((instances[1].label(), instances[2].dismissed), ("red mug", true));
        assert_eq!(corrected(room(), &[(rename, None, true), (junk, None, true)]), room());
    }

    #[test]
    fn merged_instances_become_parts_of_the_merge_result() {
        let mut scene = room();
        scene.push(thing(6, 1.5, 1.5));
        let merge = Change::Merge { instance_ids: ids([1, 2]), name: Some("sofa".into()) };
        let instances = corrected(scene.clone(), &[(merge.clone(), Some(6), false)]);
        assert_eq!(instances[5].label(), "sofa");
        assert!(
            [0, 1, 3]
                .iter()
                .all(|&i| instances[i].level == Level::Part && instances[i].things == ids([6]))
        );
        assert_eq!(instances[4].things, ids([6]), "the whole consists of the merge result");
        let undone = corrected(scene.clone(), &[(merge, Some(6), true)]);
        assert!(undone[5].dismissed);
        assert_eq!(undone[..5], scene[..5]);
    }

    #[test]
    fn splitting_a_thing_turns_its_parts_into_things() {
        let split = Change::Split { instance_id: InstanceId(1) };
        let instances = corrected(room(), &[(split, None, false)]);
        assert!(instances[0].dismissed);
        assert_eq!((instances[3].level, &instances[3].things), (Level::Thing, &Vec::new()));
        assert_eq!(instances[4].things, ids([2, 4]));
    }

    #[test]
    fn views_in_the_same_frame_are_merged() {
        let seen = |frame, visible_points, box_px| View {
            frame: FrameIndex(frame),
            visible_points,
            box_px,
            mask: None,
        };
        let (mut a, mut b) = (room().remove(0), room().remove(1));
        a.views = vec![seen(7, 100, [10, 10, 20, 20]), seen(3, 50, [0, 0, 5, 5])];
        b.views = vec![seen(7, 30, [30, 5, 40, 15])];
        let views = merge_views(&[&a, &b], 3);
        assert_eq!(views[0], seen(7, 130, [10, 5, 40, 20]));
        assert_eq!(views.len(), 2);
        assert_eq!(merge_views(&[&a, &b], 1).len(), 1);
    }
}
