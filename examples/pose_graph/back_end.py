"""A SLAM back end as a node: odometry and loop closures in, the corrected path out.

Subscribes `odometry` (nav_msgs/Odometry), `loop_closures` and, where the node measures them, the relative poses of
closures; publishes `corrected_path` (nav_msgs/Path). The camera is taken to look ahead from the body's origin.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry, Path
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from scipy.spatial.transform import Rotation
from std_msgs.msg import Float64MultiArray

from examples.listener import CLOSURES_QOS, NODE
from examples.pose_graph.graph import Loop, PoseGraph
from msg_adapters.images import stamp_of
from msg_adapters.loop_closures import closures_from_message, to_time
from msg_adapters.stamp_ids import NodePair, StampIds
from pnv_core.types import LoopClosure
from pnv_lab.worlds import CAMERA_IN_BODY

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


class BackEnd:
    """The graph by stamps, without ROS: closures wait for their poses, those that never get one are dropped."""

    def __init__(self, graph: PoseGraph) -> None:
        self.graph = graph
        self.stamps: list[int] = []
        self.used: list[NodePair] = []
        self._nodes = StampIds()
        self._measured: dict[tuple[int, int], tuple[Array, Array]] = {}
        self._fresh = False

    def add_odometry(self, stamp_ns: int, pose: Array) -> None:
        """A pose (4, 4); stamps that do not grow are ignored."""
        if not self.stamps or stamp_ns > self.stamps[-1]:
            self.stamps.append(stamp_ns)
            self._take(self._nodes.add_node(self.graph.add_odometry(pose), stamp_ns))

    def add_closures(self, closures: Sequence[LoopClosure]) -> None:
        for closure in closures:
            self._take(self._nodes.add_closure(closure))

    def _take(self, pairs: Sequence[NodePair]) -> None:
        self.used += pairs
        self._fresh |= bool(pairs)

    def add_relative_pose(self, query_ns: int, match_id: int, camera: Array, covariance: Array) -> None:
        """The query's camera (4, 4) in the match's optical frame, and its covariance (6, 6), position first."""
        self._measured[query_ns, match_id] = camera, covariance
        self._fresh = True

    def play(self, recording: Recording) -> None:
        """Take everything of a recording."""
        self.add_closures(recording.closures)
        for (query_ns, match_id), (camera, covariance) in recording.measured.items():
            self.add_relative_pose(query_ns, match_id, camera, covariance)

    @property
    def recording(self) -> Recording:
        """What was taken so far."""
        return Recording([pair.closure for pair in self.used], dict(self._measured))

    @property
    def dropped(self) -> int:
        """Closures that no odometry was near to in time."""
        return self._nodes.dropped

    def update(self) -> bool:
        """Optimise if there is anything new, and say whether there was."""
        fresh, self._fresh = self._fresh, False
        if fresh:
            self.graph.loops = [self._loop(pair) for pair in self.used]
            self.graph.optimise()
        return fresh

    def _loop(self, pair: NodePair) -> Loop:
        measured = self._measured.get((pair.closure.query.stamp_ns, pair.closure.match.id))
        if measured is None:
            return Loop(pair.query, pair.match, pair.closure.score)
        camera, covariance = measured
        turn, both = np.eye(4), np.kron(np.eye(2), CAMERA_IN_BODY)
        turn[:3, :3] = CAMERA_IN_BODY
        return Loop(pair.query, pair.match, pair.closure.score, turn @ camera @ turn.T, both @ covariance @ both.T)


class BackEndNode(Node):
    """The back end on topics. Optimises once a second, and at most a third of the time, so that messages are heard."""

    def __init__(self, graph: PoseGraph) -> None:
        super().__init__("pose_graph")
        self.back_end = BackEnd(graph)
        self.messages = 0
        self._path = self.create_publisher(Path, "corrected_path", _PATH_QOS)
        self.create_subscription(Odometry, "odometry", self._odometry, QoSProfile(depth=500))
        self.create_subscription(Float64MultiArray, "loop_closures", self._closures, CLOSURES_QOS)
        self.create_subscription(PoseWithCovarianceStamped, f"{NODE}/relative_pose", self._relative_pose, 50)
        self.create_timer(1.0, self._correct_if_due)
        self._due = 0.0  # of the monotonic clock

    def _odometry(self, message: Odometry) -> None:
        self.back_end.add_odometry(stamp_of(message), pose_matrix(message))

    def _closures(self, message: Float64MultiArray) -> None:
        self.messages += 1
        self.back_end.add_closures(closures_from_message(message))

    def _relative_pose(self, message: PoseWithCovarianceStamped) -> None:
        match_id = int(message.header.frame_id.rpartition("_")[2])
        covariance = np.reshape(message.pose.covariance, (6, 6))
        self.back_end.add_relative_pose(stamp_of(message), match_id, pose_matrix(message), covariance)

    def _correct_if_due(self) -> None:
        start = time.monotonic()
        if start >= self._due:
            self.correct()
            end = time.monotonic()
            self._due = end + 2 * (end - start)

    def correct(self) -> None:
        """Optimise if there are new closures, and publish the path."""
        if self.back_end.update() or self.back_end.stamps:
            self._path.publish(path_message(self.back_end.stamps, self.back_end.graph.poses))


def pose_matrix(message: Odometry | PoseWithCovarianceStamped) -> Array:
    """(4, 4) pose of a message that has one."""
    position, orientation = message.pose.pose.position, message.pose.pose.orientation
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat([orientation.x, orientation.y, orientation.z, orientation.w]).as_matrix()
    matrix[:3, 3] = position.x, position.y, position.z
    return matrix


def path_message(stamps_ns: Sequence[int], poses: Array) -> Path:
    """(n, 4, 4) poses as nav_msgs/Path in the frame map."""
    message = Path()
    message.header.frame_id = "map"
    if len(stamps_ns):
        message.header.stamp = to_time(stamps_ns[-1])
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat() if len(poses) else []
    for stamp_ns, pose, quaternion in zip(stamps_ns, poses, quaternions, strict=True):
        item = PoseStamped()
        item.header.frame_id = "map"
        item.header.stamp = to_time(stamp_ns)
        position, orientation = item.pose.position, item.pose.orientation
        position.x, position.y, position.z = (float(v) for v in pose[:3, 3])
        orientation.x, orientation.y, orientation.z, orientation.w = (float(v) for v in quaternion)
        message.poses.append(item)
    return message
