"""Re-ranking: the spatial score of a query against its candidates, fused over patch sizes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pnv_core.config import Config
from pnv_core.threads import workers
from pnv_core.types import PatchMatches, PlaceDescriptor
from pnv_core.verify.homography import homography_inliers, usac_inliers
from pnv_core.verify.matching import Indices, mutual_nearest_rows, patch_rows
from pnv_core.verify.spatial import fused_score, ransac_score, rapid_spatial_score

Rows = NDArray[np.float32]  # patch descriptors made ready for matching

_LARGE = 500_000  # numbers of a query's patches; of fewer the threads wait for each other more than they help
_SEARCHES = {"ransac": homography_inliers, "usac": usac_inliers}


@dataclass(frozen=True, eq=False)
class SpatialResult:
    """Score in [0, 1], the paper's score and mutual matches of each patch size, and how many matches are inliers.

    `score` is the fusion of `per_size`.
    With the rapid scorer no match is tested against a homography; `inliers` then counts the mutual matches.
    """

    score: float
    per_size: tuple[float, ...]
    matches: tuple[PatchMatches, ...]
    inliers: int


class Reranker:
    """Scores candidates by their patches, with the scorer and weights of a (completed) Config."""

    def __init__(self, config: Config) -> None:
        self.search = _SEARCHES.get(config.scorer)  # None: the rapid score, without a geometry
        self.weights = config.patch_weights
        self.workers = workers(config.threads)

    def score(self, query: PlaceDescriptor, reference: PlaceDescriptor) -> SpatialResult:
        """Both descriptors come from one describer: equal patch sizes in equal order."""
        return self._score(query, _rows(query), reference)

    def scores(self, query: PlaceDescriptor, references: Sequence[PlaceDescriptor]) -> list[SpatialResult]:
        """`score` of every reference, in their order; large ones in the threads of the Config."""
        rows = _rows(query)
        large = sum(grid.size for grid in rows) > _LARGE
        return (self.workers if large else workers(1)).map(
            lambda reference: self._score(query, rows, reference), references
        )

    def _score(self, query: PlaceDescriptor, rows: Sequence[Rows], reference: PlaceDescriptor) -> SpatialResult:
        return self._verified(query, reference, _matches(rows, reference))

    def _verified(self, query: PlaceDescriptor, reference: PlaceDescriptor, matches: Sequence[tuple]) -> SpatialResult:
        """The score of matches (query, reference) of each patch size."""
        scores = []
        found = []
        for q, r, pairs in zip(query.patches, reference.patches, matches, strict=True):
            if self.search is not None:
                score, inlier = ransac_score(q, r, pairs, self.search)
            else:
                score, inlier = rapid_spatial_score(q, r, pairs), np.zeros(len(pairs[0]), bool)
            scores.append(score)
            xy = q.keypoints()[pairs[0]], r.keypoints()[pairs[1]]
            found.append(PatchMatches(q.size, pairs[0], pairs[1], inlier, *xy))
        counted = sum(int(m.inlier.sum()) if self.search is not None else len(m.query) for m in found)
        return SpatialResult(fused_score(scores, self.weights), tuple(scores), tuple(found), counted)


def _rows(descriptor: PlaceDescriptor) -> list[Rows]:
    return [patch_rows(grid.descriptors) for grid in descriptor.patches]


def _matches(query: Sequence[Rows], reference: PlaceDescriptor) -> list[tuple[Indices, Indices]]:
    pairs = zip(query, reference.patches, strict=True)
    return [mutual_nearest_rows(rows, patch_rows(grid.descriptors)) for rows, grid in pairs]
