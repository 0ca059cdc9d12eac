"""A pose graph by stamps: odometry and loop closures in, the correction of the odometry out. No ROS, no clock.

Poses are (4, 4), metres; a body has x ahead, y left, z up, a camera's optical frame x right, y down, z ahead.
"""

import math
from bisect import bisect_left, bisect_right
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pnv_core.pose.graph import Loop, PoseGraph
from pnv_core.rotations import OPTICAL_IN_BODY, angle_of, exponential, inverse, logarithm, rigid, transported
from pnv_core.types import LoopClosure

Array = NDArray[np.float64]

_S = 1_000_000_000
_MOST_WAITING = 1000
_SAMPLE_NS = 20_000_000  # odometry is kept at 50 Hz: an hour is 180,000 poses, 25 MB


@dataclass(frozen=True)
class Keeping:
    """When a node is made, and what odometry is believed.

    A node is made every `node_m` metres or `node_deg` degrees. A step beyond `fastest_m_s` (and half a metre of slack)
    is a jump, after which odometry begins anew. A closure waits for its measured pose until odometry is `pose_wait_s`
    past the moment the closure came, and for its query's odometry until more than a thousand closures wait.
    """

    node_m: float = 0.5
    node_deg: float = 15.0
    fastest_m_s: float = 10.0
    gap_s: float = 1.0  # an image between odometry samples further apart has no pose
    pose_wait_s: float = 0.5


@dataclass(frozen=True, eq=False)
class _Waiting:
    closure: LoopClosure
    since_ns: int  # stamp of the newest odometry when it came


class BackEnd:
    """Odometry and closures by stamp over a PoseGraph.

    `mount` is the camera's optical frame in the body (4, 4). What is not used is counted in `refused` by reason, and
    said in one line each in `complaints`, which the owner empties.
    """

    def __init__(self, graph: PoseGraph, keeping: Keeping | None = None, mount: Array = OPTICAL_IN_BODY) -> None:
        self.graph, self._keep, self._mount = graph, keeping or Keeping(), mount
        self.stamps: list[int] = []  # of the nodes
        self.complaints: deque[str] = deque(maxlen=100)
        self.refused: Counter[str] = Counter()
        self.taken = 0  # closures handed to the graph
        self._first = 0  # the first node whose stamp counts, after a step back in time
        self._track: list[tuple[int, Array]] = []  # odometry since then
        self._breaks: list[int] = []  # first stamps after a break
        self._last: tuple[int, Array] | None = None
        self._waiting: deque[_Waiting] = deque()
        self._measured: dict[tuple[int, int], tuple[Array, Array]] = {}
        self._correction = np.eye(4)

    def add_odometry(self, stamp_ns: int, pose: Array) -> None:
        """A pose (4, 4) of the body. One that is not a pose, or not newer, is refused; a break begins anew."""
        if not np.isfinite(pose).all() or abs(np.linalg.det(pose[:3, :3]) - 1) > 0.01:
            self._refuse("odometry without a pose", f"odometry at {_s(stamp_ns)} is not a finite pose; passed over")
            return
        last, continues = self._last, True
        if last is not None:
            if stamp_ns <= last[0]:
                if stamp_ns > last[0] - _S:
                    self.refused["late odometry"] += 1
                    return
                self._step_back(stamp_ns, last[0])
                continues = False
            else:
                way, dt = float(np.linalg.norm(pose[:3, 3] - last[1][:3, 3])), (stamp_ns - last[0]) / _S
                if way > 0.5 + self._keep.fastest_m_s * dt:
                    self._refuse("jumps", f"odometry jumped {way:.1f} m in {dt:.2f} s at {_s(stamp_ns)}; begins anew")
                    self._breaks.append(stamp_ns)
                    continues = False
            if not continues and self.stamps[-1] < last[0] and self._breaks[-1:] == [stamp_ns]:
                self._add_node(*last)
        self._last = stamp_ns, pose
        if not self._track or stamp_ns - self._track[-1][0] >= _SAMPLE_NS or not continues:
            self._track.append(self._last)
        if not continues or not self.stamps or self._far(pose):
            self._add_node(stamp_ns, pose, continues)

    def add_closures(self, closures: Sequence[LoopClosure]) -> None:
        """Closures as they were published; each waits for odometry at its query and for its measured pose."""
        now = self._last[0] if self._last is not None else 0
        for closure in closures:
            if len(self._waiting) == _MOST_WAITING:
                self._drop(self._waiting.popleft().closure, f"more than {_MOST_WAITING} closures wait for odometry")
            self._waiting.append(_Waiting(closure, now))

    def add_relative_pose(self, query_ns: int, match_id: int, camera: Array, covariance: Array) -> None:
        """The query's camera (4, 4) in the match's optical frame, and its covariance (6, 6), position first.

        One whose covariance is not positive is refused: the closure then counts without a measured pose.
        """
        usable = np.isfinite(camera).all() and np.isfinite(covariance).all()
        if not usable or np.linalg.eigvalsh((covariance + covariance.T) / 2).min() <= 0:
            self._refuse(
                "poses without covariance",
                f"relative pose of {_s(query_ns)} has no finite, positive covariance; its closure counts without it",
            )
            return
        self._measured[query_ns, match_id] = camera, covariance
        while len(self._measured) > _MOST_WAITING:
            del self._measured[next(iter(self._measured))]

    def update(self, everything: bool = False) -> bool:
        """Solve with what came; whether old poses moved. `everything` waits for no measured pose and settles."""
        still: deque[_Waiting] = deque()
        for waiting in self._waiting:
            if not self._settle(waiting, everything):
                still.append(waiting)
        self._waiting = still
        moved = self.graph.update(settle=everything)
        if self.stamps:
            newest = len(self.graph) - 1
            self._correction = self.graph.newest @ inverse(self.graph.odometry(newest))
        return moved

    @property
    def map_from_odom(self) -> Array:
        """(4, 4): takes poses of the odometry's frame to the map."""
        return self._correction

    @property
    def waiting(self) -> int:
        """Closures whose odometry or measured pose has not come."""
        return len(self._waiting)

    def _far(self, pose: Array) -> bool:
        step = inverse(self.graph.odometry(len(self.graph) - 1)) @ pose
        turned = float(angle_of(step[:3, :3]))
        return bool(np.linalg.norm(step[:3, 3]) >= self._keep.node_m) or turned >= math.radians(self._keep.node_deg)

    def _add_node(self, stamp_ns: int, pose: Array, continues: bool = True) -> None:
        self.graph.add_node(pose, continues)
        self.stamps.append(stamp_ns)

    def _step_back(self, stamp_ns: int, last_ns: int) -> None:
        """Stamps name moments of one run only: closures of the run before cannot be told from those of the new one."""
        self._refuse(
            "steps back",
            f"odometry stepped back by {(last_ns - stamp_ns) / _S:.1f} s to {_s(stamp_ns)}; begins anew, "
            f"{len(self.stamps)} nodes keep their poses, {len(self._waiting)} waiting closures are dropped",
        )
        self.refused["of a run before"] += len(self._waiting)
        self._waiting.clear()
        self._measured.clear()
        self._track.clear()
        self._breaks.clear()
        self._first = len(self.stamps)

    def _settle(self, waiting: _Waiting, everything: bool) -> bool:
        """Hand a closure on, or refuse it; whether either was done."""
        closure, now = waiting.closure, self._last[0] if self._last is not None else -1
        if now < closure.query.stamp_ns:
            return False
        key = closure.query.stamp_ns, closure.match.id
        if key not in self._measured and not everything and now < waiting.since_ns + self._keep.pose_wait_s * _S:
            return False
        query, match = self._at(closure.query.stamp_ns), self._at(closure.match.stamp_ns)
        if query is None or match is None:
            missing = " and ".join(name for name, found in (("query", query), ("match", match)) if found is None)
            self._drop(closure, f"no odometry at the {missing}")
        elif query[0] == match[0]:
            self._drop(closure, f"both images belong to node {query[0]}")
        else:
            self.graph.add_loop(self._loop(closure, query, match))
            self.taken += 1
        return True

    def _loop(self, closure: LoopClosure, query: tuple[int, Array], match: tuple[int, Array]) -> Loop:
        measured = self._measured.pop((closure.query.stamp_ns, closure.match.id), None)
        before, after = match[1], inverse(query[1])
        if measured is None:
            return Loop(query[0], match[0], closure.score, before @ after)
        camera, covariance = measured
        before, after = before @ self._mount, inverse(self._mount) @ after
        covariance = transported(covariance, camera, before, after)
        return Loop(query[0], match[0], closure.score, before @ camera @ after, covariance)

    def _at(self, stamp_ns: int) -> tuple[int, Array] | None:
        """The last node at or before a stamp, and the body at the stamp as seen from it; None without odometry."""
        after = bisect_left(self._track, stamp_ns, key=lambda sample: sample[0])
        if after == len(self._track) and self._last is not None and stamp_ns <= self._last[0] and self._track:
            pair = self._track[-1], self._last
        elif after < len(self._track) and self._track[after][0] == stamp_ns:
            pair = self._track[after], self._track[after]
        elif 0 < after < len(self._track):
            pair = self._track[after - 1], self._track[after]
        else:
            return None
        (before_ns, before), (after_ns, later) = pair
        if after_ns - before_ns > self._keep.gap_s * _S or any(before_ns < b <= after_ns for b in self._breaks):
            return None
        share = (stamp_ns - before_ns) / (after_ns - before_ns) if after_ns > before_ns else 0.0
        node = bisect_right(self.stamps, stamp_ns, lo=self._first) - 1
        if node < self._first:
            return None
        return node, inverse(self.graph.odometry(node)) @ _between(before, later, share)

    def _drop(self, closure: LoopClosure, why: str) -> None:
        stamps = f"{_s(closure.query.stamp_ns)} - {_s(closure.match.stamp_ns)}"
        self._refuse(why.partition(" node ")[0], f"loop closure {stamps} dropped: {why}")

    def _refuse(self, reason: str, line: str) -> None:
        self.refused[reason] += 1
        self.complaints.append(line)


def _between(a: Array, b: Array, share: float) -> Array:
    """The pose a `share` of the way from a to b."""
    step = inverse(a) @ b
    return a @ rigid(exponential(logarithm(step[:3, :3]) * share), step[:3, 3] * share)


def _s(stamp_ns: int) -> str:
    return f"{stamp_ns / _S:.3f}"
