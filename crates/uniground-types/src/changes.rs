//! Differences between two scans or versions of a scene.

use crate::geometry::boxes::Aabb;
use crate::scene::InstanceId;
use serde::{Deserialize, Serialize};

/// Changes in a scene: since an earlier version, or between two scans of a room.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct SceneChanges {
    /// The earlier version.
    pub from: SceneVersion,
    /// The later version.
    pub to: SceneVersion,
    /// Alignment of the two scans. `null` for versions of one scene, which share coordinates and
    /// ids.
    pub alignment: Option<ScanAlignment>,
    /// The changes.
    pub changes: Changes,
}

/// A version of a scene.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct SceneVersion {
    /// UUIDv7 of the scene.
    pub scene_id: String,
    /// Version of its parse, from 1.
    pub version: u32,
}

/// Transform from the earlier scan to the later one: `to = rotation * from + translation_m`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ScanAlignment {
    /// Unit quaternion `x, y, z, w`.
    pub rotation: [f64; 4],
    /// Translation, meters.
    pub translation_m: [f64; 3],
    /// Whether the transform was refined by registering the two clouds.
    pub refined: bool,
    /// Share of the earlier scan's points with a point of the later scan within 5 cm, `0..=1`.
    pub overlap: f32,
    /// Root mean square distance of these points to the later scan's surfaces, meters.
    pub rms_m: f32,
}

/// Changed objects. Excludes floor, walls and ceilings.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Changes {
    /// New objects in places that were empty before.
    pub appeared: Vec<ChangedThing>,
    /// Objects whose place is now empty.
    pub gone: Vec<ChangedThing>,
    /// Objects that disappeared from one place and appeared in another, with similar size, color
    /// and name.
    pub moved: Vec<MovedThing>,
    /// Objects observed for the first time that may have been there before, because too few earlier
    /// frames show their places.
    pub first_seen: Vec<ChangedThing>,
    /// Objects whose places the later scan did not observe. Whether they are still there is
    /// unknown.
    pub not_seen: Vec<ChangedThing>,
    /// Earlier objects whose points now belong to other instances. Their surfaces are still there.
    pub regrouped: Vec<ChangedThing>,
    /// Number of unchanged objects.
    pub unchanged: u32,
}

/// A changed object.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ChangedThing {
    /// Instance id in its version: the earlier one for `gone`, the later one for `appeared`.
    pub id: InstanceId,
    /// Name of the object.
    pub label: String,
    /// Box, meters, in the coordinates of that version.
    #[serde(rename = "box")]
    pub aabb: Aabb,
}

/// A moved object.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct MovedThing {
    /// The object in the earlier version, in its coordinates.
    pub before: ChangedThing,
    /// The object in the later version, in its coordinates.
    pub after: ChangedThing,
    /// Distance between the centers of the two boxes, meters.
    pub distance_m: f32,
}

impl Changes {
    /// Returns whether nothing changed.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        let Self { appeared, gone, moved, first_seen, not_seen, regrouped, unchanged: _ } = self;
        [appeared, gone, first_seen, not_seen, regrouped].iter().all(|things| things.is_empty())
            && moved.is_empty()
    }

    /// Combines these changes with later changes of the same scene. Omits objects that appeared and
    /// then disappeared.
    #[must_use]
    pub fn followed_by(mut self, later: Self) -> Self {
        let Self { appeared, gone, moved, first_seen, not_seen, regrouped, unchanged } = later;
        for thing in gone {
            self.remove(thing, |changes| &mut changes.gone);
        }
        for thing in regrouped {
            self.remove(thing, |changes| &mut changes.regrouped);
        }
        for MovedThing { before, after, distance_m } in moved {
            if let Some(came) = self.find_appeared(before.id) {
                *came = after;
            } else if let Some(moved) =
                self.moved.iter_mut().find(|moved| moved.after.id == before.id)
            {
                moved.distance_m = (after.aabb.center - moved.before.aabb.center).norm();
                moved.after = after;
            } else {
                self.moved.push(MovedThing { before, after, distance_m });
            }
        }
        self.appeared.extend(appeared);
        self.first_seen.extend(first_seen);
        self.not_seen = not_seen;
        self.unchanged = unchanged;
        self
    }

    /// Returns an object that appeared in the combined period.
    fn find_appeared(&mut self, id: InstanceId) -> Option<&mut ChangedThing> {
        self.appeared.iter_mut().chain(&mut self.first_seen).find(|thing| thing.id == id)
    }

    /// Removes an object that appeared in the combined period. Otherwise adds its original state to
    /// a list.
    fn remove(&mut self, thing: ChangedThing, list: impl Fn(&mut Self) -> &mut Vec<ChangedThing>) {
        if self.find_appeared(thing.id).is_some() {
            self.appeared.retain(|came| came.id != thing.id);
            self.first_seen.retain(|came| came.id != thing.id);
            return;
        }
        let moved = self.moved.iter().position(|moved| moved.after.id == thing.id);
        let first = moved.map_or(thing, |at| self.moved.remove(at).before);
        list(self).push(first);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point3;

    fn thing(id: u32, x: f32) -> ChangedThing {
        let aabb =
            Aabb { center: Point3::new(x, 0.0, 0.0), size: nalgebra::Vector3::new(0.5, 0.5, 0.5) };
        ChangedThing { id: InstanceId(id), label: "chair".into(), aabb }
    }

    fn moved(before: (u32, f32), after: (u32, f32)) -> MovedThing {
        let (before, after) = (thing(before.0, before.1), thing(after.0, after.1));
        MovedThing { distance_m: (after.aabb.center - before.aabb.center).norm(), before, after }
    }

    #[test]
    fn objects_that_appear_and_disappear_are_omitted() {
        let first = Changes { appeared: vec![thing(7, 0.0)], unchanged: 6, ..Changes::default() };
        let then = Changes {
            gone: vec![thing(7, 0.0), thing(2, 1.0)],
            unchanged: 5,
            ..Changes::default()
        };
        assert_eq!(
            first.followed_by(then),
            Changes { gone: vec![thing(2, 1.0)], unchanged: 5, ..Changes::default() }
        );
    }

    #[test]
    fn successive_moves_are_combined_into_one() {
        let first = Changes { moved: vec![moved((1, 0.0), (7, 1.0))], ..Changes::default() };
        let again = Changes { moved: vec![moved((7, 1.0), (8, 3.0))], ..Changes::default() };
        let both = first.clone().followed_by(again);
        assert_eq!(both.moved, [moved((1, 0.0), (8, 3.0))]);
        let away = Changes { gone: vec![thing(8, 3.0)], ..Changes::default() };
        assert_eq!(
            both.followed_by(away),
            Changes { gone: vec![thing(1, 0.0)], ..Changes::default() }
        );
        let new = Changes { first_seen: vec![thing(7, 1.0)], ..Changes::default() };
        let carried = new
            .followed_by(Changes { moved: vec![moved((7, 1.0), (9, 2.0))], ..Changes::default() });
        assert_eq!(carried, Changes { first_seen: vec![thing(9, 2.0)], ..Changes::default() });
        assert!(!carried.is_empty() && Changes { unchanged: 3, ..Changes::default() }.is_empty());
    }
}
