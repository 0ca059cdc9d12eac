"""What the SLAM demo hears of place_recognizer and of tf_bridge, and the back end of tf_bridge without processes.

The camera is taken to look ahead from the body's origin.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Path
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger

from examples.listener import CLOSURES_QOS, NODE
from msg_adapters.images import stamp_of
from msg_adapters.loop_closures import closures_from_message
from msg_adapters.poses import matrix_of_pose
from msg_adapters.relative_pose import relative_pose_from_message
from pnv_core.errors import PnvError
from pnv_core.pose.back_end import BackEnd, Keeping
from pnv_core.pose.graph import Noise, PoseGraph
from pnv_core.types import LoopClosure

Array = NDArray[np.float64]

_SETTLED_S = 30.0
_PATH_QOS = QoSProfile(
    depth=1, reliability=QoSReliabilityPolicy.RELIABLE, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL
)


@dataclass(frozen=True)
class Recording:
    """What the recogniser said about a walk: closures, and measured relative poses by query stamp and match id.

    A relative pose is the query's camera (4, 4) in the match's optical frame with its covariance (6, 6).
    """

    closures: list[LoopClosure] = field(default_factory=list)
    measured: dict[tuple[int, int], tuple[Array, Array]] = field(default_factory=dict)


KEEPING = Keeping(node_m=0.0, node_deg=0.0, pose_wait_s=0.0)  # offline, every pose of these short walks is a node


def graph_of(noise: Noise, robust: bool = True) -> PoseGraph:
    """As tf_bridge has it by default, or plain least squares over every closure."""
    return PoseGraph(noise) if robust else PoseGraph(noise, "none", support=0)


class RecordingBackEnd(BackEnd):
    """The back end of tf_bridge, which remembers what it was told."""

    def __init__(self, graph: PoseGraph) -> None:
        super().__init__(graph, KEEPING)
        self.recording = Recording()

    def add_closures(self, closures: Sequence[LoopClosure]) -> None:
        self.recording.closures.extend(closures)
        super().add_closures(closures)

    def add_relative_pose(self, query_ns: int, match_id: int, camera: Array, covariance: Array) -> None:
        self.recording.measured[query_ns, match_id] = camera, covariance
        super().add_relative_pose(query_ns, match_id, camera, covariance)

    def play(self, recording: Recording) -> None:
        """Take everything of a recording."""
        for (query_ns, match_id), (camera, covariance) in recording.measured.items():
            self.add_relative_pose(query_ns, match_id, camera, covariance)
        self.add_closures(recording.closures)


class Follower(Node):
    """Overhears place_recognizer and tf_bridge: what the one says of the walk, and the path of the other."""

    def __init__(self) -> None:
        super().__init__("slam_demo")
        self.recording = Recording()
        self.stamps_ns: list[int] = []  # of the newest path
        self.path: Array = np.empty((0, 4, 4))
        self.create_subscription(Path, "tf_bridge/path", self._take_path, _PATH_QOS)
        self.create_subscription(Float64MultiArray, "loop_closures", self._closures, CLOSURES_QOS)
        self.create_subscription(PoseWithCovarianceStamped, f"{NODE}/relative_pose", self._relative_pose, 50)
        self._save = self.create_client(Trigger, "tf_bridge/save")

    def _take_path(self, message: Path) -> None:
        self.stamps_ns = [stamp_of(pose) for pose in message.poses]
        self.path = np.array([matrix_of_pose(pose.pose) for pose in message.poses])

    def _closures(self, message: Float64MultiArray) -> None:
        self.recording.closures.extend(closures_from_message(message))

    def _relative_pose(self, message: PoseWithCovarianceStamped) -> None:
        match_id, camera, covariance = relative_pose_from_message(message)
        self.recording.measured[stamp_of(message), match_id] = camera, covariance

    def settle(self) -> str:
        """Have tf_bridge solve with everything; what it says of its graph. `path` is of that solution then."""
        answer = self._save.call_async(Trigger.Request())
        rclpy.spin_until_future_complete(self, answer, timeout_sec=_SETTLED_S)
        response = answer.result()
        if response is None or not response.success:
            raise PnvError(f"tf_bridge: {response.message if response else f'no answer within {_SETTLED_S:g} s'}")
        nodes, end = int(response.message.split(": ")[-1].split()[0]), time.monotonic() + _SETTLED_S
        while len(self.stamps_ns) != nodes and time.monotonic() < end:
            rclpy.spin_once(self, timeout_sec=0.1)
        if len(self.stamps_ns) != nodes:
            raise PnvError(f"tf_bridge has {nodes} nodes, its path has {len(self.stamps_ns)}")
        return response.message.split(": ")[-1]


def between_nodes(stamps_ns: Sequence[int], odometry: Array, nodes_ns: Sequence[int], nodes: Array) -> Array:
    """The corrected pose (n, 4, 4) of every odometry pose: the node before it, or the first, carried on by odometry.

    `nodes` (m, 4, 4) are corrected poses at `nodes_ns`, each the stamp of an odometry pose.
    """
    before = np.maximum(0, np.searchsorted(nodes_ns, stamps_ns, side="right") - 1)
    at_node = odometry[np.searchsorted(stamps_ns, nodes_ns)][before]
    return nodes[before] @ np.linalg.inv(at_node) @ odometry
