"""~/markers: keyframes and closures to look at in RViz or Foxglove."""

from collections import deque
from collections.abc import Callable, Sequence
from itertools import pairwise
from threading import Lock

import numpy as np
from geometry_msgs.msg import Point
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from pnv_core.decide.odometry import Odometry
from pnv_core.types import ImageRef, LoopClosure
from pnv_ros.node_config import NodeConfig

MARKERS_QOS = QoSProfile(
    depth=1, reliability=QoSReliabilityPolicy.RELIABLE, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL
)

_KEPT_CLOSURES = 2000
_METRES_PER_SECOND = 0.1  # of the time-line
_ARC_POINTS = 9


class Placing:
    """Where keyframes stand by the poses of a `track`, in `frame_id`; None: the time-line places them."""

    def __init__(self, track: Odometry | None = None) -> None:
        self.track, self.frame_id = track, ""
        self._placed: dict[int, tuple[float, float, float]] = {}

    def position(self, stamp_ns: int) -> tuple[float, float, float] | None:
        """Where the robot was at a stamp, within half a second."""
        at = self.track.at(stamp_ns) if self.track is not None else None
        return None if at is None else at.xyz

    def place(self, refs: Sequence[ImageRef]) -> dict[int, tuple[float, float, float]]:
        """Positions of the keyframes that have one; those of keyframes not in `refs` are forgotten."""
        known = {r.id: self._placed[r.id] for r in refs if r.id in self._placed}
        for ref in refs:
            if ref.id not in known and (position := self.position(ref.stamp_ns)) is not None:
                known[ref.id] = position
        self._placed = known
        return known


class Markers:
    """Publishes the map as markers once a second while somebody subscribes."""

    def __init__(self, node: Node, config: NodeConfig) -> None:
        self._node = node
        self._publisher = node.create_publisher(MarkerArray, "~/markers", MARKERS_QOS)
        self._closures: deque[tuple[int, int, float]] = deque(maxlen=_KEPT_CLOSURES)
        self._lock = Lock()  # the worker adds, the timer publishes
        self.placing = Placing()
        self._drawn: tuple[int, int, int] | None = None

    def close(self) -> None:
        self._node.destroy_publisher(self._publisher)

    def add(self, closures: Sequence[LoopClosure]) -> None:
        """Remember accepted closures."""
        with self._lock:
            self._closures.extend((c.query.id, c.match.id, c.score) for c in closures if c.accepted)

    def forget(self) -> None:
        with self._lock:
            self._closures.clear()

    def publish(self, refs_of: Callable[[], list[ImageRef]], config: NodeConfig) -> None:
        """Draw the keyframes that `refs_of` gives, if somebody looks and anything has changed.

        To be called every second where poses place the keyframes, since poses are not kept for long.
        """
        posed = self.placing.track is not None
        placed = self.placing.place(refs_of()) if posed else None
        if not config.publish_markers or not self._publisher.get_subscription_count():
            self._drawn = None
            return
        refs = refs_of()
        if placed is None:
            placed = timeline(refs)
        with self._lock:
            closures = list(self._closures)
        state = (refs[-1].id if refs else -1, closures[-1][0] if closures else -1, len(placed))
        if state == self._drawn:
            return
        self._drawn = state
        frame_id = (posed and self.placing.frame_id) or config.frame_id
        self._publisher.publish(map_markers(placed, closures, frame_id, arcs=not posed))


def timeline(refs: Sequence[ImageRef]) -> dict[int, tuple[float, float, float]]:
    """Where keyframes stand without poses: along x by time, one line per camera and session."""
    lines: dict[tuple[str, int], int] = {}
    starts: dict[int, int] = {}
    placed = {}
    for ref in refs:
        y = lines.setdefault((ref.camera, ref.session), len(lines))
        start = starts.setdefault(ref.session, ref.stamp_ns)
        placed[ref.id] = ((ref.stamp_ns - start) / 1e9 * _METRES_PER_SECOND, float(y), 0.0)
    return placed


def map_markers(
    placed: dict[int, tuple[float, float, float]],
    closures: Sequence[tuple[int, int, float]],
    frame_id: str,
    arcs: bool,
) -> MarkerArray:
    """Keyframes as points and closures between placed ones as lines, red (score 0) to green (score 1)."""
    keyframes = _marker(frame_id, "keyframes", Marker.POINTS, 0.15)
    keyframes.points = [_point(p) for p in placed.values()]
    keyframes.color = ColorRGBA(r=0.3, g=0.6, b=1.0, a=1.0)
    lines = _marker(frame_id, "closures", Marker.LINE_LIST, 0.05)
    for query, match, score in closures:
        if query in placed and match in placed:
            path = _arc(placed[query], placed[match]) if arcs else np.array([placed[query], placed[match]])
            corners = [_point(p) for p in path]
            for start, end in pairwise(corners):
                lines.points += [start, end]
                lines.colors += [ColorRGBA(r=1.0 - score, g=score, b=0.1, a=1.0)] * 2
    return MarkerArray(markers=[keyframes, lines])


def _arc(start: tuple[float, float, float], end: tuple[float, float, float]) -> NDArray[np.float64]:
    """(_ARC_POINTS, 3): a bow over the time-line, as high as a quarter of its length."""
    t = np.linspace(0.0, 1.0, _ARC_POINTS)[:, None]
    a, b = np.array(start), np.array(end)
    path = a + (b - a) * t
    path[:, 2] += np.linalg.norm(b - a) * (t * (1.0 - t))[:, 0]
    return path


def _marker(frame_id: str, namespace: str, kind: int, width: float) -> Marker:
    marker = Marker(ns=namespace, id=0, type=kind, action=Marker.ADD)
    marker.header.frame_id = frame_id
    marker.pose.orientation.w = 1.0
    marker.scale.x = marker.scale.y = width
    return marker


def _point(position: Sequence[float]) -> Point:
    return Point(x=float(position[0]), y=float(position[1]), z=float(position[2]))
