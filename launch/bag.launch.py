"""Play a bag to the node; both end with the bag.

ros2 launch pnv_ros bag.launch.py bag:=/data/run1 image_topics:="['/camera/image_raw']" rate:=2.0
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, ExecuteProcess, RegisterEventHandler, TimerAction
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

START_S = 8.0  # the model is loaded by then


def generate_launch_description():
    play = ExecuteProcess(
        cmd=["ros2", "bag", "play", LaunchConfiguration("bag"), "--clock", "--rate", LaunchConfiguration("rate")],
        output="screen",
    )
    return LaunchDescription(
        [
            DeclareLaunchArgument("bag", description="folder of the bag"),
            DeclareLaunchArgument("image_topics", default_value="['camera/image_raw']", description="image topics"),
            DeclareLaunchArgument("rate", default_value="1.0", description="times real time"),
            DeclareLaunchArgument("map_path", default_value="", description="folder the map is saved to, or none"),
            DeclareLaunchArgument("autosave", default_value="false", description="save the map when the bag ends"),
            Node(
                package="pnv_ros",
                executable="place_recognizer",
                output="screen",
                parameters=[
                    {
                        "image_topics": LaunchConfiguration("image_topics"),
                        "map_path": ParameterValue(LaunchConfiguration("map_path"), value_type=str),
                        "autosave": LaunchConfiguration("autosave"),
                        "use_sim_time": True,
                    }
                ],
            ),
            TimerAction(period=START_S, actions=[play]),
            RegisterEventHandler(OnProcessExit(target_action=play, on_exit=[EmitEvent(event=Shutdown())])),
        ]
    )
