"""The executable `rtabmap_bridge`: metric closures into RTAB-Map by its service add_link.

The response of add_link is empty, whether the link was kept or not; the bridge asks for the graph afterwards and says
what became of each link. One link is asked for at a time.
"""

import math
import time
from collections import Counter, deque
from collections.abc import Sequence
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.qos import QoSProfile

from msg_adapters.metric_closures import MetricClosure
from msg_adapters.rtabmap import fill_link, node_stamps, why_not_in
from msg_adapters.stamp_ids import NodePair, StampIds
from pnv_core.errors import ConfigError
from pnv_ros.bridges.config import RtabmapConfig
from pnv_ros.bridges.metric_bridge import MetricBridge
from pnv_ros.bridges.running import foreign, run, settings

_PUMP_S, _ANSWER_S = 0.1, 10.0


class RtabmapBridge(MetricBridge):
    """Raises PnvError where rtabmap_msgs is missing."""

    def __init__(self) -> None:
        super().__init__("rtabmap_bridge")
        messages, self._types = foreign("rtabmap_msgs.msg"), foreign("rtabmap_msgs.srv")
        self.config = config = settings(self, RtabmapConfig)
        if not config.rtabmap_node.startswith("/") or config.rtabmap_node.endswith("/"):
            raise ConfigError(f"rtabmap_node = {config.rtabmap_node!r}; allowed: a full name, as /rtabmap/rtabmap")
        self._ids = StampIds(config.tolerance_s, config.wait_s)
        self._stamps: dict[int, int] = {}
        self._queue: deque[NodePair] = deque()
        self._asked: NodePair | None = None
        self._asked_at, self._knows_the_map, self._told = 0.0, False, False
        self._map_asked_at = -math.inf
        self.taken, self.refused = 0, Counter[str]()
        self._add = self.create_client(self._types.AddLink, f"{config.rtabmap_node}/add_link")
        self._get = self.create_client(self._types.GetMap, f"{config.rtabmap_node}/get_map_data")
        topic = f"{config.rtabmap_node.rpartition('/')[0]}/mapData"
        self.create_subscription(messages.MapData, topic, self._map_data, QoSProfile(depth=10))
        self.create_timer(_PUMP_S, self._pump, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.listen(config)

    def take(self, closures: Sequence[MetricClosure]) -> None:
        for closure in closures:
            self._queue += self._ids.add_closure(closure.closure, closure)

    def counts(self) -> str:
        refused = ", ".join(f"{count} refused: {why}" for why, count in sorted(self.refused.items())) or "none refused"
        return (
            f"{super().counts()}, {self._ids.dropped} without a node, {self.taken} taken, {refused}, "
            f"{len(self._queue) + (self._asked is not None)} not answered"
        )

    def _map_data(self, message: Any) -> None:
        for node, stamp_ns in node_stamps(message).items():
            if self._stamps.setdefault(node, stamp_ns) != stamp_ns:
                self.get_logger().warning(f"node {node} came again with another stamp: RTAB-Map was restarted")
                self._ids.begin_anew()
                self._stamps = {node: stamp_ns}
                self._queue.clear()
            self._queue += self._ids.add_node(node, stamp_ns)

    def _learn(self, graph: Any) -> None:
        self._knows_the_map = True
        self._map_data(graph)

    def _pump(self) -> None:
        """Learn the nodes there are, then ask for one link after the other."""
        ready = self._add.service_is_ready() and self._get.service_is_ready()
        if not ready:
            if self._queue and not self._told:
                self._told = True
                self.get_logger().warning(f"no service {self._add.srv_name}; {len(self._queue)} links wait for it")
            self._knows_the_map, self._map_asked_at, self._asked = False, -math.inf, None
            return
        self._told = False
        now = time.monotonic()  # an answer takes its time whatever a simulation's clock says
        if not self._knows_the_map and now - self._map_asked_at > _ANSWER_S:
            self._map_asked_at = now  # the answer is lost where RTAB-Map does not know this client yet
            self._whole_graph(self._learn)
        if self._asked is not None and now - self._asked_at > _ANSWER_S:
            self._settle(f"no answer in {_ANSWER_S:.0f} s")
        if self._asked is None and self._queue:
            self._asked, self._asked_at = self._queue.popleft(), now
            request = self._types.AddLink.Request()
            fill_link(request.link, self._asked, self._asked.carried, self.config.m_per_s)
            self.sent += 1
            self._add.call_async(request).add_done_callback(self._look)

    def _look(self, _: Any) -> None:
        pair = self._asked
        if pair is not None:
            self._whole_graph(lambda data: self._settle(why_not_in(data, pair.match, pair.query)))

    def _whole_graph(self, use: Any) -> None:
        request = self._types.GetMap.Request(global_map=False, optimized=True, graph_only=True)
        self._get.call_async(request).add_done_callback(lambda done: use(done.result().data))

    def _settle(self, why: str) -> None:
        pair, self._asked = self._asked, None
        if pair is None:
            return
        if why:
            self.refused["a node is not in its graph" if why.startswith("node") else why] += 1
            self.get_logger().warning(f"RTAB-Map did not keep the link {pair.match} -> {pair.query}: {why}")
        else:
            self.taken += 1


def main(args: list[str] | None = None) -> int:
    """0 after SIGINT or SIGTERM, 2 for unusable settings or a missing package."""
    return run("rtabmap_bridge", RtabmapBridge, args)
