"""rtabmap_bridge beside a running place_recognizer and RTAB-Map.

ros2 launch pnv_ros rtabmap_bridge.launch.py rtabmap_node:=/rtabmap/rtabmap
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

ARGUMENTS = {
    "camera_in_body": ("[0.0, 0.0, 0.0, 0.0, 0.0, 0.0]", "x, y, z, roll, pitch, yaw of the camera's housing"),
    "rtabmap_node": ("/rtabmap/rtabmap", "full name of the node rtabmap"),
}


def generate_launch_description():
    return LaunchDescription(
        [
            *[DeclareLaunchArgument(n, default_value=d, description=t) for n, (d, t) in ARGUMENTS.items()],
            Node(
                package="pnv_ros",
                executable="rtabmap_bridge",
                output="screen",
                parameters=[{name: LaunchConfiguration(name) for name in ARGUMENTS}],
            ),
        ]
    )
