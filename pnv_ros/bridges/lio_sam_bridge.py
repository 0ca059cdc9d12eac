"""The executable `lio_sam_bridge`: ~/lio_sam of place_recognizer into LIO-SAM's lio_loop/loop_closure_detection.

place_recognizer knows sessions and chooses what suits LIO-SAM; nothing comes back from there, so what this can add is
to wait until LIO-SAM listens, to check the form, and to count.
"""

from collections import deque

import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from std_msgs.msg import Float64MultiArray

from pnv_ros.bridges.config import LioSamConfig
from pnv_ros.bridges.running import run, settings
from pnv_ros.outputs import TABLE_QOS

_KEPT = 5  # as many as LIO-SAM itself keeps
_LOOK_S = 0.2


class LioSamBridge(Node):
    """Hands on pairs of stamps; those that come while nobody listens are kept, the last five."""

    def __init__(self) -> None:
        super().__init__("lio_sam_bridge")
        config = settings(self, LioSamConfig)
        self._waiting: deque[Float64MultiArray] = deque()
        self.sent = self.unheard = self.malformed = 0
        self._told = False
        self._out = self.create_publisher(Float64MultiArray, "lio_loop/loop_closure_detection", TABLE_QOS)
        self.create_subscription(Float64MultiArray, config.pairs_topic, self._pair, TABLE_QOS)
        self.create_timer(_LOOK_S, self._hand_on, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.get_logger().info(f"hands on {self.resolve_topic_name(config.pairs_topic)} to {self._out.topic_name}")

    def counts(self) -> str:
        """One line of what was sent and what was not."""
        unheard = self.unheard + len(self._waiting)
        return f"{self.sent} sent, {unheard} without a listener, {self.malformed} malformed"

    def end(self) -> None:
        self.get_logger().info(f"ended: {self.counts()}")

    def _pair(self, message: Float64MultiArray) -> None:
        data = np.asarray(message.data)
        if data.shape != (2,) or not np.isfinite(data).all() or data[0] <= data[1]:
            self.malformed += 1
            self.get_logger().warning(
                f"{[float(v) for v in data[:4]]} given; allowed: two stamps in seconds, the newer first",
                throttle_duration_sec=10.0,
            )
            return
        self._waiting.append(message)
        self._hand_on()
        if len(self._waiting) > _KEPT:
            self._waiting.popleft()
            self.unheard += 1

    def _hand_on(self) -> None:
        if not self._out.get_subscription_count():
            if self._waiting and not self._told:
                self._told = True
                topic = self._out.topic_name
                self.get_logger().warning(f"nobody listens on {topic}; the last {_KEPT} closures are kept")
            return
        self._told = False
        while self._waiting:
            self._out.publish(self._waiting.popleft())
            self.sent += 1


def main(args: list[str] | None = None) -> int:
    """0 after SIGINT or SIGTERM, 2 for unusable settings."""
    return run("lio_sam_bridge", LioSamBridge, args)
