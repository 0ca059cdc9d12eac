"""Image subscriptions: from the wire to the newest-frame slot."""

import struct
from collections.abc import Callable, Sequence
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSPolicyKind, QoSProfile, qos_policy_name_from_kind, qos_profile_sensor_data
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import CompressedImage, Image

from pnv_core.timing import StageTimer
from pnv_ros.losses import TransportLosses, profile
from pnv_ros.node_config import NodeConfig
from pnv_ros.slot import NewestFrames, WaitingFrame
from pnv_ros.stamps import StampRule, StampVerdict, in_seconds
from pnv_ros.statistics import Drop, Statistics

OVERRIDABLE = (
    QoSPolicyKind.RELIABILITY,
    QoSPolicyKind.DURABILITY,
    QoSPolicyKind.HISTORY,
    QoSPolicyKind.DEPTH,
)
_UNKNOWN = "_NODE_NAME_UNKNOWN_"  # a publisher whose name is not discovered yet
_MOST_LOOKS = 10
_COMPRESSED = "sensor_msgs/msg/CompressedImage"
_TYPES = {"sensor_msgs/msg/Image": Image, _COMPRESSED: CompressedImage}


def image_qos() -> QoSProfile:
    """Sensor data (best effort, volatile), which any publisher satisfies; only the newest frame is of use."""
    return QoSProfile(
        reliability=qos_profile_sensor_data.reliability,
        durability=qos_profile_sensor_data.durability,
        history=qos_profile_sensor_data.history,
        depth=2,
    )


def serialized_stamp(data: bytes) -> int:
    """Header stamp in nanoseconds of a serialized message that begins with a std_msgs/Header.

    CDR: four bytes of encapsulation, the second of which tells the byte order, then sec and nanosec.
    """
    sec, nanosec = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    return int(sec) * 1_000_000_000 + int(nanosec)


class ImageInputs:
    """One subscription per camera; callbacks take microseconds since messages stay packed until they are used."""

    def __init__(
        self,
        node: Node,
        config: NodeConfig,
        frames: NewestFrames,
        statistics: Statistics,
        stamps: StampRule,
        timer: StageTimer,
    ) -> None:
        self._node, self._config, self._frames = node, config, frames
        self._statistics, self._stamps, self._timer = statistics, stamps, timer
        self.paused = False
        self.losses = TransportLosses()
        self._told: set[tuple[str, StampVerdict]] = set()
        self._subscriptions: dict[str, Any] = {}
        self._mismatches: dict[str, str] = {}  # topic: policy
        self._sources: dict[str, str] = {}  # topic: the one listened to in its place
        self._looks: dict[str, int] = {}  # topic: how often the names of its publishers were looked up
        try:
            for topic in config.image_topics:
                self._subscribe(topic, self._expected_type(topic))
        except Exception:
            self.close()
            raise

    def close(self) -> None:
        for subscription in self._subscriptions.values():
            self._node.destroy_subscription(subscription)
        self._subscriptions.clear()

    def describe(self, topic: str) -> str:
        """The topic's full name, type and QoS in words."""
        subscription = self._subscriptions[topic]
        kind = subscription.msg_type.__name__
        return f"{subscription.topic_name} ({kind}, {qos_in_words(subscription.qos_profile)})"

    def follow_types(self) -> None:
        """Subscribe anew where transport is auto and a topic turns out to carry the other message type."""
        if self._config.transport != "auto":
            return
        for topic, subscription in list(self._subscriptions.items()):
            kinds = {info.topic_type for info in self._publishers(topic)} & set(_TYPES)
            if kinds and subscription.msg_type not in [_TYPES[k] for k in kinds]:
                self._node.destroy_subscription(subscription)
                self._subscribe(topic, _TYPES[kinds.pop()])
                self._node.get_logger().info(f"now listening to {self.describe(topic)}, as it is published")

    def follow_losses(self, silent: Sequence[str] = ()) -> None:
        """Where transport is auto, ask for image_transport's JPEGs of a topic whose raw images are lost on the way.

        `silent` are topics on which nothing came for long.
        """
        if self._config.transport != "auto":
            return
        for topic, subscription in list(self._subscriptions.items()):
            lost = self.losses.share(topic)
            if subscription.msg_type is not Image or not (self.losses.many(topic) or topic in silent):
                continue
            compressed = f"{topic}/compressed"
            if all(info.topic_type != _COMPRESSED for info in self._publishers(compressed)):
                continue
            self._node.destroy_subscription(subscription)
            self.losses.forget(topic)
            self._sources[topic] = compressed
            self._subscribe(topic, CompressedImage)
            what = "no image arrives" if topic in silent else f"the middleware loses {100 * lost:.0f} % of the frames"
            self._node.get_logger().warning(
                f"{what} of {topic}: now listening to {self.describe(topic)} in its place; "
                f"for raw images set FASTRTPS_DEFAULT_PROFILES_FILE={profile()} for the camera and for this node"
            )

    def hint(self, topic: str) -> str:
        """Why nothing may come on a topic, in words."""
        publishers = self._publishers(topic)
        if not publishers:
            return "nobody publishes it"
        wanted = f"sensor_msgs/msg/{self._subscriptions[topic].msg_type.__name__}"
        if all(info.topic_type != wanted for info in publishers):
            return f"it is published as {publishers[0].topic_type}; see the parameter transport"
        offers = "; ".join(sorted({f"{i.node_name}: {qos_in_words(i.qos_profile)}" for i in publishers}))
        return f"published by {offers}"

    def last_stamp(self, topic: str) -> str:
        """The newest stamp that was taken of a topic, in seconds."""
        return in_seconds(self._stamps.last(topic))

    def _publishers(self, topic: str) -> list[Any]:
        topic = self._sources.get(topic, topic)
        return self._node.get_publishers_info_by_topic(self._node.resolve_topic_name(topic))

    def _expected_type(self, topic: str) -> type:
        if self._config.transport == "auto":
            published = {_TYPES[i.topic_type] for i in self._publishers(topic) if i.topic_type in _TYPES}
            compressed = CompressedImage in published if len(published) == 1 else topic.endswith("/compressed")
        else:
            compressed = self._config.transport == "compressed"
        return CompressedImage if compressed else Image

    def _subscribe(self, topic: str, message_type: type) -> None:
        self._subscriptions[topic] = self._node.create_subscription(
            message_type,
            self._sources.get(topic, topic),
            self._callback(topic, message_type),
            image_qos(),
            raw=True,
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=self._incompatible(topic)),
            qos_overriding_options=QoSOverridingOptions(OVERRIDABLE),
        )

    def _callback(self, topic: str, message_type: type) -> Callable[[bytes], None]:
        def receive(serialized: bytes) -> None:
            with self._timer.stage("receive"):
                take(serialized)

        def take(serialized: bytes) -> None:
            self._statistics.receive(topic)
            if self.paused:
                self._statistics.drop(topic, Drop.PAUSED)
                return
            stamp_ns = serialized_stamp(serialized)
            ruling = self._stamps.judge(topic, stamp_ns)
            if ruling.verdict is not StampVerdict.USE:
                self._tell(topic, ruling.verdict, stamp_ns, ruling.back_ns)
            if ruling.verdict not in (StampVerdict.USE, StampVerdict.NEW_SESSION):
                self._statistics.drop(
                    topic, Drop.STAMP_REPEATED if ruling.verdict is StampVerdict.REPEATED else Drop.STAMP_BACK
                )
                return
            self.losses.arrived(topic, stamp_ns)
            if self._frames.put(WaitingFrame(topic, stamp_ns, ruling.session, serialized, message_type)):
                self._statistics.drop(topic, Drop.BUSY)

        return receive

    def _tell(self, topic: str, verdict: StampVerdict, stamp_ns: int, back_ns: int) -> None:
        """Once per topic and kind; every new session is worth a line."""
        log = self._node.get_logger()
        stamp, back = in_seconds(stamp_ns), f"{back_ns / 1e9:.3f} s"
        if verdict is StampVerdict.NEW_SESSION:
            log.info(f"stamps of {topic} went back by {back} to {stamp}: a new session begins (on_stamp_back)")
        elif (topic, verdict) not in self._told:
            self._told.add((topic, verdict))
            if verdict is StampVerdict.REPEATED:
                log.warning(f"the stamp {stamp} of {topic} repeats; such frames are skipped (said once)")
            elif verdict is StampVerdict.ENDED_RUN:
                log.warning(
                    f"the stamp {stamp} of {topic} belongs to a run that ended; such frames are skipped (said once)"
                )
            else:
                log.warning(
                    f"stamps of {topic} went back by {back} to {stamp}; frames are skipped until they pass the last "
                    "one (said once; on_stamp_back: new_session takes a looped bag as a new run)"
                )

    def _incompatible(self, topic: str) -> Callable[[Any], None]:
        def note(info: Any) -> None:
            self._mismatches[topic] = qos_policy_name_from_kind(info.last_policy_kind).lower()

        return note

    def report_mismatches(self) -> None:
        """Say which publishers cannot be heard and what to change. Called a little after the event, since the
        publisher's name is discovered after its profile."""
        for topic, policy in list(self._mismatches.items()):
            subscription = self._subscriptions[topic]
            name, ours = subscription.topic_name, qos_in_words(subscription.qos_profile)
            publishers = self._publishers(topic)
            self._looks[topic] = self._looks.get(topic, 0) + 1
            if any(p.node_name == _UNKNOWN for p in publishers) and self._looks[topic] < _MOST_LOOKS:
                continue
            del self._mismatches[topic], self._looks[topic]
            for publisher in publishers:
                theirs = qos_in_words(publisher.qos_profile)
                if theirs != ours:
                    self._node.get_logger().warning(
                        f"no images from {publisher.node_name} on {name}: it offers {theirs}, "
                        f"this node asks for {ours}; set qos_overrides.{name}.subscription.{policy} to "
                        f"{_word(getattr(publisher.qos_profile, policy))}"
                    )


def qos_in_words(profile: QoSProfile) -> str:
    """The policies that decide whether two ends connect."""
    return f"{_word(profile.reliability)}, {_word(profile.durability)}"


def _word(policy: Any) -> str:
    return getattr(policy, "name", str(policy)).lower().replace("_", " ")
