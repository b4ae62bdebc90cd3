//! Finds flat things: what lies on a plane and hardly stands out from it.
//!
//! A poster, a rug, a magazine, a keyboard on a desk: geometry shows a single plane, and masks show
//! a patchwork of colors. So each plane of the building, and each level top of a piece of
//! furniture, is unrolled into a picture of small cells. Connected cells that do not have the color
//! of the surface, or that rise a little from a top, are a flat thing, with everything they
//! enclose.
//!
//! Brightness is no evidence: a shadow is the surface's color dimmed. A flat thing must also be
//! visible to cameras: in a synthetic cloud, the underside of a box lies on the floor too.

mod texture;

use super::seen::is_seen;
use super::{CloudBySuperpoint, Plane, Planes};
use crate::superpoints::Superpoints;
use rayon::prelude::*;
use std::collections::{BTreeMap, HashSet};
use texture::Texture;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::progress::{Cancelled, Progress};
use uniground_geometry::scene::PointCloud;
use uniground_geometry::statistics::median;
use uniground_geometry::union_find::UnionFind;
use uniground_geometry::voxels::typical_spacing_m;
use uniground_geometry::{Point3, Vector3};

/// Minimum area of a level top, square meters.
const MIN_TOP_M2: f32 = 0.1;
/// Cosine of 11 degrees: maximum tilt of a superpoint of a top.
const LEVEL: f32 = 0.98;
/// Maximum height step between neighboring superpoints of one top, meters.
const TOP_STEP_M: f32 = 0.015;
/// Range of heights above a top for the points of a flat thing on it, meters.
const ON_TOP_M: std::ops::Range<f32> = -0.02..0.1;
/// Up to this height above a top, points belong to something tall that stands there, meters.
const TALL_M: f32 = 0.4;
/// Returns each flat thing as the indices of its points, ascending. `cameras` are camera centers, meters; without
/// any, every point counts as seen.
///
/// # Errors
/// [`Cancelled`].
pub fn find(
    cloud: &PointCloud,
    superpoints: &Superpoints,
    planes: &Planes,
    cameras: &[Point3<f32>],
    progress: &Progress,
) -> Result<Vec<Vec<u32>>, Cancelled> {
    let scan = CloudBySuperpoint::of(cloud, superpoints);
    let spacing_m = typical_spacing_m(&cloud.positions);
    let mut surfaces = surfaces_of_planes(planes, cameras);
    surfaces.extend(level_tops(&scan, superpoints, planes));
    let found: Vec<Vec<Vec<u32>>> = surfaces
        .par_iter()
        .map(|surface| {
            progress.check()?;
            let mut things = surface.flat_things(&scan, planes, spacing_m);
            things.retain(|points| is_seen(&scan, points, &surface.normal, cameras));
            Ok(things)
        })
        .collect::<Result<_, Cancelled>>()?;
    // A top can lie in the outline of another one.
    let mut taken: HashSet<u32> = HashSet::new();
    let mut things = Vec::new();
    for mut points in found.into_iter().flatten() {
        let all = points.len();
        points.retain(|point| taken.insert(*point));
        if 2 * points.len() > all {
            things.push(points);
        }
    }
    Ok(things)
}

/// A plane of the building or a level top.
struct Surface {
    /// Unit length, toward the cameras.
    normal: Vector3<f32>,
    middle: Point3<f32>,
    superpoints: Vec<u32>,
    /// Whether things that rise a little from it are part of it. Those on planes of the building
    /// are separate already.
    is_top: bool,
}

/// The indices of the points that lie on a surface or stand on it.
struct SurfacePoints {
    /// Those of the surface itself.
    own: Vec<u32>,
    /// Others above a top, up to [`TALL_M`].
    above: Vec<u32>,
}

fn surfaces_of_planes(planes: &Planes, cameras: &[Point3<f32>]) -> Vec<Surface> {
    let mut members = vec![Vec::new(); planes.planes.len()];
    for (s, plane) in (0..).zip(&planes.of_superpoint) {
        if let Some(plane) = plane {
            members[*plane as usize].push(s);
        }
    }
    let surface = |(plane, superpoints): (&Plane, Vec<u32>)| {
        let before = |camera: &&Point3<f32>| (*camera - plane.middle).dot(&plane.normal) > 0.0;
        let most_before = 2 * cameras.iter().filter(before).count() >= cameras.len();
        let normal = if most_before { plane.normal } else { -plane.normal };
        Surface { normal, middle: plane.middle, superpoints, is_top: false }
    };
    planes.planes.iter().zip(members).map(surface).collect()
}

/// Returns the level tops of furniture: connected level superpoints of one height.
fn level_tops(
    scan: &CloudBySuperpoint,
    superpoints: &Superpoints,
    planes: &Planes,
) -> Vec<Surface> {
    let patches = &superpoints.patches;
    let is_level = |s: u32| {
        planes.of_superpoint[s as usize].is_none() && patches[s as usize].normal.z.abs() > LEVEL
    };
    let mut sets = UnionFind::new(patches.len());
    for &(a, b) in &superpoints.adjacent {
        let step = patches[a as usize].center.z - patches[b as usize].center.z;
        if is_level(a) && is_level(b) && step.abs() <= TOP_STEP_M {
            sets.union(a, b);
        }
    }
    let (labels, _) = sets.into_labels();
    let mut groups: BTreeMap<u32, Vec<u32>> = BTreeMap::new();
    for s in (0..patches.len() as u32).filter(|s| is_level(*s)) {
        groups.entry(labels[s as usize]).or_default().push(s);
    }
    let area_m2 =
        |group: &[u32]| group.iter().map(|&s| scan.patches[s as usize].area_m2).sum::<f32>();
    let top = |superpoints: Vec<u32>| {
        let points: Vec<&Point3<f32>> = superpoints.iter().flat_map(|&s| scan.points(s)).collect();
        let middle = |axis: usize| {
            median(&mut points.iter().map(|p| p[axis]).collect::<Vec<_>>()).unwrap_or(0.0)
        };
        let middle = Point3::new(middle(0), middle(1), middle(2));
        Surface { normal: Vector3::z(), middle, superpoints, is_top: true }
    };
    // Of two tops in one outline, what lies on the larger one counts.
    let mut tops: Vec<(f32, Surface)> = groups
        .into_values()
        .map(|group| (area_m2(&group), group))
        .filter(|(area_m2, _)| *area_m2 >= MIN_TOP_M2)
        .map(|(area_m2, group)| (area_m2, top(group)))
        .collect();
    tops.sort_by(|a, b| b.0.total_cmp(&a.0));
    tops.into_iter().map(|(_, top)| top).collect()
}

impl Surface {
    fn height(&self, p: &Point3<f32>) -> f32 {
        (p - self.middle).dot(&self.normal)
    }

    /// Returns each flat thing on it as the indices of its points, ascending.
    fn flat_things(
        &self,
        scan: &CloudBySuperpoint,
        planes: &Planes,
        spacing_m: f32,
    ) -> Vec<Vec<u32>> {
        let points = self.points(scan, planes);
        let Some(texture) = Texture::of(self, points, scan, spacing_m) else { return Vec::new() };
        let things = texture.things(scan.slack_m);
        let mut thing_of = vec![None; texture.cells.len()];
        for (i, cells) in things.iter().enumerate() {
            cells.iter().for_each(|&cell| thing_of[cell] = Some(i));
        }
        let is_flat = |point: u32| {
            !self.is_top || ON_TOP_M.contains(&self.height(&scan.cloud.positions[point as usize]))
        };
        let mut found: Vec<Vec<u32>> = vec![Vec::new(); things.len()];
        for (&point, &cell) in texture.points.iter().zip(&texture.cell_of_point) {
            if let Some(thing) = thing_of[cell].filter(|_| is_flat(point)) {
                found[thing].push(point);
            }
        }
        found.iter_mut().for_each(|points| points.sort_unstable());
        found
    }

    /// Returns the points on it, and those above a top.
    fn points(&self, scan: &CloudBySuperpoint, planes: &Planes) -> SurfacePoints {
        let own: Vec<u32> = self
            .superpoints
            .iter()
            .flat_map(|&s| scan.members[s as usize].iter().copied())
            .collect();
        let at = |point: &u32| scan.cloud.positions[*point as usize];
        let mut above = Vec::new();
        if let Some(around) =
            Aabb::around(&own.iter().map(at).collect::<Vec<_>>()).filter(|_| self.is_top)
        {
            let (low, high) = (around.min(), around.max());
            let over = Aabb::from_corners(
                Point3::new(low.x, low.y, self.middle.z + ON_TOP_M.start),
                Point3::new(high.x, high.y, self.middle.z + TALL_M),
            );
            let own: HashSet<u32> = self.superpoints.iter().copied().collect();
            let others = scan
                .superpoints_near(&over)
                .filter(|s| planes.of_superpoint[*s as usize].is_none() && !own.contains(s));
            above = others
                .flat_map(|s| scan.members[s as usize].iter().copied())
                .filter(|point| over.contains(&at(point)))
                .collect();
        }
        SurfacePoints { own, above }
    }
}

#[cfg(test)]
mod tests;
