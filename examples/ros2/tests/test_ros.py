"""The ROS 2 example against the real server; `stubs` stands for ROS itself."""

from __future__ import annotations

import json
import math
import os
import runpy
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import stubs

from uniground import Scene, models

LAUNCH = Path(__file__).parents[1] / "uniground_ros/launch/grounding.launch.py"
SERVICE = Path(__file__).parents[1] / "uniground_interfaces/srv/Ground.srv"
stubs.install("\n".join(line for line in SERVICE.read_text().splitlines() if not line.startswith("#")) + "\n")

from geometry_msgs.msg import TransformStamped  # noqa: E402
from nav_msgs.msg import OccupancyGrid  # noqa: E402
from std_msgs.msg import Header, String  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402
from uniground_interfaces.srv import Ground  # noqa: E402

from uniground_ros import convert  # noqa: E402
from uniground_ros.convert import Placed  # noqa: E402
from uniground_ros.node import Grounding  # noqa: E402

HERE = Placed(np.eye(3), np.zeros(3))
MUG = "the mug on the coffee table"
ROBOT = {"robot_radius_m": 0.2, "robot_height_m": 1.3, "eye_height_m": 1.2, "reach_m": 0.8}
QUARTER = math.pi / 2


def transform(x: float, y: float, yaw: float) -> Any:
    stamped = TransformStamped()
    stamped.transform.translation.x, stamped.transform.translation.y = x, y
    stamped.transform.rotation.z, stamped.transform.rotation.w = math.sin(yaw / 2), math.cos(yaw / 2)
    return stamped


def yaw_of(orientation: Any) -> float:
    assert (orientation.x, orientation.y) == pytest.approx((0, 0), abs=1e-6)
    return 2 * math.atan2(orientation.z, orientation.w)


def at(point: Any) -> list[float]:
    return [point.x, point.y, point.z]


@pytest.fixture
def node(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> Grounding:
    monkeypatch.setattr(stubs.Node, "OVERRIDES", {"scene_id": scene.id, "min_confidence": 0.0})
    # The scan's origin lies at (10, 5) of the map, turned by a quarter; the robot stands in the middle of the room.
    known = {
        ("map", "scan"): transform(10, 5, QUARTER),
        ("scan", "base_link"): transform(0, 0, 0),
        ("map", "base_link"): transform(10, 5, QUARTER),
    }
    monkeypatch.setattr(stubs, "TRANSFORMS", known)
    return Grounding()


@pytest.fixture
def placed(scene: Scene) -> Iterator[Scene]:
    """The service knows how the scene lies in a map, the same way as tf2 would."""
    yield scene.place_in_map((0, 0, math.sin(QUARTER / 2), math.cos(QUARTER / 2)), (10, 5, 0), "site")
    scene._client.call("PATCH", f"/v1/scenes/{scene.id}", body={"scene_to_map": None, "map_frame_id": None})
    scene.refresh()


def given(node: Grounding, **parameters: float) -> Grounding:
    """The node with these parameters."""
    for name, value in parameters.items():
        node.parameters[name].value = value
    return node


def ask(node: Grounding, query: str, seen: bool = False) -> Any:
    response = node.entries["~/ground"](Ground.Request(query=query, as_seen_by_robot=seen), Ground.Response())
    assert stubs.packed(response)
    return response


def test_an_answer_is_a_detection_in_the_map(node: Grounding, scene: Scene) -> None:
    said = ask(node, MUG)
    target = scene.ask(MUG).targets[0]
    x, y, z = target.oriented_box.center
    [detection] = said.detections.detections
    assert said.status == "grounded"
    assert detection.id == f"{scene.id}/1/80"
    assert (detection.header.frame_id, detection.header.stamp.sec) == ("map", 7)
    assert at(detection.bbox.center.position) == pytest.approx([10 - y, 5 + x, z])
    assert at(detection.bbox.size) == pytest.approx(target.oriented_box.size)
    assert yaw_of(detection.bbox.center.orientation) == pytest.approx(math.pi / 2 + target.oriented_box.yaw_rad)
    [result] = detection.results
    assert (result.hypothesis.class_id, result.hypothesis.score) == ("orange mug", pytest.approx(target.confidence))
    assert at(result.pose.pose.position) == at(detection.bbox.center.position)
    assert json.loads(said.answer_json)["answer"]["predicted_id"] == 80
    assert node.published["~/detections"] == [said.detections]
    assert node.published["~/answer"][0].data == said.answer_json


def test_markers_show_it_and_take_the_last_ones_away(node: Grounding) -> None:
    ask(node, MUG)
    [array] = node.published["~/markers"]
    gone, cube, label = array.markers
    assert gone.action == gone.DELETEALL
    assert (cube.type, cube.ns, round(cube.color.g, 2), cube.color.a) == (cube.CUBE, "boxes", 0.6, 0.4)
    assert (label.type, label.text) == (label.TEXT_VIEW_FACING, "orange mug 0.34")
    assert label.pose.position.z > cube.pose.position.z


def test_the_goal_is_in_front_of_the_table_and_faces_the_mug(node: Grounding, scene: Scene) -> None:
    said = ask(node, MUG)
    assert said.has_goal
    assert node.published["~/goal"] == [said.goal]
    stand, mug = at(said.goal.pose.position), at(said.detections.detections[0].bbox.center.position)
    bearing = math.atan2(mug[1] - stand[1], mug[0] - stand[0])
    assert yaw_of(said.goal.pose.orientation) == pytest.approx(bearing)
    table = scene.instance(26).oriented_box
    # Back in the scan's world: on the rug, off the table by what the robot is told to keep, where the line to the robot leaves it.
    in_scan = [stand[1] - 5, 10 - stand[0], table.center[2]]
    assert not table.contains([in_scan])[0]
    nearer = np.array(in_scan[:2]) + 0.61 * np.array([math.cos(bearing - math.pi / 2), math.sin(bearing - math.pi / 2)])
    assert table.contains([[*nearer, table.center[2]]])[0]

    assert "robot_radius_m is not set" in said.goal_reason
    assert "~/path" not in node.published


def test_a_robot_that_is_known_is_sent_where_it_can_stand(node: Grounding, scene: Scene) -> None:
    said = ask(given(node, **ROBOT), MUG)
    best = scene.approach(node.robot(), instance_id=80, start=(0, 0)).poses[0]
    assert (said.has_goal, said.goal_reason) == (True, best.why)
    x, y, z = best.position
    assert at(said.goal.pose.position) == pytest.approx([10 - y, 5 + x, z])
    assert yaw_of(said.goal.pose.orientation) == pytest.approx(math.remainder(best.yaw_rad + QUARTER, math.tau))
    assert node.published["~/goal"] == [said.goal]
    [path] = node.published["~/path"]
    assert (path.header, len(path.poses)) == (said.goal.header, len(best.path))
    corners = [at(one.pose.position) for one in path.poses]
    assert corners == [pytest.approx([10 - y, 5 + x, z]) for x, y in best.path]
    # Each corner faces the next, and the last what is looked for.
    (x, y, _), (to_x, to_y, _) = corners[:2]
    assert yaw_of(path.poses[0].pose.orientation) == pytest.approx(math.atan2(to_y - y, to_x - x))
    assert path.poses[-1].pose.orientation.z == said.goal.pose.orientation.z
    # One that only has to see it needs no arm.
    assert ask(given(node, reach_m=0.0), MUG).has_goal


def test_where_there_is_no_place_there_is_no_goal_and_a_reason(node: Grounding, monkeypatch: pytest.MonkeyPatch) -> None:
    short = ask(given(node, **{**ROBOT, "reach_m": 0.05}), MUG)
    assert (short.status, short.has_goal) == ("grounded", False)
    assert "the mug is out of reach" in short.goal_reason
    assert node.log[-1] == f"no goal: {short.goal_reason}"
    half_known = ask(given(node, robot_height_m=0.0), MUG)
    assert (half_known.status, half_known.has_goal) == ("grounded", False)
    assert "/robot/height_m: must be 0.1 to 3" in half_known.goal_reason
    monkeypatch.setitem(stubs.TRANSFORMS, ("scan", "base_link"), transform(50, 0, 0))
    assert "the start position is not free floor" in ask(given(node, **ROBOT), MUG).goal_reason
    monkeypatch.delitem(stubs.TRANSFORMS, ("scan", "base_link"))
    assert '"base_link" is not known in "scan"' in ask(node, MUG).goal_reason
    assert not {"~/goal", "~/path"} & set(node.published)


@pytest.mark.parametrize("query", [MUG, "the chair closest to the door", "the chair closest to me", "the spaceship"])
def test_a_scene_that_lies_in_a_map_needs_no_transform_of_the_scan(
    node: Grounding, placed: Scene, monkeypatch: pytest.MonkeyPatch, query: str
) -> None:
    scan, base = stubs.TRANSFORMS["map", "scan"], stubs.TRANSFORMS["map", "base_link"]
    monkeypatch.setattr(stubs, "TRANSFORMS", {("site", "base_link"): base})
    in_map = ask(given(node, **ROBOT), query, seen=True)
    # The same as where tf2 says it.
    placed._client.call("PATCH", f"/v1/scenes/{placed.id}", body={"scene_to_map": None})
    monkeypatch.setattr(stubs, "TRANSFORMS", {("map", "scan"): scan, ("scan", "base_link"): transform(0, 0, 0)})
    by_tf = ask(node, query, seen=True)
    assert (in_map.status, in_map.has_goal, in_map.goal_reason) == (by_tf.status, by_tf.has_goal, by_tf.goal_reason)
    assert (in_map.detections.header.frame_id, by_tf.detections.header.frame_id) == ("site", "map")
    assert len(in_map.detections.detections) == len(by_tf.detections.detections)
    for one, other in zip(in_map.detections.detections, by_tf.detections.detections):
        assert (one.id, at(one.bbox.center.position)) == (other.id, pytest.approx(at(other.bbox.center.position)))
        assert yaw_of(one.bbox.center.orientation) == pytest.approx(yaw_of(other.bbox.center.orientation))
    assert at(in_map.goal.pose.position) == pytest.approx(at(by_tf.goal.pose.position))
    told = json.loads(in_map.answer_json)["in_frame"]
    assert told["frame_id"] == "site"
    for detection, box in zip(in_map.detections.detections, told["boxes"]):
        assert at(detection.bbox.center.position) == pytest.approx(box["center"])


def test_the_goal_is_where_the_service_says_in_the_map(node: Grounding, placed: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stubs, "TRANSFORMS", {("site", "base_link"): transform(10, 5, 0)})
    said = ask(given(node, **ROBOT), MUG)
    told = placed.approach(node.robot(), instance_id=80, start=(10, 5), frame="map").in_frame
    assert told is not None
    assert at(said.goal.pose.position) == pytest.approx(told.poses[0].position)
    assert [said.goal.pose.orientation.z, said.goal.pose.orientation.w] == pytest.approx(told.poses[0].orientation[2:])
    assert [at(one.pose.position) for one in node.published["~/path"][0].poses] == [pytest.approx(corner) for corner in told.poses[0].path]


def test_what_is_not_one_sure_thing_is_no_goal(node: Grounding) -> None:
    several = ask(node, "how many mugs are there")
    assert (several.status, len(several.detections.detections), several.has_goal) == ("grounded", 4, False)
    assert several.goal_reason == "4 things are meant"
    either = ask(node, "the stool")
    assert (either.status, either.has_goal) == ("ambiguous", False)
    assert len(either.detections.detections) >= 2
    nothing = ask(node, "the spaceship")
    assert (nothing.status, nothing.detections.detections, nothing.has_goal) == ("no_match", [], False)
    guess = ask(given(node, min_confidence=1.0), "the sofa")
    assert (guess.status, len(guess.detections.detections), guess.has_goal) == ("uncertain", 1, False)
    assert "~/goal" not in node.published
    assert len(node.published["~/markers"]) == 4


def test_near_is_as_the_robot_stands(node: Grounding, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    for x in (-2.9, 2.0):
        monkeypatch.setitem(stubs.TRANSFORMS, ("scan", "base_link"), transform(x, 0, 0))
        node.entries["~/question"](String(data="the mug closest to me"))
        asked.append(json.loads(node.published["~/answer"][-1].data))
    assert [answer["direction_convention"] for answer in asked] == ["observer", "observer"]
    assert asked[0]["answer"]["predicted_id"] != asked[1]["answer"]["predicted_id"]


def test_what_goes_wrong_is_the_status(node: Grounding, monkeypatch: pytest.MonkeyPatch) -> None:
    assert ask(node, "").status == "invalid_request"
    monkeypatch.delitem(stubs.TRANSFORMS, ("map", "base_link"))
    assert (ask(node, MUG).status, ask(node, MUG).has_goal) == ("grounded", False)
    monkeypatch.delitem(stubs.TRANSFORMS, ("scan", "base_link"))
    assert ask(node, MUG, seen=True).status == "no_transform"
    monkeypatch.setattr(stubs.Node, "OVERRIDES", {})
    unset = ask(Grounding(), MUG)
    assert (unset.status, unset.explanation) == ("scene_not_found", "the parameter scene_id is not set")
    monkeypatch.setattr(stubs.Node, "OVERRIDES", {"server": "http://127.0.0.1:9", "scene_id": "s"})
    away = Grounding()
    away.client._retries = 0
    assert ask(away, MUG).status == "unreachable"


def grid(node: Grounding, occupied: list[Any], frame_id: str = "map", yaw: float = 0.0) -> None:
    """The robot's own map arrives: 16 m by 16 m in cells of 0.1 m around (10, 5), free but for the cells at these points of its frame."""
    message, corner = OccupancyGrid(), np.array([10.0, 5.0]) - 8 * np.array([math.cos(yaw) - math.sin(yaw), math.sin(yaw) + math.cos(yaw)])
    message.header.frame_id = frame_id
    message.info.resolution, message.info.width, message.info.height = 0.1, 160, 160
    message.info.origin.position.x, message.info.origin.position.y = corner.tolist()
    message.info.origin.orientation.z, message.info.origin.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
    message.data = [0] * 160 * 160
    for point in occupied:
        x, y = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]]) @ (np.array(point[:2]) - corner) / 0.1
        message.data[int(y) * 160 + int(x)] = 100
    node.entries["map"](message)


@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_the_goal_keeps_off_what_the_robots_own_map_has(node: Grounding, yaw: float) -> None:
    given(node, **ROBOT)
    first = ask(node, MUG)
    grid(node, [], yaw=yaw)
    assert at(ask(node, MUG).goal.pose.position) == at(first.goal.pose.position)
    # Something stands where the best place was: the next one is taken.
    grid(node, [at(first.goal.pose.position)], yaw=yaw)
    second = ask(node, MUG)
    assert second.has_goal
    apart = math.dist(at(second.goal.pose.position), at(first.goal.pose.position))
    assert apart > ROBOT["robot_radius_m"]
    assert at(node.published["~/path"][-1].poses[-1].pose.position) == at(second.goal.pose.position)


def test_where_the_robots_own_map_leaves_no_place_there_is_no_goal(node: Grounding, monkeypatch: pytest.MonkeyPatch) -> None:
    straight = ask(node, MUG)
    grid(node, [at(straight.goal.pose.position)])
    blocked = ask(node, MUG)
    assert (blocked.status, blocked.has_goal) == ("grounded", False)
    assert blocked.goal_reason == "not on the straight line to the robot: the robot's map has an obstacle 0.00 m away"
    everywhere = [(x / 10, y / 10) for x in range(25, 175, 2) for y in range(-25, 125, 2)]
    grid(node, everywhere)
    none = ask(given(node, **ROBOT), MUG)
    assert (none.status, none.has_goal) == ("grounded", False)
    assert "places to stand; at the best of them the robot's map has an obstacle 0." in none.goal_reason
    # A map in another frame, as an odometry's costmap is.
    monkeypatch.setitem(stubs.TRANSFORMS, ("odom", "map"), transform(100, 0, 0))
    grid(node, [], "odom")
    assert "outside the robot's map" in ask(node, MUG).goal_reason
    monkeypatch.setitem(stubs.TRANSFORMS, ("odom", "map"), transform(0, 0, 0))
    assert ask(node, MUG).has_goal
    monkeypatch.delitem(stubs.TRANSFORMS, ("odom", "map"))
    assert '"map" is not known in "odom"' in ask(node, MUG).goal_reason


def test_a_map_that_is_not_wanted_is_not_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stubs.Node, "OVERRIDES", {"map_topic": ""})
    assert "map" not in Grounding().entries


@pytest.fixture
def driving(node: Grounding, monkeypatch: pytest.MonkeyPatch) -> Grounding:
    monkeypatch.setattr(stubs.Node, "OVERRIDES", {**stubs.Node.OVERRIDES, "navigate": True})
    monkeypatch.setattr(stubs.ActionClient, "made", [])
    return Grounding()


def states(node: Grounding) -> list[str]:
    return [state.data for state in node.published.get("~/navigation", [])]


def cancel(node: Grounding) -> Any:
    response = node.entries["~/cancel"](Trigger.Request(), Trigger.Response())
    assert stubs.packed(response)
    return response


def test_nav2_drives_to_the_goal(driving: Grounding) -> None:
    [nav2] = stubs.ActionClient.made
    assert nav2.name == "navigate_to_pose"
    assert (cancel(driving).success, cancel(driving).message) == (False, "there is no goal")
    said = ask(driving, MUG)
    [(goal, reply)] = nav2.sent
    assert goal.pose == said.goal
    assert goal.pose.header.frame_id == "map"
    handle = stubs.GoalHandle(accepted=True)
    reply.end(handle)
    assert states(driving) == ["sent", "accepted"]
    handle.ended.end(SimpleNamespace(status=4))
    assert states(driving) == ["sent", "accepted", "succeeded"]
    assert not cancel(driving).success
    # No sure answer, nothing to drive to.
    ask(driving, "the stool")
    assert len(nav2.sent) == 1


def test_a_drive_is_canceled(driving: Grounding) -> None:
    [nav2] = stubs.ActionClient.made
    ask(driving, MUG)
    handle = stubs.GoalHandle(accepted=True)
    nav2.sent[0][1].end(handle)
    assert cancel(driving).success
    assert handle.cancels == 1
    handle.ended.end(SimpleNamespace(status=5))
    assert states(driving) == ["sent", "accepted", "canceled"]
    # Before Nav2 has replied: its reply is met with a cancel.
    ask(driving, MUG)
    assert cancel(driving).success
    late = stubs.GoalHandle(accepted=True)
    nav2.sent[1][1].end(late)
    assert (late.cancels, states(driving)[3:]) == (1, ["sent", "canceled"])


def test_a_new_goal_replaces_the_one_before(driving: Grounding) -> None:
    [nav2] = stubs.ActionClient.made
    first, second = stubs.GoalHandle(accepted=True), stubs.GoalHandle(accepted=True)
    ask(driving, MUG)
    nav2.sent[0][1].end(first)
    ask(driving, MUG)
    nav2.sent[1][1].end(second)
    # Nav2 ends the first for the second: that is not the end of the drive.
    first.ended.end(SimpleNamespace(status=6))
    assert states(driving) == ["sent", "accepted", "sent", "accepted"]
    second.ended.end(SimpleNamespace(status=6))
    assert states(driving)[-1] == "aborted"
    assert driving.log[-1] == "Nav2: goal aborted"


def test_nav2_may_refuse_or_not_be_there(driving: Grounding, monkeypatch: pytest.MonkeyPatch) -> None:
    [nav2] = stubs.ActionClient.made
    ask(driving, MUG)
    nav2.sent[0][1].end(stubs.GoalHandle(accepted=False))
    assert states(driving) == ["sent", "rejected"]
    monkeypatch.setattr(stubs.ActionClient, "is_there", False)
    assert ask(driving, MUG).has_goal
    assert states(driving) == ["sent", "rejected", "unavailable"]
    assert (len(nav2.sent), driving.log[-2]) == (1, "Nav2: goal unavailable")


def test_without_navigate_nothing_drives(node: Grounding) -> None:
    assert "~/cancel" not in node.entries
    assert node.navigator is None


def test_the_launch_file_leaves_the_server_to_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its arguments are declared and handed to the node, each as what the node declares; the launch system itself is not here."""
    made: dict[str, list[Any]] = {}

    def kind(name: str) -> Any:
        return lambda *given, **named: made.setdefault(name, []).append((given, named)) or (name, given, named)

    for module, names in {
        "launch": ["LaunchDescription"],
        "launch.actions": ["DeclareLaunchArgument"],
        "launch.substitutions": ["LaunchConfiguration"],
        "launch_ros": [],
        "launch_ros.actions": ["Node"],
        "launch_ros.parameter_descriptions": ["ParameterValue"],
    }.items():
        monkeypatch.setitem(sys.modules, module, ModuleType(module))
        vars(sys.modules[module]).update({name: kind(name) for name in names})
    runpy.run_path(str(LAUNCH))["generate_launch_description"]()
    defaults = {given[0]: named["default_value"] for given, named in made["DeclareLaunchArgument"]}
    assert defaults["server"] == ""
    [parameters] = [named["parameters"] for _, named in made["Node"] if named["package"] == "uniground_ros"]
    handed = {name: value[2]["value_type"] for part in parameters for name, value in part.items()}
    known = Grounding().parameters
    assert {name: type(known[name].value) for name in handed} == handed
    # As the node reads it: the variable that the tests set.
    assert Grounding().client.server == os.environ["UNIGROUND_SERVER"]


def box(center: list[float], size: list[float], yaw: float = 0.0) -> models.OrientedBox:
    return models.OrientedBox(center=center, size=size, yaw_rad=yaw)


@pytest.mark.parametrize("yaw", [0.0, 0.5, -2.0])
def test_the_way_out_of_a_box_ends_at_its_rim(yaw: float) -> None:
    c, s = math.cos(yaw), math.sin(yaw)
    table = box([1, 2, 0.4], [2.0, 1.0, 0.8], yaw)
    assert convert.way_out(table, np.array([1, 2]), np.array([c, s])) == pytest.approx(1.0)
    assert convert.way_out(table, np.array([1, 2]), np.array([-s, c])) == pytest.approx(0.5)
    assert convert.way_out(table, np.array([1 - 3 * c, 2 - 3 * s]), np.array([-c, -s])) == 0


def test_a_robot_that_is_near_enough_only_turns() -> None:
    chair, header = box([2, 0, 0.5], [0.5, 0.5, 1.0]), Header(frame_id="map")
    near = Placed(np.eye(3), np.array([1.5, 0.0, 0.1]))
    stays = convert.goal(chair, [], HERE, near, 0.6, header).pose
    assert at(stays.position) == pytest.approx([1.5, 0.0, 0.1])
    far = convert.goal(chair, [], HERE, HERE, 0.6, header).pose
    assert at(far.position) == pytest.approx([2 - 0.25 - 0.6, 0, 0])
    assert yaw_of(far.orientation) == pytest.approx(0, abs=1e-9)


def test_turns_are_exact_whichever_way_the_map_lies() -> None:
    rng = np.random.default_rng(2)
    for q in [*rng.normal(size=(50, 4)), [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]:
        stamped, pose = TransformStamped(), TransformStamped().transform
        for name, value in zip("xyzw", q):
            setattr(stamped.transform.rotation, name, float(value))
        placed = Placed.of(stamped)
        assert placed.rotation @ placed.rotation.T == pytest.approx(np.eye(3))
        back = convert.box_pose(box([0, 0, 0], [1, 1, 1]), placed)
        pose.rotation = back.orientation
        stamped.transform = pose
        assert Placed.of(stamped).rotation == pytest.approx(placed.rotation)
