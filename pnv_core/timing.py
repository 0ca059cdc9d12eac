"""Cheap per-stage timings. The recogniser itself knows no clock: a driver that wants timings hands it one."""

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

_KEPT = 1000  # latest durations kept per stage


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

    def summary_ms(self) -> dict[str, tuple[float, float]]:
        """Per stage the median and 95th percentile in milliseconds of the latest calls."""
        return {
            name: (float(np.percentile(d, 50)) * 1e3, float(np.percentile(d, 95)) * 1e3)
            for name, d in ((n, list(v)) for n, v in list(self.durations.items()))
        }
