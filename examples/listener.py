"""What a program that uses the node's closures sees: closures, latencies and the node's own counts."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64MultiArray

from msg_adapters.images import stamp_of
from msg_adapters.loop_closures import closures_from_message
from pnv_core.types import LoopClosure

CLOSURES_QOS = QoSProfile(
    depth=50, reliability=QoSReliabilityPolicy.RELIABLE, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL
)
NODE = "place_recognizer"


@dataclass
class Heard:
    """Closures in order of arrival, when each query's result arrived (monotonic seconds by stamp), the last counts."""

    closures: list[LoopClosure] = field(default_factory=list)
    arrived: dict[int, float] = field(default_factory=dict)
    counts: dict[str, str] = field(default_factory=dict)
    counted: int = 0  # how many statuses came

    def count(self, name: str) -> int:
        return int(self.counts.get(name, 0))

    @property
    def dropped(self) -> int:
        return sum(int(value) for name, value in self.counts.items() if name.startswith("dropped"))

    @property
    def settled(self) -> bool:
        """Whether the node has dealt with every frame that reached it."""
        return self.count("frames in") <= self.count("frames processed") + self.dropped


def listen(
    node: Node,
    on_closures: Callable[[list[LoopClosure]], None],
    ours: Callable[[LoopClosure], bool] = lambda closure: True,
) -> Heard:
    """Subscribe a node to everything; `on_closures` is called with the closures of each query as they arrive.

    What is not `ours` comes from another node of the same domain and is passed over.
    """
    heard = Heard()

    def closures(message: Float64MultiArray) -> None:
        now = time.monotonic()
        closures_of_query = [closure for closure in closures_from_message(message) if ours(closure)]
        if not closures_of_query:
            return
        heard.arrived.setdefault(closures_of_query[0].query.stamp_ns, now)
        heard.closures += closures_of_query
        on_closures(closures_of_query)

    def candidates(message: PointCloud2) -> None:
        heard.arrived.setdefault(stamp_of(message), time.monotonic())

    def diagnostics(message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.startswith(f"/{NODE}:"):
                heard.counts = {pair.key: pair.value for pair in status.values} or heard.counts
                heard.counted += 1

    node.create_subscription(Float64MultiArray, "loop_closures", closures, CLOSURES_QOS)
    node.create_subscription(PointCloud2, f"{NODE}/candidates", candidates, 50)
    node.create_subscription(DiagnosticArray, "/diagnostics", diagnostics, 10)
    return heard
