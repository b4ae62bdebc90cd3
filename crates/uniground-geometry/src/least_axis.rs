//! The direction in which a set of points spreads least: the normal of the plane through them.

use super::{Matrix3, Vector3};
use nalgebra::SymmetricEigen;

/// Returns the smallest eigenvalue of a symmetric positive semi-definite matrix, and its unit
/// eigenvector.
///
/// The closed form (Smith 1961) is an order of magnitude faster than iteration. Degenerate
/// matrices, whose smallest eigenvalue is not unique, are solved by iteration.
#[must_use]
pub fn least_axis(matrix: &Matrix3<f32>) -> (f32, Vector3<f32>) {
    let a = matrix.cast::<f64>();
    let mean = a.trace() / 3.0;
    let shifted = a - nalgebra::Matrix3::identity() * mean;
    let spread = (shifted.norm_squared() / 6.0).sqrt();
    let half_det = (shifted.determinant() / (2.0 * spread.powi(3))).clamp(-1.0, 1.0);
    let least = mean + 2.0 * spread * (half_det.acos() / 3.0 + std::f64::consts::TAU / 3.0).cos();
    // The eigenvector is orthogonal to every row of A - lambda I: the longest cross product of two
    // rows.
    let rest = a - nalgebra::Matrix3::identity() * least;
    let rows = [rest.row(0).transpose(), rest.row(1).transpose(), rest.row(2).transpose()];
    let crosses = [rows[0].cross(&rows[1]), rows[1].cross(&rows[2]), rows[2].cross(&rows[0])];
    let longest = crosses
        .iter()
        .fold(crosses[0], |best, c| if c.norm_squared() > best.norm_squared() { *c } else { best });
    let clear = longest.norm() > 1e-6 * spread * spread;
    if clear && least.is_finite() {
        return (least.max(0.0) as f32, (longest / longest.norm()).cast());
    }
    let eigen = SymmetricEigen::new(*matrix);
    let axis = eigen.eigenvalues.imin();
    (eigen.eigenvalues[axis].max(0.0), eigen.eigenvectors.column(axis).into_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn closed_form_agrees_with_iteration(points in prop::collection::vec(prop::array::uniform3(-1.0_f32..1.0), 4..30), flat in 0.0_f32..1.0) {
            let scatter = points.iter().map(|p| Vector3::new(p[0], p[1], p[2] * flat)).fold(Matrix3::zeros(), |sum, p| sum + p * p.transpose());
            let (value, axis) = least_axis(&scatter);
            let expected = SymmetricEigen::new(scatter).eigenvalues.min();
            prop_assert!((value - expected.max(0.0)).abs() <= 1e-4 * scatter.trace(), "{} against {}", value, expected);
            prop_assert!((axis.norm() - 1.0).abs() < 1e-4);
            prop_assert!((scatter * axis - axis * value).norm() <= 1e-3 * scatter.trace());
        }
    }

    #[test]
    fn degenerate_matrices_have_a_unit_axis() {
        for diagonal in [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 1.0], [2.0, 2.0, 0.0]] {
            let (value, axis) = least_axis(&Matrix3::from_diagonal(&Vector3::from(diagonal)));
            assert!(
                (axis.norm() - 1.0).abs() < 1e-5 && value <= diagonal[2],
                "{diagonal:?}: {value} {axis}"
            );
        }
    }
}
