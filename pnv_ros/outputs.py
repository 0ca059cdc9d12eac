"""What the node publishes of each query, and when."""

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import Image, PointCloud2
from std_msgs.msg import Float64MultiArray

from msg_adapters.lio_sam import LioSamGate
from msg_adapters.loop_closures import candidates_to_message, closure_to_lio_sam, closures_to_message
from msg_adapters.pictures import rgb_to_message
from msg_adapters.relative_pose import relative_pose_to_message
from msg_adapters.typed_closures import closures_to_typed, typed_type
from pnv_core.drawing import draw_match
from pnv_core.pose.relative_poses import RelativePoses
from pnv_core.types import Frame, LoopClosure
from pnv_core.verify.feature_codes import picture_of as kept_picture
from pnv_core.verify.local_features import decoded
from pnv_ros.markers import Markers
from pnv_ros.node_config import NodeConfig

CLOSURES_QOS = QoSProfile(
    depth=50, reliability=QoSReliabilityPolicy.RELIABLE, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL
)
TABLE_QOS = QoSProfile(depth=10, reliability=QoSReliabilityPolicy.RELIABLE)
PICTURE_QOS = QoSProfile(depth=1, reliability=QoSReliabilityPolicy.RELIABLE)


class Outputs:
    """The publishers of a configured node. `config` may be replaced between frames."""

    def __init__(
        self, node: Node, config: NodeConfig, picture_size: tuple[int, int], poses: RelativePoses | None = None
    ) -> None:
        self.markers, self._poses = Markers(node, config), poses
        self._node, self.config, self._size = node, config, picture_size
        self._cameras = config.image_topics
        self._closures = node.create_publisher(Float64MultiArray, "loop_closures", CLOSURES_QOS)
        self._lio_sam = node.create_publisher(Float64MultiArray, "~/lio_sam", TABLE_QOS)
        self._relative_pose = node.create_publisher(PoseWithCovarianceStamped, "~/relative_pose", TABLE_QOS)
        self._candidates = node.create_publisher(PointCloud2, "~/candidates", TABLE_QOS)
        self._match_image = node.create_publisher(Image, "~/match_image", PICTURE_QOS)
        typed = typed_type()
        self._typed = node.create_publisher(typed, "~/closures", CLOSURES_QOS) if typed else None
        self._lio_sam_gate = LioSamGate()

    def close(self) -> None:
        for publisher in (
            self._closures, self._lio_sam, self._relative_pose, self._candidates, self._match_image
        ):  # fmt: skip
            self._node.destroy_publisher(publisher)
        if self._typed is not None:
            self._node.destroy_publisher(self._typed)
        self.markers.close()

    def new_session(self) -> None:
        self._lio_sam_gate.forget()

    def publish(self, frame: Frame, closures: Sequence[LoopClosure], picture_of: Callable[[int], bytes]) -> None:
        """Everything there is to say about one query; `closures` best first, refused ones too, not empty.

        `picture_of` gives the small JPEG of a keyframe, empty where none is kept.
        """
        accepted = [c for c in closures if c.accepted]
        if accepted:
            self._closures.publish(closures_to_message(accepted, self._cameras))
            self._publish_lio_sam(accepted)
            self._publish_relative_pose(accepted)
            self.markers.add(accepted)
        if self.config.publish_candidates and self._candidates.get_subscription_count():
            self._candidates.publish(candidates_to_message(closures, self._cameras, self.config.frame_id))
        if self.config.publish_match_image and self._match_image.get_subscription_count():
            self._match_image.publish(self._picture(frame, closures[0], picture_of(closures[0].match.id)))

    def publish_fleet(self, closures: Sequence[LoopClosure]) -> None:
        """The fleet's candidates for a query, best first, from a thread of its own; ~/lio_sam is for one robot only."""
        accepted = [c for c in closures if c.accepted]
        if accepted:
            self._closures.publish(closures_to_message(accepted, self._cameras))
            if self._typed is not None:
                self._typed.publish(closures_to_typed(accepted))
        if self.config.publish_candidates and self._candidates.get_subscription_count():
            self._candidates.publish(candidates_to_message(closures, self._cameras, self.config.frame_id))

    def _publish_lio_sam(self, accepted: Sequence[LoopClosure]) -> None:
        """The best closure old enough for LIO-SAM, which takes no loops within its own window."""
        if not self.config.publish_lio_sam:
            return
        best = self._lio_sam_gate.chosen(accepted, self.config.lio_sam_interval_s, self.config.lio_sam_gap_s)
        if best is not None:
            self._lio_sam.publish(closure_to_lio_sam(best))

    def _publish_relative_pose(self, accepted: Sequence[LoopClosure]) -> None:
        """The best closure's pose, where somebody wants it, by itself and in the typed twin."""
        heard = self._relative_pose.get_subscription_count()
        heard += self._typed.get_subscription_count() if self._typed is not None else 0
        pose = self._poses.estimate(accepted[0]) if self._poses is not None and heard else None
        if pose is not None and pose.metric:
            self._relative_pose.publish(relative_pose_to_message(accepted[0], pose))
        if self._typed is not None:
            robot = self._node.get_namespace().strip("/")
            self._typed.publish(closures_to_typed(accepted, {} if pose is None else {0: pose}, robot))

    def _picture(self, frame: Frame, closure: LoopClosure, reference: bytes) -> Image:
        verdict = "accepted" if closure.accepted else f"refused: {closure.reason}"
        caption = f"score {closure.score:.3f}, {verdict}"
        picture = draw_match(frame.rgb, self._unpacked(reference), closure.matches, self._size, caption)
        return rgb_to_message(picture, frame.stamp_ns, self.config.frame_id)

    def _unpacked(self, kept: bytes) -> NDArray[np.uint8]:
        picture = kept_picture(kept)
        if not picture:
            return np.full((self._size[1], self._size[0], 3), 64, np.uint8)
        return cv2.cvtColor(decoded(picture), cv2.COLOR_GRAY2RGB)
