"""Where the robot is in a loaded map, or that it is lost."""

import time
from collections.abc import Sequence

from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile, QoSReliabilityPolicy

from msg_adapters.loop_closures import to_time
from msg_adapters.poses import set_pose
from pnv_core.errors import PnvError
from pnv_core.pose.relative_poses import Fix, RelativePoses
from pnv_core.types import LoopClosure
from pnv_ros.node_config import NodeConfig

POSE_QOS = QoSProfile(depth=10, reliability=QoSReliabilityPolicy.RELIABLE)
_TRIED = 3  # accepted closures of a query that may give its pose


class Localisation:
    """~/pose at every fix, `initialpose` when asked for. Told of queries by the worker, asked by the callbacks."""

    def __init__(self, node: Node, config: NodeConfig, poses: RelativePoses) -> None:
        self._node, self._poses = node, poses
        self._frame_id, self._lost_after_s = config.frame_id, config.lost_after_s
        self._pose = node.create_publisher(PoseWithCovarianceStamped, "~/pose", POSE_QOS)
        self._initial = node.create_publisher(PoseWithCovarianceStamped, "initialpose", POSE_QOS)
        self._query_ns, self._fixed = 0, 0.0
        self._fix: Fix | None = None
        self._why = "no image was compared with the map yet"

    def close(self) -> None:
        self._node.destroy_publisher(self._pose)
        self._node.destroy_publisher(self._initial)

    def forget(self) -> None:
        """Another map, or another run: what was known says nothing."""
        self._fix, self._query_ns, self._why = None, 0, "no image was compared with the map yet"

    def look(self, stamp_ns: int, closures: Sequence[LoopClosure]) -> None:
        """One query and its candidates; a fix is published at once, anything vaguer is not."""
        was_lost, self._query_ns = self.lost, stamp_ns
        accepted = [c for c in closures if c.accepted]
        if not accepted:
            self._why = "nothing of the map was recognised"
        for closure in accepted[:_TRIED]:
            match = closure.match.id
            pose = self._poses.estimate(closure)
            fix = self._poses.fix(closure, pose) if pose is not None else None
            if fix is not None:
                self._fix, self._fixed, self._why = fix, time.monotonic(), ""
                self._pose.publish(self._message(fix))
                if was_lost:
                    x, y, _ = fix.pose[:3, 3]
                    self._node.get_logger().info(f"localised at x = {x:.2f}, y = {y:.2f} by keyframe {match}")
                return
            if pose is None:
                self._why = f"keyframe {match} was recognised, but no pose follows: is the camera calibrated?"
            elif not pose.metric:
                self._why = (f"keyframe {match} was recognised, but no scale is known: depth, stereo or "
                             "odometry gives one")  # fmt: skip
            else:
                self._why = (f"keyframe {match} was recognised, but the map has no pose of it: it was made "
                             "without odometry_topic and pose_topic, or in a later session")  # fmt: skip

    @property
    def lost(self) -> bool:
        """Whether images were compared with the map, and for `lost_after_s` of their time none gave a pose."""
        return self._fix is None or self._query_ns - self._fix.stamp_ns > self._lost_after_s * 1e9

    def sentence(self) -> str:
        """lost, why, and since when; empty where the robot is localised."""
        if not self.lost:
            return ""
        since = f"; last fix {time.monotonic() - self._fixed:.1f} s ago" if self._fix is not None else "; no fix yet"
        return f"lost: {self._why}{since}"

    def values(self) -> dict[str, str]:
        """For /diagnostics."""
        since = "never" if self._fix is None else f"{time.monotonic() - self._fixed:.1f}"
        return {"localised": str(not self.lost).lower(), "time since the last fix [s]": since}

    def publish_initial(self) -> str:
        """Publish the last fix on `initialpose`, stamped as its image. Raises PnvError where the robot is lost."""
        fix = self._fix
        if fix is None or self.lost:
            raise PnvError(f"{self.sentence()}; allowed: once a place of the map is recognised")
        self._initial.publish(self._message(fix))
        x, y, _ = fix.pose[:3, 3]
        return f"published x = {x:.2f}, y = {y:.2f} in {self._frame_id} on {self._initial.topic_name}"

    def _message(self, fix: Fix) -> PoseWithCovarianceStamped:
        message = PoseWithCovarianceStamped()
        message.header.stamp, message.header.frame_id = to_time(fix.stamp_ns), self._frame_id
        set_pose(message.pose.pose, fix.pose)
        message.pose.covariance = [float(v) for v in fix.covariance.ravel()]
        return message
