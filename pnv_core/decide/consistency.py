"""Belief over time: what the keyframes before a query say of its match.

In the spirit of SeqSLAM (Milford and Wyeth, ICRA 2012) and of the Bayes filters of FAB-MAP and RTAB-Map: a robot that
is back at a place sees a sequence of places again, forwards or backwards, at some other speed; a chance resemblance
stands alone. Weak evidence that agrees over several frames becomes a closure, strong evidence that stands alone waits.
"""

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from pnv_core.types import ImageRef, LoopClosure

Steps = Callable[[ImageRef, ImageRef], int]  # keyframes from one to a later one of its sequence

_STEP = 6  # keyframes of the other visit that may pass per keyframe of this one
_MISSES = 2  # queries in the window that may lack a match on the path: a person in the way, a blurred image
_FLOOR = 0.05  # a candidate below this score supports nothing
PRIOR = 0.12  # P(same place) of a candidate on a path before its own frame is looked at; less speaks against it
_MISS = -0.7  # log odds, of a query without a match on the path
_MOST = 3.0  # log odds, of one frame: a blurred image proves as little as a lucky one
DOUBT = 4  # more keyframes must agree where a place elsewhere is supported alike: look-alike rooms are left sooner


@dataclass(frozen=True)
class Path:
    """Matches of successive queries that follow one another in the other visit.

    `length` counts the queries with a match on the path; `belief` is P(same place) after all of them.
    """

    length: int
    belief: float
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
        placed = [self._placed(candidates, closure.match) for candidates in earlier]
        return max((self._followed(closure, placed, way) for way in (1, -1)), key=lambda p: (p.length, p.belief))

    def _placed(self, candidates: Sequence[LoopClosure], match: ImageRef) -> list[tuple[int, LoopClosure]]:
        """Those of the match's own sequence, each with the steps from it to the match."""
        own = (match.robot, match.session, match.camera)
        same = (c for c in candidates if (c.match.robot, c.match.session, c.match.camera) == own)
        return [(self._steps(c.match, match), c) for c in same]

    def _followed(self, closure: LoopClosure, earlier: list[list[tuple[int, LoopClosure]]], way: int) -> Path:
        """Backwards through the queries: of the matches in order and reach, take the best; a query may be missed."""
        at, behind, length, steps, moved = closure.match, 0, 1, 1, False
        total, here = 0.0, _evidence(closure.score)  # the same picture again is one witness, heard at its best
        for candidates in reversed(earlier):
            following = [(s, c) for s, c in candidates if 0 <= way * (s - behind) <= _STEP * steps]
            if not following:
                steps += 1
                total += _MISS
                continue
            behind, best = max(following, key=lambda p: (p[1].score, p[1].match.id != at.id, -abs(p[0] - behind)))
            if best.match.id == at.id:
                here = max(here, _evidence(best.score))
            else:
                total, here, moved = total + here, _evidence(best.score), True
            at, length, steps = best.match, length + 1, 1
        if not moved:  # the other visit stood still
            length, total, here = 1, 0.0, _evidence(closure.score)
        return Path(length, _probability(_log_odds(PRIOR) + total + here), way if moved else 0)


def _log_odds(probability: float) -> float:
    return math.log(max(probability, 1e-6) / max(1.0 - probability, 1e-6))


def _probability(log_odds: float) -> float:
    return 1.0 / (1.0 + math.exp(-log_odds))


def _evidence(score: float) -> float:
    """How far the log odds of a frame's score are from what was to be expected, bounded."""
    return max(-_MOST, min(_MOST, _log_odds(score) - _log_odds(PRIOR)))


def by_id(earlier: ImageRef, later: ImageRef) -> int:
    """Steps where every keyframe is of one camera and none is missing."""
    return later.id - earlier.id


def confirmed(path: Path, wanted: int) -> bool:
    """Whether `wanted` neighbouring keyframes agree. 0 and 1 want nothing beyond the closure itself."""
    return path.length >= wanted


def window_of(wanted: int) -> int:
    """How many query keyframes may take part where `wanted` must agree."""
    return wanted + _MISSES if wanted > 1 else 1
