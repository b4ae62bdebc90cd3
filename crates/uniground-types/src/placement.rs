//! Other coordinates than the scene's: those of the files that were uploaded, and those of
//! somebody's map. And who stands there.

use crate::geometry::boxes::OrientedBox;
use crate::numbers;
use crate::problem::FieldError;
use crate::scene::{InstanceId, SourceToScene};
use nalgebra::{Matrix3, Quaternion, Rotation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

/// Whose coordinates a question and its answer's boxes are in. The scene's own are told in any
/// case.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum FrameChoice {
    /// The scene's: metres, Z up.
    #[default]
    Scene,
    /// Those of the files that were uploaded, in their units (`import.source_to_scene`).
    Source,
    /// Those of the map that the scene lies in (`scene_to_map`).
    Map,
}

/// Somebody who stands in the room.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct Observer {
    /// Metres, world frame (Z up), unless a question's `frame` says otherwise.
    pub position: [f64; 3],
    /// Direction of view about +Z, radians; 0 looks along +X.
    pub yaw_rad: f32,
}

/// Where a scene lies in somebody's map: `map = rotation * scene + translation_m`, in metres on
/// both sides.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct SceneToMap {
    /// Unit quaternion `x, y, z, w`, as ROS has it.
    #[cfg_attr(feature = "openapi", schema(example = json!([0.0, 0.0, 0.0, 1.0])))]
    pub rotation: [f64; 4],
    /// Metres, in the map's axes.
    #[cfg_attr(feature = "openapi", schema(example = json!([1.5, -2.0, 0.0])))]
    pub translation_m: [f64; 3],
}

/// How far from 1 the length of a quaternion may be that somebody has rounded.
const ROUNDED: f64 = 1e-3;

impl SceneToMap {
    /// # Errors
    /// A [`FieldError`] below `/scene_to_map`.
    pub fn check(&self) -> Result<(), FieldError> {
        let length = self.rotation.iter().map(|v| v * v).sum::<f64>().sqrt();
        if !(length.is_finite() && (length - 1.0).abs() <= ROUNDED) {
            return Err(FieldError::new(
                "/scene_to_map/rotation",
                "it must be a unit quaternion x, y, z, w",
            ));
        }
        numbers::check_coordinates("/scene_to_map/translation_m", &self.translation_m)
    }
}

/// From a scene's coordinates to others: `other = scale * rotation * scene + translation`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct SceneToFrame {
    /// Unit quaternion `x, y, z, w`.
    pub rotation: [f64; 4],
    /// In units of the other coordinates.
    pub translation: [f64; 3],
    /// Units of the other coordinates to a metre; 1 for maps.
    pub scale: f64,
}

/// The boxes of an answer in the coordinates that were asked for.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct InFrame {
    /// `source` or `map`.
    pub frame: FrameChoice,
    /// What the map's frame is called, the scene's `map_frame_id`; `null` where nobody has said.
    pub frame_id: Option<String>,
    /// When this was told; with `frame_id` the header of a ROS message. Absent in answers given
    /// before it was.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stamp: Option<Stamp>,
    /// From the scene's coordinates to these: for everything else the answer tells.
    pub scene_to_frame: SceneToFrame,
    /// One for each of `targets`, in their order.
    pub boxes: Vec<PlacedBox>,
}

/// A moment, as `builtin_interfaces/Time` has it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Stamp {
    /// Seconds since 1970, UTC.
    pub sec: i64,
    /// Nanoseconds on top.
    pub nanosec: u32,
}

/// A box anyhow turned. As `vision_msgs/BoundingBox3D` has it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PlacedBox {
    /// The instance it is of.
    pub id: InstanceId,
    /// Centre, in the frame's units.
    pub center: [f64; 3],
    /// Full extent along the box's own axes, in the frame's units.
    pub size: [f64; 3],
    /// Turns the box's own axes to the frame's: unit quaternion `x, y, z, w`.
    pub orientation: [f64; 4],
}

impl SceneToFrame {
    /// Into the map a scene lies in.
    #[must_use]
    pub fn scene_to_map(to_map: &SceneToMap) -> Self {
        Self {
            rotation: from_unit_quaternion(&to_unit_quaternion(to_map.rotation)),
            translation: to_map.translation_m,
            scale: 1.0,
        }
    }

    /// Back into the files a scene was made of.
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

    /// A point of the scene in these coordinates.
    #[must_use]
    pub fn apply(&self, scene: [f64; 3]) -> [f64; 3] {
        (to_unit_quaternion(self.rotation) * Vector3::from(scene) * self.scale
            + Vector3::from(self.translation))
        .into()
    }

    /// A point of these coordinates in the scene.
    #[must_use]
    pub fn invert(&self, other: [f64; 3]) -> [f64; 3] {
        (to_unit_quaternion(self.rotation).inverse()
            * ((Vector3::from(other) - Vector3::from(self.translation)) / self.scale))
            .into()
    }

    /// A box of the scene in these coordinates.
    #[must_use]
    pub fn transform_box(&self, id: InstanceId, of: &OrientedBox) -> PlacedBox {
        PlacedBox {
            id,
            center: self.apply(of.center.coords.map(f64::from).into()),
            size: (of.size.map(f64::from) * self.scale).into(),
            orientation: self.orientation_of_yaw(f64::from(of.yaw_rad)),
        }
    }

    /// Turns the axes of what stands upright in the scene, turned by an angle about its Z, to these
    /// coordinates: unit quaternion `x, y, z, w`.
    #[must_use]
    pub fn orientation_of_yaw(&self, yaw_rad: f64) -> [f64; 4] {
        from_unit_quaternion(
            &(to_unit_quaternion(self.rotation)
                * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw_rad)),
        )
    }

    /// Somebody who stands in these coordinates, in the scene. Where they are tilted, the direction
    /// of view is that seen from above.
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

/// As `x, y, z, w`, of the two that turn alike the one with a positive `w`.
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
    fn a_map_turned_by_a_quarter_has_things_where_a_robot_finds_them() {
        // The scene's X is the map's Y.
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
        // Who looks along the map's Y looks along the scene's X.
        let observer =
            map.observer_to_scene(&Observer { position: [10.0, 1.0, 1.5], yaw_rad: FRAC_PI_2 });
        assert!(
            near(observer.position, [1.0, 0.0, 1.0], 1e-5) && observer.yaw_rad.abs() < 1e-6,
            "{observer:?}"
        );
    }

    #[test]
    fn files_in_millimetres_with_y_up_get_their_own_coordinates_back() {
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
    fn what_is_no_rotation_is_refused() {
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
        /// The corners of a box are where the corners of the placed one are.
        #[test]
        fn a_placed_box_is_the_same_box(q in prop::array::uniform4(-1.0..1.0_f64), t in prop::array::uniform3(-1e3..1e3_f64), yaw in -0.7..0.7_f32) {
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
