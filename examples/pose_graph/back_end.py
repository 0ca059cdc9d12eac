"""A SLAM back end as a node: odometry and loop closures in, the corrected path out.

Subscribes `odometry` (nav_msgs/Odometry), `loop_closures` and, where the node measures them, the relative poses of
closures; publishes `corrected_path` (nav_msgs/Path). The camera is taken to look ahead from the body's origin.
"""

import time
from bisect import bisect_left
from collections.abc import Sequence

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
from pnv_core.types import LoopClosure
from pnv_core.worlds import CAMERA_IN_BODY

Array = NDArray[np.float64]

NEAREST_NS = 500_000_000  # a closure's images have a pose at most this far in time, or there is none
_PATH_QOS = QoSProfile(
    depth=1, reliability=QoSReliabilityPolicy.RELIABLE, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL
)


class BackEnd:
    """The graph by stamps, without ROS: closures wait for their poses, each that has none is dropped."""

    def __init__(self, graph: PoseGraph) -> None:
        self.graph = graph
        self.stamps: list[int] = []
        self.used: list[tuple[LoopClosure, int, int]] = []  # with the nodes of query and match
        self.dropped: list[LoopClosure] = []
        self.measured: dict[tuple[int, int], tuple[Array, Array]] = {}
        self._waiting: list[LoopClosure] = []
        self._fresh = False

    def add_odometry(self, stamp_ns: int, pose: Array) -> None:
        """A pose (4, 4); stamps that do not grow are ignored."""
        if self.stamps and stamp_ns <= self.stamps[-1]:
            return
        self.stamps.append(stamp_ns)
        self.graph.add_odometry(pose)

    def add_closures(self, closures: Sequence[LoopClosure]) -> None:
        self._waiting += closures

    def add_relative_pose(self, query_ns: int, match_id: int, camera: Array, covariance: Array) -> None:
        """The query's camera (4, 4) in the match's optical frame, and its covariance (6, 6), position first."""
        turn = np.eye(4)
        turn[:3, :3] = CAMERA_IN_BODY
        both = np.kron(np.eye(2), CAMERA_IN_BODY)
        self.measured[query_ns, match_id] = turn @ camera @ turn.T, both @ covariance @ both.T
        self._fresh = True

    def update(self) -> bool:
        """Take the closures whose poses are there and optimise; whether anything was new."""
        ready = [c for c in self._waiting if self.stamps and c.query.stamp_ns <= self.stamps[-1]]
        self._waiting = [c for c in self._waiting if c not in ready]
        for closure in ready:
            query, match = self.nearest(closure.query.stamp_ns), self.nearest(closure.match.stamp_ns)
            if query is None or match is None:
                self.dropped.append(closure)
            else:
                self.used.append((closure, query, match))
        changed = bool(ready) or self._fresh
        if changed:
            self._fresh = False
            self.graph.loops = [
                Loop(query, match, c.score, *self.measured.get((c.query.stamp_ns, c.match.id), (None, None)))
                for c, query, match in self.used
            ]
            self.graph.optimise()
        return changed

    def nearest(self, stamp_ns: int) -> int | None:
        """The node nearest in time; None where it is too far."""
        after = bisect_left(self.stamps, stamp_ns)
        near = [node for node in (after - 1, after) if 0 <= node < len(self.stamps)]
        best = min(near, key=lambda node: abs(self.stamps[node] - stamp_ns), default=None)
        return best if best is not None and abs(self.stamps[best] - stamp_ns) <= NEAREST_NS else None


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
        dropped = len(self.back_end.dropped)
        changed = self.back_end.update()
        for closure in self.back_end.dropped[dropped:]:
            self.get_logger().warning(
                f"no odometry within 0.5 s of {closure.query.stamp_ns} or {closure.match.stamp_ns}: closure dropped"
            )
        if changed or len(self.back_end.stamps):
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
