"""What comes beside the images: camera infos, odometry and poses, where topics are given."""

from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import (
    QoSDurabilityPolicy,
    QoSProfile,
    QoSReliabilityPolicy,
    qos_policy_name_from_kind,
    qos_profile_sensor_data,
)
from sensor_msgs.msg import CameraInfo, Image

from msg_adapters.camera_info import Rectifier, baseline_of, calibration_of
from msg_adapters.images import stamp_of
from pnv_core.decide.odometry import Odometry as OdometryMemory
from pnv_core.errors import PnvError
from pnv_core.pose.relative_poses import RelativePoses
from pnv_ros.depths import Depths
from pnv_ros.inputs import qos_in_words
from pnv_ros.markers import Placing
from pnv_ros.node_config import NodeConfig
from pnv_ros.view import View

_REPEAT_S = 10.0  # the same complaint is not made more often
_TRANSIENT_LOCAL = QoSDurabilityPolicy.TRANSIENT_LOCAL
_LATCHED = QoSProfile(depth=1, reliability=QoSReliabilityPolicy.RELIABLE, durability=_TRANSIENT_LOCAL)


def is_rectified(topic: str) -> bool:
    """Whether an image topic carries rectified images by its name, as image_proc and camera drivers name them."""
    return any(part.startswith("image_rect") for part in topic.split("/"))


class Companions:
    """The subscriptions of a configured node beside its images. Sensor-data QoS, which any publisher satisfies."""

    def __init__(
        self, node: Node, config: NodeConfig, views: dict[str, View], poses: RelativePoses, odometry: OdometryMemory,
        placing: Placing,
    ) -> None:  # fmt: skip
        self._node, self._views, self._poses, self._placing = node, views, poses, placing
        self._calibrations: dict[str, tuple[Any, ...]] = {}
        self._mismatches: dict[str, str] = {}  # topic: policy
        self._subscriptions: dict[str, Any] = {}
        self._info_topics = dict(zip(config.image_topics, config.camera_info_topics, strict=False))
        for camera, topic in self._info_topics.items():
            self._subscribe(CameraInfo, topic, self._calibrate(camera))
        self.depths = Depths(node) if config.depth_topics else None
        for camera, topic in zip(config.image_topics, config.depth_topics, strict=False):
            if self.depths is not None:
                self._subscribe(Image, topic, self.depths.receive(camera))
        if config.odometry_topic:
            self._subscribe(Odometry, config.odometry_topic, self._came(odometry, "odometry"))
            placing.track = odometry
        if config.pose_topic:
            placing.track = poses.track = OdometryMemory()
            self._subscribe(PoseStamped, config.pose_topic, self._came(poses.track, "pose"))

    def close(self) -> None:
        for subscription in self._subscriptions.values():
            self._node.destroy_subscription(subscription)
        self._subscriptions.clear()

    def waiting_for(self, camera: str) -> str:
        """Why a camera has no CameraInfo yet, in words. One that was said once is asked for."""
        topic = self._info_topics[camera]
        publishers = self._node.get_publishers_info_by_topic(self._node.resolve_topic_name(topic))
        kinds = sorted({p.topic_type for p in publishers} - {"sensor_msgs/msg/CameraInfo"})
        if not publishers:
            return f"nobody publishes {topic}"
        heard = self._subscriptions[topic]
        if heard.qos_profile.durability != _TRANSIENT_LOCAL and all(
            p.qos_profile.durability == _TRANSIENT_LOCAL for p in publishers
        ):  # said once, before this node was there, and kept for who asks for it
            self._node.destroy_subscription(heard)
            self._subscribe(CameraInfo, topic, self._calibrate(camera), _LATCHED)
        return f"{topic} is published as {kinds[0]}" if kinds else f"{topic} has carried no usable CameraInfo"

    def report_mismatches(self) -> None:
        """Say which publishers cannot be heard."""
        for topic, policy in list(self._mismatches.items()):
            del self._mismatches[topic]
            ours = qos_in_words(self._subscriptions[topic].qos_profile)
            self._node.get_logger().warning(f"a publisher of {topic} is not heard: its {policy} does not suit {ours}")

    def _subscribe(
        self, kind: type, topic: str, receive: Callable[[Any], None], qos: QoSProfile = qos_profile_sensor_data
    ) -> None:
        def mismatch(info: Any) -> None:
            self._mismatches[topic] = qos_policy_name_from_kind(info.last_policy_kind).lower()

        self._subscriptions[topic] = self._node.create_subscription(
            kind, topic, receive, qos,
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=mismatch),
        )  # fmt: skip

    def _came(self, memory: OdometryMemory, name: str) -> Callable[[Any], None]:
        """The callback for Odometry or PoseStamped."""

        def receive(message: Any) -> None:
            pose = message.pose.pose if isinstance(message, Odometry) else message.pose
            p, q = pose.position, pose.orientation
            refusal = memory.add(stamp_of(message), p.x, p.y, p.z, (q.x, q.y, q.z, q.w))
            if memory is self._placing.track:
                self._placing.frame_id = message.header.frame_id
            if refusal is not None:
                self._node.get_logger().warning(
                    f"{name} at {p.x:.6g}, {p.y:.6g}, {p.z:.6g} m is not taken: {refusal} "
                    f"({memory.refused} so far)", throttle_duration_sec=_REPEAT_S,
                )  # fmt: skip

        return receive

    def _calibrate(self, camera: str) -> Callable[[CameraInfo], None]:
        view = self._views[camera]

        def receive(info: CameraInfo) -> None:
            calibration = calibration_of(info)
            if calibration == self._calibrations.get(camera):
                return
            try:
                rectifier = Rectifier(info, rectified=is_rectified(camera))
                self._poses.cameras[camera] = view.intrinsics(rectifier)
                self._poses.baselines[camera] = baseline_of(info)
            except PnvError as error:
                self._node.get_logger().warning(f"camera info of {camera}: {error}", throttle_duration_sec=_REPEAT_S)
                return
            again = "anew " if camera in self._calibrations else ""
            self._calibrations[camera], view.rectifier = calibration, rectifier
            done = "taken as rectified, by their name, at" if is_rectified(camera) else "rectified as"
            self._node.get_logger().info(f"images of {camera} are {again}{done} {info.width}x{info.height}")

        return receive
