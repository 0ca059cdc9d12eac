"""/diagnostics: once a second, how the node is and why."""

import time
from collections import deque
from collections.abc import Sequence

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from rclpy.qos import QoSProfile

from pnv_ros.companions import Companions
from pnv_ros.inputs import ImageInputs
from pnv_ros.parameters import Settings
from pnv_ros.recognition import Recognition
from pnv_ros.statistics import Counts, Drop, Statistics

_WINDOW_S = 5.0  # rates are over this long
_REPEAT_S = 30.0  # the log repeats that no image comes


class Diagnostics:
    """Watches an active node: publishes its status and warns where no image comes."""

    def __init__(self, node: Node, recognition: Recognition, statistics: Statistics) -> None:
        self._node, self._recognition, self._statistics = node, recognition, statistics
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", QoSProfile(depth=10))
        self._looks: deque[tuple[float, Counts, int]] = deque()  # when, counts, odometry samples refused
        self._seen: dict[str, tuple[int, float]] = {}
        self._warned: dict[str, float] = {}
        self._lossy: set[str] = set()  # topics whose losses were said

    def close(self) -> None:
        self._node.destroy_publisher(self._publisher)

    def forget(self) -> None:
        """The node was activated: waiting for images begins anew."""
        self._looks.clear()
        self._seen.clear()
        self._warned.clear()

    def look(self, settings: Settings, inputs: ImageInputs, companions: Companions) -> None:
        """Publish the status of this second."""
        now = time.monotonic()
        self._looks.append((now, self._statistics.counts(), self._recognition.recognizer.odometry.refused))
        while now - self._looks[0][0] > _WINDOW_S and len(self._looks) > 2:
            self._looks.popleft()
        then, earlier, refused_then = self._looks[0]
        span = max(now - then, 1e-9)
        late = self._looks[-1][1].since(earlier)
        rates = late.received.total() / span, late.processed.total() / span
        silent = self._silent(now, settings.node.no_image_warning_s, settings.node.image_topics)
        if inputs.paused:
            self._warned.clear()  # it says nothing about whether images come
        else:
            inputs.follow_losses(list(silent))
            self._log_silence(now, silent, inputs)

        losses = self._losses(settings.node.image_topics, inputs)
        fleet = self._recognition.fleet.status() if self._recognition.fleet is not None else None
        localisation = self._recognition.localisation
        level = DiagnosticStatus.WARN
        if self._statistics.autosave_failure:
            level, text = DiagnosticStatus.ERROR, f"autosave: {self._statistics.autosave_failure}"
        elif inputs.paused:
            text = "paused"
        elif silent:
            topic, seconds = next(iter(silent.items()))
            text = f"no image for {seconds:.0f} s on {topic}: {inputs.hint(topic)}"
        elif starved := late.starved():
            camera, why, count = starved
            text = f"{count} frames of late on {camera} and none is used: {self._why(why, camera, inputs, companions)}"
        elif late.of(Drop.UNUSABLE):
            text = f"{late.of(Drop.UNUSABLE)} unusable images of late; see the log"
        elif late.of(Drop.STAMP_BACK):
            back = late.of(Drop.STAMP_BACK)
            text = f"{back} frames of late have stamps before the last one and are skipped (~/reset)"
        elif self._looks[-1][2] > refused_then:
            text = f"{self._looks[-1][2] - refused_then} odometry samples of late are not taken; see the log"
        elif fleet is not None and fleet.problem:
            text = fleet.sentence()
        elif missing := self._recognition.without_picture():
            text = missing
        elif losses:
            text = losses[0]
        elif localisation is not None and localisation.lost:
            text = localisation.sentence()
        else:
            level, text = DiagnosticStatus.OK, self._sentence(rates, settings)
        more = [part.values() for part in (fleet, localisation) if part is not None]
        values = self._values(rates, settings, inputs) | _shares(late, settings.node.image_topics)
        self.publish(level, text, {k: v for some in (values, *more) for k, v in some.items()})

    def _losses(self, topics: Sequence[str], inputs: ImageInputs) -> list[str]:
        """What the middleware loses of late; each topic's is logged once."""
        said = {topic: sentence for topic in topics if (sentence := inputs.losses.sentence(topic))}
        for topic in set(said) - self._lossy:
            self._lossy.add(topic)
            self._node.get_logger().warning(f"{said[topic]} (said once)")
        return list(said.values())

    def _why(self, why: Drop, camera: str, inputs: ImageInputs, companions: Companions) -> str:
        """What keeps every frame of a camera from being used, in words."""
        if why is Drop.NO_CAMERA_INFO:
            return f"it waits for its camera info; {companions.waiting_for(camera)}"
        return {
            Drop.STAMP_REPEATED: "every header stamp is the same",
            Drop.STAMP_BACK: f"their stamps lie before {inputs.last_stamp(camera)}, which it had (~/reset)",
            Drop.UNUSABLE: "every image is unusable; see the log",
        }.get(why, str(why))

    def _sentence(self, rates: tuple[float, float], settings: Settings) -> str:
        score = max(self._statistics.best_scores, default=None)
        least = settings.recogniser.accept_score
        best = "no candidate yet" if score is None else f"best score of late {score:.2f}, accepted from {least:.2f}"
        keyframes = len(self._recognition.recognizer.database)
        return f"{rates[1]:.1f} of {rates[0]:.1f} frames/s, {keyframes} keyframes, {best}"

    def _values(self, rates: tuple[float, float], settings: Settings, inputs: ImageInputs) -> dict[str, str]:
        losses = {topic: inputs.losses.share(topic) for topic in settings.node.image_topics}
        counts = self._statistics.counts()
        score = max(self._statistics.best_scores, default=None)
        stats = self._recognition.recognizer.database.stats()
        stages = self._recognition.recognizer.timer.summary_ms()
        return {
            "frames in [1/s]": f"{rates[0]:.2f}",
            "frames processed [1/s]": f"{rates[1]:.2f}",
            "frames in": str(counts.received.total()),
            "frames processed": str(counts.processed.total()),
            **{f"lost on the way, {t} [%]": f"{100 * share:.0f}" for t, share in losses.items()},
            **{f"dropped: {why}": str(counts.of(why)) for why in Drop},
            "keyframes": str(stats.keyframes),
            "keyframes evicted": str(stats.evicted),
            "keyframes unreadable": str(stats.unreadable),
            "keyframes without picture": str(stats.without_picture),
            "odometry samples not taken": str(self._recognition.recognizer.odometry.refused),
            "memory [MB]": f"{stats.bytes_used / 1e6:.1f}",
            "memory budget [MB]": f"{stats.bytes_budget / 1e6:.1f}",
            "best score of late": "none" if score is None else f"{score:.3f}",
            "accept_score": f"{settings.recogniser.accept_score:.3f}",
            "last autosave": self._statistics.autosave_failure or "no failure",
            "closures": str(self._statistics.closures),
            "last closure": self._statistics.last_closure or "none",
            **{f"{s} p50, p95, p99 [ms]": ", ".join(f"{p:.2f}" for p in late) for s, late in stages.items()},
        }

    def _log_silence(self, now: float, silent: dict[str, float], inputs: ImageInputs) -> None:
        for topic, seconds in silent.items():
            if now - self._warned.get(topic, -_REPEAT_S) >= _REPEAT_S:
                self._warned[topic] = now
                self._node.get_logger().warning(
                    f"no image for {seconds:.0f} s on {inputs.describe(topic)}: {inputs.hint(topic)}"
                )
        for topic in set(self._warned) - set(silent):
            del self._warned[topic]
            self._node.get_logger().info(f"images come on {topic}")

    def publish(self, level: bytes, text: str, values: dict[str, str] | None = None) -> None:
        """One status, as it is."""
        status = DiagnosticStatus(
            level=level,
            name=f"{self._node.get_fully_qualified_name()}: place recognition",
            message=text,
            hardware_id=self._node.get_fully_qualified_name(),
            values=[KeyValue(key=k, value=v) for k, v in (values or {}).items()],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)

    def _silent(self, now: float, limit_s: float, topics: tuple[str, ...]) -> dict[str, float]:
        """Topics on which nothing came for the limit, with how long."""
        silent = {}
        for topic in topics:
            count, since = self._seen.get(topic, (-1, now))
            received = self._statistics.received[topic]
            if received != count:
                self._seen[topic] = received, now
            elif now - since >= limit_s:
                silent[topic] = now - since
        return silent


def _shares(late: Counts, topics: Sequence[str]) -> dict[str, str]:
    """Of several cameras, how much of what was processed of late each one had."""
    if len(topics) < 2:
        return {}
    total = max(late.processed.total(), 1)
    return {f"share of what is processed, {t} [%]": f"{100 * late.processed[t] / total:.0f}" for t in topics}
