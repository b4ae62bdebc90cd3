//! Standing poses from which a robot can see or reach an object: requests and results.

use crate::answer::{CoordinateFrame, Status};
use crate::coverage::UnseenRegion;
use crate::geometry::boxes::{Aabb, OrientedBox};
use crate::numbers;
use crate::placement::{FrameChoice, SceneToFrame, Stamp};
use crate::problem::FieldError;
use crate::question::check_query;
use crate::scene::{InstanceId, Support};
use serde::{Deserialize, Serialize};

/// Maximum height of a robot, meters. Obstacles are mapped up to this height above the floor.
pub const MAX_HEIGHT_M: f32 = 3.0;
/// Minimum height of obstacles above the floor, meters. Anything lower is ignored.
const MIN_HEIGHT_M: f32 = 0.1;
const MAX_RADIUS_M: f32 = 2.0;
const MAX_REACH_M: f32 = 5.0;
const MAX_DISTANCE_M: f32 = 20.0;
const MAX_POSES: u32 = 20;

/// A robot, modeled as an upright cylinder on the floor.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct Robot {
    /// Radius of the circle around its footprint, meters.
    #[cfg_attr(feature = "openapi", schema(exclusive_minimum = 0, maximum = 2, example = 0.25))]
    pub radius_m: f32,
    /// Height of the robot, meters. It passes under anything higher.
    #[cfg_attr(feature = "openapi", schema(minimum = 0.1, maximum = 3, example = 1.3))]
    pub height_m: f32,
    /// Height of the camera above the floor, meters, over the center of the footprint. At most
    /// `height_m`.
    #[cfg_attr(feature = "openapi", schema(exclusive_minimum = 0, maximum = 3, example = 1.2))]
    pub eye_height_m: f32,
    /// Reach of the arm beyond the cylinder, meters. If omitted, the robot only has to see the
    /// object.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(exclusive_minimum = 0, maximum = 5, example = 0.7))]
    pub reach_m: Option<f32>,
}

/// A position on the floor, meters. World frame (Z up) unless the request sets another `frame`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct FloorPoint {
    /// X, meters.
    pub x: f64,
    /// Y, meters.
    pub y: f64,
    /// Z, meters. Required if the Z axis of `frame` does not point up, otherwise ignored. Default:
    /// 0.
    #[serde(default, skip_serializing_if = "is_zero")]
    #[cfg_attr(feature = "openapi", schema(default = 0))]
    pub z: f64,
}

fn is_zero(value: &f64) -> bool {
    *value == 0.0
}

/// A request for standing poses. Exactly one of `instance_id`, `query` and `unseen_region` is
/// required.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "openapi", schema(example = json!({
    "query": "the mug on the coffee table", "robot": {"radius_m": 0.25, "height_m": 1.3, "eye_height_m": 1.2}, "from": {"x": 0.5, "y": -1.0}
})))]
#[serde(deny_unknown_fields)]
pub struct ApproachRequest {
    /// Id of an instance of the scene's current parse.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub instance_id: Option<InstanceId>,
    /// Description of the object in English. The built-in reasoner answers it, and the answer is
    /// stored.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(min_length = 1, max_length = 1000))]
    pub query: Option<String>,
    /// Number of a part of the room that no camera saw: a region of `coverage` in an answer about the
    /// scene's current parse. Poses look at it, from at least 0.5 m away if possible.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(minimum = 1))]
    pub unseen_region: Option<u32>,
    /// Minimum confidence of the answer to `query`, `0..=1`, as in a question. Below it, no poses
    /// are computed. 0 also approaches guesses. Default: 0.7.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(minimum = 0, maximum = 1, default = 0.7))]
    pub min_confidence: Option<f32>,
    /// The robot.
    pub robot: Robot,
    /// Start position of the robot. Poses that it cannot drive to are omitted, and each pose has a
    /// path. If omitted, poses lie in the largest free area near the object of at least 0.5 square
    /// meters, or in the largest free area if none is that large.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub from: Option<FloorPoint>,
    /// Frame of `from`, and additional frame of the result (`in_frame`). Default: `scene`.
    #[serde(default)]
    #[cfg_attr(feature = "openapi", schema(default = "scene"))]
    pub frame: FrameChoice,
    /// Minimum horizontal distance from the robot's center to the object's nearest point, meters.
    /// Default: 0.
    #[serde(default)]
    #[cfg_attr(feature = "openapi", schema(minimum = 0, maximum = 20, default = 0))]
    pub min_distance_m: f32,
    /// Maximum horizontal distance from the robot's center to the object's nearest point, meters.
    /// Default: 2.5.
    #[serde(default = "default_distance")]
    #[cfg_attr(feature = "openapi", schema(exclusive_minimum = 0, maximum = 20, default = 2.5))]
    pub max_distance_m: f32,
    /// Maximum number of poses. Fewer are returned if not enough lie apart from each other.
    /// Default: 3.
    #[serde(default = "default_poses")]
    #[cfg_attr(feature = "openapi", schema(minimum = 1, maximum = 20, default = 3))]
    pub max_poses: u32,
}

fn default_distance() -> f32 {
    2.5
}

fn default_poses() -> u32 {
    3
}

impl ApproachRequest {
    /// Creates a request for an instance with default options.
    #[must_use]
    pub fn for_instance(instance_id: InstanceId, robot: Robot) -> Self {
        Self { instance_id: Some(instance_id), ..Self::with_defaults(robot) }
    }

    /// Creates a request for a query with default options.
    #[must_use]
    pub fn for_query(query: impl Into<String>, robot: Robot) -> Self {
        Self { query: Some(query.into()), ..Self::with_defaults(robot) }
    }

    /// Creates a request for an unseen part of the room with default options.
    #[must_use]
    pub fn for_unseen_region(number: u32, robot: Robot) -> Self {
        Self { unseen_region: Some(number), ..Self::with_defaults(robot) }
    }

    fn with_defaults(robot: Robot) -> Self {
        let (min_distance_m, max_distance_m, max_poses) =
            (0.0, default_distance(), default_poses());
        let frame = FrameChoice::default();
        Self {
            instance_id: None,
            query: None,
            unseen_region: None,
            min_confidence: None,
            robot,
            from: None,
            frame,
            min_distance_m,
            max_distance_m,
            max_poses,
        }
    }

    /// # Errors
    /// Returns a [`FieldError`] that names the field.
    pub fn check(&self) -> Result<(), FieldError> {
        match (&self.instance_id, &self.query, self.unseen_region) {
            (Some(_), None, None) | (None, None, Some(1..)) => {}
            (None, Some(query), None) => check_query(query)?,
            (None, None, Some(0)) => {
                return Err(FieldError::new("/unseen_region", "must be 1 or more"));
            }
            _ => {
                return Err(FieldError::new(
                    "",
                    "exactly one of instance_id, query and unseen_region is required",
                ));
            }
        }
        self.min_confidence
            .map_or(Ok(()), |least| numbers::check_in_range("/min_confidence", least, 0.0..=1.0))?;
        let Robot { radius_m, height_m, eye_height_m, reach_m } = self.robot;
        numbers::check_above_zero("/robot/radius_m", radius_m, MAX_RADIUS_M)?;
        check_height("/robot/height_m", height_m)?;
        numbers::check_above_zero("/robot/eye_height_m", eye_height_m, MAX_HEIGHT_M)?;
        if eye_height_m > height_m {
            return Err(FieldError::new("/robot/eye_height_m", "must not be above height_m"));
        }
        reach_m.map_or(Ok(()), |reach| {
            numbers::check_above_zero("/robot/reach_m", reach, MAX_REACH_M)
        })?;
        self.from.map_or(Ok(()), |FloorPoint { x, y, z }| {
            numbers::check_coordinates("/from", &[x, y, z])
        })?;
        numbers::check_above_zero("/max_distance_m", self.max_distance_m, MAX_DISTANCE_M)?;
        if !(0.0..=self.max_distance_m).contains(&self.min_distance_m) {
            return Err(FieldError::new(
                "/min_distance_m",
                "must be 0 or more, and not above max_distance_m",
            ));
        }
        match self.max_poses {
            1..=MAX_POSES => Ok(()),
            _ => Err(FieldError::new("/max_poses", format!("must be 1 to {MAX_POSES}"))),
        }
    }
}

/// Checks the height for a floor map.
///
/// # Errors
/// Returns a [`FieldError`] that names the parameter.
pub fn check_map_height(height_m: f32) -> Result<(), FieldError> {
    check_height("height_m", height_m)
}

fn check_height(pointer: &str, height_m: f32) -> Result<(), FieldError> {
    numbers::check_in_range(pointer, height_m, MIN_HEIGHT_M..=MAX_HEIGHT_M)
}

/// Whether a standing pose was found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum ApproachStatus {
    /// At least one pose was found. See `poses`.
    Found,
    /// No pose is possible. `failed` names the condition that excluded all positions.
    NonePossible,
    /// The answer to the query is not `grounded` (see `answer_status`) or refers to several
    /// objects. The service computes no poses for uncertain targets.
    NotGrounded,
}

/// The first condition that excluded all positions, in the order of checking.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum FailedCondition {
    /// The robot cannot stand at `from` or within 0.5 m of it.
    StartNotFree,
    /// No free floor was observed within the distance limits.
    NoFloor,
    /// Obstacles leave no room for this robot.
    NoRoom,
    /// No path leads from `from` to a position that sees and reaches the object.
    NotReachable,
    /// The arm does not reach the object from any position.
    OutOfReach,
    /// No position sees enough of the object.
    NotVisible,
}

/// Number of floor cells that remain after each condition.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct CellCounts {
    /// Cells within the distance limits.
    pub near: u32,
    /// Cells with observed floor and no obstacle lower than the robot.
    pub floor: u32,
    /// Cells at least the robot's radius away from obstacles.
    pub clear: u32,
    /// Cells connected to `from`, or without `from` in the largest free area near the object.
    pub connected: u32,
    /// Cells from which the arm reaches the object. All cells if no reach is given.
    pub in_reach: u32,
    /// Cells tested for visibility: the one with the most clearance in every nine cells.
    pub looked_from: u32,
    /// Cells that see enough of the object.
    pub visible: u32,
}

/// Start of the paths.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Start {
    /// X of the free cell nearest to `from`; meters, world frame.
    pub x: f32,
    /// Y of this cell; meters, world frame.
    pub y: f32,
    /// Distance of this cell from `from`, meters. Larger than a cell if `from` was not free.
    pub moved_m: f32,
    /// Whether the robot can stand at `from`.
    pub was_free: bool,
}

/// A standing pose that faces the object; meters, world frame (Z up).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct StandingPose {
    /// Center of the robot's footprint, on the floor.
    pub position: [f32; 3],
    /// Heading about +Z, radians. 0 looks along +X.
    pub yaw_rad: f32,
    /// Center of the visible part of the object.
    pub look_at: [f32; 3],
    /// Horizontal distance from the robot's center to the object's nearest point, meters.
    pub distance_m: f32,
    /// Distance from the robot's cylinder to the object's nearest point, meters. The arm must reach
    /// this far.
    pub reach_m: f32,
    /// Share of the object's points that no other object occludes from the camera, `0..=1`.
    /// Self-occlusion does not count.
    pub visible_share: f32,
    /// Distance from the robot's center to the nearest obstacle, meters. At least the robot's
    /// radius. `null` if there are no obstacles.
    pub clearance_m: Option<f32>,
    /// Length of `path`, meters. `null` without `from`.
    pub path_m: Option<f32>,
    /// Corners of the path from the start to this pose, connected by straight lines. Keeps the
    /// robot's radius from obstacles, within half a grid cell. Empty without `from`.
    pub path: Vec<[f32; 2]>,
    /// Explanation of the pose for people.
    pub why: String,
}

/// The object to approach.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ApproachTarget {
    /// Id within the parse, from 1.
    pub id: InstanceId,
    /// Name of the object.
    pub name: String,
    /// Axis-aligned box without outlier points; meters, world frame (Z up).
    #[serde(rename = "box")]
    pub aabb: Aabb,
    /// Box rotated about the vertical axis.
    pub oriented_box: OrientedBox,
    /// What the object stands on or hangs on.
    pub support: Support,
}

/// Standing poses for an object, best first, or the reason why none exists.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Approach {
    /// UUIDv7 of the scene.
    pub scene_id: String,
    /// Version of the scene's parse, from 1. Instance ids belong to it.
    pub parse_version: u32,
    /// Whether a standing pose was found.
    pub status: ApproachStatus,
    /// Id of the answer to `query`, available at `/v1/answers/{id}`. `null` without a query.
    pub answer_id: Option<String>,
    /// Status of the answer to `query`. `null` without a query.
    pub answer_status: Option<Status>,
    /// The object to approach. `null` if `not_grounded`, and for an unseen part of the room.
    pub target: Option<ApproachTarget>,
    /// The unseen part of the room to look at. Absent unless requested by `unseen_region`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unseen_region: Option<UnseenRegion>,
    /// Poses, best first: near the object, with a short path, good visibility and much clearance.
    pub poses: Vec<StandingPose>,
    /// Start of the paths. `null` without `from`, or if it is not free.
    pub start: Option<Start>,
    /// Why there is no pose. `null` if there is one, or if `not_grounded`.
    pub failed: Option<FailedCondition>,
    /// The result in words, for people.
    pub detail: String,
    /// Number of cells left after each condition. `null` if `not_grounded`.
    pub cells: Option<CellCounts>,
    /// Height of the floor; meters, world frame. `null` if `not_grounded`.
    pub floor_z_m: Option<f32>,
    /// The coordinate frame of all coordinates except those in `in_frame`.
    pub frame: CoordinateFrame,
    /// The poses in the requested frame. `null` for the scene's own frame, or if `not_grounded`.
    pub in_frame: Option<PosesInFrame>,
}

/// Standing poses in another frame than the scene's.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PosesInFrame {
    /// `source` or `map`.
    pub frame: FrameChoice,
    /// Name of the map frame: the scene's `map_frame_id`. `null` if not set.
    pub frame_id: Option<String>,
    /// Time of the response. Together with `frame_id`, it forms the header of a ROS message.
    pub stamp: Stamp,
    /// Transform from the scene's frame to this frame, for the other coordinates of the response.
    pub scene_to_frame: SceneToFrame,
    /// One pose for each of `poses`, in the same order.
    pub poses: Vec<PlacedPose>,
}

/// A standing pose in the format of `geometry_msgs/Pose`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PlacedPose {
    /// Center of the robot's footprint, on the floor, in the units of the frame.
    pub position: [f64; 3],
    /// Rotation from the robot's axes (X forward, Z up) to the frame's axes: unit quaternion `x, y,
    /// z, w`.
    pub orientation: [f64; 4],
    /// Corners of the path, in the units of the frame.
    pub path: Vec<[f64; 3]>,
}

impl PlacedPose {
    /// Transforms a pose to another frame.
    #[must_use]
    pub fn from_pose(pose: &StandingPose, scene_to_frame: &SceneToFrame) -> Self {
        let [x, y, z] = pose.position.map(f64::from);
        let corner = |[x, y]: &[f32; 2]| scene_to_frame.apply([f64::from(*x), f64::from(*y), z]);
        Self {
            position: scene_to_frame.apply([x, y, z]),
            orientation: scene_to_frame.orientation_of_yaw(f64::from(pose.yaw_rad)),
            path: pose.path.iter().map(corner).collect(),
        }
    }

    /// Returns the direction that the robot faces in the frame's XY plane, radians from X.
    #[must_use]
    pub fn yaw_rad(&self) -> f64 {
        let [x, y, z, w] = self.orientation;
        (2.0 * (w * z + x * y)).atan2(1.0 - 2.0 * (y * y + z * z))
    }
}

/// Metadata of a scene's floor map in the format of the ROS `map_server`. The JSON is also valid
/// YAML. The upper left pixel has the smallest x and the largest y.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct FloorMap {
    /// File name of the image next to this file.
    #[cfg_attr(feature = "openapi", schema(example = "floor.png"))]
    pub image: String,
    /// Always `trinary`: a cell is free, occupied or unknown.
    #[cfg_attr(feature = "openapi", schema(example = "trinary"))]
    pub mode: String,
    /// Size of a pixel, meters.
    pub resolution: f32,
    /// x, y and yaw of the lower left corner of the lower left pixel; meters and radians, world
    /// frame. The yaw is always 0.
    pub origin: [f32; 3],
    /// Always 0: white is free and black is occupied.
    pub negate: u8,
    /// A pixel `p` is occupied if `(255 - p) / 255` is above this value. Occupied pixels are black,
    /// 0.
    pub occupied_thresh: f32,
    /// A pixel `p` is free if `(255 - p) / 255` is below this value. Free pixels are white, 254.
    /// Unknown pixels are gray, 205.
    pub free_thresh: f32,
    /// Width of the image, pixels.
    pub width: u32,
    /// Height of the image, pixels.
    pub height: u32,
    /// Maximum height of obstacles above the floor, meters. Anything higher is ignored.
    pub height_m: f32,
    /// Height of the floor; meters, world frame.
    pub floor_z_m: f32,
}

#[cfg(test)]
mod tests {
    use super::*;

    const ROBOT: Robot = Robot { radius_m: 0.25, height_m: 1.2, eye_height_m: 1.1, reach_m: None };

    #[test]
    fn the_yaw_of_a_placed_pose_follows_its_frame() {
        let half = 65.0_f64.to_radians();
        let placed = PlacedPose {
            position: [0.0; 3],
            orientation: [0.0, 0.0, half.sin(), half.cos()],
            path: Vec::new(),
        };
        assert!((placed.yaw_rad() - 130.0_f64.to_radians()).abs() < 1e-9);
    }

    #[test]
    fn errors_of_invalid_requests_name_the_field() {
        let good = ApproachRequest::for_instance(InstanceId(1), ROBOT);
        assert_eq!(good.check(), Ok(()));
        let with = |change: fn(&mut ApproachRequest)| {
            let mut request = good.clone();
            change(&mut request);
            request.check().unwrap_err().pointer
        };
        for (change, pointer) in [
            ((|r| r.instance_id = None) as fn(&mut ApproachRequest), ""),
            (|r| r.query = Some("the mug".into()), ""),
            (|r| r.unseen_region = Some(1), ""),
            (|r| (r.instance_id, r.unseen_region) = (None, Some(0)), "/unseen_region"),
            (|r| (r.instance_id, r.query) = (None, Some(" ".into())), "/query"),
            (|r| r.min_confidence = Some(1.1), "/min_confidence"),
            (|r| r.min_confidence = Some(f32::NAN), "/min_confidence"),
            (|r| r.robot.radius_m = 0.0, "/robot/radius_m"),
            (|r| r.robot.height_m = 3.1, "/robot/height_m"),
            (|r| r.robot.height_m = 0.05, "/robot/height_m"),
            (|r| r.robot.height_m = f32::NAN, "/robot/height_m"),
            (|r| r.robot.eye_height_m = 1.3, "/robot/eye_height_m"),
            (|r| r.robot.reach_m = Some(-1.0), "/robot/reach_m"),
            (|r| r.from = Some(FloorPoint { x: f64::INFINITY, ..FloorPoint::default() }), "/from"),
            (|r| r.from = Some(FloorPoint { z: f64::NAN, ..FloorPoint::default() }), "/from"),
            (|r| r.max_distance_m = 0.0, "/max_distance_m"),
            (|r| r.min_distance_m = 3.0, "/min_distance_m"),
            (|r| r.max_poses = 0, "/max_poses"),
        ] {
            assert_eq!(with(change), pointer);
        }
    }
}
