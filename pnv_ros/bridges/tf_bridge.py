"""The executable `tf_bridge`: a corrected pose for a robot with odometry and no SLAM.

Odometry and loop closures become a pose graph; map -> odom is broadcast as REP-105 asks, `~/path` is corrected.
"""

import time
from pathlib import Path as FilePath

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry, Path
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger

from msg_adapters.images import stamp_of
from msg_adapters.loop_closures import closures_from_message
from msg_adapters.poses import matrix_of_pose, path_message, transform_stamped
from msg_adapters.relative_pose import relative_pose_from_message
from pnv_core.errors import ConfigError, PnvError
from pnv_core.files import atomic_write
from pnv_core.pose.back_end import BackEnd, Keeping
from pnv_core.pose.export import pose_graph_to_g2o
from pnv_core.pose.graph import Noise, PoseGraph
from pnv_ros.bridges.config import TfConfig
from pnv_ros.bridges.running import foreign, run, settings
from pnv_ros.outputs import CLOSURES_QOS

_UPDATE_S, _PATH_S = 0.2, 1.0
_POSE_LATEST_S = 1.0  # no odometry for so long: closures wait for no measured pose any more
_LATCHED = QoSProfile(
    depth=1, reliability=QoSReliabilityPolicy.RELIABLE, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL
)
_TF_QOS = QoSProfile(depth=100, reliability=QoSReliabilityPolicy.RELIABLE)


class TfBridge(Node):
    """A BackEnd on topics. Raises PnvError where a setting, GTSAM or tf2_msgs cannot be used."""

    def __init__(self) -> None:
        super().__init__("tf_bridge")
        self.config = config = settings(self, TfConfig)
        if config.graph_path and not FilePath(config.graph_path).absolute().parent.is_dir():
            raise ConfigError(f"graph_path = {config.graph_path!r}; allowed: a file in a folder that exists")
        self._tf_message = foreign("tf2_msgs.msg").TFMessage if config.publish_tf else None
        noise = Noise(
            odometry_per_m=config.odometry_per_m, odometry_deg_per_root_m=config.odometry_deg_per_root_m,
            tolerance_m=config.tolerance_m, tolerance_deg=config.tolerance_deg,
        )  # fmt: skip
        keeping = Keeping(node_m=config.node_m, fastest_m_s=config.fastest_m_s)
        self.back_end = BackEnd(PoseGraph(noise, config.kernel, config.support), keeping, config.mount)
        self._odom_frame, self._stamp_ns, self._sent_ns = "", 0, 0
        self._heard, self._silent, self._slowest_ms = time.monotonic(), False, 0.0
        self._path_is_old, self._path_due, self._path_nodes = False, 0.0, 0
        self._path = self.create_publisher(Path, "~/path", _LATCHED)
        if self._tf_message is not None:
            self._tf = self.create_publisher(self._tf_message, "/tf", _TF_QOS)
        self.create_subscription(Odometry, config.odometry_topic, self._odometry, QoSProfile(depth=500))
        self.create_subscription(Float64MultiArray, config.closures_topic, self._closures, CLOSURES_QOS)
        self.create_subscription(PoseWithCovarianceStamped, config.relative_pose_topic, self._relative_pose, 50)
        self.create_service(Trigger, "~/save", self._save)
        self.create_timer(_UPDATE_S, self._update, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.get_logger().info(
            f"corrects {self.resolve_topic_name(config.odometry_topic)} by "
            f"{self.resolve_topic_name(config.closures_topic)}, kernel {config.kernel}, support {config.support}"
        )

    def end(self) -> None:
        """Solve with everything, write the graph, say what was taken."""
        self._update(everything=True)
        if self.config.graph_path and self.back_end.stamps:
            self.get_logger().info(self._write())
        self.get_logger().info(f"ended: {self.counts()}")

    def counts(self) -> str:
        """One line of what was taken and refused."""
        graph, back_end = self.back_end.graph, self.back_end
        refused = ", ".join(f"{count} {reason}" for reason, count in sorted(back_end.refused.items())) or "none"
        return (
            f"{len(graph)} nodes, {sum(graph.entered)} of {back_end.taken} closures in the solution "
            f"({back_end.taken - sum(graph.entered)} unsupported), {back_end.waiting} waiting, refused: {refused}, "
            f"slowest update {self._slowest_ms:.0f} ms"
        )

    def _odometry(self, message: Odometry) -> None:
        self._heard, stamp_ns = time.monotonic(), stamp_of(message)
        if self._silent:
            self._silent = False
            self.get_logger().info("odometry is back")
        self._odom_frame = message.header.frame_id or "odom"
        if self._stamp_ns - stamp_ns >= 1_000_000_000:
            self._sent_ns = 0  # time began anew
        self._stamp_ns = stamp_ns
        self.back_end.add_odometry(stamp_ns, matrix_of_pose(message.pose.pose))
        self._say()
        if self.back_end.stamps:
            self._broadcast()

    def _closures(self, message: Float64MultiArray) -> None:
        try:
            self.back_end.add_closures(closures_from_message(message))
        except PnvError as error:
            self.get_logger().warning(f"{self.config.closures_topic}: {error}", throttle_duration_sec=10.0)

    def _relative_pose(self, message: PoseWithCovarianceStamped) -> None:
        try:
            match, camera, covariance = relative_pose_from_message(message)
        except PnvError as error:
            self.get_logger().warning(f"{self.config.relative_pose_topic}: {error}", throttle_duration_sec=10.0)
            return
        self.back_end.add_relative_pose(stamp_of(message), match, camera, covariance)
        self._say()

    def _update(self, everything: bool = False) -> None:
        start = time.monotonic()
        moved = self.back_end.update(everything or start - self._heard > _POSE_LATEST_S)
        end = time.monotonic()
        self._slowest_ms = max(self._slowest_ms, (end - start) * 1e3)
        self._say()
        if moved:
            self.get_logger().info(self.counts(), throttle_duration_sec=10.0)
        self._path_is_old |= moved or len(self.back_end.stamps) != self._path_nodes
        if self._path_is_old and self._path.get_subscription_count() and (end >= self._path_due or everything):
            self._path_is_old, self._path_due, self._path_nodes = False, end + _PATH_S, len(self.back_end.stamps)
            self._path.publish(path_message(self.back_end.stamps, self.back_end.graph.poses, self.config.map_frame))
        if end - self._heard > self.config.odometry_timeout_s and not self._silent:
            self._silent = True
            self.get_logger().warning(
                f"no odometry on {self.resolve_topic_name(self.config.odometry_topic)} for {end - self._heard:.1f} s; "
                f"{self.config.map_frame} is not broadcast until it is back"
            )

    def _broadcast(self) -> None:
        """map -> odom at every odometry stamp, a little ahead, so that the newest pose can be looked up at once."""
        stamp_ns = self._stamp_ns + round(self.config.tf_ahead_s * 1e9)
        if self._tf_message is None or stamp_ns <= self._sent_ns:
            return
        self._sent_ns = stamp_ns
        correction = self.back_end.map_from_odom
        transform = transform_stamped(correction, stamp_ns, self.config.map_frame, self._odom_frame)
        self._tf.publish(self._tf_message(transforms=[transform]))

    def _say(self) -> None:
        while self.back_end.complaints:
            self.get_logger().warning(self.back_end.complaints.popleft())

    def _save(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            if not self.config.graph_path:
                raise ConfigError("graph_path is empty; allowed: a file, set by the parameter graph_path")
            if not self.back_end.stamps:
                raise ConfigError("no odometry yet; allowed: after the first")
            self._update(everything=True)
            response.success, response.message = True, self._write()
        except (PnvError, OSError) as error:
            response.success, response.message = False, str(error)
        return response

    def _write(self) -> str:
        graph = self.back_end.graph
        text = pose_graph_to_g2o(np.asarray(graph.poses), graph.edges())
        with atomic_write(self.config.graph_path) as file:
            file.write(text.encode())
        return f"{self.config.graph_path}: {len(graph)} nodes, {sum(graph.entered)} closures"


def main(args: list[str] | None = None) -> int:
    """0 after SIGINT or SIGTERM, 2 for unusable settings or a missing package."""
    return run("tf_bridge", TfBridge, args)
