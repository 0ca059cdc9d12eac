"""Cheap per-stage timings. The recogniser itself knows no clock: a driver that wants timings hands it one."""

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

_KEPT = 1000  # latest durations kept per stage
_REMEMBERED = 50  # latest frames that say what a candidate takes
_CAUTION = 75  # percentile of those


class StageTimer:
    """Durations of named stages in seconds, measured with the given clock; without a clock nothing is measured."""

    def __init__(self, clock: Callable[[], float] | None = None) -> None:
        self.clock = clock
        self.durations: dict[str, deque[float]] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        if self.clock is None:
            yield
            return
        start = self.clock()
        try:
            yield
        finally:
            self.durations.setdefault(name, deque(maxlen=_KEPT)).append(self.clock() - start)

    def summary_ms(self) -> dict[str, tuple[float, float, float]]:
        """Per stage the median, 95th and 99th percentile in milliseconds of the latest calls."""
        found = {}
        for name, durations in list(self.durations.items()):
            median, late, latest = 1e3 * np.percentile(list(durations), (50, 95, 99))
            found[name] = float(median), float(late), float(latest)
        return found


class TimeBudget:
    """How many candidates the rest of a frame's time allows, going by what the latest ones took.

    Without a clock, or with a budget of 0, all of them: only a driver that asks for it gives up determinism.
    """

    def __init__(self, clock: Callable[[], float] | None) -> None:
        self._clock = clock
        self._each: deque[float] = deque(maxlen=_REMEMBERED)  # seconds per candidate

    def now(self) -> float:
        """When the work on a frame begins, for `affordable`."""
        return 0.0 if self._clock is None else self._clock()

    def affordable(self, candidates: int, budget_s: float, began: float) -> int:
        """Of so many candidates of a frame that `began` then, how many to re-rank; at least one, where there is one."""
        if self._clock is None or not budget_s or not self._each or not candidates:
            return candidates
        left = budget_s - (self._clock() - began)
        return max(1, min(candidates, int(left / float(np.percentile(self._each, _CAUTION)))))

    @contextmanager
    def taken(self, candidates: int) -> Iterator[None]:
        """Around the re-ranking of so many candidates: remembers how long each took."""
        before = self._clock() if self._clock is not None else 0.0
        yield
        if self._clock is not None and candidates:
            self._each.append(max((self._clock() - before) / candidates, 1e-9))
