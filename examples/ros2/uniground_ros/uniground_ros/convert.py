"""Answers as messages: plain functions, no node and no middleware.

Boxes of answers and places to stand are in the scan's world: metres, Z up, turned about the vertical. Messages are in the map's frame;
`Placed` says how the one lies in the other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from geometry_msgs.msg import Pose, PoseStamped
from nav_msgs.msg import Path
from vision_msgs.msg import Detection3D, Detection3DArray, ObjectHypothesisWithPose
from visualization_msgs.msg import Marker, MarkerArray

from uniground import models

GREEN, YELLOW, BLUE = (0.0, 0.6, 0.25), (0.9, 0.7, 0.0), (0.15, 0.35, 0.8)
COLORS = {"grounded": GREEN, "uncertain": YELLOW, "ambiguous": BLUE}
LABEL_HEIGHT_M = 0.12
# As in Nav2: from this occupancy on a cell of a map is an obstacle. Below 0 nobody has seen it.
OCCUPIED = 65


@dataclass(frozen=True)
class Placed:
    """A frame in another: what `tf2` tells, as numbers to compute with."""

    rotation: np.ndarray
    translation: np.ndarray

    @classmethod
    def of(cls, stamped) -> Placed:
        """Of a `geometry_msgs/TransformStamped`."""
        q, t = stamped.transform.rotation, stamped.transform.translation
        return cls(rotation_of([q.x, q.y, q.z, q.w]), np.array([t.x, t.y, t.z]))

    @classmethod
    def told(cls, scene_to_frame: models.SceneToFrame) -> Placed:
        """As the service tells it; maps are in metres, so nothing is scaled."""
        return cls(rotation_of(scene_to_frame.rotation), np.array(scene_to_frame.translation))

    @property
    def yaw_rad(self) -> float:
        """Where its X axis points, about +Z."""
        return math.atan2(self.rotation[1, 0], self.rotation[0, 0])

    def place(self, point) -> np.ndarray:
        return self.rotation @ np.asarray(point) + self.translation


class FloorGrid(NamedTuple):
    """What a `nav_msgs/OccupancyGrid` knows of the floor."""

    cells: np.ndarray
    """Occupancy in percent, -1 unknown; rows along Y, columns along X of the grid's own axes."""
    resolution: float
    """Side of a cell, metres."""
    origin: Placed
    """How the grid's lower left corner lies in its frame."""
    frame_id: str

    @classmethod
    def of(cls, grid) -> FloorGrid:
        info, q, t = grid.info, grid.info.origin.orientation, grid.info.origin.position
        cells = np.array(grid.data, dtype=np.int8).reshape(info.height, info.width)
        origin = Placed(rotation_of([q.x, q.y, q.z, q.w]), np.array([t.x, t.y, t.z]))
        return cls(cells, float(info.resolution), origin, grid.header.frame_id)

    def obstacle(self, point, radius_m: float) -> str | None:
        """Why a robot cannot stand at a point of the grid's frame; `None` where it can. Cells that nobody has seen are no obstacle."""
        x, y = (self.origin.rotation.T @ (np.asarray(point) - self.origin.translation))[:2] / self.resolution
        height, width = self.cells.shape
        if not (0 <= x < width and 0 <= y < height):
            return "it is outside the robot's map"
        reach = radius_m / self.resolution + 1
        left, lower = max(0, int(x - reach)), max(0, int(y - reach))
        rows, columns = np.nonzero(self.cells[lower : int(y + reach) + 1, left : int(x + reach) + 1] >= OCCUPIED)
        # To the nearest point of each occupied cell.
        apart = [np.maximum(np.abs(cells + 0.5 - at) - 0.5, 0) for cells, at in ((columns + left, x), (rows + lower, y))]
        off = np.hypot(*apart) * self.resolution
        nearest = off.min(initial=np.inf)
        return f"the robot's map has an obstacle {nearest:.2f} m away" if nearest <= radius_m else None


@dataclass(frozen=True)
class Found:
    """One thing that an answer means, or may mean."""

    id: int
    name: str
    confidence: float
    box: models.Aabb | models.OrientedBox


def found(answer: models.Answer) -> list[Found]:
    """What is meant; where the question is ambiguous, each thing it may mean."""
    if answer.status != "ambiguous":
        return [Found(one.id, one.name, one.confidence, one.oriented_box) for one in answer.targets]
    names = answer.answer.candidate_names
    return [Found(one.id, names.get(str(one.id), ""), one.confidence, one.box) for one in answer.alternatives]


def detections(answer: models.Answer, scan: Placed, header) -> Detection3DArray:
    """`docs/guides/robot.md` has this as a table."""
    array = Detection3DArray(header=header)
    for one in found(answer):
        detection = Detection3D(header=header, id=f"{answer.scene_id}/{answer.parse_version}/{one.id}")
        detection.bbox.center = box_pose(one.box, scan)
        detection.bbox.size.x, detection.bbox.size.y, detection.bbox.size.z = map(float, one.box.size)
        hypothesis = ObjectHypothesisWithPose()
        hypothesis.hypothesis.class_id = one.name
        hypothesis.hypothesis.score = float(one.confidence)
        hypothesis.pose.pose = box_pose(one.box, scan)
        detection.results.append(hypothesis)
        array.detections.append(detection)
    return array


def markers(answer: models.Answer, scan: Placed, header) -> MarkerArray:
    """A box and a label per thing, for RViz: green what is meant, yellow a guess, blue what may be. The last answer's vanish."""
    array = MarkerArray(markers=[Marker(header=header, action=Marker.DELETEALL)])
    for number, one in enumerate(found(answer)):
        color = COLORS.get(answer.status, BLUE)
        cube = Marker(header=header, ns="boxes", id=number, type=Marker.CUBE, pose=box_pose(one.box, scan))
        cube.scale.x, cube.scale.y, cube.scale.z = map(float, one.box.size)
        label = Marker(header=header, ns="names", id=number, type=Marker.TEXT_VIEW_FACING, pose=box_pose(one.box, scan))
        label.text, label.scale.z = f"{one.name} {one.confidence:.2f}", LABEL_HEIGHT_M
        label.pose.position.z += float(one.box.size[2]) / 2 + LABEL_HEIGHT_M
        for marker, opacity in ((cube, 0.4), (label, 1.0)):
            marker.color.r, marker.color.g, marker.color.b = color
            marker.color.a = opacity
            array.markers.append(marker)
    return array


def stand(pose: models.StandingPose, scan: Placed, header) -> PoseStamped:
    """A place to stand that the service has found."""
    return PoseStamped(header=header, pose=upright(pose.position, pose.yaw_rad, scan))


def path(pose: models.StandingPose, scan: Placed, header) -> Path:
    """The way there, corner by corner, each facing the next."""
    z = pose.position[2]
    legs = zip(pose.path, pose.path[1:])
    poses = [upright([x, y, z], math.atan2(to_y - y, to_x - x), scan) for (x, y), (to_x, to_y) in legs]
    poses.append(upright(pose.position, pose.yaw_rad, scan))
    return Path(header=header, poses=[PoseStamped(header=header, pose=one) for one in poses])


def goal(box, around, scan: Placed, robot: Placed, standoff_m: float, header) -> PoseStamped:
    """Where to stand: on the line from the thing to the robot, `standoff_m` off the thing and what it stands on, facing it.

    `around` are the boxes of what carries it: in front of a table, not in it. What else stands in the way is for the planner to know.
    A robot that is near enough only turns.
    """
    target, here = scan.place(box.center), robot.translation
    away = here[:2] - target[:2]
    distance = float(np.linalg.norm(away))
    if distance > 0:
        direction = away / distance
        # The same direction in the scan's world, where the boxes are.
        in_scan = scan.rotation[:2, :2].T @ direction
        rim = max(way_out(one, np.asarray(box.center)[:2], in_scan) for one in [box, *around])
        distance = min(distance, rim + standoff_m)
    else:
        direction = np.array([-1.0, 0.0])
    stand = target[:2] + direction * distance
    pose = Pose()
    pose.position.x, pose.position.y, pose.position.z = float(stand[0]), float(stand[1]), float(here[2])
    turn(pose, math.atan2(-direction[1], -direction[0]))
    return PoseStamped(header=header, pose=pose)


def way_out(box, start: np.ndarray, direction: np.ndarray) -> float:
    """How far it is from a point along a direction until the box's footprint lies behind; 0 where it is not in the way."""
    turned = box.rotation()[:2, :2].T
    at, along, half = turned @ (start - np.asarray(box.center)[:2]), turned @ direction, np.asarray(box.size)[:2] / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        enter, leave = np.sort(np.stack([(-half - at) / along, (half - at) / along]), axis=0)
    # Along an axis that the direction does not go, the footprint is either never left or never met.
    still = along == 0
    enter = np.where(still, np.where(np.abs(at) <= half, -np.inf, np.inf), enter)
    leave = np.where(still, np.inf, leave)
    return float(max(0.0, leave.min())) if enter.max() <= leave.min() else 0.0


def box_pose(box, scan: Placed) -> Pose:
    """The box's centre and axes, in the map's frame."""
    return upright(box.center, getattr(box, "yaw_rad", 0.0), scan)


def upright(point, yaw_rad: float, scan: Placed) -> Pose:
    """What stands upright in the scan's world, in the map's frame."""
    pose = Pose()
    pose.position.x, pose.position.y, pose.position.z = map(float, scan.place(point))
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    set_orientation(pose, scan.rotation @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))
    return pose


def rotation_of(quaternion) -> np.ndarray:
    """A quaternion x, y, z, w as a matrix."""
    x, y, z, w = np.asarray(quaternion) / np.linalg.norm(quaternion)
    rotation = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rotation)


def turn(pose: Pose, yaw_rad: float) -> None:
    pose.orientation.z, pose.orientation.w = math.sin(yaw_rad / 2), math.cos(yaw_rad / 2)


def set_orientation(pose: Pose, rotation: np.ndarray) -> None:
    """A rotation matrix as a quaternion, by its largest component: exact wherever the map's axes point."""
    m = rotation
    squares = np.array([1 + m[0, 0] - m[1, 1] - m[2, 2], 1 - m[0, 0] + m[1, 1] - m[2, 2], 1 - m[0, 0] - m[1, 1] + m[2, 2], 1 + np.trace(m)])
    rows = [
        [squares[0], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[2, 1] - m[1, 2]],
        [m[0, 1] + m[1, 0], squares[1], m[1, 2] + m[2, 1], m[0, 2] - m[2, 0]],
        [m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], squares[2], m[1, 0] - m[0, 1]],
        [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], squares[3]],
    ]
    q = np.array(rows[int(squares.argmax())])
    # Of the two that turn alike the one with a positive w, as the service tells them.
    q = math.copysign(1.0, q[3]) * q / np.linalg.norm(q)
    pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w = map(float, q)
