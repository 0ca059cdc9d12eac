"""place_recognizer and tf_bridge: a corrected pose for a robot with odometry and no SLAM.

ros2 launch pnv_ros tf_bridge.launch.py image_topics:="['/camera/image_raw']" odometry_topic:=/odom
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

ARGUMENTS = {
    "image_topics": ("['camera/image_raw']", "image topics, one per camera"),
    "odometry_topic": ("odom", "nav_msgs/Odometry"),
    "camera_in_body": ("[0.0, 0.0, 0.0, 0.0, 0.0, 0.0]", "x, y, z, roll, pitch, yaw of the camera's housing"),
    "graph_path": ("", "g2o file written at the end and by ~/save"),
}


def generate_launch_description():
    given = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    recogniser = {name: given[name] for name in ("image_topics", "odometry_topic")}
    bridge = {name: given[name] for name in ("odometry_topic", "camera_in_body", "graph_path")}
    return LaunchDescription(
        [
            *[DeclareLaunchArgument(n, default_value=d, description=t) for n, (d, t) in ARGUMENTS.items()],
            Node(package="pnv_ros", executable="place_recognizer", output="screen", parameters=[recogniser]),
            Node(package="pnv_ros", executable="tf_bridge", output="screen", parameters=[bridge]),
        ]
    )
