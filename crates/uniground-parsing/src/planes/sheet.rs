//! Flat pieces: the plane of one superpoint, and connected parts of larger planes.

use super::{CELL_M, SAME_NORMAL};
use std::collections::{BTreeMap, BTreeSet};
use uniground_geometry::least_axis::least_axis;
use uniground_geometry::moments::Moments;
use uniground_geometry::scene::PointCloud;
use uniground_geometry::{Matrix3, Point3, Vector3};

/// The plane of one superpoint.
pub(super) struct SuperpointPlane {
    pub(super) area_m2: f32,
    pub(super) middle: Point3<f32>,
    pub(super) normal: Vector3<f32>,
}

/// A connected part of a plane.
pub(super) struct PlanePart {
    pub(super) normal: Vector3<f32>,
    pub(super) middle: Point3<f32>,
    /// Two directions in the plane: level and the steepest; for a level plane, X and Y.
    pub(super) along: Vector3<f32>,
    pub(super) up: Vector3<f32>,
    /// Occupied cells along both.
    pub(super) cells: BTreeSet<(i32, i32)>,
}

impl PlanePart {
    pub(super) fn area_m2(&self) -> f32 {
        self.cells.len() as f32 * CELL_M * CELL_M
    }

    pub(super) fn is_level(&self) -> bool {
        self.normal.z.abs() > SAME_NORMAL
    }

    pub(super) fn is_upright(&self) -> bool {
        self.normal.z.abs() < 0.2
    }

    pub(super) fn cell(&self, p: &Point3<f32>) -> (i32, i32) {
        let d = p - self.middle;
        ((d.dot(&self.along) / CELL_M).floor() as i32, (d.dot(&self.up) / CELL_M).floor() as i32)
    }

    /// Returns whether a point, projected, falls on the sheet or next to it.
    pub(super) fn covers(&self, p: &Point3<f32>) -> bool {
        let (a, b) = self.cell(p);
        (-1..=1).any(|i| (-1..=1).any(|j| self.cells.contains(&(a + i, b + j))))
    }

    pub(super) fn distance(&self, p: &Point3<f32>) -> f32 {
        (p - self.middle).dot(&self.normal)
    }
}

impl SuperpointPlane {
    pub(super) fn of(cloud: &PointCloud, points: &[u32]) -> Self {
        let positions: Vec<_> = points.iter().map(|&i| cloud.positions[i as usize]).collect();
        let Moments { mean, covariance } = Moments::from_points(&positions);
        let (_, normal) = least_axis(&covariance);
        let cells: BTreeSet<(i32, i32)> = {
            let sheet = PlanePart {
                normal,
                middle: mean,
                along: any_perpendicular(&normal),
                up: normal.cross(&any_perpendicular(&normal)),
                cells: BTreeSet::new(),
            };
            const FINE: f32 = 4.0;
            positions.iter().map(|p| sheet.cell(&(mean + (p - mean) * FINE))).collect()
        };
        Self { area_m2: cells.len() as f32 * (CELL_M / 4.0).powi(2), middle: mean, normal }
    }
}

/// Returns some unit vector at a right angle to this one.
pub(super) fn any_perpendicular(normal: &Vector3<f32>) -> Vector3<f32> {
    let axis = if normal.x.abs() < 0.6 { Vector3::x() } else { Vector3::y() };
    normal.cross(&axis).normalize()
}

/// Fits a plane through patches, weighted by area, using their centers and normals.
pub(super) fn fit<'a>(
    patches: impl Iterator<Item = &'a SuperpointPlane>,
) -> (Vector3<f32>, Point3<f32>) {
    let (mut spread, mut middle, mut area) =
        (Matrix3::zeros(), nalgebra::Vector3::<f64>::zeros(), 0.0_f64);
    for patch in patches {
        spread += patch.normal * patch.normal.transpose() * patch.area_m2;
        middle += patch.middle.coords.cast::<f64>() * f64::from(patch.area_m2);
        area += f64::from(patch.area_m2);
    }
    let eigen = nalgebra::SymmetricEigen::new(spread);
    let normal = eigen.eigenvectors.column(eigen.eigenvalues.imax()).into_owned();
    (normal, Point3::from((middle / area.max(1e-9)).cast::<f32>()))
}

/// Groups cells no farther from each other than `gap`, measured by the largest coordinate.
pub(super) fn connected_components(
    cells: &BTreeSet<(i32, i32)>,
    gap: i32,
) -> Vec<BTreeSet<(i32, i32)>> {
    // On a grid as coarse as the gap, neighbors are within it.
    let coarse = |&(a, b): &(i32, i32)| (a.div_euclid(gap), b.div_euclid(gap));
    let mut left: BTreeMap<(i32, i32), Vec<(i32, i32)>> = BTreeMap::new();
    cells.iter().for_each(|cell| left.entry(coarse(cell)).or_default().push(*cell));
    let mut groups = Vec::new();
    while let Some((first, cells)) = left.pop_first() {
        let mut group: BTreeSet<(i32, i32)> = cells.into_iter().collect();
        let mut open = vec![first];
        while let Some((a, b)) = open.pop() {
            for key in (-1..=1).flat_map(|i| (-1..=1).map(move |j| (a + i, b + j))) {
                if let Some(cells) = left.remove(&key) {
                    group.extend(cells);
                    open.push(key);
                }
            }
        }
        groups.push(group);
    }
    groups
}
