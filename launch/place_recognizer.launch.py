"""The node with a parameter file and the arguments that change most.

ros2 launch pnv_ros place_recognizer.launch.py image_topics:="['/camera/image_raw']"
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

ARGUMENTS = {
    "image_topics": ("['camera/image_raw']", "image topics, one per camera"),
    "preset": ("default", "default, performance, balanced, speed or storage: the file of config/ that is taken"),
    "map_path": ("", "folder of ~/save and ~/load"),
    "use_sim_time": ("false", "follow /clock"),
}


def generate_launch_description():
    # one flat list: launch before 3.4.5 takes no list inside another
    config = [FindPackageShare("pnv_ros"), "/config/", LaunchConfiguration("preset"), ".yaml"]
    return LaunchDescription(
        [
            DeclareLaunchArgument("namespace", default_value="", description="namespace of the node"),
            *[DeclareLaunchArgument(n, default_value=d, description=t) for n, (d, t) in ARGUMENTS.items()],
            DeclareLaunchArgument("params_file", default_value=config, description="parameters; see config/"),
            Node(
                package="pnv_ros",
                executable="place_recognizer",
                namespace=LaunchConfiguration("namespace"),
                output="screen",
                parameters=[
                    LaunchConfiguration("params_file"),
                    {
                        "image_topics": LaunchConfiguration("image_topics"),
                        "map_path": ParameterValue(LaunchConfiguration("map_path"), value_type=str),
                        "use_sim_time": LaunchConfiguration("use_sim_time"),
                    },
                ],
            ),
        ]
    )
