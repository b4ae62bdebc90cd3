//! Regions to instances: boxes, colours, support, structure. Class-agnostic; flags never drop an instance.

mod bounds;
mod structure;
mod support;

use crate::geometry::boxes::{Aabb, OrientedBox};
use crate::geometry::colour::ColourHistogram;
use crate::geometry::least_axis::least_axis;
use crate::geometry::moments::Moments;
use crate::geometry::statistics::{median, quantile};
use crate::geometry::{Point3, Vector3};
use crate::progress::{Cancelled, Progress};
use crate::scene::{Instance, InstanceId, PointCloud};
use crate::scene_parsing::planes::Planes;
use crate::scene_parsing::superpoints::Superpoints;
use rayon::prelude::*;
use std::collections::BTreeMap;
pub use support::supports;
use uniground_types::settings::InstanceSettings;

/// Builds instances from the region of each point. Returns them in order of id and the instance of each point.
///
/// Ids count from 1 in falling order of points; ties by the region's first point.
///
/// # Errors
/// [`Cancelled`].
pub fn build(
    cloud: &PointCloud,
    superpoints: &Superpoints,
    planes: &Planes,
    region_of: &[u32],
    settings: &InstanceSettings,
    progress: &Progress,
) -> Result<(Vec<Instance>, Vec<InstanceId>), Cancelled> {
    progress.report("instances", 0.0)?;
    let count = region_of.iter().max().map_or(0, |&r| r as usize + 1);
    let mut members: Vec<Vec<u32>> = vec![Vec::new(); count];
    for (i, &region) in region_of.iter().enumerate() {
        members[region as usize].push(i as u32);
    }
    members.retain(|points| !points.is_empty());
    members.sort_by_key(|points| (std::cmp::Reverse(points.len()), points[0]));
    let mut of_point = vec![InstanceId(0); cloud.len()];
    for (i, points) in members.iter().enumerate() {
        points.iter().for_each(|&p| of_point[p as usize] = InstanceId(i as u32 + 1));
    }
    let noise = Noise::of(superpoints);
    let shapes: Vec<Shape> = members
        .par_iter()
        .map(|points| progress.check().map(|()| Shape::of(cloud, points, noise.around(points), settings)))
        .collect::<Result<_, Cancelled>>()?;
    let lowest_z = || quantile(&mut cloud.positions.iter().map(|p| p.z).collect::<Vec<_>>(), 0.01);
    let floor_z = planes.floor_z().or_else(lowest_z).unwrap_or(0.0);
    let structures: Vec<_> = shapes
        .iter()
        .zip(&members)
        .map(|(shape, points)| {
            let mut on_plane: BTreeMap<u32, u32> = BTreeMap::new();
            points
                .iter()
                .filter_map(|&p| planes.of_superpoint[superpoints.of_point[p as usize] as usize])
                .for_each(|plane| *on_plane.entry(plane).or_default() += 1);
            structure::of(shape, &on_plane.into_iter().collect::<Vec<_>>(), planes, floor_z)
        })
        .collect();
    let supports = supports(&shapes.iter().map(|shape| shape.aabb).collect::<Vec<_>>(), &structures, floor_z, progress)?;
    let instances = shapes
        .into_iter()
        .zip(structures)
        .zip(supports)
        .enumerate()
        .map(|(i, ((shape, structure), support))| Instance {
            id: InstanceId(i as u32 + 1),
            aabb: shape.aabb,
            raw_box: shape.raw_box,
            oriented_box: shape.oriented_box,
            point_count: shape.point_count,
            mean_rgb: shape.mean_rgb,
            colours: shape.colours,
            planarity: shape.planarity,
            structure,
            support,
            height_above_floor_m: shape.aabb.min().z - floor_z,
            views: Vec::new(),
            names: Vec::new(),
            given_name: None,
        })
        .collect();
    Ok((instances, of_point))
}

/// How far points lie from the surfaces they were measured on.
struct Noise<'a> {
    superpoints: &'a Superpoints,
    scene_m: f32,
}

impl<'a> Noise<'a> {
    fn of(superpoints: &'a Superpoints) -> Self {
        // Most of a room is even: what is rough at the median is rough by noise.
        let mut all: Vec<f32> = superpoints.of_point.iter().map(|&s| superpoints.roughness_m[s as usize]).collect();
        let scene_m = median(&mut all).unwrap_or(0.0);
        Self { superpoints, scene_m }
    }

    /// Standard deviation around these points, metres. Far things are noisier than the scene at large; leaves of a plant are
    /// rough without being noisy: hence the bound.
    fn around(&self, points: &[u32]) -> f32 {
        const FAR_FACTOR: f32 = 2.0;
        let mut here: Vec<f32> = points
            .iter()
            .map(|&p| self.superpoints.roughness_m[self.superpoints.of_point[p as usize] as usize])
            .collect();
        median(&mut here).unwrap_or(0.0).min(FAR_FACTOR * self.scene_m)
    }
}

/// What the points of one region look like, before they are compared with the others.
struct Shape {
    point_count: u32,
    aabb: Aabb,
    raw_box: Aabb,
    oriented_box: OrientedBox,
    mean_rgb: [u8; 3],
    colours: ColourHistogram,
    planarity: f32,
}

impl Shape {
    fn of(cloud: &PointCloud, members: &[u32], noise_m: f32, settings: &InstanceSettings) -> Self {
        let positions: Vec<Point3<f32>> = members.iter().map(|&i| cloud.positions[i as usize]).collect();
        let colours = || members.iter().map(|&i| cloud.colours[i as usize]);
        let raw_box = Aabb::around(&positions).unwrap_or(Aabb { center: Point3::origin(), size: Vector3::zeros() });
        let (aabb, oriented_box) = bounds::robust(&positions, noise_m, settings);
        let planarity = planarity(&positions);
        let n = members.len().max(1) as u64;
        let sum = colours().fold([0_u64; 3], |sum, c| std::array::from_fn(|i| sum[i] + u64::from(c[i])));
        Self {
            point_count: members.len() as u32,
            aabb,
            raw_box,
            oriented_box,
            mean_rgb: sum.map(|s| ((s + n / 2) / n) as u8),
            colours: ColourHistogram::of(colours()),
            planarity,
        }
    }
}

/// Points this close to the best plane count as on it, metres.
const ON_PLANE_M: f32 = 0.03;

/// Share of the points within 3 cm of their best plane.
#[must_use]
pub fn planarity(positions: &[Point3<f32>]) -> f32 {
    let Moments { mean, covariance } = Moments::of(positions);
    let (_, normal) = least_axis(&covariance);
    let on_plane = positions.iter().filter(|p| (*p - mean).dot(&normal).abs() <= ON_PLANE_M).count();
    on_plane as f32 / positions.len().max(1) as f32
}
