//! Transforms between the scene's frame, the frame of the uploaded files and the frame of a map,
//! and the observer of a question.

use crate::geometry::boxes::OrientedBox;
use crate::numbers;
use crate::problem::FieldError;
use crate::scene::{InstanceId, SourceToScene};
use nalgebra::{Matrix3, Quaternion, Rotation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

/// Frame of a question's observer, and additional frame of the answer's boxes. Boxes in the scene's
/// frame are always returned.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum FrameChoice {
    /// The scene's frame: meters, Z up.
    #[default]
    Scene,
    /// The frame of the uploaded files, in their units (`import.source_to_scene`).
    Source,
    /// The frame of the scene's map (`scene_to_map`).
    Map,
}

/// An observer in the room.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct Observer {
    /// Position, meters. World frame (Z up) unless the question sets another `frame`.
    pub position: [f64; 3],
    /// View direction about +Z, radians. 0 looks along +X.
    pub yaw_rad: f32,
}

/// Transform from the scene to a map: `map = rotation * scene + translation_m`, with meters in both
/// frames.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct SceneToMap {
    /// Unit quaternion `x, y, z, w`, in the order of ROS.
    #[cfg_attr(feature = "openapi", schema(example = json!([0.0, 0.0, 0.0, 1.0])))]
    pub rotation: [f64; 4],
    /// Translation in the map's axes, meters.
    #[cfg_attr(feature = "openapi", schema(example = json!([1.5, -2.0, 0.0])))]
    pub translation_m: [f64; 3],
}

/// Tolerance for the length of a quaternion, which may be rounded.
const ROUNDED: f64 = 1e-3;

impl SceneToMap {
    /// # Errors
    /// Returns a [`FieldError`] below `/scene_to_map`.
    pub fn check(&self) -> Result<(), FieldError> {
        let length = self.rotation.iter().map(|v| v * v).sum::<f64>().sqrt();
        if !(length.is_finite() && (length - 1.0).abs() <= ROUNDED) {
            return Err(FieldError::new(
                "/scene_to_map/rotation",
                "must be a unit quaternion x, y, z, w",
            ));
        }
        numbers::check_coordinates("/scene_to_map/translation_m", &self.translation_m)
    }
}

/// Transform from the scene to another frame: `other = scale * rotation * scene + translation`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct SceneToFrame {
    /// Unit quaternion `x, y, z, w`.
    pub rotation: [f64; 4],
    /// Translation in the units of the other frame.
    pub translation: [f64; 3],
    /// Units of the other frame per meter. 1 for maps.
    pub scale: f64,
}

/// The boxes of an answer in the requested frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct InFrame {
    /// `source` or `map`.
    pub frame: FrameChoice,
    /// Name of the map frame: the scene's `map_frame_id`. `null` if not set.
    pub frame_id: Option<String>,
    /// Time of the answer. Together with `frame_id`, it forms the header of a ROS message. Absent
    /// in answers from older versions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stamp: Option<Stamp>,
    /// Transform from the scene's frame to this frame, for the other coordinates of the answer.
    pub scene_to_frame: SceneToFrame,
    /// One box for each of `targets`, in the same order.
    pub boxes: Vec<PlacedBox>,
}

/// A time in the format of `builtin_interfaces/Time`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Stamp {
    /// Seconds since 1970, UTC.
    pub sec: i64,
    /// Nanoseconds within the second.
    pub nanosec: u32,
}

/// A box with any orientation, in the format of `vision_msgs/BoundingBox3D`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PlacedBox {
    /// Id of the instance.
    pub id: InstanceId,
    /// Center, in the units of the frame.
    pub center: [f64; 3],
    /// Full extent along the box's own axes, in the units of the frame.
    pub size: [f64; 3],
    /// Rotation from the box's axes to the frame's axes: unit quaternion `x, y, z, w`.
    pub orientation: [f64; 4],
}

impl SceneToFrame {
    /// Returns the transform to a scene's map.
    #[must_use]
    pub fn scene_to_map(to_map: &SceneToMap) -> Self {
        Self {
            rotation: from_unit_quaternion(&to_unit_quaternion(to_map.rotation)),
            translation: to_map.translation_m,
            scale: 1.0,
        }
    }

    /// Returns the transform to the uploaded files.
    #[must_use]
    pub fn scene_to_source(from_source: &SourceToScene) -> Self {
        let rotation = Matrix3::from_fn(|row, column| from_source.rotation[row][column]);
        let back = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(
            rotation.transpose(),
        ));
        Self {
            rotation: from_unit_quaternion(&back),
            translation: from_source.invert([0.0; 3]),
            scale: 1.0 / from_source.metres_per_unit,
        }
    }

    /// Transforms a point from the scene to the other frame.
    #[must_use]
    pub fn apply(&self, scene: [f64; 3]) -> [f64; 3] {
        (to_unit_quaternion(self.rotation) * Vector3::from(scene) * self.scale
            + Vector3::from(self.translation))
        .into()
    }

    /// Transforms a point from the other frame to the scene.
    #[must_use]
    pub fn invert(&self, other: [f64; 3]) -> [f64; 3] {
        (to_unit_quaternion(self.rotation).inverse()
            * ((Vector3::from(other) - Vector3::from(self.translation)) / self.scale))
            .into()
    }

    /// Transforms a box from the scene to the other frame.
    #[must_use]
    pub fn transform_box(&self, id: InstanceId, of: &OrientedBox) -> PlacedBox {
        PlacedBox {
            id,
            center: self.apply(of.center.coords.map(f64::from).into()),
            size: (of.size.map(f64::from) * self.scale).into(),
            orientation: self.orientation_of_yaw(f64::from(of.yaw_rad)),
        }
    }

    /// Returns the rotation of an upright object with a yaw in the scene, as a unit quaternion `x,
    /// y, z, w` in the other frame.
    #[must_use]
    pub fn orientation_of_yaw(&self, yaw_rad: f64) -> [f64; 4] {
        from_unit_quaternion(
            &(to_unit_quaternion(self.rotation)
                * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw_rad)),
        )
    }

    /// Transforms an observer from the other frame to the scene. If the frames are tilted, projects
    /// the view direction to the floor plane.
    #[must_use]
    pub fn observer_to_scene(&self, other: &Observer) -> Observer {
        let yaw = f64::from(other.yaw_rad);
        let looks =
            to_unit_quaternion(self.rotation).inverse() * Vector3::new(yaw.cos(), yaw.sin(), 0.0);
        Observer { position: self.invert(other.position), yaw_rad: looks.y.atan2(looks.x) as f32 }
    }
}

fn to_unit_quaternion([x, y, z, w]: [f64; 4]) -> UnitQuaternion<f64> {
    UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z))
}

/// Returns the quaternion as `x, y, z, w`, with the sign that makes `w` positive.
fn from_unit_quaternion(turn: &UnitQuaternion<f64>) -> [f64; 4] {
    let sign = if turn.w < 0.0 { -1.0 } else { 1.0 };
    [turn.i, turn.j, turn.k, turn.w].map(|v| sign * v + 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point3;
    use proptest::prelude::*;
    use std::f32::consts::FRAC_PI_2;

    fn near<const N: usize>(a: [f64; N], b: [f64; N], within: f64) -> bool {
        a.iter().zip(b).all(|(a, b)| (a - b).abs() <= within)
    }

    const S: f64 = std::f64::consts::FRAC_1_SQRT_2;

    #[test]
    fn points_boxes_and_observers_are_transformed_to_a_rotated_map() {
        // The scene's X axis is the map's Y axis.
        let map = SceneToFrame::scene_to_map(&SceneToMap {
            rotation: [0.0, 0.0, S, S],
            translation_m: [10.0, 0.0, 0.5],
        });
        assert!(near(map.apply([1.0, 0.0, 0.0]), [10.0, 1.0, 0.5], 1e-12));
        let turned = OrientedBox {
            center: Point3::new(1.0, 2.0, 0.0),
            size: nalgebra::Vector3::new(2.0, 1.0, 0.5),
            yaw_rad: 0.0,
        };
        let placed = map.transform_box(InstanceId(3), &turned);
        assert!(
            near(placed.center, [8.0, 1.0, 0.5], 1e-6)
                && near(placed.orientation, [0.0, 0.0, S, S], 1e-6),
            "{placed:?}"
        );
        // The map's Y direction is the scene's X direction.
        let observer =
            map.observer_to_scene(&Observer { position: [10.0, 1.0, 1.5], yaw_rad: FRAC_PI_2 });
        assert!(
            near(observer.position, [1.0, 0.0, 1.0], 1e-5) && observer.yaw_rad.abs() < 1e-6,
            "{observer:?}"
        );
    }

    #[test]
    fn scene_to_source_returns_the_coordinates_of_y_up_files_in_millimeters() {
        let source = SourceToScene {
            rotation: [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]],
            translation_m: [-500_000.0, 2.0, 0.0],
            metres_per_unit: 0.001,
        };
        let back = SceneToFrame::scene_to_source(&source);
        assert!(near(
            back.apply(source.apply([500_000_123.0, 40.0, -7.0])),
            [500_000_123.0, 40.0, -7.0],
            1e-4
        ));
        let placed = back.transform_box(
            InstanceId(1),
            &OrientedBox {
                center: Point3::origin(),
                size: nalgebra::Vector3::new(1.0, 2.0, 3.0),
                yaw_rad: 0.0,
            },
        );
        assert!(near(placed.size, [1000.0, 2000.0, 3000.0], 1e-9), "{placed:?}");
    }

    #[test]
    fn invalid_scene_to_map_transforms_are_rejected() {
        let map = |rotation, x| {
            SceneToMap { rotation, translation_m: [x, 0.0, 0.0] }
                .check()
                .map_err(|error| error.pointer)
        };
        assert_eq!(map([0.0, 0.0, 0.6, 0.8001], 0.0), Ok(()));
        assert_eq!(map([0.0; 4], 0.0), Err("/scene_to_map/rotation".to_owned()));
        assert_eq!(map([f64::NAN, 0.0, 0.0, 1.0], 0.0), Err("/scene_to_map/rotation".to_owned()));
        assert_eq!(
            map([0.0, 0.0, 0.0, 1.0], f64::INFINITY),
            Err("/scene_to_map/translation_m".to_owned())
        );
    }

    proptest! {
        #[test]
        fn transformed_boxes_have_the_transformed_corners(q in prop::array::uniform4(-1.0..1.0_f64), t in prop::array::uniform3(-1e3..1e3_f64), yaw in -0.7..0.7_f32) {
            prop_assume!(q.iter().map(|v| v * v).sum::<f64>() > 0.1);
            let length = q.iter().map(|v| v * v).sum::<f64>().sqrt();
            let map = SceneToFrame::scene_to_map(&SceneToMap { rotation: q.map(|v| v / length), translation_m: t });
            let of = OrientedBox { center: Point3::new(1.0, -2.0, 0.5), size: nalgebra::Vector3::new(2.0, 1.0, 0.5), yaw_rad: yaw };
            let placed = map.transform_box(InstanceId(1), &of);
            let own = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), f64::from(yaw));
            let half = of.size.map(f64::from) / 2.0;
            let corner = map.apply((own * half + of.center.coords.map(f64::from)).into());
            let again = to_unit_quaternion(placed.orientation) * (Vector3::from(placed.size) / 2.0) + Vector3::from(placed.center);
            prop_assert!(near(corner, again.into(), 1e-9));
            prop_assert!(near(map.invert(corner), (own * half + of.center.coords.map(f64::from)).into(), 1e-9));
        }
    }
}
