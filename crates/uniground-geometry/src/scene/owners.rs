//! Determines which instance owns a point after people's corrections. Points of a merged instance
//! belong to the merge result. Points of a dismissed instance have no owner. Points of a split
//! instance belong to the part whose box contains them, because points of parts are not stored.

use super::{Instance, InstanceId};
use crate::Point3;
use std::collections::{BTreeMap, BTreeSet};

/// The current owners of points.
pub struct Owners<'a> {
    instances: &'a [Instance],
    /// The merge result that an instance is a member of.
    merged: BTreeMap<InstanceId, InstanceId>,
    /// Instances that can own points without having any in the parse: parts that are now things,
    /// smallest first.
    parts: Vec<&'a Instance>,
}

impl<'a> Owners<'a> {
    /// Creates the lookup. `instance_of_point` is the result of stage 1; `instances` are the
    /// corrected instances.
    #[must_use]
    pub fn new(instance_of_point: &[InstanceId], instances: &'a [Instance]) -> Self {
        let with_members = instances.iter().filter(|instance| !instance.dismissed);
        let merged: BTreeMap<InstanceId, InstanceId> = with_members
            .flat_map(|whole| whole.merged_from.iter().map(|id| (*id, whole.id)))
            .collect();
        let had_points: BTreeSet<InstanceId> = instance_of_point.iter().copied().collect();
        let may_own = |i: &&Instance| {
            !i.is_added_after_parse()
                && !had_points.contains(&i.id)
                && (i.is_shown() || merged.contains_key(&i.id))
        };
        let mut parts: Vec<&Instance> = instances.iter().filter(may_own).collect();
        parts.sort_by(|a, b| {
            a.raw_box.volume().total_cmp(&b.raw_box.volume()).then(a.id.cmp(&b.id))
        });
        Self { instances, merged, parts }
    }

    /// Returns the current owner of a point that stage 1 assigned to `found`, or 0 if it has none.
    #[must_use]
    pub fn owner_of(&self, found: InstanceId, position: &Point3<f32>) -> InstanceId {
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
