"""A node that asks a uniground server where things are, and tells the robot in its own messages."""

from __future__ import annotations

import dataclasses
import json
from typing import NamedTuple

import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid, Path
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.time import Time
from std_msgs.msg import Header, String
from std_srvs.srv import Trigger
from tf2_ros import Buffer, TransformException, TransformListener
from uniground_interfaces.srv import Ground
from vision_msgs.msg import Detection3DArray
from visualization_msgs.msg import MarkerArray

from uniground import Client, Scene, UnigroundError, models
from uniground_ros import convert
from uniground_ros.convert import FloorGrid, Placed
from uniground_ros.navigation import Navigator

# How many things may lie on one another: a mug on a tray on a table.
MOST_SUPPORTS = 5
# Places to stand that the service is asked for where the robot's own map may rule some out.
MOST_PLACES = 10
# What is no higher than this, a rug, can be driven on.
FLAT_M = 0.15


class Frames(NamedTuple):
    """Whose coordinates a question and its answer are in."""

    choice: models.FrameChoice
    """What the service calls the coordinates that it is asked in."""
    asked_in: str
    """What tf2 calls them."""
    told_in: str
    """The frame of messages, as tf2 calls it."""
    scan: Placed | None
    """How the scan lies in that frame; `None` where each answer tells."""


class Grounding(Node):
    """Service `~/ground` and topic `~/question` in; `~/detections`, `~/markers`, `~/goal`, `~/path` and `~/answer` out.

    Goals keep off what the robot's own map has (`map_topic`), and are driven to by Nav2 where `navigate` is set: `~/navigation` tells
    how that goes, `~/cancel` ends it.

    Address and key come from `UNIGROUND_SERVER` and `UNIGROUND_API_KEY`; the key is no parameter, since everybody may read those.
    """

    def __init__(self) -> None:
        super().__init__("uniground")
        for name, default in {
            "server": "",
            "scene_id": "",
            "map_frame": "map",
            "scan_frame": "scan",
            "robot_frame": "base_link",
            # The robot as a cylinder: with it the service finds the goal. Without a radius the node does, and does not know the room.
            "robot_radius_m": 0.0,
            "robot_height_m": 0.0,
            "eye_height_m": 0.0,
            "reach_m": 0.0,
            "standoff_m": 0.6,
            "min_confidence": 0.7,
            "timeout_s": 10.0,
            # What the robot itself knows of the floor, a map or a costmap; empty: goals are not checked.
            "map_topic": "map",
            # Whether Nav2 drives to every goal.
            "navigate": False,
            "navigate_action": "navigate_to_pose",
        }.items():
            self.declare_parameter(name, default)
        self.client = Client(self.value("server") or None)
        self.transforms = Buffer()
        self.listener = TransformListener(self.transforms, self)

        # Whoever looks later, RViz for one, still gets the last answer.
        kept = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.detections = self.create_publisher(Detection3DArray, "~/detections", kept)
        self.markers = self.create_publisher(MarkerArray, "~/markers", kept)
        self.answers = self.create_publisher(String, "~/answer", kept)
        # A goal that is kept would be driven to again.
        self.goals = self.create_publisher(PoseStamped, "~/goal", 1)
        self.paths = self.create_publisher(Path, "~/path", 1)
        # Questions may take seconds; transforms must come in meanwhile.
        group = ReentrantCallbackGroup()
        self.create_service(Ground, "~/ground", self.on_request, callback_group=group)
        self.create_subscription(String, "~/question", self.on_question, 1, callback_group=group)
        self.grid: FloorGrid | None = None
        if self.value("map_topic"):
            self.create_subscription(OccupancyGrid, self.value("map_topic"), self.on_map, kept, callback_group=group)
        self.navigator: Navigator | None = None
        if self.value("navigate"):
            self.states = self.create_publisher(String, "~/navigation", kept)
            self.navigator = Navigator(self, self.value("navigate_action"), group, self.on_navigation)
            self.create_service(Trigger, "~/cancel", self.on_cancel, callback_group=group)

    def value(self, name: str):
        return self.get_parameter(name).value

    def on_question(self, question: String) -> None:
        """A question without a reply: `ros2 topic pub --once`. What comes out is published."""
        self.on_request(Ground.Request(query=question.data, as_seen_by_robot=True), Ground.Response())

    def on_request(self, request: Ground.Request, response: Ground.Response) -> Ground.Response:
        try:
            self.answer(request, response)
        except UnigroundError as error:
            response.status, response.explanation = error.code, error.detail
        except TransformException as error:
            response.status, response.explanation = "no_transform", str(error)
        self.get_logger().info(f"{request.query}: {response.status}. {response.explanation}")
        if response.goal_reason and not response.has_goal:
            self.get_logger().warning(f"no goal: {response.goal_reason}")
        return response

    def on_map(self, grid: OccupancyGrid) -> None:
        self.grid = FloorGrid.of(grid)

    def on_navigation(self, state: str) -> None:
        self.states.publish(String(data=state))
        # Two lines: rclpy lets a line of code log with one severity only.
        if state in ("unavailable", "rejected", "aborted"):
            self.get_logger().warning(f"Nav2: goal {state}")
        else:
            self.get_logger().info(f"Nav2: goal {state}")

    def on_cancel(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = self.navigator.cancel()
        response.message = "goal canceled" if response.success else "there is no goal"
        return response

    def answer(self, request: Ground.Request, response: Ground.Response) -> None:
        # Asked for each question: somebody may have said anew where the scene lies.
        scene = self.parsed_scene()
        frames = self.frames(scene)
        options: models.GroundOptions = {
            "frame": frames.choice,
            "min_confidence": self.value("min_confidence"),
            "timeout_s": self.value("timeout_s"),
        }
        if request.as_seen_by_robot:
            robot = self.placed(frames.asked_in, self.value("robot_frame"))
            options["observer"] = {"position": robot.translation.tolist(), "yaw_rad": robot.yaw_rad}
        answer = scene.ask(request.query, **options)
        scan = Placed.told(answer.in_frame.scene_to_frame) if answer.in_frame else frames.scan

        # By the robot's own clock, which may be a simulation's; `in_frame.stamp` is the server's.
        header = Header(stamp=self.get_clock().now().to_msg(), frame_id=frames.told_in)
        response.status, response.explanation = answer.status, answer.answer.explanation
        response.answer_json = json.dumps(dataclasses.asdict(answer))
        response.detections = convert.detections(answer, scan, header)
        self.detections.publish(response.detections)
        self.markers.publish(convert.markers(answer, scan, header))
        self.answers.publish(String(data=response.answer_json))
        # A guess, several things or none: ask the person back, drive nowhere.
        if answer.status != "grounded":
            return
        if len(answer.targets) > 1:
            response.goal_reason = f"{len(answer.targets)} things are meant"
            return
        try:
            self.tell_goal(scene, answer.targets[0], frames, scan, header, response)
        except (TransformException, UnigroundError) as error:
            # The answer holds all the same.
            response.goal_reason = str(error)

    def tell_goal(
        self, scene: Scene, target: models.Target, frames: Frames, scan: Placed, header: Header, response: Ground.Response
    ) -> None:
        if not self.value("robot_radius_m"):
            here = self.placed(frames.told_in, self.value("robot_frame"))
            around = supports(scene, target.id)
            goal = convert.goal(target.oriented_box, around, scan, here, self.value("standoff_m"), header)
            if obstacle := self.obstacle(goal):
                response.goal_reason = f"not on the straight line to the robot: {obstacle}"
                return
            response.goal = goal
            response.goal_reason = "on the straight line to the robot: walls and furniture are not looked at, robot_radius_m is not set"
        else:
            here = self.placed(frames.asked_in, self.value("robot_frame"))
            most = 1 if self.grid is None else MOST_PLACES
            found = scene.approach(self.robot(), instance_id=target.id, start=here.translation, frame=frames.choice, max_poses=most)
            response.goal_reason = found.detail
            if found.status != "found":
                return
            obstacles = []
            for pose in found.poses:
                goal = convert.stand(pose, scan, header)
                if obstacle := self.obstacle(goal):
                    obstacles.append(obstacle)
                    continue
                response.goal, response.goal_reason = goal, pose.why
                self.paths.publish(convert.path(pose, scan, header))
                break
            else:
                response.goal_reason = f"the scan has {len(obstacles)} places to stand; at the best of them {obstacles[0]}"
                return
        response.has_goal = True
        self.goals.publish(response.goal)
        if self.navigator is not None:
            self.navigator.send(response.goal)

    def obstacle(self, goal: PoseStamped) -> str | None:
        """What the robot's own map has against a goal; `None` without a map."""
        grid = self.grid
        if grid is None:
            return None
        position = [goal.pose.position.x, goal.pose.position.y, goal.pose.position.z]
        if grid.frame_id != goal.header.frame_id:
            position = self.placed(grid.frame_id, goal.header.frame_id).place(position)
        return grid.obstacle(position, self.value("robot_radius_m"))

    def robot(self) -> models.Robot:
        """As the service wants it; it says what is missing."""
        robot: models.Robot = {
            "radius_m": self.value("robot_radius_m"),
            "height_m": self.value("robot_height_m"),
            "eye_height_m": self.value("eye_height_m"),
        }
        if self.value("reach_m"):
            robot["reach_m"] = self.value("reach_m")
        return robot

    def frames(self, scene: Scene) -> Frames:
        """The map's, where the service knows how the scene lies in it; else the scan's, which tf2 must know in the map."""
        if scene.info.scene_to_map and scene.info.map_frame_id:
            return Frames("map", scene.info.map_frame_id, scene.info.map_frame_id, None)
        map_frame, scan_frame = self.value("map_frame"), self.value("scan_frame")
        return Frames("scene", scan_frame, map_frame, self.placed(map_frame, scan_frame))

    def parsed_scene(self) -> Scene:
        if not self.value("scene_id"):
            raise UnigroundError("scene_not_found", "the parameter scene_id is not set")
        return self.client.scene(self.value("scene_id"))

    def placed(self, frame: str, of: str) -> Placed:
        """How a frame lies in another, as tf2 knows it now."""
        return Placed.of(self.transforms.lookup_transform(frame, of, Time()))


def supports(scene: Scene, instance_id: int) -> list[models.OrientedBox]:
    """Boxes of what carries a thing and stands in the way, downwards."""
    boxes: list[models.OrientedBox] = []
    thing = scene.instance(instance_id)
    for _ in range(MOST_SUPPORTS):
        if thing.support.on != "instance" or thing.support.id is None:
            break
        thing = scene.instance(thing.support.id)
        if thing.height_above_floor_m + thing.box.size[2] > FLAT_M:
            boxes.append(thing.oriented_box)
    return boxes


def main() -> None:
    rclpy.init()
    node = Grounding()
    executor = MultiThreadedExecutor()
    executor.add_node(node)
    try:
        executor.spin()
    except KeyboardInterrupt:
        pass
    finally:
        node.client.close()
        node.destroy_node()
        rclpy.try_shutdown()
