//! Whom a point belongs to after what people have said: what was merged to the one thing it is now,
//! what was dismissed to nothing, what was taken apart to the part whose box it lies in (of parts
//! no points are kept).

use super::{Instance, InstanceId};
use crate::Point3;
use std::collections::{BTreeMap, BTreeSet};

/// The present owners of points.
pub struct Owners<'a> {
    instances: &'a [Instance],
    /// The thing an instance has become a member of.
    merged: BTreeMap<InstanceId, InstanceId>,
    /// What may own points without having had any: parts that are things now, the smallest first.
    parts: Vec<&'a Instance>,
}

impl<'a> Owners<'a> {
    /// `instance_of_point` is what stage 1 has found, `instances` as people have corrected them.
    #[must_use]
    pub fn of(instance_of_point: &[InstanceId], instances: &'a [Instance]) -> Self {
        let with_members = instances.iter().filter(|instance| !instance.dismissed);
        let merged: BTreeMap<InstanceId, InstanceId> = with_members
            .flat_map(|whole| whole.merged_from.iter().map(|id| (*id, whole.id)))
            .collect();
        let had_points: BTreeSet<InstanceId> = instance_of_point.iter().copied().collect();
        let may_own = |i: &&Instance| {
            !i.came_later()
                && !had_points.contains(&i.id)
                && (i.is_shown() || merged.contains_key(&i.id))
        };
        let mut parts: Vec<&Instance> = instances.iter().filter(may_own).collect();
        parts.sort_by(|a, b| {
            a.raw_box.volume().total_cmp(&b.raw_box.volume()).then(a.id.cmp(&b.id))
        });
        Self { instances, merged, parts }
    }

    /// The owner of a point that stage 1 has found to be of a thing; 0: none.
    #[must_use]
    pub fn of_point(&self, found: InstanceId, position: &Point3<f32>) -> InstanceId {
        let mut id = found;
        if !self.merged.contains_key(&id) && self.instance(id).is_some_and(|thing| thing.dismissed)
        {
            let part = self.parts.iter().find(|part| part.raw_box.contains(position));
            id = part.map_or(InstanceId::default(), |part| part.id);
        }
        while let Some(whole) = self.merged.get(&id) {
            id = *whole;
        }
        if self.instance(id).is_some_and(Instance::is_shown) { id } else { InstanceId::default() }
    }

    fn instance(&self, id: InstanceId) -> Option<&'a Instance> {
        self.instances.get((id.0 as usize).checked_sub(1)?)
    }
}
