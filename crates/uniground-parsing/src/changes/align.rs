//! Aligns one scan with another: iterative closest points from an initial guess (Chen and Medioni
//! 1992, point to plane).

use super::overlap::NearestPoints;
use nalgebra::{Matrix6, Translation3, UnitQuaternion, Vector6};
use rayon::prelude::*;
use uniground_geometry::least_axis::least_axis;
use uniground_geometry::progress::{Cancelled, Progress};
use uniground_geometry::scene::PointCloud;
use uniground_geometry::voxels::VoxelGrid;
use uniground_geometry::{Isometry3, Matrix3, Point3, Vector3};

/// Maximum distances between corresponding points, meters: used one after the other, each for a
/// number of iterations.
const REACHES_M: [f32; 4] = [0.6, 0.3, 0.15, 0.06];
const ROUNDS: usize = 12;
/// Maximum number of points used from either cloud.
const POINTS: usize = 40_000;
/// A point whose distance to the plane exceeds this share of the reach belongs to something that
/// changed, and is ignored.
const OUTLIER: f32 = 0.5;
/// Radius in which points are taken to fit a surface, meters.
const SURFACE_M: f32 = 0.1;
/// Two points within this distance count as the same place, meters.
pub const SAME_PLACE_M: f32 = 0.05;

/// The alignment of one scan with another.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Alignment {
    /// Transform from the first scan's coordinates to the second's.
    pub place: Isometry3<f32>,
    /// Share of the first scan's points with a point of the second within 5 cm.
    pub overlap: f32,
    /// Root mean square distance of these points to the second scan's surfaces, meters.
    pub rms_m: f32,
}

/// Aligns `from` with `to`, starting at an initial guess. With `refine` off, only measures the
/// guess.
///
/// # Errors
/// [`Cancelled`].
pub fn align(
    from: &PointCloud,
    to: &PointCloud,
    guess: &Isometry3<f32>,
    refine: bool,
    progress: &Progress,
) -> Result<Alignment, Cancelled> {
    let (from, to) = (sample_points(from), sample_points(to));
    let surfaces = OrientedPoints::estimate(&to);
    let mut place = *guess;
    for reach_m in REACHES_M.into_iter().filter(|_| refine) {
        let nearest = NearestPoints::new(&to, reach_m);
        for _ in 0..ROUNDS {
            progress.check()?;
            let Some(step) = surfaces.solve_step(&from, &nearest, &place) else { break };
            place = step * place;
            if step.translation.vector.norm() < 1e-5 && step.rotation.angle() < 1e-5 {
                break;
            }
        }
    }
    let nearest = NearestPoints::new(&to, SAME_PLACE_M);
    let off: Vec<f32> = from
        .par_iter()
        .filter_map(|p| surfaces.signed_distance(&(place * p), &nearest))
        .map(|(off_m, _)| off_m)
        .collect();
    let rms_m = (off.iter().map(|m| m * m).sum::<f32>() / off.len().max(1) as f32).sqrt();
    Ok(Alignment { place, overlap: off.len() as f32 / from.len().max(1) as f32, rms_m })
}

fn sample_points(cloud: &PointCloud) -> Vec<Point3<f32>> {
    cloud.positions.iter().step_by(cloud.len().div_ceil(POINTS).max(1)).copied().collect()
}

/// Points with the normals of the surfaces they lie on.
struct OrientedPoints<'a> {
    points: &'a [Point3<f32>],
    normals: Vec<Vector3<f32>>,
}

impl<'a> OrientedPoints<'a> {
    fn estimate(points: &'a [Point3<f32>]) -> Self {
        let by_voxel = VoxelGrid::new(points, SURFACE_M);
        let mut sums = vec![(0.0_f32, Vector3::zeros()); by_voxel.len()];
        for (p, &voxel) in points.iter().zip(&by_voxel.of_point) {
            let (count, sum) = &mut sums[voxel as usize];
            *count += 1.0;
            *sum += p.coords;
        }
        let mut scatter = vec![Matrix3::zeros(); by_voxel.len()];
        for (p, &voxel) in points.iter().zip(&by_voxel.of_point) {
            let (count, sum) = sums[voxel as usize];
            let d = p.coords - sum / count;
            scatter[voxel as usize] += d * d.transpose();
        }
        let normals: Vec<Vector3<f32>> =
            scatter.par_iter().map(|scatter| least_axis(scatter).1).collect();
        Self {
            points,
            normals: by_voxel.of_point.iter().map(|&voxel| normals[voxel as usize]).collect(),
        }
    }

    /// Returns the signed distance from a point to the surface at its nearest point, and the normal
    /// there.
    fn signed_distance(
        &self,
        p: &Point3<f32>,
        nearest: &NearestPoints,
    ) -> Option<(f32, Vector3<f32>)> {
        let at = nearest.nearest_to(p)? as usize;
        Some(((p - self.points[at]).dot(&self.normals[at]), self.normals[at]))
    }

    /// Computes the motion that brings the points nearer to their surfaces; `None` where too few
    /// points have a surface near.
    fn solve_step(
        &self,
        from: &[Point3<f32>],
        nearest: &NearestPoints,
        place: &Isometry3<f32>,
    ) -> Option<Isometry3<f32>> {
        const FEWEST: usize = 100;
        let partners: Vec<(Point3<f32>, f32, Vector3<f32>)> = from
            .par_iter()
            .map(|p| place * p)
            .filter_map(|p| {
                self.signed_distance(&p, nearest).map(|(off_m, normal)| (p, off_m, normal))
            })
            .filter(|(_, off_m, _)| off_m.abs() <= OUTLIER * nearest.within_m)
            .collect();
        if partners.len() < FEWEST {
            return None;
        }
        // Rotation about the center is best conditioned against translation.
        let middle =
            partners.iter().map(|(p, ..)| p.coords).sum::<Vector3<f32>>() / partners.len() as f32;
        let (mut normal_matrix, mut right) = (Matrix6::<f64>::zeros(), Vector6::<f64>::zeros());
        for (p, off_m, normal) in &partners {
            let turn = (p.coords - middle).cross(normal);
            let row =
                Vector6::new(turn.x, turn.y, turn.z, normal.x, normal.y, normal.z).cast::<f64>();
            normal_matrix += row * row.transpose();
            right -= row * f64::from(*off_m);
        }
        // In a corridor, motion along its axis is not determined: damping keeps the position there.
        normal_matrix += Matrix6::identity() * (1e-6 * normal_matrix.trace());
        let solved = normal_matrix.cholesky()?.solve(&right).cast::<f32>();
        let turn = UnitQuaternion::from_scaled_axis(Vector3::new(solved[0], solved[1], solved[2]));
        let step = Vector3::new(solved[3], solved[4], solved[5]);
        let about = Translation3::from(middle + step) * turn * Translation3::from(-middle);
        Some(about)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a corner of a room with a box in it.
    fn corner() -> PointCloud {
        let mut positions = Vec::new();
        for i in 0..80 {
            for j in 0..80 {
                let (a, b) = (i as f32 * 0.04, j as f32 * 0.04);
                positions.extend([
                    Point3::new(a, b, 0.0),
                    Point3::new(a, 0.0, b),
                    Point3::new(0.0, a, b),
                ]);
            }
        }
        for i in 0..20 {
            for j in 0..20 {
                let (a, b) = (i as f32 * 0.03, j as f32 * 0.03);
                positions.extend([
                    Point3::new(1.0 + a, 1.5 + b, 0.6),
                    Point3::new(1.0 + a, 1.5, b),
                    Point3::new(1.0, 1.5 + a, b),
                ]);
            }
        }
        PointCloud { colors: vec![[0; 3]; positions.len()], positions }
    }

    #[test]
    fn alignment_recovers_a_known_transform() {
        let room = corner();
        let truth = Isometry3::new(Vector3::new(0.12, -0.2, 0.05), Vector3::new(0.02, -0.01, 0.12));
        let other = PointCloud {
            positions: room.positions.iter().map(|p| truth * p).collect(),
            ..room.clone()
        };
        let found =
            align(&room, &other, &Isometry3::identity(), true, &Progress::silent()).unwrap();
        let off = truth.inverse() * found.place;
        assert!(off.translation.vector.norm() < 0.01 && off.rotation.angle() < 0.005, "{off:?}");
        assert!(found.overlap > 0.99 && found.rms_m < 0.005, "{found:?}");
        let as_guessed =
            align(&room, &other, &Isometry3::identity(), false, &Progress::silent()).unwrap();
        assert_eq!(as_guessed.place, Isometry3::identity());
        assert!(as_guessed.overlap < 0.7, "{as_guessed:?}");
    }

    #[test]
    fn scans_of_different_places_do_not_overlap() {
        let room = corner();
        let far = PointCloud {
            positions: room.positions.iter().map(|p| p + Vector3::new(50.0, 0.0, 0.0)).collect(),
            ..room.clone()
        };
        let found = align(&room, &far, &Isometry3::identity(), true, &Progress::silent()).unwrap();
        assert_eq!((found.overlap, found.place), (0.0, Isometry3::identity()));
    }
}
