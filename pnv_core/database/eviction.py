"""Which keyframe goes when the budget is full.

Both policies see keyframes in the order they were added and name one id at a time.
"""

import heapq
from collections.abc import Callable
from typing import Protocol

import numpy as np

from pnv_core.errors import ConfigError
from pnv_core.types import ImageRef


class Eviction(Protocol):
    """A policy. `vector` is the unit global vector (D,) of the keyframe."""

    def added(self, ref: ImageRef, vector: np.ndarray) -> None: ...

    def removed(self, ref: ImageRef) -> None: ...

    def choose(self) -> int:
        """The id of the keyframe to give up; raises LookupError when there is none."""
        ...


class Oldest:
    """The keyframe added first goes first: a rolling window over the recent past."""

    def __init__(self) -> None:
        self._ids: dict[int, None] = {}  # insertion order is age

    def added(self, ref: ImageRef, vector: np.ndarray) -> None:
        self._ids[ref.id] = None

    def removed(self, ref: ImageRef) -> None:
        del self._ids[ref.id]

    def choose(self) -> int:
        if not self._ids:
            raise LookupError("no keyframe to evict")
        return next(iter(self._ids))


class Densest:
    """The keyframe most similar to both its neighbours in time goes first, so that places stay covered.

    A keyframe's redundancy is the smaller of its similarities to the one before and the one after it (same session
    and camera). Judging by the smaller one thins evenly: the gap a removal opens makes both its ends less redundant,
    where the larger one would let a gap grow from one side without end. The ends of a run count as not redundant.
    """

    def __init__(self) -> None:
        self._vectors: dict[int, np.ndarray] = {}
        self._before: dict[int, int] = {}
        self._after: dict[int, int] = {}
        self._last: dict[tuple[int, str], int] = {}  # newest id of a run
        self._run: dict[int, tuple[int, str]] = {}
        self._redundancy: dict[int, float] = {}
        self._heap: list[tuple[float, int]] = []  # (-redundancy, id); outdated entries are skipped when met

    def added(self, ref: ImageRef, vector: np.ndarray) -> None:
        run = (ref.session, ref.camera)
        self._vectors[ref.id] = vector
        self._run[ref.id] = run
        before = self._last.get(run)
        self._last[run] = ref.id
        self._judge(ref.id)
        if before is not None:
            self._link(before, ref.id)

    def removed(self, ref: ImageRef) -> None:
        before, after = self._before.pop(ref.id, None), self._after.pop(ref.id, None)
        run = self._run.pop(ref.id)
        del self._vectors[ref.id], self._redundancy[ref.id]
        if before is not None and after is not None:
            self._link(before, after)
        elif before is not None:
            del self._after[before]
            self._last[run] = before
            self._judge(before)
        elif after is not None:
            del self._before[after]
            self._judge(after)
        else:
            del self._last[run]

    def choose(self) -> int:
        while self._heap:
            negative, keyframe = self._heap[0]
            if self._redundancy.get(keyframe) == -negative:
                return keyframe
            heapq.heappop(self._heap)
        raise LookupError("no keyframe to evict")

    def _link(self, before: int, after: int) -> None:
        self._after[before], self._before[after] = after, before
        self._judge(before)
        self._judge(after)

    def _judge(self, keyframe: int) -> None:
        before, after = self._before.get(keyframe), self._after.get(keyframe)
        redundancy = -1.0
        if before is not None and after is not None:
            vector = self._vectors[keyframe]
            redundancy = float(min(vector @ self._vectors[before], vector @ self._vectors[after]))
        self._redundancy[keyframe] = redundancy
        heapq.heappush(self._heap, (-redundancy, keyframe))
        if len(self._heap) > 4 * len(self._redundancy) + 64:
            self._heap = [(-value, key) for key, value in self._redundancy.items()]
            heapq.heapify(self._heap)


def make_eviction(name: str) -> Eviction:
    """The policy of this name. Raises ConfigError."""
    policies: dict[str, Callable[[], Eviction]] = {"oldest": Oldest, "densest": Densest}
    if name not in policies:
        raise ConfigError(f"eviction = {name!r} is out of range; allowed: one of {', '.join(policies)}")
    return policies[name]()
