"""hydra_bridge beside a running place_recognizer and Hydra.

ros2 launch pnv_ros hydra_bridge.launch.py robot_id:=0
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

ARGUMENTS = {
    "camera_in_body": ("[0.0, 0.0, 0.0, 0.0, 0.0, 0.0]", "x, y, z, roll, pitch, yaw of the camera's housing"),
    "robot_id": ("0", "id of this robot in Hydra's scene graph"),
}


def generate_launch_description():
    return LaunchDescription(
        [
            *[DeclareLaunchArgument(n, default_value=d, description=t) for n, (d, t) in ARGUMENTS.items()],
            Node(
                package="pnv_ros",
                executable="hydra_bridge",
                output="screen",
                parameters=[{name: LaunchConfiguration(name) for name in ARGUMENTS}],
                remappings=[("external_loop_closures", "/hydra/external_loop_closures")],
            ),
        ]
    )
