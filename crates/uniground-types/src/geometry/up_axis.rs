//! The up axis of a scan, and the rotation that maps it to Z.

use super::{Isometry3, Matrix3, Vector3};
use nalgebra::{Rotation3, UnitQuaternion};
use serde::{Deserialize, Serialize};

/// The axis that points up in a file. After import it is always `z`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub enum UpAxis {
    /// +X points up.
    #[serde(rename = "x")]
    X,
    /// -X points up.
    #[serde(rename = "-x")]
    NegX,
    /// +Y points up.
    #[serde(rename = "y")]
    Y,
    /// -Y points up.
    #[serde(rename = "-y")]
    NegY,
    /// +Z points up: no rotation is needed.
    #[serde(rename = "z")]
    Z,
    /// -Z points up: the scan is upside down.
    #[serde(rename = "-z")]
    NegZ,
}

impl UpAxis {
    /// All six axes, in the order in which they are tried.
    pub const ALL: [Self; 6] = [Self::X, Self::NegX, Self::Y, Self::NegY, Self::Z, Self::NegZ];

    /// Returns the name in files and requests: `x`, `-x` and so on.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::X => "x",
            Self::NegX => "-x",
            Self::Y => "y",
            Self::NegY => "-y",
            Self::Z => "z",
            Self::NegZ => "-z",
        }
    }

    /// Returns the unit vector that points up in the file's world.
    #[must_use]
    pub fn direction(self) -> Vector3<f32> {
        match self {
            Self::X => Vector3::x(),
            Self::NegX => -Vector3::x(),
            Self::Y => Vector3::y(),
            Self::NegY => -Vector3::y(),
            Self::Z => Vector3::z(),
            Self::NegZ => -Vector3::z(),
        }
    }

    /// Returns the rotation from the file's world to the Z-up world: a signed permutation of the
    /// axes.
    ///
    /// The two Y-up rotations match the paper: `y`: (x,y,z) -> (x,-z,y); `-y`: (x,y,z) -> (x,z,-y).
    #[must_use]
    pub fn to_z_up(self) -> Isometry3<f32> {
        let m = match self {
            Self::Z => return Isometry3::identity(),
            Self::NegZ => Matrix3::new(1., 0., 0., 0., -1., 0., 0., 0., -1.),
            Self::Y => Matrix3::new(1., 0., 0., 0., 0., -1., 0., 1., 0.),
            Self::NegY => Matrix3::new(1., 0., 0., 0., 0., 1., 0., -1., 0.),
            Self::X => Matrix3::new(0., 0., -1., 0., 1., 0., 1., 0., 0.),
            Self::NegX => Matrix3::new(0., 0., 1., 0., 1., 0., -1., 0., 0.),
        };
        Isometry3::from_parts(
            nalgebra::Translation3::identity(),
            UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(m)),
        )
    }

    /// Returns the axis nearest to a direction of nonzero length.
    #[must_use]
    pub fn nearest(direction: &Vector3<f32>) -> Self {
        let along = |axis: &Self| axis.direction().dot(direction);
        Self::ALL.into_iter().max_by(|a, b| along(a).total_cmp(&along(b))).unwrap_or(Self::Z)
    }

    /// Returns the axis that cameras hold upward. People hold a camera roughly level, so the
    /// image's up direction (-Y of an OpenCV camera), averaged over the path, points away from the
    /// ground. Returns `None` if no axis clearly wins.
    #[must_use]
    pub fn from_cameras(camera_to_world: &[Isometry3<f32>]) -> Option<Self> {
        let mean: Vector3<f32> =
            camera_to_world.iter().map(|pose| pose.rotation * -Vector3::y()).sum::<Vector3<f32>>();
        let mean = mean.try_normalize(1e-3 * camera_to_world.len() as f32)?;
        Self::ALL.into_iter().find(|axis| axis.direction().dot(&mean) > CLEARLY_UP)
    }
}

/// Cosine of 40 degrees, the maximum angle from an axis for a guess.
const CLEARLY_UP: f32 = 0.766;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_up_axis_is_rotated_to_z() {
        for axis in UpAxis::ALL {
            let turned = axis.to_z_up() * axis.direction();
            assert!((turned - Vector3::z()).norm() < 1e-6, "{axis:?} became {turned:?}");
        }
        let p = super::super::Point3::new(1.0, 2.0, 3.0);
        assert!(
            (UpAxis::Y.to_z_up() * p - super::super::Point3::new(1.0, -3.0, 2.0)).norm() < 1e-5
        );
        assert!(
            (UpAxis::NegY.to_z_up() * p - super::super::Point3::new(1.0, 3.0, -2.0)).norm() < 1e-5
        );
    }

    #[test]
    fn up_axis_is_estimated_only_from_level_cameras() {
        // An OpenCV camera with the identity pose looks along +Z with image-down +Y, so up is -Y.
        assert_eq!(UpAxis::from_cameras(&[Isometry3::identity()]), Some(UpAxis::NegY));
        let upside_down = Isometry3::rotation(Vector3::z() * std::f32::consts::PI);
        assert_eq!(UpAxis::from_cameras(&[Isometry3::identity(), upside_down]), None);
    }
}
