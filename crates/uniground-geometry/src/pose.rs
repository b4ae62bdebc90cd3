//! Rigid transforms read from untrusted files.

use super::{Isometry3, MAX_COORDINATE_M, Matrix3, Matrix4, Vector3};
use nalgebra::{Rotation3, Translation3, UnitQuaternion};

/// Why a 4x4 matrix is not a pose.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[allow(missing_docs)] // Every message describes its variant.
pub enum PoseError {
    #[error("pose has a value that is not finite")]
    NotFinite,
    #[error(
        "pose is not a rigid transform (determinant {determinant:.3}, deviation from orthonormal {deviation:.3})"
    )]
    NotRigid { determinant: f32, deviation: f32 },
    #[error(
        "pose is {kilometres:.0} km from the origin; the limit is 10 km: subtract an offset from the whole scan first"
    )]
    TooFar { kilometres: f32 },
}

/// Largest entry of `RᵀR - I` that still counts as a rounding error of a text file.
const ORTHONORMAL_TOLERANCE: f32 = 0.02;

/// Converts a row-major 4x4 matrix to a rigid transform. Corrects small rounding errors.
///
/// # Errors
/// Returns [`PoseError`] when an entry is not finite, the upper 3x3 block is not a rotation, or the
/// position is too far away.
pub fn rigid(matrix: &Matrix4<f32>) -> Result<Isometry3<f32>, PoseError> {
    if matrix.iter().any(|v| !v.is_finite()) {
        return Err(PoseError::NotFinite);
    }
    let rotation: Matrix3<f32> = matrix.fixed_view::<3, 3>(0, 0).into_owned();
    let translation: Vector3<f32> = matrix.fixed_view::<3, 1>(0, 3).into_owned();
    let deviation = (rotation.transpose() * rotation - Matrix3::identity()).abs().max();
    let determinant = rotation.determinant();
    if deviation > ORTHONORMAL_TOLERANCE || determinant < 0.0 {
        return Err(PoseError::NotRigid { determinant, deviation });
    }
    if translation.norm() > MAX_COORDINATE_M {
        return Err(PoseError::TooFar { kilometres: translation.norm() / 1000.0 });
    }
    let rotation =
        UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
    let rotation = UnitQuaternion::new_normalize(rotation.into_inner());
    Ok(Isometry3::from_parts(Translation3::from(translation), rotation))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Point3;
    use proptest::prelude::*;

    #[test]
    fn non_finite_mirrored_and_scaled_matrices_are_refused() {
        let mut lost = Matrix4::<f32>::identity();
        lost[(0, 3)] = f32::NEG_INFINITY;
        assert_eq!(rigid(&lost), Err(PoseError::NotFinite));
        let mirrored = Matrix4::from_diagonal(&nalgebra::Vector4::new(-1.0, 1.0, 1.0, 1.0));
        assert!(matches!(rigid(&mirrored), Err(PoseError::NotRigid { .. })));
        let scaled = Matrix4::from_diagonal(&nalgebra::Vector4::new(2.0, 2.0, 2.0, 1.0));
        assert!(matches!(rigid(&scaled), Err(PoseError::NotRigid { .. })));
    }

    proptest! {
        #[test]
        fn poses_rounded_to_four_decimals_are_accepted(axis in prop::array::uniform3(-1.0_f32..1.0), angle in -3.1_f32..3.1, t in prop::array::uniform3(-9.0_f32..9.0)) {
            prop_assume!(Vector3::from(axis).norm() > 0.1);
            let exact = Isometry3::new(Vector3::from(t), Vector3::from(axis).normalize() * angle);
            let rounded = exact.to_homogeneous().map(|v| (v * 1e4).round() / 1e4);
            let read = rigid(&rounded).unwrap();
            let p = Point3::new(0.3, -2.0, 1.5);
            prop_assert!((read * p - exact * p).norm() < 1e-2);
        }
    }
}
