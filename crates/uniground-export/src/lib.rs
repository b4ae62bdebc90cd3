//! Exports a scene with its instances as files for other programs.
//!
//! [`Export`] selects the points and assigns each to its thing, including manual corrections
//! ([`Owners`]). The other files write one format each: [`write_glb`] (glTF 2.0, binary),
//! [`write_usdz`], [`write_ply`]. The same scene gives the same bytes.
//!
//! Coordinates are the scene's own, meters with Z up, if the format supports that. glTF has Y up:
//! there, a root node rotates the scene, and everything below it, including boxes, stays unchanged.

#![warn(missing_docs)]

mod glb;
mod ply;
mod usdz;

pub use glb::write_glb;
pub use ply::write_ply;
pub use usdz::write_usdz;

use nalgebra::{Rotation3, Translation3};
use serde::Serialize;
use std::collections::BTreeMap;
use uniground_geometry::Vector3;
use uniground_geometry::boxes::{Aabb, OrientedBox};
use uniground_geometry::scene::{
    Instance, InstanceId, Level, Owners, PointCloud, Structure, Support, evenly_spread_order,
};

/// Name of the points that belong to no thing.
const REST: &str = "rest of the scan";

/// A scene to export.
#[derive(Debug)]
pub struct Export<'a> {
    title: &'a str,
    cloud: &'a PointCloud,
    /// The exported points by index, with the thing each belongs to (0: none), in the order of the
    /// cloud.
    points: Vec<(u32, InstanceId)>,
    /// Things that are not dismissed, including parts of the building, in order of id.
    things: Vec<&'a Instance>,
}

impl<'a> Export<'a> {
    /// Selects at most `most` points of a scene, thinned out evenly. `instance_of_point` is the
    /// result of stage 1. `instances` are the corrected instances of the parse, in order of id.
    #[must_use]
    pub fn new(
        title: &'a str,
        cloud: &'a PointCloud,
        instance_of_point: &[InstanceId],
        instances: &'a [Instance],
        most: usize,
    ) -> Self {
        let owners = Owners::new(instance_of_point, instances);
        let mut chosen: Vec<u32> = match cloud.len() > most {
            true => {
                evenly_spread_order(&cloud.positions).take(most).map(|point| point as u32).collect()
            }
            false => (0..cloud.len() as u32).collect(),
        };
        chosen.sort_unstable();
        let owner = |point: u32| {
            let found = instance_of_point.get(point as usize).copied().unwrap_or_default();
            owners.owner_of(found, &cloud.positions[point as usize])
        };
        let points = chosen.into_iter().map(|point| (point, owner(point))).collect();
        Self {
            title,
            cloud,
            points,
            things: instances.iter().filter(|instance| instance.is_shown()).collect(),
        }
    }

    /// Returns the points of each thing, in order of id, followed by the points that belong to no
    /// thing.
    fn group_points(&self) -> (Vec<(&'a Instance, Vec<u32>)>, Vec<u32>) {
        let mut by_owner: BTreeMap<InstanceId, Vec<u32>> = BTreeMap::new();
        self.points
            .iter()
            .for_each(|(point, owner)| by_owner.entry(*owner).or_default().push(*point));
        let things = self
            .things
            .iter()
            .map(|thing| (*thing, by_owner.remove(&thing.id).unwrap_or_default()))
            .collect();
        (things, by_owner.remove(&InstanceId::default()).unwrap_or_default())
    }
}

/// Properties of a thing, besides its points. Meters, frame of the scene (Z up).
#[derive(Debug, Serialize)]
struct ObjectDescription<'a> {
    id: InstanceId,
    /// The name: given by people, else by a model that has seen it, else its label.
    name: &'a str,
    /// The encoder's name for it.
    label: &'a str,
    /// How well the label fits, `0..=1`.
    #[serde(skip_serializing_if = "Option::is_none")]
    confidence: Option<f32>,
    level: Level,
    #[serde(skip_serializing_if = "Option::is_none")]
    structure: Option<Structure>,
    #[serde(rename = "box")]
    aabb: Aabb,
    oriented_box: OrientedBox,
    support: Support,
}

impl<'a> ObjectDescription<'a> {
    fn from_instance(instance: &'a Instance) -> Self {
        let guess = instance.names.first().filter(|_| instance.structure.is_none());
        let label = match instance.structure {
            Some(structure) => structure.as_str(),
            None => guess.map_or("object", |guess| &guess.name),
        };
        Self {
            id: instance.id,
            name: instance.label(),
            label,
            confidence: guess.map(|guess| guess.score),
            level: instance.level,
            structure: instance.structure,
            aabb: instance.aabb,
            oriented_box: instance.oriented_box,
            support: instance.support,
        }
    }
}

/// Returns the corners of a cube with edges of one meter around the origin. Bit 0 of the index
/// selects the largest X, bit 1 Y, bit 2 Z.
fn unit_corners() -> [Vector3<f32>; 8] {
    std::array::from_fn(|i| Vector3::from_fn(|axis, _| if i >> axis & 1 == 1 { 0.5 } else { -0.5 }))
}

/// The twelve edges of a box, as pairs of corners.
const EDGES: [[u8; 2]; 12] = [
    [0, 1],
    [2, 3],
    [4, 5],
    [6, 7],
    [0, 2],
    [1, 3],
    [4, 6],
    [5, 7],
    [0, 4],
    [1, 5],
    [2, 6],
    [3, 7],
];

/// Returns the corners of a thing's box, in the order of [`unit_corners`].
fn box_corners(of: &OrientedBox) -> [nalgebra::Point3<f32>; 8] {
    let to_world =
        Translation3::from(of.center) * Rotation3::from_axis_angle(&Vector3::z_axis(), of.yaw_rad);
    unit_corners().map(|corner| to_world * nalgebra::Point3::from(corner.component_mul(&of.size)))
}

/// Converts an 8-bit sRGB channel to linear light, `0..=1`. glTF and USD store linear colors.
fn srgb_to_linear(channel: u8) -> f32 {
    let c = f32::from(channel) / 255.0;
    if c <= 0.040_45 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;
    use uniground_geometry::Point3;
    use uniground_geometry::scene::{NameGuess, correct};
    use uniground_testing::thing;
    use uniground_types::corrections::{Change, Correction};

    pub(super) struct Room {
        pub cloud: PointCloud,
        pub of_point: Vec<InstanceId>,
        pub instances: Vec<Instance>,
    }

    /// Returns a room: a floor (1) with a coffee table (2), a mug on it (3), the table's top (4, a
    /// part), and two points that belong to no thing.
    pub(super) fn room() -> Room {
        let named = |instance: Instance, name: &str| Instance {
            names: vec![NameGuess { name: name.into(), score: 0.75 }],
            ..instance
        };
        let floor = thing(1, [1.0, 2.0], [4.0, 3.0, 0.0], 0.0, Support::Nothing, [90; 3]);
        let table = thing(2, [1.0, 2.0], [0.8, 0.6, 0.5], 0.0, Support::Floor, [120, 80, 40]);
        let mug = thing(
            3,
            [1.0, 2.0],
            [0.1, 0.1, 0.1],
            0.5,
            Support::Instance { id: InstanceId(2) },
            [200, 20, 30],
        );
        let top = thing(4, [1.0, 2.0], [0.8, 0.6, 0.1], 0.4, Support::Floor, [120, 80, 40]);
        let yaw_rad = 0.5;
        let instances = vec![
            Instance { structure: Some(Structure::Floor), ..floor },
            named(table, "coffee table"),
            Instance {
                oriented_box: OrientedBox { yaw_rad, ..mug.oriented_box },
                ..named(mug, "mug")
            },
            Instance { level: Level::Part, things: vec![InstanceId(2)], ..top },
        ];
        let points = [
            (1, [-1.0, 0.5, 0.0], [90; 3]),
            (1, [3.0, 0.5, 0.0], [91, 90, 89]),
            (0, [0.0, 1.0, 1.25], [0, 1, 2]),
            (2, [1.25, 2.25, 0.5], [120, 80, 40]),
            (3, [1.0, 2.0, 0.59], [200, 20, 30]),
            (1, [-1.0, 3.5, 0.0], [92; 3]),
            (2, [0.75, 1.75, 0.45], [121, 80, 40]),
            (1, [3.0, 3.5, 0.0], [93; 3]),
            (2, [0.75, 2.25, 0.1], [122, 80, 40]),
            (0, [0.0, 3.0, 1.5], [255, 254, 253]),
        ];
        let cloud = PointCloud {
            positions: points.iter().map(|(_, at, _)| Point3::from(*at)).collect(),
            colors: points.iter().map(|(.., color)| *color).collect(),
        };
        Room { cloud, of_point: points.iter().map(|(id, ..)| InstanceId(*id)).collect(), instances }
    }

    /// Returns the ids of exported things with their numbers of points after corrections. Points of
    /// no thing come last.
    fn point_counts(changes: &[(Change, Option<u32>, bool)]) -> Vec<(u32, usize)> {
        let Room { cloud, of_point, mut instances } = room();
        let corrections: Vec<Correction> = changes
            .iter()
            .map(|(change, made, is_undone)| {
                if let (Change::Merge { instance_ids, .. }, Some(made)) = (change, made) {
                    let merged = Instance {
                        id: InstanceId(*made),
                        merged_from: instance_ids.clone(),
                        ..instances[1].clone()
                    };
                    instances.push(merged);
                }
                let undone_at = is_undone.then(String::new);
                Correction {
                    id: String::new(),
                    change: change.clone(),
                    made: made.map(InstanceId),
                    author: None,
                    created_at: String::new(),
                    undone_at,
                }
            })
            .collect();
        correct(&mut instances, &corrections);
        let (things, rest) =
            Export::new("", &cloud, &of_point, &instances, usize::MAX).group_points();
        things
            .iter()
            .map(|(thing, points)| (thing.id.0, points.len()))
            .chain([(0, rest.len())])
            .collect()
    }

    fn ids<const N: usize>(ids: [u32; N]) -> Vec<InstanceId> {
        ids.map(InstanceId).to_vec()
    }

    #[test]
    fn export_applies_corrections() {
        let merge = |of: Vec<InstanceId>| Change::Merge { instance_ids: of, name: None };
        let dismiss = |id: u32| Change::Dismiss { instance_ids: ids([id]) };
        let split = || Change::Split { instance_id: InstanceId(2) };
        for (said, changes, expected) in [
            ("no corrections", vec![], vec![(1, 4), (2, 3), (3, 1), (0, 2)]),
            ("dismissed", vec![(dismiss(2), None, false)], vec![(1, 4), (3, 1), (0, 5)]),
            ("undone", vec![(dismiss(2), None, true)], vec![(1, 4), (2, 3), (3, 1), (0, 2)]),
            ("merged", vec![(merge(ids([2, 3])), Some(5), false)], vec![(1, 4), (5, 4), (0, 2)]),
            (
                "merge undone",
                vec![(merge(ids([2, 3])), Some(5), true)],
                vec![(1, 4), (2, 3), (3, 1), (0, 2)],
            ),
            (
                "merged twice",
                vec![(merge(ids([2, 3])), Some(5), false), (merge(ids([5, 1])), Some(6), false)],
                vec![(6, 8), (0, 2)],
            ),
            (
                "merged and dismissed",
                vec![(merge(ids([2, 3])), Some(5), false), (dismiss(5), None, false)],
                vec![(1, 4), (0, 6)],
            ),
            ("split", vec![(split(), None, false)], vec![(1, 4), (3, 1), (4, 2), (0, 3)]),
            (
                "split and a part merged",
                vec![(split(), None, false), (merge(ids([3, 4])), Some(5), false)],
                vec![(1, 4), (5, 3), (0, 3)],
            ),
        ] {
            assert_eq!(point_counts(&changes), expected, "{said}");
        }
    }

    #[test]
    fn points_are_thinned_evenly_and_reproducibly() {
        // A floor of 64 x 64 points, listed row by row.
        let positions: Vec<Point3<f32>> =
            (0..4096).map(|i| Point3::new((i % 64) as f32, (i / 64) as f32, 0.0)).collect();
        let cloud = PointCloud { colors: vec![[1, 2, 3]; positions.len()], positions };
        let points = |most| Export::new("", &cloud, &[], &[], most).points;
        let chosen = points(256);
        let squares: BTreeSet<(u32, u32)> =
            chosen.iter().map(|(at, _)| (at % 64 / 16, at / 64 / 16)).collect();
        assert_eq!((chosen.len(), squares.len()), (256, 16));
        assert!(chosen.is_sorted() && chosen == points(256));
        assert_eq!((points(4096).len(), points(usize::MAX).len()), (4096, 4096));
    }

    #[test]
    fn box_corners_follow_the_rotation() {
        let turned = OrientedBox {
            center: Point3::new(1.0, 2.0, 3.0),
            size: Vector3::new(2.0, 4.0, 6.0),
            yaw_rad: std::f32::consts::FRAC_PI_2,
        };
        let corners = box_corners(&turned);
        assert!((corners[7] - Point3::new(-1.0, 3.0, 6.0)).norm() < 1e-5, "{corners:?}");
        for [from, to] in EDGES {
            let side = (corners[usize::from(to)] - corners[usize::from(from)]).norm();
            assert!([2.0, 4.0, 6.0].iter().any(|length| (length - side).abs() < 1e-5), "{side}");
        }
    }
}
