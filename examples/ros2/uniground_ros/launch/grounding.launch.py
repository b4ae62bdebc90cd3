"""The node, and where the scan lies in the map: `ros2 launch uniground_ros grounding.launch.py scene_id:=… x:=1.2 yaw:=0.3`."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

ARGUMENTS = {
    "scene_id": ("", "A parsed scene of the server"),
    # Empty, so that the node reads UNIGROUND_SERVER.
    "server": ("", "Its address; default: UNIGROUND_SERVER, else http://127.0.0.1:8080. The key is read from UNIGROUND_API_KEY"),
    "robot_radius_m": ("0.0", "The robot as a cylinder, metres; 0: goals do not look at walls and furniture"),
    "robot_height_m": ("0.0", ""),
    "eye_height_m": ("0.0", "Where it sees from, above the floor"),
    "reach_m": ("0.0", "How far its arm reaches out of the cylinder; 0: it only has to see the thing"),
    "map_topic": ("map", "The robot's own map or costmap, which goals keep off; empty: not looked at"),
    "navigate": ("false", "Whether Nav2 drives to every goal"),
    "x": ("0", "Where the scan's origin lies in the map, metres"),
    "y": ("0", ""),
    "z": ("0", ""),
    "yaw": ("0", "How the scan is turned in the map, radians"),
}
ROBOT = ("robot_radius_m", "robot_height_m", "eye_height_m", "reach_m")


def generate_launch_description():
    given = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    place = [word for name in ("x", "y", "z", "yaw") for word in (f"--{name}", given[name])]
    return LaunchDescription(
        [
            *(DeclareLaunchArgument(name, default_value=value, description=says) for name, (value, says) in ARGUMENTS.items()),
            Node(
                package="tf2_ros",
                executable="static_transform_publisher",
                arguments=[*place, "--frame-id", "map", "--child-frame-id", "scan"],
            ),
            Node(
                package="uniground_ros",
                executable="grounding",
                name="uniground",
                output="screen",
                # As words, whatever they look like: launch would read some ids as numbers.
                parameters=[
                    {name: ParameterValue(given[name], value_type=str) for name in ("scene_id", "server", "map_topic")},
                    {"navigate": ParameterValue(given["navigate"], value_type=bool)},
                    {name: ParameterValue(given[name], value_type=float) for name in ROBOT},
                ],
            ),
        ]
    )
