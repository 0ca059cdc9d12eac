"""A bridge that hands on closures with measured poses; what becomes of them is said by those who derive from it."""

from collections.abc import Sequence

from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node
from std_msgs.msg import Float64MultiArray

from msg_adapters.images import stamp_of
from msg_adapters.loop_closures import closures_from_message
from msg_adapters.metric_closures import MetricClosure, MetricClosures
from msg_adapters.relative_pose import relative_pose_from_message
from pnv_core.errors import PnvError
from pnv_ros.bridges.config import BridgeConfig
from pnv_ros.outputs import CLOSURES_QOS


class MetricBridge(Node):
    """Subscribes closures and relative poses; `take` gets them joined."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.sent = 0

    def listen(self, config: BridgeConfig) -> None:
        """Begin, once everything else is there."""
        self._joined, self._config = MetricClosures(config.mount), config
        self.create_subscription(Float64MultiArray, config.closures_topic, self._closures, CLOSURES_QOS)
        self.create_subscription(PoseWithCovarianceStamped, config.relative_pose_topic, self._relative_pose, 50)
        self.get_logger().info(
            f"hands on {self.resolve_topic_name(config.closures_topic)} with the poses of "
            f"{self.resolve_topic_name(config.relative_pose_topic)}"
        )

    def take(self, closures: Sequence[MetricClosure]) -> None:
        """Hand closures on."""
        raise NotImplementedError

    def counts(self) -> str:
        """One line of what was sent and what was not."""
        joined = self._joined
        return (
            f"{self.sent} sent, {joined.waiting + joined.without_pose} without a measured pose, "
            f"{joined.unusable} poses without a usable covariance"
        )

    def end(self) -> None:
        self.get_logger().info(f"ended: {self.counts()}")

    def _closures(self, message: Float64MultiArray) -> None:
        try:
            self.take(self._joined.add_closures(closures_from_message(message)))
        except PnvError as error:
            self.get_logger().warning(f"{self._config.closures_topic}: {error}", throttle_duration_sec=10.0)

    def _relative_pose(self, message: PoseWithCovarianceStamped) -> None:
        before = self._joined.unusable
        try:
            match, camera, covariance = relative_pose_from_message(message)
        except PnvError as error:
            self.get_logger().warning(f"{self._config.relative_pose_topic}: {error}", throttle_duration_sec=10.0)
            return
        self.take(self._joined.add_pose(stamp_of(message), match, camera, covariance))
        if self._joined.unusable > before:
            self.get_logger().warning(
                f"relative pose of {stamp_of(message) / 1e9:.3f} has no finite, positive covariance; passed over"
            )
