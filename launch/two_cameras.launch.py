"""A front and a rear camera in one database, so that a place is recognised when driven through the other way round.

ros2 launch pnv_ros two_cameras.launch.py front:=/front/image_raw rear:=/rear/image_raw
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description():
    return LaunchDescription(
        [
            DeclareLaunchArgument("front", default_value="/front/image_raw", description="camera 0"),
            DeclareLaunchArgument("rear", default_value="/rear/image_raw", description="camera 1"),
            DeclareLaunchArgument("use_sim_time", default_value="false", description="follow /clock"),
            Node(
                package="pnv_ros",
                executable="place_recognizer",
                output="screen",
                remappings=[
                    ("front/image", LaunchConfiguration("front")),
                    ("rear/image", LaunchConfiguration("rear")),
                ],
                parameters=[
                    {
                        "image_topics": ["front/image", "rear/image"],
                        "use_sim_time": LaunchConfiguration("use_sim_time"),
                    }
                ],
            ),
        ]
    )
