"""The executable `hydra_bridge`: metric closures into Hydra's external_loop_closures (pose_graph_tools_msgs/PoseGraph).

Hydra finds its own nodes by the stamps that stand in key_from and key_to, waits for them, and drops what is further off
than its max_time_difference. An edge's pose is to_T_from: the query goes in as `from`, the match as `to`.
"""

from collections.abc import Sequence

from rclpy.qos import QoSProfile

from msg_adapters.loop_closures import to_time
from msg_adapters.metric_closures import MetricClosure
from msg_adapters.poses import set_pose
from pnv_ros.bridges.config import HydraConfig
from pnv_ros.bridges.metric_bridge import MetricBridge
from pnv_ros.bridges.running import foreign, run, settings


class HydraBridge(MetricBridge):
    """Raises PnvError where pose_graph_tools_msgs is missing."""

    def __init__(self) -> None:
        super().__init__("hydra_bridge")
        self._messages = foreign("pose_graph_tools_msgs.msg")
        self.config = settings(self, HydraConfig)
        self._edges = self.create_publisher(self._messages.PoseGraph, "external_loop_closures", QoSProfile(depth=100))
        self.listen(self.config)

    def take(self, closures: Sequence[MetricClosure]) -> None:
        for closure in closures:
            query, match = closure.closure.query, closure.closure.match
            edge = self._messages.PoseGraphEdge(
                key_from=query.stamp_ns, key_to=match.stamp_ns, robot_from=self.config.robot_id,
                robot_to=self.config.robot_id, type=self._messages.PoseGraphEdge.LOOPCLOSE,
            )  # fmt: skip
            edge.header.stamp = to_time(query.stamp_ns)
            set_pose(edge.pose, closure.relative)
            edge.covariance = closure.covariance.ravel()  # not read by Hydra today
            graph = self._messages.PoseGraph(edges=[edge])
            graph.header.stamp = edge.header.stamp
            self._edges.publish(graph)
            self.sent += 1


def main(args: list[str] | None = None) -> int:
    """0 after SIGINT or SIGTERM, 2 for unusable settings or a missing package."""
    return run("hydra_bridge", HydraBridge, args)
