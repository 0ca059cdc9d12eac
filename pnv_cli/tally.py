"""What a run came to, counted once for terminal and report."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from pnv_core.config import Config
from pnv_core.types import Frame, LoopClosure


@dataclass
class Tally:
    """Counts of a run. A query is a keyframe with at least one candidate; a closure is a pair of keyframes."""

    frames: int = 0
    queries: int = 0
    closed: int = 0  # queries with a closure
    closures: int = 0
    refused: Counter[str] = field(default_factory=Counter)  # candidates by reason
    first_ns: int = 0
    last_ns: int = 0
    best: LoopClosure | None = None  # the refused candidate of the highest score

    def add(self, frame: Frame, closures: Sequence[LoopClosure]) -> None:
        """A processed frame with its candidates, best first."""
        self.first_ns = min(self.first_ns, frame.stamp_ns) if self.frames else frame.stamp_ns
        self.last_ns = max(self.last_ns, frame.stamp_ns) if self.frames else frame.stamp_ns
        self.frames += 1
        self.queries += bool(closures)
        accepted = sum(c.accepted for c in closures)
        self.closed += bool(accepted)
        self.closures += accepted
        for closure in closures:
            if not closure.accepted:
                self.refused[str(closure.reason)] += 1
                if self.best is None or closure.score > self.best.score:
                    self.best = closure

    @property
    def span_s(self) -> float:
        return (self.last_ns - self.first_ns) / 1e9

    def sentence(self, keyframes: int) -> str:
        """The counts in one line; `keyframes` are those this run added."""
        return (
            f"{self.frames} frames, {keyframes} keyframes, {self.queries} queries: {self.closed} closed, by "
            f"{self.closures} pairs"
        )

    def refusals(self) -> str:
        """Refused candidates by reason, the most frequent first."""
        return ", ".join(f"{reason} {count}" for reason, count in self.refused.most_common()) or "none"

    def why_nothing(self, config: Config) -> str:
        """Why no closure was found."""
        if not self.queries:
            return (
                f"{self.frames} frames span {self.span_s:.0f} s; a match must be at least "
                f"{config.exclude_recent_s:g} s older (--exclude-recent-s; images in a folder: --fps, --timestamps)"
            )
        assert self.best is not None
        return (
            f"the best candidate scored {self.best.score:.3f} and was refused as {self.best.reason}; accepted from "
            f"{config.accept_score:g} (--all lists the best candidate of every query)"
        )
