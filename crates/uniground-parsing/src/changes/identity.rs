//! Stable ids across parses: when a scene has grown, it is parsed again, and objects that stayed
//! keep their old ids.

use std::collections::{BTreeMap, BTreeSet};
use uniground_geometry::scene::{Embeddings, Instance, InstanceId, ParsedScene, Support};

/// IoU of boxes from which a part, a whole or an instance found for a question counts as the same
/// as before.
const SAME_BOX: f32 = 0.5;

/// Renumbers the parse of a scene that has grown with the ids of the previous parse. `same` pairs
/// previous things with things of the new parse.
///
/// New instances get the next free ids. An id is never reused: an instance that no longer exists
/// leaves a placeholder marked as gone. Instances found for questions keep their ids. Instances
/// that people have merged keep theirs too, marked as gone until they are merged again.
#[must_use]
pub fn continue_ids(
    before: &[Instance],
    mut parsed: ParsedScene,
    same: &[(InstanceId, InstanceId)],
) -> ParsedScene {
    let same = add_pairs_by_box(before, &parsed.instances, same);
    let old_of: BTreeMap<InstanceId, InstanceId> =
        same.iter().map(|&(old, new)| (new, old)).collect();
    let mut next = (before.len() as u32 + 1..).map(InstanceId);
    let number: BTreeMap<InstanceId, InstanceId> = parsed
        .instances
        .iter()
        .map(|instance| {
            (
                instance.id,
                old_of
                    .get(&instance.id)
                    .copied()
                    .unwrap_or_else(|| next.next().unwrap_or_default()),
            )
        })
        .collect();
    let renumbered = |id: InstanceId| number.get(&id).copied().unwrap_or_default();
    let mut by_id: BTreeMap<InstanceId, Instance> = BTreeMap::new();
    let mut row_of: BTreeMap<InstanceId, usize> = BTreeMap::new();
    for (row, mut instance) in parsed.instances.into_iter().enumerate() {
        instance.id = renumbered(instance.id);
        instance.things.iter_mut().for_each(|thing| *thing = renumbered(*thing));
        instance.things.sort_unstable();
        if let Support::Instance { id } = &mut instance.support {
            *id = renumbered(*id);
        }
        row_of.insert(instance.id, row);
        by_id.insert(instance.id, instance);
    }
    for old in before {
        by_id.entry(old.id).or_insert_with(|| match old.found_for.is_some() && !old.gone {
            true => old.clone(),
            // Its pictures were deleted with the previous parse.
            false => Instance { gone: true, dismissed: true, views: Vec::new(), ..old.clone() },
        });
    }
    parsed.instances = by_id.into_values().collect();
    parsed.instance_of_point.iter_mut().for_each(|id| *id = renumbered(*id));
    let rows = parsed.instances.iter().map(|instance| row_of.get(&instance.id).copied());
    parsed.embeddings = parsed.embeddings.map(|seen: Embeddings| seen.select_rows(rows));
    parsed
}

/// Adds pairs of parts, wholes and instances found for questions to the pairs of things. Only their
/// boxes are known.
fn add_pairs_by_box(
    before: &[Instance],
    after: &[Instance],
    same: &[(InstanceId, InstanceId)],
) -> Vec<(InstanceId, InstanceId)> {
    let mut same = same.to_vec();
    let paired_before: BTreeSet<InstanceId> = same.iter().map(|pair| pair.0).collect();
    let paired_after: BTreeSet<InstanceId> = same.iter().map(|pair| pair.1).collect();
    let mut scored: Vec<(f32, InstanceId, InstanceId)> = Vec::new();
    for old in before
        .iter()
        .filter(|old| !paired_before.contains(&old.id) && !old.gone && old.merged_from.is_empty())
    {
        for new in after.iter().filter(|new| !paired_after.contains(&new.id)) {
            let is_kind =
                old.level == new.level && (old.found_for.is_some() || !old.things.is_empty());
            let iou = if is_kind { old.aabb.iou(&new.aabb) } else { 0.0 };
            if iou >= SAME_BOX {
                scored.push((iou, old.id, new.id));
            }
        }
    }
    scored.sort_by(|a, b| b.0.total_cmp(&a.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    let (mut taken_before, mut taken_after) = (BTreeSet::new(), BTreeSet::new());
    for (_, old, new) in scored {
        if !taken_before.contains(&old) && !taken_after.contains(&new) {
            taken_before.insert(old);
            taken_after.insert(new);
            same.push((old, new));
        }
    }
    same
}

#[cfg(test)]
mod tests {
    use super::*;
    use uniground_geometry::boxes::Aabb;
    use uniground_geometry::scene::{Level, ParseReport, PointCloud};
    use uniground_geometry::{Point3, Vector3};
    use uniground_testing::thing;

    fn at(id: u32, x: f32) -> Instance {
        thing(id, [x, 0.0], [0.5, 0.5, 0.5], 0.0, Support::Floor, [90; 3])
    }

    fn parsed(instances: Vec<Instance>, owners: &[u32]) -> ParsedScene {
        let positions = vec![Point3::origin(); owners.len()];
        let rows: Vec<f32> = (0..instances.len()).flat_map(|i| [i as f32 + 1.0, 0.0]).collect();
        ParsedScene {
            cloud: PointCloud { colors: vec![[0; 3]; positions.len()], positions },
            instance_of_point: owners.iter().copied().map(InstanceId).collect(),
            superpoint_of_point: vec![0; owners.len()],
            embeddings: Some(Embeddings::new(2, &rows)),
            instances,
            frame_embeddings: None,
            extent: Aabb { center: Point3::origin(), size: Vector3::new(1.0, 1.0, 1.0) },
            report: ParseReport::default(),
        }
    }

    #[test]
    fn remaining_instances_keep_their_ids_and_ids_are_never_reused() {
        let part =
            |id, of, x| Instance { level: Level::Part, things: vec![InstanceId(of)], ..at(id, x) };
        let found = Instance { found_for: Some("the mug".into()), ..at(4, 9.0) };
        let before = vec![
            at(1, 1.0),
            at(2, 2.0),
            part(3, 2, 2.0),
            found.clone(),
            Instance { merged_from: vec![InstanceId(1)], ..at(5, 1.0) },
        ];
        // Instance 2 comes first now, 1 is gone, the one at 3.0 is new, and the part still exists.
        let on_two = Instance { support: Support::Instance { id: InstanceId(1) }, ..at(2, 3.0) };
        let now = continue_ids(
            &before,
            parsed(vec![at(1, 2.0), on_two, part(3, 1, 2.0)], &[1, 2, 0]),
            &[(InstanceId(2), InstanceId(1))],
        );
        assert_eq!(now.instances.iter().map(|i| i.id.0).collect::<Vec<_>>(), [1, 2, 3, 4, 5, 6]);
        assert_eq!(
            now.instances.iter().map(|i| i.gone).collect::<Vec<_>>(),
            [true, false, false, false, true, false]
        );
        assert_eq!(now.instances[2].things, [InstanceId(2)]);
        assert_eq!(now.instances[3], found);
        assert_eq!(now.instances[5].support, Support::Instance { id: InstanceId(2) });
        assert_eq!(now.instance_of_point, [InstanceId(2), InstanceId(6), InstanceId(0)]);
        let seen = now.embeddings.unwrap();
        assert_eq!(
            (0..6).map(|i| seen.is_seen(i)).collect::<Vec<_>>(),
            [false, true, true, false, false, true]
        );
    }

    #[test]
    fn instance_found_for_a_question_becomes_a_thing_when_parsed() {
        let found = Instance { found_for: Some("the mug".into()), ..at(1, 1.0) };
        let now = continue_ids(&[found], parsed(vec![at(1, 1.05)], &[1]), &[]);
        assert_eq!((now.instances.len(), now.instances[0].found_for.clone()), (1, None));
    }
}
