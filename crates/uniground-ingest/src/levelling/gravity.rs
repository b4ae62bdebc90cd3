//! Finds the direction that most surfaces are level or upright with (after Gupta, Arbelaez and
//! Malik, CVPR 2013).
//!
//! From a first guess, surfaces that are nearly level and nearly upright are separated. The
//! direction that fits both best is the next guess. The first cones are wide, the later ones
//! narrow.

use super::surfaces::SurfacePatch;
use nalgebra::SymmetricEigen;
use uniground_geometry::{Matrix3, Vector3};

/// How well a direction fits the surfaces.
#[derive(Debug, Clone, Copy)]
pub(super) struct UpFit {
    /// Unit vector.
    pub up: Vector3<f32>,
    /// Share of the surfaces within [`CLOSE_DEG`] of level, by area.
    pub level: f32,
    /// Share of the surfaces within [`CLOSE_DEG`] of upright, by area.
    pub upright: f32,
    /// How clearly it is a single direction and not a range of them, `0..=1`. With a single wall,
    /// upright is ambiguous.
    pub clearness: f32,
}

impl UpFit {
    /// Returns the share of the surfaces that the direction explains.
    pub fn explained_share(&self) -> f32 {
        self.level + self.upright
    }
}

/// Maximum angle to level or upright, degrees.
pub(super) const CLOSE_DEG: f32 = 7.0;
/// Widths of the cones, degrees. Each is used a few times.
const CONES_DEG: [f32; 4] = [40.0, 20.0, 10.0, 5.0];
const ROUNDS: usize = 6;

/// Returns the direction nearest to a guess that best explains the surfaces, with the guess's sign.
/// `widest_deg` is the maximum error of the guess.
pub(super) fn refine(surfaces: &[SurfacePatch], guess: &Vector3<f32>, widest_deg: f32) -> UpFit {
    let mut up = *guess;
    for cone_deg in CONES_DEG.into_iter().filter(|cone| *cone <= widest_deg) {
        for _ in 0..ROUNDS {
            let Some(next) = refine_once(surfaces, &up, cone_deg) else { break };
            up = next;
        }
    }
    measure(surfaces, &up)
}

/// Performs one step. Returns `None` where no surface lies within the cone.
fn refine_once(
    surfaces: &[SurfacePatch],
    up: &Vector3<f32>,
    cone_deg: f32,
) -> Option<Vector3<f32>> {
    let (matrix, weight) = scatter_matrix(surfaces, up, cone_deg);
    if weight <= 0.0 {
        return None;
    }
    let eigen = SymmetricEigen::new(matrix);
    let next: Vector3<f32> = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned();
    Some(if next.dot(up) < 0.0 { -next } else { next })
}

/// Accumulates the scatter matrix. Upright normals are perpendicular to the direction, level ones
/// are parallel to it. The direction is the axis with the smallest eigenvalue of upright scatter
/// minus level scatter.
fn scatter_matrix(
    surfaces: &[SurfacePatch],
    up: &Vector3<f32>,
    cone_deg: f32,
) -> (Matrix3<f32>, f32) {
    let (level, upright) = (cone_deg.to_radians().cos(), cone_deg.to_radians().sin());
    let mut matrix = nalgebra::Matrix3::<f64>::zeros();
    let mut weight = 0.0;
    for surface in surfaces {
        let along = surface.normal.dot(up).abs();
        let sign = if along > level {
            -1.0
        } else if along < upright {
            1.0
        } else {
            continue;
        };
        let n = surface.normal.cast::<f64>();
        matrix += n * n.transpose() * (sign * f64::from(surface.weight));
        weight += surface.weight;
    }
    (matrix.cast(), weight)
}

/// Measures how well a direction explains the surfaces.
pub(super) fn measure(surfaces: &[SurfacePatch], up: &Vector3<f32>) -> UpFit {
    let (at_least, at_most) = (CLOSE_DEG.to_radians().cos(), CLOSE_DEG.to_radians().sin());
    let total = surfaces.iter().map(|s| s.weight).sum::<f32>().max(f32::MIN_POSITIVE);
    let share = |counts: &dyn Fn(f32) -> bool| {
        let counted = surfaces.iter().filter(|s| counts(s.normal.dot(up).abs()));
        counted.map(|s| s.weight).sum::<f32>() / total
    };
    let (matrix, weight) = scatter_matrix(surfaces, up, CLOSE_DEG);
    let mut eigenvalues: Vec<f32> =
        SymmetricEigen::new(matrix).eigenvalues.iter().copied().collect();
    eigenvalues.sort_by(f32::total_cmp);
    let clearness = if weight > 0.0 { (eigenvalues[1] - eigenvalues[0]) / weight } else { 0.0 };
    UpFit {
        up: *up,
        level: share(&|along| along > at_least),
        upright: share(&|along| along < at_most),
        clearness,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use uniground_geometry::Point3;

    /// Creates a floor, two walls, and surfaces that face in any direction.
    fn room(turn: &nalgebra::UnitQuaternion<f32>) -> Vec<SurfacePatch> {
        let mut surfaces = Vec::new();
        let mut push = |normal: Vector3<f32>, weight| {
            surfaces.push(SurfacePatch { normal: turn * normal, at: Point3::origin(), weight });
        };
        for i in 0..200 {
            let shake = |k: i32| ((i * 37 + k * 101) % 21 - 10) as f32 * 0.004;
            push(Vector3::new(shake(0), shake(1), 1.0).normalize(), 1.0);
            push(Vector3::new(1.0, shake(2), shake(3)).normalize(), 0.8);
            push(Vector3::new(shake(4), 1.0, shake(5)).normalize(), 0.5);
            let any = Vector3::new(shake(6) * 25.0, shake(7) * 25.0, shake(8) * 25.0 + 0.01);
            push(any.normalize(), 0.3);
        }
        surfaces
    }

    proptest! {
        #[test]
        fn up_of_a_room_tilted_by_less_than_38_degrees_is_found(axis in prop::array::uniform2(-1.0_f32..1.0), tilt_deg in 0.0_f32..38.0) {
            let axis = Vector3::new(axis[0], axis[1], 0.0);
            prop_assume!(axis.norm() > 0.1);
            let turn = nalgebra::UnitQuaternion::new(axis.normalize() * tilt_deg.to_radians());
            let found = refine(&room(&turn), &Vector3::z(), 40.0);
            let off = found.up.dot(&(turn * Vector3::z())).clamp(-1.0, 1.0).acos().to_degrees();
            prop_assert!(off < 1.0, "{off} degrees off at a tilt of {tilt_deg}: {found:?}");
            prop_assert!(found.explained_share() > 0.6 && found.clearness > 0.1, "{found:?}");
        }
    }

    #[test]
    fn up_is_ambiguous_for_a_single_wall() {
        let wall: Vec<SurfacePatch> = (0..100)
            .map(|_| SurfacePatch { normal: Vector3::x(), at: Point3::origin(), weight: 1.0 })
            .collect();
        assert!(refine(&wall, &Vector3::z(), 40.0).clearness < 0.01);
    }
}
