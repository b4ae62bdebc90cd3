//! Carries the corrections that people made to a parse over to the next parse of the same scene.

use crate::instances::merge_points;
use uniground_geometry::scene::{Instance, InstanceId, Owners, ParsedScene, correct, parts_of};
use uniground_types::corrections::{Change, Correction};
use uniground_types::settings::InstanceSettings;

/// Returns the corrections of the previous parse whose instances still exist; the scene has grown
/// and keeps its old ids. Merged instances are measured again from the points that their members
/// have now.
#[must_use]
pub fn carry_over_corrections(
    corrections: &[Correction],
    scene: &mut ParsedScene,
    settings: &InstanceSettings,
) -> Vec<Correction> {
    let mut now = scene.instances.clone();
    let mut carried = Vec::new();
    for correction in corrections.iter().filter(|correction| correction.undone_at.is_none()) {
        let is_there = |id: &InstanceId| {
            now.get((id.0 as usize).wrapping_sub(1)).is_some_and(|instance| !instance.gone)
        };
        let change = match &correction.change {
            Change::Rename { instance_id, .. } => {
                is_there(instance_id).then(|| correction.change.clone())
            }
            Change::Dismiss { instance_ids } => {
                let left: Vec<InstanceId> = instance_ids.iter().copied().filter(is_there).collect();
                (!left.is_empty()).then_some(Change::Dismiss { instance_ids: left })
            }
            Change::Split { instance_id } => (is_there(instance_id)
                && !parts_of(&now, *instance_id).is_empty())
            .then(|| correction.change.clone()),
            Change::Merge { instance_ids, .. } => {
                let made = correction.made.filter(|_| instance_ids.iter().all(is_there));
                let owners = Owners::new(&scene.instance_of_point, &now);
                let owner = |point: usize| {
                    owners.owner_of(scene.instance_of_point[point], &scene.cloud.positions[point])
                };
                made.and_then(|id| {
                    Some((id, merge_points(&scene.cloud, owner, instance_ids, &now, settings)?))
                })
                .map(|(id, whole)| {
                    let whole = Instance { id, ..whole };
                    scene.instances[id.0 as usize - 1] = whole.clone();
                    now[id.0 as usize - 1] = whole;
                    correction.change.clone()
                })
            }
        };
        if let Some(change) = change {
            let correction = Correction { change, ..correction.clone() };
            correct(&mut now, std::slice::from_ref(&correction));
            carried.push(correction);
        }
    }
    carried
}

#[cfg(test)]
mod tests {
    use super::*;
    use uniground_geometry::boxes::Aabb;
    use uniground_geometry::scene::{ParseReport, PointCloud, Support};
    use uniground_geometry::{Point3, Vector3};
    use uniground_testing::thing;

    /// Returns a scene of things in a row with a hundred points each. Instance 4 is gone, and so is
    /// 5, the placeholder that 1 and 2 were merged into.
    fn scene() -> ParsedScene {
        let at =
            |id: u32, x: f32| thing(id, [x, 0.0], [0.5, 0.5, 0.5], 0.0, Support::Floor, [90; 3]);
        let gone = |id: u32| Instance { gone: true, dismissed: true, ..at(id, id as f32) };
        let instances = vec![at(1, 1.0), at(2, 2.0), at(3, 3.0), gone(4), gone(5)];
        let position = |owner: u32, i: u32| {
            Point3::new(owner as f32 + (i % 10) as f32 * 0.05, (i / 10) as f32 * 0.05, 0.1)
        };
        let owned = (1..=3)
            .flat_map(|owner| (0..100).map(move |i| (InstanceId(owner), position(owner, i))));
        let (instance_of_point, positions): (Vec<_>, Vec<_>) = owned.unzip();
        ParsedScene {
            cloud: PointCloud { colors: vec![[90; 3]; positions.len()], positions },
            superpoint_of_point: vec![0; instance_of_point.len()],
            instance_of_point,
            instances,
            embeddings: None,
            frame_embeddings: None,
            extent: Aabb { center: Point3::origin(), size: Vector3::new(9.0, 9.0, 9.0) },
            report: ParseReport::default(),
        }
    }

    fn correction(change: Change, made: Option<u32>) -> Correction {
        let made = made.map(InstanceId);
        Correction {
            id: String::new(),
            change,
            made,
            author: Some("ann".into()),
            created_at: "then".into(),
            undone_at: None,
        }
    }

    #[test]
    fn corrections_of_existing_instances_are_carried_over() {
        let ids = |ids: &[u32]| ids.iter().copied().map(InstanceId).collect::<Vec<_>>();
        let rename = |id| Change::Rename { instance_id: InstanceId(id), name: "mug".into() };
        let undone = Correction { undone_at: Some("later".into()), ..correction(rename(1), None) };
        let mut scene = scene();
        let merge = Change::Merge { instance_ids: ids(&[1, 2]), name: Some("bench".into()) };
        let corrections = [
            correction(rename(3), None),
            correction(rename(4), None),
            undone,
            correction(Change::Dismiss { instance_ids: ids(&[3, 4]) }, None),
            correction(merge.clone(), Some(5)),
            correction(rename(5), None),
        ];
        let carried =
            carry_over_corrections(&corrections, &mut scene, &InstanceSettings::default());
        let changes: Vec<Change> =
            carried.iter().map(|correction| correction.change.clone()).collect();
        assert_eq!(
            changes,
            [rename(3), Change::Dismiss { instance_ids: ids(&[3]) }, merge, rename(5)]
        );
        let bench = &scene.instances[4];
        assert_eq!(
            (bench.gone, bench.point_count, &bench.merged_from),
            (false, 200, &ids(&[1, 2]))
        );
        assert!(bench.raw_box.min().x < 1.01 && bench.raw_box.max().x > 2.4, "{bench:?}");
    }

    #[test]
    fn merges_with_a_missing_member_are_not_carried_over() {
        let merge = Change::Merge { instance_ids: vec![InstanceId(3), InstanceId(4)], name: None };
        let mut scene = scene();
        assert!(
            carry_over_corrections(
                &[correction(merge, Some(5))],
                &mut scene,
                &InstanceSettings::default()
            )
            .is_empty()
        );
        assert!(scene.instances[4].gone);
    }
}
