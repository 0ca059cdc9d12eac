"""Closures together with their measured poses, which come on a topic of their own, for back ends that want metres."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pnv_core.rotations import inverse, transported
from pnv_core.types import LoopClosure

Array = NDArray[np.float64]
_MOST_WAITING = 1000


@dataclass(frozen=True, eq=False)
class MetricClosure:
    """A closure and the query's body (4, 4) in the match's body frame, with its covariance (6, 6), position first."""

    closure: LoopClosure
    relative: Array
    covariance: Array


class MetricClosures:
    """Joins closures and poses by query stamp and match id, in either order. `mount` is the camera in the body (4, 4).

    `without_pose` counts closures given up since a thousand newer ones came; `unusable` counts poses whose covariance
    is not finite and positive.
    """

    def __init__(self, mount: Array) -> None:
        self._mount = mount
        self._closures: dict[tuple[int, int], LoopClosure] = {}
        self._poses: dict[tuple[int, int], tuple[Array, Array]] = {}
        self.without_pose = self.unusable = 0

    @property
    def waiting(self) -> int:
        """Closures without a measured pose so far."""
        return len(self._closures)

    def add_closures(self, closures: Sequence[LoopClosure]) -> list[MetricClosure]:
        """Closures as published; those whose pose is known already."""
        found = []
        for closure in closures:
            key = closure.query.stamp_ns, closure.match.id
            if key in self._poses:
                found.append(self._joined(closure, *self._poses.pop(key)))
            else:
                self._closures[key] = closure
        while len(self._closures) > _MOST_WAITING:
            del self._closures[next(iter(self._closures))]
            self.without_pose += 1
        return found

    def add_pose(self, query_ns: int, match_id: int, camera: Array, covariance: Array) -> list[MetricClosure]:
        """The query's camera (4, 4) in the match's, and its covariance; the closure it belongs to, if that has come."""
        even = (covariance + covariance.T) / 2
        if not (np.isfinite(camera).all() and np.isfinite(even).all()) or np.linalg.eigvalsh(even).min() <= 0:
            self.unusable += 1
            return []
        closure = self._closures.pop((query_ns, match_id), None)
        if closure is not None:
            return [self._joined(closure, camera, even)]
        self._poses[query_ns, match_id] = camera, even
        while len(self._poses) > _MOST_WAITING:
            del self._poses[next(iter(self._poses))]
        return []

    def _joined(self, closure: LoopClosure, camera: Array, covariance: Array) -> MetricClosure:
        back = inverse(self._mount)
        return MetricClosure(closure, self._mount @ camera @ back, transported(covariance, camera, self._mount, back))
