"""A node that asks a uniground server where things are, and tells the robot in its own messages."""

from __future__ import annotations

import dataclasses
import json

import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.time import Time
from std_msgs.msg import Header, String
from tf2_ros import Buffer, TransformException, TransformListener
from uniground_interfaces.srv import Ground
from vision_msgs.msg import Detection3DArray
from visualization_msgs.msg import MarkerArray

from uniground import Client, Scene, UnigroundError, models
from uniground_ros import convert
from uniground_ros.convert import Placed

# How many things may lie on one another: a mug on a tray on a table.
MOST_SUPPORTS = 5
# What is no higher than this, a rug, can be driven on.
FLAT_M = 0.15


class Grounding(Node):
    """Service `~/ground` and topic `~/question` in; `~/detections`, `~/markers`, `~/goal` and `~/answer` out.

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
            "standoff_m": 0.6,
            "min_confidence": 0.5,
            "timeout_s": 10.0,
        }.items():
            self.declare_parameter(name, default)
        self.client = Client(self.value("server") or None)
        self.scene: Scene | None = None
        self.transforms = Buffer()
        self.listener = TransformListener(self.transforms, self)

        # Whoever looks later, RViz for one, still gets the last answer.
        kept = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.detections = self.create_publisher(Detection3DArray, "~/detections", kept)
        self.markers = self.create_publisher(MarkerArray, "~/markers", kept)
        self.answers = self.create_publisher(String, "~/answer", kept)
        # A goal that is kept would be driven to again.
        self.goals = self.create_publisher(PoseStamped, "~/goal", 1)
        # Questions may take seconds; transforms must come in meanwhile.
        group = ReentrantCallbackGroup()
        self.create_service(Ground, "~/ground", self.on_request, callback_group=group)
        self.create_subscription(String, "~/question", self.on_question, 1, callback_group=group)

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
        return response

    def answer(self, request: Ground.Request, response: Ground.Response) -> None:
        scan = self.placed(self.value("map_frame"), self.value("scan_frame"))
        options: models.GroundOptions = {"min_confidence": self.value("min_confidence"), "timeout_s": self.value("timeout_s")}
        if request.as_seen_by_robot:
            robot = self.placed(self.value("scan_frame"), self.value("robot_frame"))
            options["observer"] = {"position": robot.translation.tolist(), "yaw_rad": robot.yaw_rad}
        answer = self.parsed_scene().ask(request.query, **options)

        header = Header(stamp=self.get_clock().now().to_msg(), frame_id=self.value("map_frame"))
        response.status, response.explanation = answer.status, answer.answer.explanation
        response.answer_json = json.dumps(dataclasses.asdict(answer))
        response.detections = convert.detections(answer, scan, header)
        self.detections.publish(response.detections)
        self.markers.publish(convert.markers(answer, scan, header))
        self.answers.publish(String(data=response.answer_json))
        # A guess, several things or none: ask the person back, drive nowhere.
        if answer.status == "grounded" and len(answer.targets) == 1:
            self.tell_goal(answer, scan, header, response)

    def tell_goal(self, answer: models.Answer, scan: Placed, header: Header, response: Ground.Response) -> None:
        try:
            robot = self.placed(self.value("map_frame"), self.value("robot_frame"))
        except TransformException as error:
            self.get_logger().warning(f"no goal: {error}")
            return
        target = answer.targets[0]
        around = self.supports(target.id)
        response.goal = convert.goal(target.oriented_box, around, scan, robot, self.value("standoff_m"), header)
        response.has_goal = True
        self.goals.publish(response.goal)

    def supports(self, instance_id: int) -> list[models.OrientedBox]:
        """Boxes of what carries a thing and stands in the way, downwards."""
        boxes: list[models.OrientedBox] = []
        thing = self.parsed_scene().instance(instance_id)
        for _ in range(MOST_SUPPORTS):
            if thing.support.on != "instance" or thing.support.id is None:
                break
            thing = self.parsed_scene().instance(thing.support.id)
            if thing.height_above_floor_m + thing.box.size[2] > FLAT_M:
                boxes.append(thing.oriented_box)
        return boxes

    def parsed_scene(self) -> Scene:
        if self.scene is None:
            if not self.value("scene_id"):
                raise UnigroundError("scene_not_found", "the parameter scene_id is not set")
            self.scene = self.client.scene(self.value("scene_id"))
        return self.scene

    def placed(self, frame: str, of: str) -> Placed:
        """How a frame lies in another, as tf2 knows it now."""
        return Placed.of(self.transforms.lookup_transform(frame, of, Time()))


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
