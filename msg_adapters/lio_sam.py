"""Closures as LIO-SAM takes them from outside.

LIO-SAM's subscriber keeps messages of exactly two doubles, [newer, older] in seconds, the last five; it passes over
pairs closer in time than its historyKeyframeSearchTimeDiff (30 s). It knows the stamps of its own run only.
"""

from collections.abc import Sequence

from pnv_core.types import LoopClosure


class LioSamGate:
    """Which closure of a query goes to LIO-SAM: the best one old enough, and not too many in a row."""

    def __init__(self) -> None:
        self._last_ns: int | None = None

    def chosen(self, closures: Sequence[LoopClosure], interval_s: float, gap_s: float) -> LoopClosure | None:
        """The best accepted closure within one session and at least `gap_s` wide, or None.

        None too within `interval_s` of the last.
        """
        own = [c for c in closures if c.accepted and c.query.session == c.match.session]
        old = [c for c in own if c.query.stamp_ns - c.match.stamp_ns >= gap_s * 1e9]
        if not old:
            return None
        best = max(old, key=lambda c: c.score)
        if self._last_ns is not None and 0 <= best.query.stamp_ns - self._last_ns < interval_s * 1e9:
            return None
        self._last_ns = best.query.stamp_ns
        return best

    def forget(self) -> None:
        """Start anew, as in a new session."""
        self._last_ns = None
