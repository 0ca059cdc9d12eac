"""From image stamps to the ids a back end gives its nodes.

Back ends number their own keyframes, at other times than ours. A closure names two images by stamp; it can be handed
on once the back end has nodes near both. A node that has not come yet is waited for; one that will not come is not
invented.
"""

import logging
from bisect import bisect_left, insort
from collections import deque
from dataclasses import dataclass
from typing import Any

from pnv_core.types import LoopClosure

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class NodePair:
    """A closure between two nodes of a back end: `query` the newer node, `match` the older, and how far off in time.

    `carried` is what was given with the closure.
    """

    closure: LoopClosure
    query: int
    match: int
    query_offset_ns: int  # node stamp less image stamp
    match_offset_ns: int
    carried: Any = None


class StampIds:
    """Pairs closures with nodes: nearest within `tolerance_s`; else wait up to `wait_s`; else drop, saying so.

    Time is that of the stamps: a closure is given up when a node has come that is `wait_s` newer than its query.
    """

    def __init__(self, tolerance_s: float = 0.5, wait_s: float = 10.0, most_waiting: int = 1000) -> None:
        self._tolerance_ns = round(tolerance_s * 1e9)
        self._wait_ns = round(wait_s * 1e9)
        self._nodes: list[tuple[int, int]] = []  # (stamp, id), by stamp
        self._ids: dict[int, int] = {}  # stamp by id
        self._waiting: deque[tuple[LoopClosure, Any]] = deque()
        self._most_waiting = most_waiting
        self.dropped = 0

    def add_node(self, node: int, stamp_ns: int) -> list[NodePair]:
        """A node of the back end, in any order; known ids are passed over. Gives the closures that waited for it."""
        if node not in self._ids:
            self._ids[node] = stamp_ns
            insort(self._nodes, (stamp_ns, node))
        return self._settled()

    def remove_node(self, node: int) -> None:
        """A node the back end has given up: no closure is handed on for it any more."""
        stamp = self._ids.pop(node, None)
        if stamp is not None:
            self._nodes.remove((stamp, node))

    def begin_anew(self) -> None:
        """The back end was restarted: its nodes are forgotten, closures go on waiting for the new ones."""
        self._nodes.clear()
        self._ids.clear()

    def add_closure(self, closure: LoopClosure, carried: Any = None) -> list[NodePair]:
        """A closure as it was published, and what goes with it. Gives what can be handed on now, this one or others."""
        self._waiting.append((closure, carried))
        if len(self._waiting) > self._most_waiting:
            self._drop(self._waiting.popleft()[0], f"more than {self._most_waiting} wait")
        return self._settled()

    def nearest(self, stamp_ns: int) -> tuple[int, int] | None:
        """(id, its stamp less this) of the node nearest in time, the older of two; None beyond the tolerance."""
        place = bisect_left(self._nodes, (stamp_ns, -1))
        near = [self._nodes[i] for i in (place - 1, place) if 0 <= i < len(self._nodes)]
        if not near:
            return None
        stamp, node = min(near, key=lambda pair: (abs(pair[0] - stamp_ns), pair[0]))
        return (node, stamp - stamp_ns) if abs(stamp - stamp_ns) <= self._tolerance_ns else None

    def _settled(self) -> list[NodePair]:
        if not self._nodes:
            return []
        pairs: list[NodePair] = []
        waiting: deque[tuple[LoopClosure, Any]] = deque()
        newest = self._nodes[-1][0]
        for closure, carried in self._waiting:
            query, match = self.nearest(closure.query.stamp_ns), self.nearest(closure.match.stamp_ns)
            if query and match and newest >= closure.query.stamp_ns:  # earlier, a nearer node may still come
                if query[0] == match[0]:
                    self._drop(closure, f"both images belong to node {query[0]}")
                else:
                    pairs.append(NodePair(closure, query[0], match[0], query[1], match[1], carried))
            elif newest - closure.query.stamp_ns > self._wait_ns:
                missing = " and ".join(name for name, found in (("query", query), ("match", match)) if not found)
                self._drop(closure, f"no node within {self._tolerance_ns / 1e9:g} s of the {missing}")
            else:
                waiting.append((closure, carried))
        self._waiting = waiting
        return pairs

    def _drop(self, closure: LoopClosure, why: str) -> None:
        self.dropped += 1
        stamps = closure.query.stamp_ns / 1e9, closure.match.stamp_ns / 1e9
        _log.warning("loop closure %.3f - %.3f dropped: %s", *stamps, why)
