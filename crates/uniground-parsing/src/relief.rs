//! Relief: how far a flat thing stands out from its plane of the building, measured frame by frame.
//!
//! A picture is a few centimeters thick, a rug one. Noise blurs that, and where poses drift the
//! cloud contains a wall twice: the points of a picture then fill ten times its thickness. But
//! within one frame, the thing and the wall have the same error. So heights are measured above the
//! plane as the same frame sees it around the thing. Collected from all frames in cells along the
//! plane, they are free of drift, and with enough of them free of noise.

use super::labels::Labels;
use super::planes::Planes;
use super::superpoints::Superpoints;
use super::visibility::{FramePoint, PointVisibility, is_sampled};
use rayon::prelude::*;
use std::collections::BTreeMap;
use uniground_geometry::scene::{Camera, DepthImage, InstanceId, PointCloud, Structure};
use uniground_geometry::statistics::{median, quantile};
use uniground_geometry::{Point3, Vector3};
use uniground_types::settings::InstanceSettings;

/// Where a flat thing begins and ends above its plane.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FlatRelief {
    /// Unit length, from the plane toward the cameras.
    pub normal: Vector3<f32>,
    /// A point of the plane, as the cloud shows it around the thing, meters, world frame.
    pub base: Point3<f32>,
    /// Heights above the plane at which the thing begins and ends, meters.
    pub span_m: (f32, f32),
}

impl FlatRelief {
    /// Removes noise and drift along the normal from these points. Each becomes a pair: where the
    /// thing begins and where it ends.
    #[must_use]
    pub fn flatten(&self, positions: &[Point3<f32>]) -> Vec<Point3<f32>> {
        let at = |p: &Point3<f32>, height: f32| {
            p + self.normal * (height - (p - self.base).dot(&self.normal))
        };
        let (from, to) = self.span_m;
        positions.iter().flat_map(|p| [at(p, from), at(p, to)]).collect()
    }
}

/// Range of heights above its plane for the points of a flat thing, in a cloud that drifts, meters.
const IN_CLOUD_M: std::ops::Range<f32> = -0.08..0.12;
/// Minimum share of a flat thing's points in [`IN_CLOUD_M`].
const FLAT: f32 = 0.9;
/// Maximum thickness of a flat thing as a share of its smaller extent along the plane: shoes are
/// not flat.
const THIN: f32 = 0.25;
/// Maximum distance from the thing at which the plane is measured, meters.
const AROUND_M: f32 = 0.25;
/// Minimum number of points of the thing, and of the plane around it, for a frame to count.
const MIN_POINTS: usize = 30;
/// Edge of the cells along the plane, meters.
const CELL_M: f32 = 0.03;
/// Minimum number of heights in a cell.
const MIN_HEIGHTS: u32 = 4;
/// Minimum number of cells of a thing.
const MIN_CELLS: usize = 4;
/// Share of the cells left out at either end, because rims are part thing, part plane.
const TRIM: f32 = 0.1;
/// Minimum relief, meters. Anything flatter is the plane itself, or set into it like a door.
const LEAST_M: f32 = 0.003;
/// A thing whose lowest height exceeds this hangs before its wall, like a curtain. Any other thing
/// starts at the plane. Meters.
const HANGS_M: f32 = 0.065;

/// A candidate for a thing that lies flat on a plane.
struct FlatCandidate {
    id: InstanceId,
    plane: u32,
    /// Unit length: the normal toward the cameras, and two directions along the plane.
    axes: [Vector3<f32>; 3],
    /// A point of the plane as the cloud shows it around the thing, meters.
    base: Point3<f32>,
    /// Bounds of the thing along the plane, meters from `base`: lows and highs.
    low: [f32; 2],
    high: [f32; 2],
}

impl FlatCandidate {
    /// Returns the height above the plane and position along it, meters.
    fn plane_coordinates(&self, p: &Point3<f32>) -> (f32, [f32; 2]) {
        let [height, a, b] = self.axes.map(|axis| (p - self.base).dot(&axis));
        (height, [a, b])
    }

    fn is_around(&self, at: [f32; 2]) -> bool {
        (0..2).all(|i| (self.low[i] - AROUND_M..self.high[i] + AROUND_M).contains(&at[i]))
    }
}

/// The candidates for things that lie flat on planes of the building.
pub struct FlatCandidates<'a> {
    superpoints: &'a Superpoints,
    planes: &'a Planes,
    labels: &'a Labels<'a>,
    things: Vec<FlatCandidate>,
    /// Index in `things`, by id.
    of_id: Vec<Option<u32>>,
}

/// Sum and number of the heights in each cell of a flat thing. Key: index of the thing, cell.
type HeightCells = BTreeMap<(u32, [i32; 2]), (f32, u32)>;

impl<'a> FlatCandidates<'a> {
    /// Finds the things whose points are close to a plane, and points of the plane around them.
    /// Finds nothing where the settings treat nothing as thin. `cameras` are camera centers,
    /// meters.
    #[must_use]
    pub fn find(
        cloud: &PointCloud,
        superpoints: &'a Superpoints,
        planes: &'a Planes,
        labels: &'a Labels<'a>,
        cameras: &[Point3<f32>],
        settings: &InstanceSettings,
    ) -> Self {
        let mut of_id = vec![None; labels.len() + 1];
        if settings.thin_sigmas == 0.0 {
            return Self { superpoints, planes, labels, things: Vec::new(), of_id };
        }
        let (mut members, mut on_plane) =
            (vec![Vec::new(); labels.len()], vec![Vec::new(); planes.planes.len()]);
        for point in (0..cloud.len() as u32).filter(|&point| is_sampled(point)) {
            labels
                .instances_of_point(point as usize)
                .for_each(|id| members[id.0 as usize - 1].push(point));
            if let Some(plane) = planes.of_superpoint[superpoints.of_point[point as usize] as usize]
            {
                on_plane[plane as usize].push(point);
            }
        }
        // Excludes floor and walls themselves, which are most of what frames see.
        let whose = |points: &Vec<u32>| {
            let mut things: Vec<InstanceId> =
                points.iter().map(|&point| labels.thing_of_point[point as usize]).collect();
            things.sort_unstable();
            things
                .chunk_by(|a, b| a == b)
                .max_by_key(|same| (same.len(), same[0]))
                .map(|same| same[0])
        };
        let whose: Vec<Option<InstanceId>> = on_plane.iter().map(whose).collect();
        let axes: Vec<[Vector3<f32>; 3]> = planes
            .planes
            .iter()
            .map(|plane| {
                let before = cameras
                    .iter()
                    .filter(|camera| (*camera - plane.middle).dot(&plane.normal) > 0.0)
                    .count();
                let normal = if 2 * before >= cameras.len() { plane.normal } else { -plane.normal };
                let across = normal
                    .cross(&if normal.z.abs() < 0.7 { Vector3::z() } else { Vector3::x() })
                    .normalize();
                [normal, across, normal.cross(&across)]
            })
            .collect();
        let at = |&point: &u32| &cloud.positions[point as usize];
        let flat = |(points, id): (&Vec<u32>, InstanceId)| {
            let close = |plane: usize| {
                let height = |p: &u32| (at(p) - planes.planes[plane].middle).dot(&axes[plane][0]);
                points.iter().filter(|p| IN_CLOUD_M.contains(&height(p))).count()
            };
            let (share, plane) = (0..axes.len()).map(|plane| (close(plane), plane)).max()?;
            if (share as f32) < FLAT * points.len() as f32 || whose[plane] == Some(id) {
                return None;
            }
            let mut flat = FlatCandidate {
                id,
                plane: plane as u32,
                axes: axes[plane],
                base: planes.planes[plane].middle,
                low: [0.0; 2],
                high: [0.0; 2],
            };
            for i in 0..2 {
                let mut along: Vec<f32> =
                    points.iter().map(|p| flat.plane_coordinates(at(p)).1[i]).collect();
                (flat.low[i], flat.high[i]) =
                    (quantile(&mut along, 0.02)?, quantile(&mut along, 0.98)?);
            }
            let around = on_plane[plane]
                .iter()
                .filter(|p| labels.instances_of_point(**p as usize).all(|other| other != id));
            let around = around
                .map(|p| flat.plane_coordinates(at(p)))
                .filter(|(_, along)| flat.is_around(*along));
            let mut around: Vec<f32> = around.map(|(height, _)| height).collect();
            if around.len() < MIN_POINTS {
                return None;
            }
            flat.base += flat.axes[0] * median(&mut around)?;
            Some(flat)
        };
        let things: Vec<FlatCandidate> = members
            .par_iter()
            .enumerate()
            .filter_map(|(i, points)| flat((points, InstanceId(i as u32 + 1))))
            .collect();
        (0..).zip(&things).for_each(|(i, flat)| of_id[flat.id.0 as usize] = Some(i));
        Self { superpoints, planes, labels, things, of_id }
    }

    /// Measures one frame, given its depth, the depth camera, and the points it shows.
    #[must_use]
    pub fn measure_heights(
        &self,
        camera: &Camera,
        depth: &DepthImage,
        points: &[FramePoint],
    ) -> FlatHeights {
        if self.things.is_empty() {
            return FlatHeights::default();
        }
        let to_world = camera.world_to_camera().inverse();
        // By flat thing: heights of the plane around it; positions along the plane and heights of
        // its own points.
        let mut around: Vec<Vec<f32>> = vec![Vec::new(); self.things.len()];
        let mut own: Vec<Vec<([i32; 2], f32)>> = vec![Vec::new(); self.things.len()];
        for seen in points.iter().filter(|seen| seen.sight == PointVisibility::Visible) {
            let (u, v) = seen.cell;
            let measured =
                || to_world * camera.intrinsics.unproject(u as f32, v as f32, depth.at(seen.cell));
            let is_of = |flat: &FlatCandidate| {
                self.labels.instances_of_point(seen.point as usize).any(|id| id == flat.id)
            };
            for flat in self
                .labels
                .instances_of_point(seen.point as usize)
                .filter_map(|id| self.of_id[id.0 as usize])
            {
                let (_, along) = self.things[flat as usize].plane_coordinates(&seen.position);
                let (height, _) = self.things[flat as usize].plane_coordinates(&measured());
                own[flat as usize].push((along.map(|at| (at / CELL_M).floor() as i32), height));
            }
            let plane =
                self.planes.of_superpoint[self.superpoints.of_point[seen.point as usize] as usize];
            if plane.is_none() || !is_sampled(seen.point) {
                continue;
            }
            for (i, flat) in
                self.things.iter().enumerate().filter(|(_, flat)| Some(flat.plane) == plane)
            {
                if flat.is_around(flat.plane_coordinates(&seen.position).1) && !is_of(flat) {
                    around[i].push(flat.plane_coordinates(&measured()).0);
                }
            }
        }
        let mut cells = HeightCells::new();
        for (i, (mut around, own)) in (0..).zip(around.into_iter().zip(own)) {
            if around.len() < MIN_POINTS || own.len() < MIN_POINTS {
                continue;
            }
            let base_m = median(&mut around).unwrap_or(0.0);
            for (cell, height) in own {
                add_height(&mut cells, (i, cell), (height - base_m, 1));
            }
        }
        FlatHeights(cells)
    }

    /// Returns the reliefs of flat things, given the heights from all frames.
    #[must_use]
    pub fn compute_reliefs(&self, heights: FlatHeights) -> BTreeMap<InstanceId, FlatRelief> {
        let mut of_flat: Vec<Vec<f32>> = vec![Vec::new(); self.things.len()];
        for ((flat, _), (sum, count)) in
            heights.0.into_iter().filter(|(_, (_, count))| *count >= MIN_HEIGHTS)
        {
            of_flat[flat as usize].push(sum / count as f32);
        }
        let relief = |(flat, mut heights): (&FlatCandidate, Vec<f32>)| {
            if heights.len() < MIN_CELLS || median(&mut heights)? <= LEAST_M {
                return None;
            }
            let (from, to) = (quantile(&mut heights, TRIM)?, quantile(&mut heights, 1.0 - TRIM)?);
            let extent = (0..2).map(|i| flat.high[i] - flat.low[i]).fold(f32::INFINITY, f32::min);
            // Nothing floats above a floor.
            let hangs = from > HANGS_M
                && self.planes.planes[flat.plane as usize].structure != Structure::Floor;
            let span_m = (if hangs { from } else { 0.0 }, to);
            (span_m.1 - span_m.0 < THIN * extent)
                .then(|| (flat.id, FlatRelief { normal: flat.axes[0], base: flat.base, span_m }))
        };
        self.things.iter().zip(of_flat).filter_map(relief).collect()
    }
}

/// Heights of flat things above their planes.
#[derive(Debug, Default)]
pub struct FlatHeights(HeightCells);

impl FlatHeights {
    /// Adds the heights of another frame.
    pub fn merge(&mut self, other: Self) {
        other.0.into_iter().for_each(|(cell, heights)| add_height(&mut self.0, cell, heights));
    }
}

fn add_height(cells: &mut HeightCells, cell: (u32, [i32; 2]), (sum, count): (f32, u32)) {
    let heights = cells.entry(cell).or_default();
    *heights = (heights.0 + sum, heights.1 + count);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::planes::Plane;
    use crate::visibility::Visibility;
    use uniground_geometry::Isometry3;
    use uniground_geometry::boxes::Aabb;
    use uniground_geometry::scene::Intrinsics;

    const CAMERA: Intrinsics =
        Intrinsics { width: 64, height: 48, fx: 40.0, fy: 40.0, cx: 31.5, cy: 23.5 };
    const WALL_Z: f32 = 2.0;

    /// Measures a square thing in a cloud of five noisy frames that drift by up to `drift_m` in
    /// both directions. The thing's plane is two meters before a camera. Returns the relief, and
    /// the box of the thing's points in the cloud.
    fn measure_relief(
        height_m: f32,
        width_m: f32,
        structure: Structure,
        drift_m: f32,
    ) -> (Option<FlatRelief>, Aabb) {
        let camera = Camera::new(CAMERA, &Isometry3::identity());
        let (mut cloud, mut region_of, mut depths) =
            (PointCloud::default(), Vec::new(), Vec::new());
        for step in -2..=2_i32 {
            let mut depth =
                DepthImage { width: CAMERA.width, height: CAMERA.height, depth_m: Vec::new() };
            for i in 0..CAMERA.width * CAMERA.height {
                let (u, v) = ((i % CAMERA.width) as f32, (i / CAMERA.width) as f32);
                let at = CAMERA.unproject(u, v, WALL_Z);
                let on_thing = at.x.abs().max(at.y.abs()) < width_m / 2.0;
                let noise =
                    ((i as i32 * 7919 + step * 331).rem_euclid(1000) as f32 / 1000.0 - 0.5) * 0.02;
                let z = WALL_Z - if on_thing { height_m } else { 0.0 }
                    + step as f32 / 2.0 * drift_m
                    + noise;
                depth.depth_m.push(z);
                cloud.positions.push(CAMERA.unproject(u, v, z));
                region_of.push(u32::from(on_thing));
            }
            depths.push(depth);
        }
        cloud.colors = vec![[0; 3]; cloud.positions.len()];
        let superpoints = Superpoints {
            of_point: region_of.clone(),
            patches: Vec::new(),
            adjacent: Vec::new(),
            roughness_m: vec![0.005; 2],
        };
        let plane = Plane {
            structure,
            normal: Vector3::z(),
            middle: Point3::new(0.0, 0.0, WALL_Z),
            area_m2: 7.0,
        };
        let planes = Planes::new(vec![plane], vec![Some(0), None]);
        let labels = Labels::from_regions(&region_of, &superpoints, Vec::new());
        let visibility = Visibility::new(&cloud, &region_of, 0.1);
        let flats = FlatCandidates::find(
            &cloud,
            &superpoints,
            &planes,
            &labels,
            &[Point3::origin()],
            &InstanceSettings::default(),
        );
        let mut heights = FlatHeights::default();
        depths.iter().for_each(|depth| {
            heights.merge(flats.measure_heights(
                &camera,
                depth,
                &visibility.around_frame(&camera, depth),
            ));
        });
        let thing = cloud
            .positions
            .iter()
            .zip(&region_of)
            .filter(|(_, region)| **region == 1)
            .map(|(p, _)| p);
        // The wall has more points and so has the first id.
        (flats.compute_reliefs(heights).get(&InstanceId(2)).copied(), Aabb::around(thing).unwrap())
    }

    #[test]
    fn relief_of_a_picture_does_not_depend_on_drift() {
        let (relief, in_cloud) = measure_relief(0.03, 0.6, Structure::Wall, 0.04);
        let relief = relief.unwrap();
        assert!(in_cloud.size.z > 0.09, "{in_cloud:?}");
        assert!(relief.span_m.0 == 0.0 && (relief.span_m.1 - 0.03).abs() < 0.008, "{relief:?}");
        assert!((relief.base.z - WALL_Z).abs() < 0.005 && relief.normal.z == -1.0, "{relief:?}");
        let flattened = Aabb::around(&relief.flatten(&[in_cloud.min(), in_cloud.max()])).unwrap();
        assert!((flattened.size.z - relief.span_m.1).abs() < 1e-4, "{flattened:?}");
        assert!(
            (flattened.size.xy() - in_cloud.size.xy()).norm() < 1e-4,
            "the width does not change: {flattened:?}"
        );
    }

    #[test]
    fn curtains_hang_before_walls_and_nothing_floats_above_a_floor() {
        let span = |structure| measure_relief(0.1, 0.8, structure, 0.0).0.unwrap().span_m;
        let (hanging, standing) = (span(Structure::Wall), span(Structure::Floor));
        assert!((hanging.0 - 0.1).abs() < 0.01 && (hanging.1 - 0.1).abs() < 0.01, "{hanging:?}");
        assert!(standing.0 == 0.0 && (standing.1 - 0.1).abs() < 0.01, "{standing:?}");
    }

    #[test]
    fn recessed_coplanar_thick_and_distant_things_have_no_relief() {
        assert_eq!(
            measure_relief(-0.05, 0.8, Structure::Wall, 0.0).0,
            None,
            "recessed into the wall"
        );
        assert_eq!(measure_relief(0.0, 0.8, Structure::Wall, 0.0).0, None, "the wall itself");
        assert_eq!(measure_relief(0.1, 0.3, Structure::Floor, 0.0).0, None, "a shoe");
        assert_eq!(measure_relief(0.5, 0.8, Structure::Wall, 0.0).0, None, "far from the plane");
    }
}
