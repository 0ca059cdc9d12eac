"""What odometry says against a closure. Positions in metres in the odometry's own frame.

Nothing is taken for granted: odometry trembles while the robot stands, jumps when it is initialised anew, and carries
stamps of other clocks. The way gone is therefore measured between anchors at least NOISE_M apart, and a sample that
does not follow from the last one counts only once others have followed from it.
"""

import math
import threading
from bisect import bisect_left
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from pnv_core.rotations import matrix_of
from pnv_core.types import ImageRef

NOISE_M = 0.2  # less is no way gone: forty times the tremble of 5 mm that wheel and visual odometry show at rest
FASTEST_M_S = 200.0  # what drives is slower
LONGEST_GAP_NS = 60_000_000_000
FOLLOWERS = 3  # samples that follow from one another before a jump is believed
FARTHEST_M = 1e7  # coordinates of no map reach farther
_KEPT = 20_000  # latest samples, some minutes at 50 Hz
_KEYFRAMES = 200_000  # about 20 MB
_NEAR_NS = 500_000_000  # a position holds for images this close in time
_STEP_BACK_NS = 1_000_000_000
_LEVEL = 5.0  # how much surer height is than the way across: gravity tells what is level, and floors are 3 m apart


class Refusal(StrEnum):
    """Why a sample was not taken."""

    NOT_FINITE = "not finite, or farther than any map reaches"
    LATE = "not newer than the last one"
    JUMP = "a jump in place or time that nothing has followed yet"


@dataclass(frozen=True)
class Position:
    """Where odometry places the robot, how it is turned, and the way it has gone since the start."""

    xyz: tuple[float, float, float]
    travelled_m: float
    quaternion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)  # x, y, z, w; of length 1

    def of(self, offset: Sequence[float]) -> tuple[float, float, float]:
        """Where a point fixed to the robot is, such as a camera at `offset` (x, y, z) in the robot's own frame."""
        x, y, z = matrix_of(self.quaternion) @ offset
        return self.xyz[0] + x, self.xyz[1] + y, self.xyz[2] + z


Sample = tuple[int, tuple[float, float, float], tuple[float, float, float, float]]  # stamp, position, quaternion


class Odometry:
    """Positions over time, and those of the keyframes.

    A driver feeds `add` from an odometry source, from any thread; samples must have arrived before the images they
    belong to.
    """

    def __init__(self) -> None:
        self._stamps: deque[int] = deque(maxlen=_KEPT)
        self._positions: deque[Position] = deque(maxlen=_KEPT)
        self._keyframes: dict[tuple[int, int], Position] = {}  # by (session, id)
        self._anchor = (0.0, 0.0, 0.0)  # up to where the way is counted
        self._jumped: list[Sample] = []  # samples that do not follow from the last one, but from one another
        self._lock = threading.RLock()
        self.refused = 0

    def add(
        self, stamp_ns: int, x: float, y: float, z: float, quaternion: Sequence[float] = (0.0, 0.0, 0.0, 1.0)
    ) -> Refusal | None:
        """A sample; `quaternion` (x, y, z, w) says how the robot is turned. Gives the reason where it is not taken.

        Once FOLLOWERS samples follow from one another after a jump in place or a step back in time, another run has
        begun and odometry starts anew; after a gap it goes on.
        """
        with self._lock:
            refusal = self._taken(stamp_ns, (x, y, z), quaternion)
            self.refused += refusal is not None
            return refusal

    def _taken(self, stamp_ns: int, xyz: tuple[float, float, float], quaternion: Sequence[float]) -> Refusal | None:
        length = math.hypot(*quaternion)
        if not all(abs(v) <= FARTHEST_M for v in xyz) or not 0.5 < length < 2.0:  # false for NaN
            return Refusal.NOT_FINITE
        x, y, z, w = (v / length for v in quaternion)
        sample = stamp_ns, xyz, (x, y, z, w)
        if not self._stamps or self._follows(sample, self._stamps[-1], self._positions[-1].xyz):
            self._jumped.clear()
            self._append(sample)
            return None
        if 0 <= self._stamps[-1] - stamp_ns < _STEP_BACK_NS:
            return Refusal.LATE
        if self._jumped and not self._follows(sample, *self._jumped[-1][:2]):
            self._jumped.clear()
        self._jumped.append(sample)
        if len(self._jumped) < FOLLOWERS:
            return Refusal.JUMP
        begun, self._jumped = self._jumped, []
        if not self._reachable(begun[0], self._stamps[-1], self._positions[-1].xyz):
            self.forget()
        for one in begun:
            self._append(one)
        return None

    @staticmethod
    def _reachable(sample: Sample, stamp_ns: int, xyz: tuple[float, float, float]) -> bool:
        seconds = (sample[0] - stamp_ns) / 1e9
        return seconds > 0 and math.dist(sample[1], xyz) <= NOISE_M + FASTEST_M_S * seconds

    def _follows(self, sample: Sample, stamp_ns: int, xyz: tuple[float, float, float]) -> bool:
        return sample[0] - stamp_ns <= LONGEST_GAP_NS and self._reachable(sample, stamp_ns, xyz)

    def _append(self, sample: Sample) -> None:
        stamp_ns, xyz, quaternion = sample
        travelled_m = self._positions[-1].travelled_m if self._positions else 0.0
        step_m = math.dist(self._anchor, xyz) if self._positions else math.inf
        if step_m >= NOISE_M:
            travelled_m += step_m if self._positions else 0.0
            self._anchor = xyz
        self._stamps.append(stamp_ns)
        self._positions.append(Position(xyz, travelled_m, quaternion))

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
            self._jumped.clear()

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

        A place seen from `slack_m` away still counts as the same; of height a fifth of slack and drift is allowed, so
        that the same spot of two floors is not one place. Where a position is unknown nothing is impossible.
        """
        here, there = (self._keyframes.get((ref.session, ref.id)) for ref in (query, match))
        if here is None or there is None:
            return False
        way = here.travelled_m - there.travelled_m
        (*across, up), (*across_there, up_there) = here.xyz, there.xyz
        apart = max(math.dist(across, across_there), _LEVEL * abs(up - up_there))
        return way < least_way_m or apart > slack_m + drift * way
