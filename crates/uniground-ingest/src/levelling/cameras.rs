//! Estimates up from the cameras: people hold them without roll, wherever they point.

use nalgebra::SymmetricEigen;
use uniground_geometry::{Isometry3, Matrix3, Vector3};

/// The up direction according to the cameras.
#[derive(Debug, Clone, Copy)]
pub(super) struct CamerasUp {
    /// Unit vector, in the world of the poses.
    pub up: Vector3<f32>,
    /// Whether up comes from cameras without roll that look in several directions. It then does not
    /// depend on how far down they looked.
    pub by_roll: bool,
}

/// Minimum share of the second smallest spread of the cameras' right axes in the total spread, for
/// cameras that look in several directions.
const SEVERAL_SIDES: f32 = 0.12;
/// Maximum share of the smallest spread in the total spread, for cameras without roll.
const WITHOUT_ROLL: f32 = 0.06;
/// If the mean of the cameras' up axes is shorter than this, it is not used.
const SHORTEST_MEAN: f32 = 0.3;

/// Returns the up direction, or `None` when the cameras do not agree.
pub(super) fn up_from_cameras(camera_to_world: &[Isometry3<f32>]) -> Option<CamerasUp> {
    let count = camera_to_world.len().max(1) as f32;
    let mean =
        camera_to_world.iter().map(|pose| pose.rotation * -Vector3::y()).sum::<Vector3<f32>>()
            / count;
    if mean.norm() < SHORTEST_MEAN {
        return None;
    }
    let mean = mean.normalize();
    // The right axis of a camera without roll is level. Up is perpendicular to all right axes.
    let spread = camera_to_world.iter().fold(Matrix3::zeros(), |sum, pose| {
        let right = pose.rotation * Vector3::x();
        sum + right * right.transpose()
    }) / count;
    let eigen = SymmetricEigen::new(spread);
    let mut order = [0, 1, 2];
    order.sort_by(|a, b| eigen.eigenvalues[*a].total_cmp(&eigen.eigenvalues[*b]));
    let across: Vector3<f32> = eigen.eigenvectors.column(order[0]).into_owned();
    let across = if across.dot(&mean) < 0.0 { -across } else { across };
    let by_roll = eigen.eigenvalues[order[1]] > SEVERAL_SIDES
        && eigen.eigenvalues[order[0]] < WITHOUT_ROLL
        && across.dot(&mean) > 0.5;
    Some(CamerasUp { up: if by_roll { across } else { mean }, by_roll })
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::UnitQuaternion;

    /// Creates an OpenCV camera with this yaw, tilted down by `down` (radians), in a world with Z
    /// up.
    fn camera(yaw: f32, down: f32) -> Isometry3<f32> {
        let (right, forward) =
            (Vector3::new(yaw.sin(), -yaw.cos(), 0.0), Vector3::new(yaw.cos(), yaw.sin(), 0.0));
        let forward = forward * down.cos() - Vector3::z() * down.sin();
        let rotation = Matrix3::from_columns(&[right, forward.cross(&right), forward]);
        Isometry3::from_parts(
            nalgebra::Translation3::identity(),
            UnitQuaternion::from_rotation_matrix(&nalgebra::Rotation3::from_matrix_unchecked(
                rotation,
            )),
        )
    }

    #[test]
    fn cameras_without_roll_determine_up_even_if_they_look_down() {
        let poses: Vec<_> = (0..20).map(|i| camera(i as f32 * 0.1, 0.7)).collect();
        let found = up_from_cameras(&poses).unwrap();
        assert!(found.by_roll && found.up.dot(&Vector3::z()) > 0.999, "{found:?}");
    }

    #[test]
    fn tumbling_cameras_do_not_determine_up() {
        let poses: Vec<_> =
            (0..20).map(|i| camera(0.3, i as f32 * std::f32::consts::TAU / 20.0)).collect();
        assert!(up_from_cameras(&poses).is_none());
    }
}
