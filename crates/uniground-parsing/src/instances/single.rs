//! Builds one more instance beside the known ones: from points, or by merging several instances.

use super::{Body, RegionShape, support};
use uniground_geometry::scene::{
    Instance, InstanceId, Level, PointCloud, Structure, Support, merge_views,
};
use uniground_models::attributes::name_guesses;
use uniground_types::settings::InstanceSettings;

/// Maximum number of views of a merged instance.
const MOST_VIEWS: usize = 5;

/// Merges the points of several instances into one thing, built as the next of the known instances.
/// `owner` returns the instance of a point. `None` where the members have no points.
#[must_use]
pub fn merge_points(
    cloud: &PointCloud,
    owner: impl Fn(usize) -> InstanceId,
    members: &[InstanceId],
    known: &[Instance],
    settings: &InstanceSettings,
) -> Option<Instance> {
    let points: Vec<u32> = (0..cloud.len())
        .filter(|&point| members.contains(&owner(point)))
        .map(|point| point as u32)
        .collect();
    if points.is_empty() {
        return None;
    }
    let shown: Vec<&Instance> = members.iter().map(|id| &known[id.0 as usize - 1]).collect();
    // The merged thing does not rest on its own members.
    let beside: Vec<Instance> = known
        .iter()
        .map(|i| Instance { dismissed: i.dismissed || members.contains(&i.id), ..i.clone() })
        .collect();
    let whole = build_from_points(cloud, &points, &beside, settings);
    Some(Instance {
        views: merge_views(&shown, MOST_VIEWS),
        merged_from: members.to_vec(),
        ..whole
    })
}

/// Builds a thing without views from these points of the cloud, as the next of the known instances.
#[must_use]
pub fn build_from_points(
    cloud: &PointCloud,
    points: &[u32],
    known: &[Instance],
    settings: &InstanceSettings,
) -> Instance {
    // Roughness was measured with the superpoints, which are not stored.
    const NOISE_M: f32 = 0.0;
    let mut shape = RegionShape::measure(cloud, points, NOISE_M, None, settings);
    let bottom_z = |i: &Instance| i.aabb.min().z;
    let floor_z =
        known.first().map_or(shape.aabb.min().z, |i| bottom_z(i) - i.height_above_floor_m);
    let things: Vec<&Instance> =
        known.iter().filter(|i| i.level == Level::Thing && !i.dismissed).collect();
    let mut bodies: Vec<Body> =
        things.iter().map(|i| Body::from_box(i.aabb, &i.oriented_box)).collect();
    let mut structures: Vec<Option<Structure>> = things.iter().map(|i| i.structure).collect();
    bodies.push(shape.body(cloud, points));
    structures.push(None);
    // Support refers to positions in this list, counted from 1.
    let id_of = |place: InstanceId| things[place.0 as usize - 1].id;
    let own = bodies.len() - 1;
    let held = support::extend_to_support(
        own,
        support::find_support(own, &bodies, &structures, floor_z),
        &bodies,
        &structures,
        floor_z,
    );
    shape.extend_to(held.from_z, held.to_z);
    let support = match held.support {
        Support::Instance { id } => Support::Instance { id: id_of(id) },
        Support::Wall { id } => Support::Wall { id: id_of(id) },
        other => other,
    };
    let id = InstanceId(known.len() as u32 + 1);
    let found = Instance {
        height_above_floor_m: shape.aabb.min().z - floor_z,
        raw_box: shape.raw_box,
        oriented_box: shape.oriented_box,
        point_count: shape.point_count,
        mean_rgb: shape.mean_rgb,
        colors: shape.colors,
        planarity: shape.planarity,
        support,
        ..Instance::from_box(id, shape.aabb)
    };
    Instance { names: name_guesses(&found), ..found }
}
