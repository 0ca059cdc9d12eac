"""The executable `swarm_slam_bridge`: metric closures of one robot into Swarm-SLAM's cslam/intra_robot_loop_closure.

Keyframes are numbered by Swarm-SLAM's front end, whose cslam/keyframe_odom says which id was taken when. `transform` is
keyframe1 in the frame of keyframe0 (its back end makes a BetweenFactor of it, with a fixed noise).
"""

from collections.abc import Sequence

from rclpy.qos import QoSProfile

from msg_adapters.images import stamp_of
from msg_adapters.metric_closures import MetricClosure
from msg_adapters.poses import transform_of
from msg_adapters.stamp_ids import NodePair, StampIds
from pnv_ros.bridges.config import SwarmSlamConfig
from pnv_ros.bridges.metric_bridge import MetricBridge
from pnv_ros.bridges.running import foreign, run, settings


class SwarmSlamBridge(MetricBridge):
    """Raises PnvError where cslam_common_interfaces is missing."""

    def __init__(self) -> None:
        super().__init__("swarm_slam_bridge")
        messages = foreign("cslam_common_interfaces.msg")
        self.config = settings(self, SwarmSlamConfig)
        self._closure_type = messages.IntraRobotLoopClosure
        self._ids = StampIds(self.config.tolerance_s, self.config.wait_s)
        self._stamps: dict[int, int] = {}
        qos = QoSProfile(depth=1000)
        self._out = self.create_publisher(self._closure_type, "cslam/intra_robot_loop_closure", qos)
        self.create_subscription(messages.KeyframeOdom, "cslam/keyframe_odom", self._keyframe, qos)
        self.listen(self.config)

    def take(self, closures: Sequence[MetricClosure]) -> None:
        for closure in closures:
            self._send(self._ids.add_closure(closure.closure, closure))

    def counts(self) -> str:
        return f"{super().counts()}, {self._ids.dropped} without a keyframe"

    def _keyframe(self, message: object) -> None:
        number, stamp_ns = int(message.id), stamp_of(message.odom)  # type: ignore[attr-defined]
        if self._stamps.setdefault(number, stamp_ns) != stamp_ns:
            self.get_logger().warning(f"keyframe {number} came again with another stamp: Swarm-SLAM was restarted")
            self._ids.begin_anew()
            self._stamps = {number: stamp_ns}
        self._send(self._ids.add_node(number, stamp_ns))

    def _send(self, pairs: Sequence[NodePair]) -> None:
        for pair in pairs:
            self._out.publish(
                self._closure_type(
                    keyframe0_id=pair.match,
                    keyframe1_id=pair.query,
                    success=True,
                    transform=transform_of(pair.carried.relative),
                )
            )
            self.sent += 1


def main(args: list[str] | None = None) -> int:
    """0 after SIGINT or SIGTERM, 2 for unusable settings or a missing package."""
    return run("swarm_slam_bridge", SwarmSlamBridge, args)
