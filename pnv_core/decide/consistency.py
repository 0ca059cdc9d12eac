"""Agreement in time: a loop is believed when the keyframes before the query matched neighbours of its match, in order.

In the spirit of SeqSLAM (Milford and Wyeth, ICRA 2012): a robot that is back at a place sees a sequence of places
again, forwards or backwards, at some other speed; a chance resemblance stands alone.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from pnv_core.types import ImageRef, LoopClosure

Steps = Callable[[ImageRef, ImageRef], int]  # keyframes from one to a later one of its sequence

_STEP = 6  # keyframes of the other visit that may pass per keyframe of this one
_MISSES = 2  # queries in the window that may lack a match on the path: a person in the way, a blurred image
_FLOOR = 0.05  # a candidate below this score supports nothing


@dataclass(frozen=True)
class Path:
    """Matches of successive queries that follow one another in the other visit.

    `length` counts the queries with a match on the path, `score` is the mean of the matches' scores over the window,
    a query without one counting 0.
    """

    length: int
    score: float
    direction: int  # +1 the way was taken in the same direction, -1 backwards, 0 not yet known


class SequenceMemory:
    """The candidates of the latest query keyframes of every camera.

    `steps` counts in the sequence of a camera (KeyframeDatabase.steps): ids alone grow with every other camera and
    leave gaps where a map was thinned.
    """

    def __init__(self, steps: Steps | None = None) -> None:
        self._steps = steps or by_id
        self._queries: dict[str, deque[tuple[LoopClosure, ...]]] = {}

    def remember(self, camera: str, closures: Sequence[LoopClosure], window: int) -> None:
        """What was found for a query keyframe; only the `window` latest are kept. Without candidates, an empty one."""
        kept = self._queries.setdefault(camera, deque())
        kept.append(tuple(c for c in closures if c.score >= _FLOOR))
        while len(kept) > max(window, 1):
            kept.popleft()

    def forget(self) -> None:
        self._queries.clear()

    def path(self, closure: LoopClosure, window: int) -> Path:
        """The best path that ends at a closure, over this query (remembered last) and the `window` - 1 before it."""
        earlier = list(self._queries.get(closure.query.camera, ()))[:-1][-(window - 1) :] if window > 1 else []
        return max(
            (self._followed(closure, earlier, way, window) for way in (1, -1)), key=lambda p: (p.length, p.score)
        )

    def _followed(self, closure: LoopClosure, earlier: list[tuple[LoopClosure, ...]], way: int, window: int) -> Path:
        """Backwards through the queries: of the matches in order and reach, take the best; a query may be missed."""
        at, length, total, steps, moved = closure.match, 1, closure.score, 1, False
        for candidates in reversed(earlier):
            following = [c for c in candidates if self._follows(c.match, at, way, steps)]
            if not following:
                steps += 1
                continue
            best = max(following, key=lambda c: (c.score, c.match.id != at.id, -abs(self._steps(c.match, at))))
            moved = moved or best.match.id != at.id
            at, steps = best.match, 1
            length, total = length + 1, total + best.score
        if not moved and length > 1:
            length = 1  # the other visit stood still: the same picture again and again is one witness, not many
        return Path(length, total / window, way if moved else 0)

    def _follows(self, earlier: ImageRef, later: ImageRef, way: int, queries: int) -> bool:
        """Whether `earlier` may be matched by the query `queries` before the one that matched `later`."""
        same = (earlier.robot, earlier.session, earlier.camera) == (later.robot, later.session, later.camera)
        return same and 0 <= way * self._steps(earlier, later) <= _STEP * queries


def by_id(earlier: ImageRef, later: ImageRef) -> int:
    """Steps where every keyframe is of one camera and none is missing."""
    return later.id - earlier.id


def confirmed(path: Path, wanted: int) -> bool:
    """Whether `wanted` neighbouring keyframes agree. 0 and 1 want nothing beyond the closure itself."""
    return path.length >= wanted


def window_of(wanted: int) -> int:
    """How many query keyframes may take part where `wanted` must agree."""
    return wanted + _MISSES if wanted > 1 else 1
