"""Pictures and messages of an imagined camera."""

from array import array
from typing import Any

import cv2
import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import CompressedImage, Image

from test.ros.processes import NODE, PATIENCE_S, Listener, wait_until

EPOCH_S = 1_700_000_000
RELIABLE = QoSProfile(depth=10, reliability=QoSReliabilityPolicy.RELIABLE)


def reliable(*topics: str) -> dict[str, str]:
    """Parameters for tests that count frames: best effort, the default, may lose one on a machine short of time."""
    return {f"qos_overrides./{topic}.subscription.reliability": "reliable" for topic in topics}


def scene(seed: int, width: int = 320, height: int = 240) -> np.ndarray:
    """(height, width, 3) uint8: a place made of sixty shapes, the same for the same seed."""
    random = np.random.default_rng(seed)
    picture = np.full((height, width, 3), random.integers(60, 190, 3), np.uint8)
    for _ in range(60):
        centre = random.uniform((0, 0), (width, height))
        corners = centre + random.normal(0, width / 12, (int(random.integers(3, 6)), 2))
        cv2.fillPoly(picture, [corners.astype(np.int32)], random.integers(0, 256, 3).tolist())
    return picture


def image(rgb: np.ndarray, stamp_ns: int) -> Image:
    message = Image(height=rgb.shape[0], width=rgb.shape[1], encoding="rgb8", step=3 * rgb.shape[1])
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
    message.data = array("B", rgb.tobytes())
    return message


def compressed(rgb: np.ndarray, stamp_ns: int, extension: str = ".jpg") -> CompressedImage:
    message = CompressedImage(format="jpeg" if extension == ".jpg" else "png")
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
    message.data = array("B", cv2.imencode(extension, rgb[..., ::-1])[1].tobytes())
    return message


class Camera:
    """Publishes one message at a time and waits until the node has dealt with it."""

    def __init__(self, listener: Listener, health: "Health", topic: str, kind: type = Image, qos: Any = RELIABLE):
        self._publisher = listener.node.create_publisher(kind, topic, qos)
        self._health = health
        wait_until(self._publisher.get_subscription_count, PATIENCE_S, f"a subscription of {topic}")
        listener.met_by(health.node)

    def send(self, message: Any, wait: bool = True) -> None:
        before = self._health.dealt_with()
        self._publisher.publish(message)
        if wait:
            wait_until(lambda: self._health.dealt_with() > before, PATIENCE_S, "the node to take a frame")


def dealt_with(values: dict[str, str]) -> int:
    """Frames processed or dropped, of the values of one status."""
    return sum(int(v) for k, v in values.items() if k == "frames processed" or k.startswith("dropped"))


class Health:
    """/diagnostics of one node."""

    def __init__(self, listener: Listener, node: str = NODE):
        self._messages = listener.collect(DiagnosticArray, "/diagnostics")
        self.node = node

    @property
    def status(self) -> Any:
        """The latest status."""
        return wait_until(self._latest, PATIENCE_S, "diagnostics")

    def _latest(self) -> Any:
        return next((s for m in reversed(self._messages) for s in m.status if s.hardware_id == self.node), None)

    def values(self) -> dict[str, str]:
        return {v.key: v.value for v in self.status.values}

    def count(self, key: str) -> int:
        return int(self.values().get(key, 0))

    def working(self) -> bool:
        """Whether frames were processed."""
        return self.count("frames processed") > 0

    def dealt_with(self) -> int:
        """Frames processed or dropped."""
        return dealt_with(self.values())

    def fresh(self) -> Any:
        """A status published from now on."""
        seen = len(self._messages)
        wait_until(lambda: len(self._messages) > seen + 1, PATIENCE_S, "fresh diagnostics")
        return self.status
