"""What odometry says against a closure. Positions in metres in the odometry's own frame."""

import math
import threading
from bisect import bisect_left
from collections import deque
from dataclasses import dataclass

from pnv_core.types import ImageRef

_KEPT = 20_000  # latest samples, some minutes at 50 Hz
_KEYFRAMES = 200_000  # about 20 MB
_NEAR_NS = 500_000_000  # a position holds for images this close in time
_STEP_BACK_NS = 1_000_000_000


@dataclass(frozen=True)
class Position:
    """Where odometry places the robot, and the way it has gone since the start."""

    xyz: tuple[float, float, float]
    travelled_m: float


class Odometry:
    """Positions over time, and those of the keyframes.

    A driver feeds `add` from an odometry source, from any thread; samples must have arrived before the images they
    belong to.
    """

    def __init__(self) -> None:
        self._stamps: deque[int] = deque(maxlen=_KEPT)
        self._positions: deque[Position] = deque(maxlen=_KEPT)
        self._keyframes: dict[tuple[int, int], Position] = {}  # by (session, id)
        self._lock = threading.RLock()

    def add(self, stamp_ns: int, x: float, y: float, z: float) -> None:
        """A sample. One that is not finite or not newer is passed over; a step back in time starts anew."""
        if not all(map(math.isfinite, (x, y, z))):
            return
        with self._lock:
            if self._stamps and stamp_ns <= self._stamps[-1]:
                if stamp_ns > self._stamps[-1] - _STEP_BACK_NS:
                    return
                self.forget()
            last = self._positions[-1] if self._positions else Position((x, y, z), 0.0)
            self._stamps.append(stamp_ns)
            self._positions.append(Position((x, y, z), last.travelled_m + math.dist(last.xyz, (x, y, z))))

    def remember(self, keyframe: ImageRef) -> None:
        """Note where a keyframe was taken, if that is known."""
        with self._lock:
            position = self.at(keyframe.stamp_ns)
            if position is not None and keyframe.id >= 0:
                self._keyframes[keyframe.session, keyframe.id] = position
                if len(self._keyframes) > _KEYFRAMES:
                    del self._keyframes[next(iter(self._keyframes))]

    def forget(self) -> None:
        """Start anew, as after a reset or in a new session: another run's odometry has another origin."""
        with self._lock:
            self._stamps.clear()
            self._positions.clear()
            self._keyframes.clear()

    def at(self, stamp_ns: int) -> Position | None:
        """The position nearest in time, within half a second."""
        with self._lock:
            place = bisect_left(self._stamps, stamp_ns)
            near = [i for i in (place - 1, place) if 0 <= i < len(self._stamps)]
            best = min(near, key=lambda i: abs(self._stamps[i] - stamp_ns), default=None)
            if best is None or abs(self._stamps[best] - stamp_ns) > _NEAR_NS:
                return None
            return self._positions[best]

    def impossible(self, query: ImageRef, match: ImageRef, drift: float, slack_m: float, least_way_m: float) -> bool:
        """Whether the robot cannot be back at `match`: too far from it for `drift` per metre gone, or it never left.

        A place seen from `slack_m` away still counts as the same. Where a position is unknown nothing is impossible.
        """
        here, there = (self._keyframes.get((ref.session, ref.id)) for ref in (query, match))
        if here is None or there is None:
            return False
        way = here.travelled_m - there.travelled_m
        return way < least_way_m or math.dist(here.xyz, there.xyz) > slack_m + drift * way
