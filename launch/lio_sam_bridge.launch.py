"""lio_sam_bridge beside a running place_recognizer and LIO-SAM.

ros2 launch pnv_ros lio_sam_bridge.launch.py pairs_topic:=place_recognizer/lio_sam
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

ARGUMENTS = {"pairs_topic": ("place_recognizer/lio_sam", "~/lio_sam of place_recognizer")}


def generate_launch_description():
    return LaunchDescription(
        [
            *[DeclareLaunchArgument(n, default_value=d, description=t) for n, (d, t) in ARGUMENTS.items()],
            Node(
                package="pnv_ros",
                executable="lio_sam_bridge",
                output="screen",
                parameters=[{name: LaunchConfiguration(name) for name in ARGUMENTS}],
            ),
        ]
    )
