"""What stands for ROS 2, which the tests do not want installed.

Messages are made of their real definitions, so that a wrong field or type fails here too: `packed` writes them as they go over the wire.
Nodes keep what they publish, and transforms are those of `TRANSFORMS`.
"""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

# vision_msgs 4 (Humble and later), and our own service's two halves.
DEFINITIONS = {
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score",
    "vision_msgs/msg/ObjectHypothesisWithPose": "ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose",
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
    "vision_msgs/msg/Detection3D": "std_msgs/Header header\nObjectHypothesisWithPose[] results\nBoundingBox3D bbox\nstring id",
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nDetection3D[] detections",
    "nav2_msgs/msg/NavigateToPose_Goal": "geometry_msgs/PoseStamped pose\nstring behavior_tree",
    "std_srvs/msg/Trigger_Request": "",
    "std_srvs/msg/Trigger_Response": "bool success\nstring message",
}
ARRAY, SEQUENCE = 3, 4


class Messages:
    """Classes of messages that are made empty, as ROS does, and then filled in."""

    def __init__(self, service: str) -> None:
        self.store = get_typestore(Stores.ROS2_HUMBLE)
        request, response = service.split("---\n")
        halves = {"uniground_interfaces/msg/Ground_Request": request, "uniground_interfaces/msg/Ground_Response": response}
        for name, text in {**DEFINITIONS, **halves}.items():
            self.store.register(get_types_from_msg(text, name))
        self.classes: dict[str, type] = {}

    def named(self, name: str) -> type:
        if name not in self.classes:
            constants, fields = self.store.fielddefs[name]
            body = {constant: value for constant, _, value in constants}
            self.classes[name] = type(name, (Message,), {**body, "messages": self, "name": name, "fields": dict(fields)})
        return self.classes[name]

    def empty(self, field: Any) -> Any:
        kind, of = field
        if kind == ARRAY:
            return [self.empty(of[0]) for _ in range(of[1])]
        if kind == SEQUENCE:
            return []
        if isinstance(of, str):
            return self.named(of)()
        return "" if of[0] == "string" else False if of[0] == "bool" else 0.0 if of[0].startswith("float") else 0


class Message:
    """Only fields of the definition can be set; quaternions begin as no turn."""

    messages: Messages
    name: str
    fields: dict[str, Any]

    def __init__(self, **given: Any) -> None:
        for name, field in self.fields.items():
            setattr(self, name, self.messages.empty(field))
        if self.name == "geometry_msgs/msg/Quaternion":
            self.w = 1.0
        for name, value in given.items():
            setattr(self, name, value)

    def __setattr__(self, name: str, value: Any) -> None:
        assert name in self.fields, f"{self.name} has no {name}"
        object.__setattr__(self, name, value)


def packed(message: Message) -> bytes:
    """As it goes over the wire; fails where a value is not of the field's type."""

    def real(value: Any, field: Any) -> Any:
        if isinstance(value, Message):
            kinds = value.messages.store.types
            return kinds[value.name](**{name: real(getattr(value, name), of) for name, of in value.fields.items()})
        if isinstance(value, list):
            parts = [real(part, None) for part in value]
            numeric = field is not None and not isinstance(field[1][0][1], str) and field[1][0][1][0] != "string"
            return np.array(parts) if numeric else parts
        return value

    # Python's own numbers pass for any; ROS takes no int for a float.
    def check(value: Any, field: Any, path: str) -> None:
        kind, of = field
        if isinstance(value, Message):
            for name, inner in value.fields.items():
                check(getattr(value, name), inner, f"{path}.{name}")
        elif kind in (ARRAY, SEQUENCE):
            for part in value:
                check(part, of[0], f"{path}[]")
        else:
            expected = type(message.messages.empty(field))
            assert type(value) is expected, f"{path} is {type(value).__name__}, must be {expected.__name__}"

    check(message, (2, message.name), message.name)
    return bytes(message.messages.store.serialize_cdr(real(message, None), message.name))


# (frame, of): TransformStamped, as a robot's tf2 would have them.
TRANSFORMS: dict[tuple[str, str], Any] = {}


class TransformException(Exception):
    pass


class Buffer:
    def lookup_transform(self, frame: str, of: str, _time: Any) -> Any:
        try:
            return TRANSFORMS[frame, of]
        except KeyError:
            raise TransformException(f'"{of}" is not known in "{frame}"') from None


class Node:
    """Parameters are given by the test in `OVERRIDES`; publishers keep what they are given."""

    OVERRIDES: ClassVar[dict[str, Any]] = {}

    def __init__(self, name: str) -> None:
        self.name, self.parameters, self.published, self.entries, self.log = name, {}, {}, {}, []

    def declare_parameter(self, name: str, default: Any) -> None:
        given = self.OVERRIDES.get(name, default)
        assert type(given) is type(default), f"parameter {name} is declared as {type(default).__name__}"
        self.parameters[name] = SimpleNamespace(value=given)

    def get_parameter(self, name: str) -> Any:
        return self.parameters[name]

    def create_publisher(self, kind: type, topic: str, _qos: Any) -> Any:
        def publish(message: Message) -> None:
            assert type(message) is kind
            assert packed(message)
            self.published.setdefault(topic, []).append(message)

        return SimpleNamespace(publish=publish)

    def create_service(self, kind: Any, name: str, callback: Any, **_: Any) -> None:
        self.entries[name] = callback

    def create_subscription(self, kind: type, topic: str, callback: Any, _qos: Any, **_: Any) -> None:
        self.entries[topic] = callback

    def get_clock(self) -> Any:
        stamp = sys.modules["builtin_interfaces.msg"].Time(sec=7)
        return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: stamp))

    def get_logger(self) -> Any:
        return SimpleNamespace(info=self.log.append, warning=self.log.append)

    def destroy_node(self) -> None:
        pass


class Future:
    """As rclpy's: done when the test says so."""

    def __init__(self) -> None:
        self.callbacks: list[Any] = []

    def add_done_callback(self, callback: Any) -> None:
        self.callbacks.append(callback)

    def result(self) -> Any:
        return self.value

    def end(self, value: Any) -> None:
        self.value = value
        for callback in self.callbacks:
            callback(self)


class GoalHandle:
    def __init__(self, accepted: bool) -> None:
        self.accepted, self.ended, self.cancels = accepted, Future(), 0

    def get_result_async(self) -> Future:
        return self.ended

    def cancel_goal_async(self) -> Future:
        self.cancels += 1
        return Future()


class ActionClient:
    """Nav2 as the test plays it: `sent` has each goal and the future of its reply. There is none where `is_there` says so."""

    is_there: ClassVar[bool] = True
    made: ClassVar[list[ActionClient]] = []

    def __init__(self, _node: Any, kind: Any, name: str, **_: Any) -> None:
        self.kind, self.name, self.sent = kind, name, []
        self.made.append(self)

    def wait_for_server(self, timeout_sec: float) -> bool:
        return self.is_there

    def send_goal_async(self, goal: Any) -> Future:
        assert type(goal) is self.kind.Goal
        assert packed(goal)
        self.sent.append((goal, Future()))
        return self.sent[-1][1]


def install(service: str) -> None:
    """Puts all of it where `import` finds it."""
    messages = Messages(service)
    for package in ("action_msgs", "builtin_interfaces", "geometry_msgs", "nav_msgs", "std_msgs", "vision_msgs", "visualization_msgs"):
        inside = ModuleType(f"{package}.msg")
        for name in [name for name in messages.store.fielddefs if name.startswith(f"{package}/msg/")]:
            setattr(inside, name.rsplit("/", 1)[1], messages.named(name))
        sys.modules[package], sys.modules[inside.__name__] = ModuleType(package), inside
    halves = {half: messages.named(f"uniground_interfaces/msg/Ground_{half}") for half in ("Request", "Response")}
    trigger = {half: messages.named(f"std_srvs/msg/Trigger_{half}") for half in ("Request", "Response")}
    navigate = SimpleNamespace(Goal=messages.named("nav2_msgs/msg/NavigateToPose_Goal"))
    modules: dict[str, dict[str, Any]] = {
        "nav2_msgs": {},
        "nav2_msgs.action": {"NavigateToPose": navigate},
        "std_srvs": {},
        "std_srvs.srv": {"Trigger": SimpleNamespace(**trigger)},
        "uniground_interfaces": {},
        "uniground_interfaces.srv": {"Ground": SimpleNamespace(**halves)},
        "rclpy": {"init": lambda: None, "try_shutdown": lambda: None},
        "rclpy.action": {"ActionClient": ActionClient},
        "rclpy.callback_groups": {"ReentrantCallbackGroup": object},
        "rclpy.executors": {"MultiThreadedExecutor": object},
        "rclpy.node": {"Node": Node},
        "rclpy.qos": {"DurabilityPolicy": SimpleNamespace(TRANSIENT_LOCAL=1), "QoSProfile": lambda **_: None},
        "rclpy.time": {"Time": object},
        "tf2_ros": {"Buffer": Buffer, "TransformException": TransformException, "TransformListener": lambda *_: None},
    }
    for name, content in modules.items():
        sys.modules[name] = ModuleType(name)
        vars(sys.modules[name]).update(content)
