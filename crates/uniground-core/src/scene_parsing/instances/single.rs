//! One more instance beside those that are known.

use super::{Shape, support};
use crate::geometry::boxes::Aabb;
use crate::models::attributes::name_guesses;
use crate::scene::{Instance, InstanceId, Level, PointCloud, Structure};
use uniground_types::settings::InstanceSettings;

/// These points of the cloud as the next of the known instances: a thing, without views.
#[must_use]
pub fn of_points(cloud: &PointCloud, points: &[u32], known: &[Instance], settings: &InstanceSettings) -> Instance {
    // How rough surfaces are was measured with the superpoints, which are not kept.
    const NOISE_M: f32 = 0.0;
    let shape = Shape::of(cloud, points, NOISE_M, settings);
    let bottom_z = |i: &Instance| i.aabb.min().z;
    let floor_z = known.first().map_or(shape.aabb.min().z, |i| bottom_z(i) - i.height_above_floor_m);
    // Ids of things are their places in this list; what was found later comes behind parts and wholes.
    let things = || known.iter().take_while(|i| i.level == Level::Thing);
    let mut boxes: Vec<Aabb> = things().map(|i| i.aabb).collect();
    let mut structures: Vec<Option<Structure>> = things().map(|i| i.structure).collect();
    boxes.push(shape.aabb);
    structures.push(None);
    let support = support::of(boxes.len() - 1, &boxes, &structures, floor_z);
    let found = Instance {
        id: InstanceId(known.len() as u32 + 1),
        level: Level::Thing,
        things: Vec::new(),
        height_above_floor_m: shape.aabb.min().z - floor_z,
        aabb: shape.aabb,
        raw_box: shape.raw_box,
        oriented_box: shape.oriented_box,
        point_count: shape.point_count,
        mean_rgb: shape.mean_rgb,
        colours: shape.colours,
        planarity: shape.planarity,
        structure: None,
        support,
        views: Vec::new(),
        names: Vec::new(),
        given_name: None,
        found_for: None,
    };
    Instance { names: name_guesses(&found), ..found }
}
