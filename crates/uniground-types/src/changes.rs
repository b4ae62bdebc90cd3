//! What is different between two looks at a room.

use crate::geometry::boxes::Aabb;
use crate::scene::InstanceId;
use serde::{Deserialize, Serialize};

/// What changed in a scene: since an earlier version of it, or from one scan of a room to another.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct SceneChanges {
    /// The earlier look.
    pub from: SceneVersion,
    /// The later one.
    pub to: SceneVersion,
    /// How the two scans lie to each other; `null` for versions of one scene, which share their
    /// coordinates and ids.
    pub alignment: Option<ScanAlignment>,
    /// What is different.
    pub changes: Changes,
}

/// A scene as it was parsed at some time.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct SceneVersion {
    /// UUIDv7 of the scene.
    pub scene_id: String,
    /// Number of its parse, from 1.
    pub version: u32,
}

/// From the coordinates of the earlier scan to those of the later one: `to = rotation * from +
/// translation_m`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ScanAlignment {
    /// Unit quaternion `x, y, z, w`.
    pub rotation: [f64; 4],
    /// Metres.
    pub translation_m: [f64; 3],
    /// Whether it was refined by laying the two clouds over each other.
    pub refined: bool,
    /// Share of the earlier scan's points that have one of the later scan's within 5 cm.
    pub overlap: f32,
    /// Their root mean square distance to its surfaces, metres.
    pub rms_m: f32,
}

/// Things that are not as they were. Floor, walls and ceilings are left out.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Changes {
    /// Things that stand where nothing was before.
    pub appeared: Vec<ChangedThing>,
    /// Things whose place is empty now.
    pub gone: Vec<ChangedThing>,
    /// Things that are gone in one place and, alike in size, colour and name, appeared in another.
    pub moved: Vec<MovedThing>,
    /// Things nobody had seen before, though they may have been there: no frame had looked at
    /// their places, or too few for it to be known.
    pub first_seen: Vec<ChangedThing>,
    /// Things in places that the later scan did not look at: nobody knows whether they are still
    /// there.
    pub not_seen: Vec<ChangedThing>,
    /// Things of before that are no things of their own any more, though their surfaces are still
    /// there: the same points are grouped otherwise.
    pub regrouped: Vec<ChangedThing>,
    /// How many things stayed.
    pub unchanged: u32,
}

/// A thing that changed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ChangedThing {
    /// In the look it is in: the earlier one for what is gone, the later one for what appeared.
    pub id: InstanceId,
    /// What it is called.
    pub label: String,
    /// Its box, metres, in the coordinates of that look.
    #[serde(rename = "box")]
    pub aabb: Aabb,
}

/// A thing that is elsewhere.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct MovedThing {
    /// As it was, in the coordinates of the earlier look.
    pub before: ChangedThing,
    /// As it is, in those of the later one.
    pub after: ChangedThing,
    /// Between the middles of the two boxes, metres.
    pub distance_m: f32,
}

impl Changes {
    /// Whether nothing changed.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        let Self { appeared, gone, moved, first_seen, not_seen, regrouped, unchanged: _ } = self;
        [appeared, gone, first_seen, not_seen, regrouped].iter().all(|things| things.is_empty())
            && moved.is_empty()
    }

    /// These changes and then later ones of the same scene, as one: what came and went again is not
    /// told.
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

    /// A thing that came in the time looked at.
    fn find_appeared(&mut self, id: InstanceId) -> Option<&mut ChangedThing> {
        self.appeared.iter_mut().chain(&mut self.first_seen).find(|thing| thing.id == id)
    }

    /// Forgets a thing that came in the time looked at; else notes that it is no more, as it was at
    /// first.
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
    fn what_comes_and_goes_again_is_not_told() {
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
    fn moves_are_told_from_the_first_place_to_the_last() {
        let first = Changes { moved: vec![moved((1, 0.0), (7, 1.0))], ..Changes::default() };
        let again = Changes { moved: vec![moved((7, 1.0), (8, 3.0))], ..Changes::default() };
        let both = first.clone().followed_by(again);
        assert_eq!(both.moved, [moved((1, 0.0), (8, 3.0))]);
        let away = Changes { gone: vec![thing(8, 3.0)], ..Changes::default() };
        assert_eq!(both.then(away), Changes { gone: vec![thing(1, 0.0)], ..Changes::default() });
        let new = Changes { first_seen: vec![thing(7, 1.0)], ..Changes::default() };
        let carried =
            new.then(Changes { moved: vec![moved((7, 1.0), (9, 2.0))], ..Changes::default() });
        assert_eq!(carried, Changes { first_seen: vec![thing(9, 2.0)], ..Changes::default() });
        assert!(!carried.is_empty() && Changes { unchanged: 3, ..Changes::default() }.is_empty());
    }
}
