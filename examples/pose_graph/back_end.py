"""A SLAM back end as a node: odometry and loop closures in, the corrected path out.

Subscribes `odometry` (nav_msgs/Odometry), `loop_closures` and, where the node measures them, the relative poses of
closures; publishes `corrected_path` (nav_msgs/Path). The camera is taken to look ahead from the body's origin.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry, Path
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from std_msgs.msg import Float64MultiArray

from examples.listener import CLOSURES_QOS, NODE
from msg_adapters.images import stamp_of
from msg_adapters.loop_closures import closures_from_message
from msg_adapters.poses import matrix_of_pose, path_message
from msg_adapters.relative_pose import relative_pose_from_message
from pnv_core.pose.back_end import BackEnd, Keeping
from pnv_core.pose.graph import Noise, PoseGraph
from pnv_core.types import LoopClosure

Array = NDArray[np.float64]

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


KEEPING = Keeping(node_m=0.0, node_deg=0.0, pose_wait_s=0.0)  # every pose of these short walks is a node


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


class BackEndNode(Node):
    """The back end on topics. Optimises once a second, and at most a third of the time, so that messages are heard."""

    def __init__(self, graph: PoseGraph) -> None:
        super().__init__("pose_graph")
        self.back_end = RecordingBackEnd(graph)
        self.messages = 0
        self._path = self.create_publisher(Path, "corrected_path", _PATH_QOS)
        self.create_subscription(Odometry, "odometry", self._odometry, QoSProfile(depth=500))
        self.create_subscription(Float64MultiArray, "loop_closures", self._closures, CLOSURES_QOS)
        self.create_subscription(PoseWithCovarianceStamped, f"{NODE}/relative_pose", self._relative_pose, 50)
        self.create_timer(1.0, self._correct_if_due)
        self._due = 0.0  # of the monotonic clock

    def _odometry(self, message: Odometry) -> None:
        self.back_end.add_odometry(stamp_of(message), matrix_of_pose(message.pose.pose))

    def _closures(self, message: Float64MultiArray) -> None:
        self.messages += 1
        self.back_end.add_closures(closures_from_message(message))

    def _relative_pose(self, message: PoseWithCovarianceStamped) -> None:
        match_id, camera, covariance = relative_pose_from_message(message)
        self.back_end.add_relative_pose(stamp_of(message), match_id, camera, covariance)

    def _correct_if_due(self) -> None:
        start = time.monotonic()
        if start >= self._due:
            self.correct()
            end = time.monotonic()
            self._due = end + 2 * (end - start)

    def correct(self, everything: bool = False) -> None:
        """Optimise, and publish the path."""
        self.back_end.update(everything)
        if self.back_end.stamps:
            self._path.publish(path_message(self.back_end.stamps, self.back_end.graph.poses, "map"))
