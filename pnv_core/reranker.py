"""Re-ranking: the spatial score of a query against a candidate, fused over patch sizes."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from pnv_core.config import Config
from pnv_core.matching import mutual_nearest
from pnv_core.parallel import workers
from pnv_core.spatial import fused_score, ransac_score, rapid_spatial_score
from pnv_core.types import PatchMatches, PlaceDescriptor


@dataclass(frozen=True, eq=False)
class SpatialResult:
    """Fused score in [0, 1], the score and mutual matches of each patch size, and how many matches are inliers.

    With the rapid scorer no match is tested against a homography; `inliers` then counts the mutual matches.
    """

    score: float
    per_size: tuple[float, ...]
    matches: tuple[PatchMatches, ...]
    inliers: int


class Reranker:
    """Scores candidates by their patches, with the scorer and weights of a (completed) Config."""

    def __init__(self, config: Config) -> None:
        self.scorer = config.scorer
        self.weights = config.patch_weights
        self.workers = workers(config.threads)

    def scores(self, query: PlaceDescriptor, references: Sequence[PlaceDescriptor]) -> list[SpatialResult]:
        """`score` of every reference, in their order, in the threads of the Config."""
        return self.workers.map(partial(self.score, query), references)

    def score(self, query: PlaceDescriptor, reference: PlaceDescriptor) -> SpatialResult:
        """Both descriptors come from one describer: equal patch sizes in equal order."""
        scores = []
        found = []
        for q, r in zip(query.patches, reference.patches, strict=True):
            matches = mutual_nearest(q.descriptors, r.descriptors)
            if self.scorer == "ransac":
                score, inlier = ransac_score(q, r, matches)
            else:
                score, inlier = rapid_spatial_score(q, r, matches), np.zeros(len(matches[0]), bool)
            scores.append(score)
            found.append(PatchMatches(q.size, *matches, inlier, q.keypoints()[matches[0]], r.keypoints()[matches[1]]))
        counted = sum(int(m.inlier.sum()) if self.scorer == "ransac" else len(m.query) for m in found)
        return SpatialResult(fused_score(scores, self.weights), tuple(scores), tuple(found), counted)
