//! Where a robot can stand to see or reach a thing: what is asked and told.

use crate::answer::{CoordinateFrame, Status};
use crate::geometry::boxes::{Aabb, OrientedBox};
use crate::numbers;
use crate::placement::{FrameChoice, SceneToFrame, Stamp};
use crate::problem::FieldError;
use crate::question::check_query;
use crate::scene::{InstanceId, Support};
use serde::{Deserialize, Serialize};

/// Obstacles are known up to this height above the floor, metres: no robot is taller.
pub const MAX_HEIGHT_M: f32 = 3.0;
/// What is lower than this above the floor is no obstacle: a robot is higher.
const MIN_HEIGHT_M: f32 = 0.1;
const MAX_RADIUS_M: f32 = 2.0;
const MAX_REACH_M: f32 = 5.0;
const MAX_DISTANCE_M: f32 = 20.0;
const MAX_POSES: u32 = 20;

/// A robot as an upright cylinder on the floor.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct Robot {
    /// Of the circle around its footprint, metres.
    #[cfg_attr(feature = "openapi", schema(exclusive_minimum = 0, maximum = 2, example = 0.25))]
    pub radius_m: f32,
    /// What is higher above the floor than this it passes under, metres.
    #[cfg_attr(feature = "openapi", schema(minimum = 0.1, maximum = 3, example = 1.3))]
    pub height_m: f32,
    /// Where it sees from: above the middle of its footprint, metres above the floor, at most
    /// `height_m`.
    #[cfg_attr(feature = "openapi", schema(exclusive_minimum = 0, maximum = 3, example = 1.2))]
    pub eye_height_m: f32,
    /// How far its arm reaches out of the cylinder, metres. Left out, it only has to see the
    /// thing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(exclusive_minimum = 0, maximum = 5, example = 0.7))]
    pub reach_m: Option<f32>,
}

/// A place on the floor: metres, world frame (Z up), unless a request's `frame` says otherwise.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct FloorPoint {
    /// Metres along X.
    pub x: f64,
    /// Metres along Y.
    pub y: f64,
    /// Metres along Z: wanted where the `frame`'s Z does not point up, of no importance elsewhere.
    #[serde(default, skip_serializing_if = "is_zero")]
    #[cfg_attr(feature = "openapi", schema(default = 0))]
    pub z: f64,
}

fn is_zero(value: &f64) -> bool {
    *value == 0.0
}

/// Asks where to stand for a thing: one of `instance_id` and `query`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "openapi", schema(example = json!({
    "query": "the mug on the coffee table", "robot": {"radius_m": 0.25, "height_m": 1.3, "eye_height_m": 1.2}, "from": {"x": 0.5, "y": -1.0}
})))]
#[serde(deny_unknown_fields)]
pub struct ApproachRequest {
    /// An instance of the scene's current parse.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub instance_id: Option<InstanceId>,
    /// What to find, in plain English: answered by the built-in reasoner, and kept like any
    /// answer.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(min_length = 1, max_length = 1000))]
    pub query: Option<String>,
    /// Who is to stand there.
    pub robot: Robot,
    /// Where the robot is: poses it can not drive to are left out, and each has its path. Left
    /// out, poses lie in the largest free area near the thing that is no pocket: of half a
    /// square metre at least, unless there is no larger one anywhere.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub from: Option<FloorPoint>,
    /// Whose coordinates `from` is in, and in which poses are told beside the scene's own
    /// (`in_frame`).
    #[serde(default)]
    #[cfg_attr(feature = "openapi", schema(default = "scene"))]
    pub frame: FrameChoice,
    /// Least horizontal distance from the middle of the robot to the thing's nearest point,
    /// metres.
    #[serde(default)]
    #[cfg_attr(feature = "openapi", schema(minimum = 0, maximum = 20, default = 0))]
    pub min_distance_m: f32,
    /// Greatest horizontal distance from the middle of the robot to the thing's nearest point,
    /// metres.
    #[serde(default = "default_distance")]
    #[cfg_attr(feature = "openapi", schema(exclusive_minimum = 0, maximum = 20, default = 2.5))]
    pub max_distance_m: f32,
    /// Most poses to send back; fewer where there are not so many apart from each other.
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
    /// To an instance, with everything else at its default.
    #[must_use]
    pub fn for_instance(instance_id: InstanceId, robot: Robot) -> Self {
        Self { instance_id: Some(instance_id), ..Self::with_defaults(robot) }
    }

    /// To what a question means, with everything else at its default.
    #[must_use]
    pub fn for_query(query: impl Into<String>, robot: Robot) -> Self {
        Self { query: Some(query.into()), ..Self::with_defaults(robot) }
    }

    fn with_defaults(robot: Robot) -> Self {
        let (min_distance_m, max_distance_m, max_poses) =
            (0.0, default_distance(), default_poses());
        let frame = FrameChoice::default();
        Self {
            instance_id: None,
            query: None,
            robot,
            from: None,
            frame,
            min_distance_m,
            max_distance_m,
            max_poses,
        }
    }

    /// # Errors
    /// A [`FieldError`] naming the field.
    pub fn check(&self) -> Result<(), FieldError> {
        match (&self.instance_id, &self.query) {
            (Some(_), None) => {}
            (None, Some(query)) => check_query(query)?,
            _ => return Err(FieldError::new("", "one of instance_id and query is wanted")),
        }
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

/// Whether a height for a map of the floor makes sense.
///
/// # Errors
/// A [`FieldError`] naming the parameter.
pub fn check_map_height(height_m: f32) -> Result<(), FieldError> {
    check_height("height_m", height_m)
}

fn check_height(pointer: &str, height_m: f32) -> Result<(), FieldError> {
    numbers::check_in_range(pointer, height_m, MIN_HEIGHT_M..=MAX_HEIGHT_M)
}

/// Whether there is a place to stand.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum ApproachStatus {
    /// There is at least one: see `poses`.
    Found,
    /// There is none: `failed` says which condition left nothing.
    NonePossible,
    /// The query's answer is not `grounded`, see `answer_status`, or means several things. Nothing
    /// is driven to on a guess.
    NotGrounded,
}

/// The first condition that left no place to stand, in the order they are looked at.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum FailedCondition {
    /// `from` is no place this robot can stand, nor is any within half a metre.
    StartNotFree,
    /// Within the limits of distance no floor was seen on which nothing stands.
    NoFloor,
    /// There is floor, but obstacles leave this robot no room.
    NoRoom,
    /// There is room, but no way from `from` to where the thing is in sight and in reach.
    NotReachable,
    /// There are places, but none from which the arm reaches.
    OutOfReach,
    /// From none of the places is enough of the thing in sight.
    NotVisible,
}

/// Cells of the floor that each condition left, of those that the conditions before it had left.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct CellCounts {
    /// Within the limits of distance.
    pub near: u32,
    /// With floor, and nothing on or above it that is lower than the robot.
    pub floor: u32,
    /// No nearer to an obstacle than the robot's radius.
    pub clear: u32,
    /// In one free area with `from`; without it, in the largest near the thing that is no pocket.
    pub connected: u32,
    /// From where the arm reaches; all where no reach was given.
    pub in_reach: u32,
    /// Looked from: the clearest of every nine cells.
    pub looked_from: u32,
    /// From where enough of the thing is in sight.
    pub visible: u32,
}

/// Where the robot sets out.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Start {
    /// Where paths begin, metres, world frame: the nearest free cell to what was asked for.
    pub x: f32,
    /// Metres along Y.
    pub y: f32,
    /// How far that is from what was asked for, metres; more than a cell where `from` was not
    /// free.
    pub moved_m: f32,
    /// Whether the robot can stand where it says it is.
    pub was_free: bool,
}

/// A place to stand, facing the thing. World frame (Z up), metres.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct StandingPose {
    /// Middle of the robot's footprint, on the floor.
    pub position: [f32; 3],
    /// Direction it faces about +Z, radians; 0 looks along +X.
    pub yaw_rad: f32,
    /// What to look at: the middle of what is in sight of the thing.
    pub look_at: [f32; 3],
    /// Horizontal distance to the thing's nearest point.
    pub distance_m: f32,
    /// From the robot's cylinder to the thing's nearest point: what the arm has to reach.
    pub reach_m: f32,
    /// Share of the thing's points that nothing else hides from the eye, `0..=1`; what it hides of
    /// itself counts as seen.
    pub visible_share: f32,
    /// From the middle of the robot to the nearest obstacle; never less than the robot's radius.
    /// `null` where there is none at all.
    pub clearance_m: Option<f32>,
    /// Length of `path`; `null` without `from`.
    pub path_m: Option<f32>,
    /// From the start to here, corner by corner, straight in between; free of obstacles by the
    /// robot's radius, to within half a cell of the grid. Empty without `from`.
    pub path: Vec<[f32; 2]>,
    /// Why here, in words.
    pub why: String,
}

/// What is approached.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ApproachTarget {
    /// Numbered from 1 within the parse.
    pub id: InstanceId,
    /// What it is called.
    pub name: String,
    /// Axis-aligned box, stray points left out; metres, world frame (Z up).
    #[serde(rename = "box")]
    pub aabb: Aabb,
    /// Box turned about the vertical to fit it.
    pub oriented_box: OrientedBox,
    /// What it stands on or hangs on.
    pub support: Support,
}

/// Where to stand for a thing, best first, or why nowhere.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Approach {
    /// UUIDv7 of the scene.
    pub scene_id: String,
    /// Number of the scene's parse, from 1; instance ids belong to it.
    pub parse_version: u32,
    /// Whether there is a place to stand.
    pub status: ApproachStatus,
    /// The answer to `query`, at `/v1/answers/{id}`; `null` without one.
    pub answer_id: Option<String>,
    /// What the answer to `query` came to; `null` without one.
    pub answer_status: Option<Status>,
    /// What is approached; `null` where `not_grounded`.
    pub target: Option<ApproachTarget>,
    /// Best first: near the thing, little to drive, much of it in sight, room around.
    pub poses: Vec<StandingPose>,
    /// Where paths begin; `null` without `from`, and where it is not free.
    pub start: Option<Start>,
    /// Why there is no pose; `null` where there is one, and where `not_grounded`.
    pub failed: Option<FailedCondition>,
    /// What came of it, in words.
    pub detail: String,
    /// Cells each condition left; `null` where `not_grounded`.
    pub cells: Option<CellCounts>,
    /// Height of the floor, metres, world frame; `null` where `not_grounded`.
    pub floor_z_m: Option<f32>,
    /// The frame of all coordinates here, but those of `in_frame`.
    pub frame: CoordinateFrame,
    /// The poses in the coordinates that were asked for; `null` for the scene's own, and where
    /// `not_grounded`.
    pub in_frame: Option<PosesInFrame>,
}

/// Places to stand in other coordinates than the scene's.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PosesInFrame {
    /// `source` or `map`.
    pub frame: FrameChoice,
    /// What the map's frame is called, the scene's `map_frame_id`; `null` where nobody has said.
    pub frame_id: Option<String>,
    /// When this was told; with `frame_id` the header of a ROS message.
    pub stamp: Stamp,
    /// From the scene's coordinates to these: for everything else that is told.
    pub scene_to_frame: SceneToFrame,
    /// One for each of `poses`, in their order.
    pub poses: Vec<PlacedPose>,
}

/// A place to stand as `geometry_msgs/Pose` has it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PlacedPose {
    /// Middle of the robot's footprint, on the floor, in the frame's units.
    pub position: [f64; 3],
    /// Turns the robot's axes, X ahead and Z up, to the frame's: unit quaternion `x, y, z, w`.
    pub orientation: [f64; 4],
    /// The corners of the way, in the frame's units.
    pub path: Vec<[f64; 3]>,
}

impl PlacedPose {
    /// A place of the scene in other coordinates.
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
}

/// The map of a scene's floor, as `map_server` of ROS reads it: this JSON is YAML too. The
/// picture's upper left pixel is at the least x and the greatest y.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct FloorMap {
    /// Name of the picture beside this file.
    #[cfg_attr(feature = "openapi", schema(example = "floor.png"))]
    pub image: String,
    /// Always `trinary`: a cell is free, occupied or unknown.
    #[cfg_attr(feature = "openapi", schema(example = "trinary"))]
    pub mode: String,
    /// Side of a pixel, metres.
    pub resolution: f32,
    /// x, y and yaw of the lower left corner of the lower left pixel; metres, world frame, and
    /// radians, always 0.
    pub origin: [f32; 3],
    /// Always 0: white is free, black occupied.
    pub negate: u8,
    /// A pixel `p` is occupied where `(255 - p) / 255` is above this: black, 0.
    pub occupied_thresh: f32,
    /// A pixel `p` is free where `(255 - p) / 255` is below this: white, 254. In between it is
    /// unknown: grey, 205.
    pub free_thresh: f32,
    /// Columns of the picture.
    pub width: u32,
    /// Rows of the picture.
    pub height: u32,
    /// What is higher above the floor than this is no obstacle, metres.
    pub height_m: f32,
    /// Height of the floor, metres, world frame.
    pub floor_z_m: f32,
}

#[cfg(test)]
mod tests {
    use super::*;

    const ROBOT: Robot = Robot { radius_m: 0.25, height_m: 1.2, eye_height_m: 1.1, reach_m: None };

    #[test]
    fn wrong_requests_are_named_by_field() {
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
            (|r| (r.instance_id, r.query) = (None, Some(" ".into())), "/query"),
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
