//! Which points on a surface cameras could see: in a synthetic cloud, the underside of a box lies
//! on the floor too.

use super::{ASSIGNED_SLACKS, CloudBySuperpoint};
use std::collections::HashSet;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::statistics::quantile;
use uniground_geometry::voxels::VoxelKey;
use uniground_geometry::{Point3, Vector3};

/// Minimum share of the points that some camera could see.
const MIN_SEEN: f32 = 0.5;
/// About this many points and cameras are sampled: less than twice as many.
const MOST_POINTS: usize = 100;
const MOST_CAMERAS: usize = 40;
/// Edge of the voxels for obstructions, and how far they are searched, meters.
const VOXEL_M: f32 = 0.05;
const IN_THE_WAY_M: f32 = 1.0;

/// Returns whether cameras could see most of these points: nothing that rises from their surface is
/// in the way. `normal` of the surface has unit length and points toward the cameras, whose centers
/// are in meters. Without cameras, every point counts as seen.
pub(super) fn is_seen(
    scan: &CloudBySuperpoint,
    points: &[u32],
    normal: &Vector3<f32>,
    cameras: &[Point3<f32>],
) -> bool {
    let positions: Vec<Point3<f32>> =
        points.iter().map(|&point| scan.cloud.positions[point as usize]).collect();
    let Some(around) = Aabb::around(&positions) else { return false };
    let height = |p: &Point3<f32>| (p - around.center).dot(normal);
    let mut heights: Vec<f32> = positions.iter().map(height).collect();
    let top_m = quantile(&mut heights, 0.95).unwrap_or(0.0);
    let rises = |p: &Point3<f32>| height(p) > top_m + ASSIGNED_SLACKS * scan.slack_m;
    let reach = Vector3::repeat(IN_THE_WAY_M);
    let near = Aabb::from_corners(around.min() - reach, around.max() + reach);
    let rising = scan
        .superpoints_near(&near)
        .flat_map(|s| scan.points(s))
        .filter(|p| near.contains(p) && rises(p));
    let in_the_way: HashSet<VoxelKey> = rising.map(|p| VoxelKey::containing(p, VOXEL_M)).collect();
    let sees = |camera: &Point3<f32>, p: &Point3<f32>| {
        let towards = (camera - p).cap_magnitude(IN_THE_WAY_M);
        let steps = (2.0 * IN_THE_WAY_M / VOXEL_M) as usize;
        let way = (1..=steps).map(|step| p + towards * (step as f32 / steps as f32));
        rises(camera)
            && way
                .filter(|p| rises(p))
                .all(|p| !in_the_way.contains(&VoxelKey::containing(&p, VOXEL_M)))
    };
    let cameras: Vec<&Point3<f32>> =
        cameras.iter().step_by((cameras.len() / MOST_CAMERAS).max(1)).collect();
    let tried: Vec<&Point3<f32>> =
        positions.iter().step_by((positions.len() / MOST_POINTS).max(1)).collect();
    let seen = tried.iter().filter(|p| cameras.iter().any(|camera| sees(camera, p))).count();
    cameras.is_empty() || seen as f32 >= MIN_SEEN * tried.len() as f32
}
