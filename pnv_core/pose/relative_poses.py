"""Relative poses of accepted closures, with the scale that depth or odometry gives, or none."""

import math

import numpy as np
from numpy.typing import NDArray

from pnv_core.pose.geometry import (
    Intrinsics,
    RelativePose,
    metric_from_baseline,
    metric_from_depth,
    relative_direction,
)
from pnv_core.recognizer import PlaceRecognizer
from pnv_core.types import ImageRef, LoopClosure
from pnv_core.verify.verifier import EpipolarCheck

_LEAST_BASELINE_M = 0.05  # of shorter ones odometry knows little
_LONGEST_BASELINE_M = 5.0


class RelativePoses:
    """Poses from the small pictures a recogniser keeps. `cameras` holds the intrinsics of every calibrated camera.

    `offsets` (x, y, z) in metres say where cameras sit on the robot that odometry speaks of; else in its origin.
    """

    def __init__(self, recognizer: PlaceRecognizer, cameras: dict[str, Intrinsics] | None = None) -> None:
        self._recognizer = recognizer
        self.cameras = cameras if cameras is not None else {}
        self.offsets: dict[str, tuple[float, float, float]] = {}

    def estimate(self, closure: LoopClosure, depth: NDArray[np.floating] | None = None) -> RelativePose | None:
        """The query's camera in the frame of the match's. `depth` (h, w) in metres belongs to the query's image.

        None for an uncalibrated camera, keyframes without a picture, and where too few points agree. Without depth,
        the scale comes from the way odometry has gone since the keyframe before the query.
        """
        query, match = self.cameras.get(closure.query.camera), self.cameras.get(closure.match.camera)
        if query is None or match is None:
            return None
        check = self._check(closure.query, closure.match)
        if check is None:
            return None
        found = (
            metric_from_depth(check, depth, query, match) if depth is not None else self._by_odometry(closure, check)
        )
        return found or relative_direction(check, query, match)

    def _by_odometry(self, closure: LoopClosure, check: EpipolarCheck) -> RelativePose | None:
        before = self._recognizer.database.neighbours(closure.query.id, 1)
        here = self._recognizer.odometry.at(closure.query.stamp_ns)
        there = self._recognizer.odometry.at(before[0].stamp_ns) if before else None
        if here is None or there is None:
            return None
        offset = self.offsets.get(closure.query.camera, (0.0, 0.0, 0.0))
        baseline = math.dist(here.of(offset), there.of(offset))
        if not _LEAST_BASELINE_M <= baseline <= _LONGEST_BASELINE_M:
            return None
        neighbour = self._check(closure.query, before[0])
        cameras = self.cameras[closure.query.camera], self.cameras[closure.match.camera]
        return None if neighbour is None else metric_from_baseline(check, neighbour, baseline, *cameras)

    def _check(self, query: ImageRef, other: ImageRef) -> EpipolarCheck | None:
        database = self._recognizer.database
        if query.id not in database or other.id not in database:
            return None
        pictures = [database.picture(ref.id) for ref in (query, other)]
        if not all(pictures):
            return None
        return self._recognizer.judge.verifier.check(pictures[0], query.camera, pictures[1], other.camera)
