"""Every setting of the bridges, declared once."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pnv_core.errors import ConfigError
from pnv_core.pose.graph import KERNELS
from pnv_core.rotations import mount_of
from pnv_core.settings import checked, setting

_MOUNT = "camera on the body: x, y, z, roll, pitch, yaw of its housing, which looks along x"


@dataclass(frozen=True)
class BridgeConfig:
    """What every bridge is told."""

    closures_topic: str = setting("loop_closures", "std_msgs/Float64MultiArray of place_recognizer")
    relative_pose_topic: str = setting(
        "place_recognizer/relative_pose", "geometry_msgs/PoseWithCovarianceStamped of place_recognizer"
    )
    camera_in_body: tuple[float, ...] = setting((0.0,) * 6, _MOUNT, unit="m, rad")

    def __post_init__(self) -> None:
        checked(self)
        if len(self.camera_in_body) != 6:
            raise ConfigError(f"camera_in_body = {list(self.camera_in_body)}; allowed: 6 numbers")

    @property
    def mount(self) -> NDArray[np.float64]:
        """The camera's optical frame in the body, (4, 4)."""
        return mount_of(self.camera_in_body)


@dataclass(frozen=True)
class TfConfig(BridgeConfig):
    """tf_bridge."""

    odometry_topic: str = setting("odom", "nav_msgs/Odometry; its child frame is the body")
    map_frame: str = setting("map", "frame of the corrected poses")
    publish_tf: bool = setting(True, "broadcast map_frame -> the odometry's frame on /tf")
    tf_ahead_s: float = setting(0.1, "the transform is stamped so much after its odometry", unit="s", low=0.0, high=9.0)
    odometry_timeout_s: float = setting(5.0, "warn when no odometry came for so long", unit="s", low=0.1, high=1e6)
    graph_path: str = setting("", "g2o file that ~/save writes, and the end of the program; empty: none")
    kernel: str = setting("cauchy", "robust kernel of closures", choices=KERNELS)
    support: int = setting(
        1, "other closures that must agree with one before it counts; 0 takes every closure", low=0, high=100
    )
    tolerance_m: float = setting(
        1.0, "how far apart two images of one place are typically taken", unit="m", low=0.01, high=1e3
    )
    tolerance_deg: float = setting(12.0, "how far they are typically turned", unit="deg", low=0.1, high=180.0)
    odometry_per_m: float = setting(0.03, "error of the odometry per metre", unit="m/m", low=1e-4, high=1.0)
    odometry_deg_per_root_m: float = setting(
        1.0, "turning error of the odometry per root of a metre", unit="deg/m^0.5", low=1e-3, high=90.0
    )
    node_m: float = setting(0.5, "metres between nodes of the graph", unit="m", low=0.01, high=1e3)
    fastest_m_s: float = setting(10.0, "a faster step is a jump: odometry begins anew", unit="m/s", low=0.1, high=1e4)


@dataclass(frozen=True)
class RtabmapConfig(BridgeConfig):
    """rtabmap_bridge."""

    rtabmap_node: str = setting("/rtabmap/rtabmap", "full name of the node rtabmap; mapData is in its namespace")
    tolerance_s: float = setting(0.5, "furthest in time a node may be from an image", unit="s", low=0.0, high=60.0)
    wait_s: float = setting(10.0, "a closure waits until a node is so much newer than it", unit="s", low=0.0, high=1e4)
    m_per_s: float = setting(
        0.5, "speed of the robot: what a node's distance in time adds to the deviation", unit="m/s", low=0.0, high=100.0
    )


@dataclass(frozen=True)
class HydraConfig(BridgeConfig):
    """hydra_bridge."""

    robot_id: int = setting(0, "id of this robot in Hydra's scene graph", low=0, high=25)


@dataclass(frozen=True)
class SwarmSlamConfig(BridgeConfig):
    """swarm_slam_bridge."""

    tolerance_s: float = setting(0.5, "furthest in time a node may be from an image", unit="s", low=0.0, high=60.0)
    wait_s: float = setting(10.0, "a closure waits until a node is so much newer than it", unit="s", low=0.0, high=1e4)


@dataclass(frozen=True)
class LioSamConfig:
    """lio_sam_bridge."""

    pairs_topic: str = setting("place_recognizer/lio_sam", "std_msgs/Float64MultiArray, ~/lio_sam of place_recognizer")

    def __post_init__(self) -> None:
        checked(self)


BRIDGE_SETTINGS: dict[str, type] = {
    "tf_bridge": TfConfig,
    "rtabmap_bridge": RtabmapConfig,
    "hydra_bridge": HydraConfig,
    "swarm_slam_bridge": SwarmSlamConfig,
    "lio_sam_bridge": LioSamConfig,
}
