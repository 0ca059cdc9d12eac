"""Re-ranking: the spatial score of a query against its candidates, fused over patch sizes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from pnv_core.config import Config
from pnv_core.threads import workers
from pnv_core.types import PatchMatches, PlaceDescriptor
from pnv_core.verify.matching import Indices, PatchRows, mutual_nearest_rows, patch_rows
from pnv_core.verify.spatial import fused_score, ransac_score, rapid_spatial_score, scale_change

_COARSE_LEAST = 5  # candidates that coarse matching keeps at least
# Beside the rapid score of one patch size: of 80 queries with 40 candidates each (Gardens Point, ESSEX3IN1) the best
# candidate was among the 10 kept in 80 cases with it, in 75 without.
_COARSE_SIMILARITY = 0.2


@dataclass(frozen=True, eq=False)
class SpatialResult:
    """Score in [0, 1], the paper's score and mutual matches of each patch size, and how many matches are inliers.

    `score` is the fusion of `per_size`, less what `Config.scale_weight` takes off where the scale differs.
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
        self.scale_weight = config.scale_weight
        self.mode = config.match_mode
        self.keep = config.match_keep
        self.workers = workers(config.threads)

    def score(self, query: PlaceDescriptor, reference: PlaceDescriptor) -> SpatialResult:
        """Both descriptors come from one describer: equal patch sizes in equal order."""
        return self._score(query, _rows(query), reference)

    def scores(self, query: PlaceDescriptor, references: Sequence[PlaceDescriptor]) -> list[SpatialResult | None]:
        """`score` of every reference, in their order, in the threads of the Config.

        With match_mode bounded or coarse, None for those that cannot, or hardly, have the best score of all.
        """
        rows = _rows(query)
        if self.mode == "bounded" and self.scorer == "ransac":
            return self._bounded(query, rows, references)
        kept: Sequence[int] = range(len(references))
        if self.mode == "coarse":
            kept = self._worth_scoring(query, rows, references)
        found = self.workers.map(lambda i: self._score(query, rows, references[i]), kept)
        results: list[SpatialResult | None] = [None] * len(references)
        for i, result in zip(kept, found, strict=True):
            results[i] = result
        return results

    def _score(self, query: PlaceDescriptor, rows: Sequence[PatchRows], reference: PlaceDescriptor) -> SpatialResult:
        return self._verified(query, reference, _matches(rows, reference))

    def _verified(self, query: PlaceDescriptor, reference: PlaceDescriptor, matches: Sequence[tuple]) -> SpatialResult:
        """The score of matches (query, reference) of each patch size."""
        scores = []
        found = []
        for q, r, pairs in zip(query.patches, reference.patches, matches, strict=True):
            if self.scorer == "ransac":
                score, inlier = ransac_score(q, r, pairs)
            else:
                score, inlier = rapid_spatial_score(q, r, pairs), np.zeros(len(pairs[0]), bool)
            scores.append(score)
            xy = q.keypoints()[pairs[0]], r.keypoints()[pairs[1]]
            found.append(PatchMatches(q.size, pairs[0], pairs[1], inlier, *xy))
        counted = sum(int(m.inlier.sum()) if self.scorer == "ransac" else len(m.query) for m in found)
        fused = fused_score(scores, self.weights)
        if self.scorer == "ransac" and self.scale_weight and fused:
            fused *= 1.0 - self.scale_weight * scale_change(found)
        return SpatialResult(fused, tuple(scores), tuple(found), counted)

    def _worth_scoring(
        self, query: PlaceDescriptor, rows: Sequence[PatchRows], references: Sequence[PlaceDescriptor]
    ) -> list[int]:
        """The best candidates by the cheapest patch size, matched in int8, and the similarity of the whole images."""
        keep = max(_COARSE_LEAST, math.ceil(self.keep * len(references)))
        cheapest = min(range(len(rows)), key=lambda s: len(rows[s].rows))

        def rough(reference: PlaceDescriptor) -> float:
            grid = reference.patches[cheapest]
            matches = mutual_nearest_rows(rows[cheapest], patch_rows(grid.descriptors), exact=False)
            similarity = float(query.global_vector @ reference.global_vector)
            return rapid_spatial_score(query.patches[cheapest], grid, matches) + _COARSE_SIMILARITY * similarity

        order = np.argsort(-np.array(self.workers.map(rough, references)), kind="stable")
        return sorted(order[:keep].tolist())

    def _bounded(
        self, query: PlaceDescriptor, rows: Sequence[PatchRows], references: Sequence[PlaceDescriptor]
    ) -> list[SpatialResult | None]:
        """Inliers are never more than matches: once the best score exceeds what the matches allow, RANSAC can stop."""
        matches = self.workers.map(partial(_matches, rows), references)
        shares = [[len(q) / len(r.rows) for (q, _), r in zip(found, rows, strict=True)] for found in matches]
        bounds = np.array([fused_score(share, self.weights) for share in shares])
        results: list[SpatialResult | None] = [None] * len(references)
        best = 0.0
        order = np.argsort(-bounds, kind="stable").tolist()
        for start in range(0, len(order), self.workers.threads):
            batch = [i for i in order[start : start + self.workers.threads] if bounds[i] >= best]
            for i, result in zip(
                batch, self.workers.map(lambda i: self._verified(query, references[i], matches[i]), batch), strict=True
            ):
                results[i] = result
                best = max(best, result.score)
        return results


def _rows(descriptor: PlaceDescriptor) -> list[PatchRows]:
    return [patch_rows(grid.descriptors) for grid in descriptor.patches]


def _matches(query: Sequence[PatchRows], reference: PlaceDescriptor) -> list[tuple[Indices, Indices]]:
    pairs = zip(query, reference.patches, strict=True)
    return [mutual_nearest_rows(rows, patch_rows(grid.descriptors)) for rows, grid in pairs]
