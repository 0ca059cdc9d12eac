"""A bridge as its own process, and what place_recognizer says to it."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry
from std_msgs.msg import Float64MultiArray

from msg_adapters.loop_closures import closures_to_message, to_time
from msg_adapters.poses import set_pose
from msg_adapters.relative_pose import relative_pose_to_message
from pnv_core.pose.geometry import RelativePose
from pnv_core.types import ImageRef, LoopClosure
from pnv_ros.outputs import CLOSURES_QOS
from test.ros.processes import NODE, Listener, Process, ros_arguments, wait_until

S = 1_000_000_000
METRIC = RelativePose(np.eye(3), np.array([0.0, 0.0, 1.0]), True, 30, np.diag([0.01] * 3 + [0.001] * 3))  # 1 m ahead


@contextmanager
def running(name: str, ready: str, *arguments: str, **parameters: Any) -> Iterator[Process]:
    code = f"import sys; from pnv_ros.bridges.{name} import main; sys.exit(main())"
    process = Process(sys.executable, "-c", code, *ros_arguments(*arguments, **parameters))
    try:
        process.wait_for(ready)
        yield process
    finally:
        if process.child.poll() is None:
            process.child.kill()
            process.child.wait()


def closure(query_ns: int, match_ns: int, query_id: int = 1, match_id: int = 0, score: float = 0.9) -> LoopClosure:
    return LoopClosure(ImageRef(query_id, query_ns, "c"), ImageRef(match_id, match_ns, "c"), score, 0.8, 0.4, 40, True)


class Recogniser:
    """The topics of place_recognizer, spoken by the test."""

    def __init__(self, listener: Listener, bridge: str, node: str = NODE) -> None:
        from geometry_msgs.msg import PoseWithCovarianceStamped

        self.closures = listener.node.create_publisher(Float64MultiArray, "/loop_closures", CLOSURES_QOS)
        self.poses = listener.node.create_publisher(PoseWithCovarianceStamped, f"{node}/relative_pose", 50)
        wait_until(
            lambda: self.closures.get_subscription_count() and self.poses.get_subscription_count(), 60, "a bridge"
        )
        listener.met_by(bridge)

    def say(self, one: LoopClosure, pose: RelativePose | None = METRIC) -> None:
        self.closures.publish(closures_to_message([one], ["c"]))
        if pose is not None:
            self.poses.publish(relative_pose_to_message(one, pose))


def odometry_message(stamp_ns: int, matrix: np.ndarray) -> Odometry:
    message = Odometry(child_frame_id="base_link")
    message.header.stamp, message.header.frame_id = to_time(stamp_ns), "odom"
    set_pose(message.pose.pose, matrix)
    return message
