"""Grid search over patch sizes and fusion weights, as the paper did on training data (section 4.1).

P sizes, Q queries, k candidates.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray

from pnv_lab.evaluation.datasets.dataset import Dataset
from pnv_lab.evaluation.evaluate import Evaluation
from pnv_lab.evaluation.methods import METHODS
from pnv_lab.evaluation.metrics import recall_at

_STEPS = 20  # weights are multiples of 0.05
_LARGEST_SET = 3  # the paper found no gain from more sizes


@dataclass(frozen=True)
class GridPoint:
    """A setting and how well it did."""

    sizes: tuple[int, ...]
    weights: tuple[float, ...]
    recall_1: float
    recall_5: float
    mean_reciprocal_rank: float


def grid_search(evaluation: Evaluation, dataset: Dataset, sizes: Sequence[int], scorer: str) -> list[GridPoint]:
    """Every set of at most three of `sizes` with every weight on a grid of 0.05, best first.

    Each size is matched once; settings are then compared on the stored scores. Ties go to fewer and smaller sizes.
    """
    base = METHODS["multi-ransac" if scorer == "usac" else f"multi-{scorer}"]
    methods = [replace(base, name=f"{base.name}[sizes={s}]", sizes=(s,)) for s in sizes]
    asked = dataset.take([q for q, true in enumerate(dataset.truth) if len(true)])
    results = evaluation.run(asked, methods)
    scores, right = [], []
    for q, true in enumerate(asked.truth):
        head = np.sort(results[0].rankings[q].references[: evaluation.config.candidates])
        per_size = [dict(zip(r.rankings[q].references.tolist(), r.rankings[q].scores, strict=True)) for r in results]
        scores.append(np.array([[known[int(r)] for r in head] for known in per_size]))  # (P, k)
        right.append(np.isin(head, true))
    points = []
    for chosen, weights in settings(sizes):
        rows = [list(sizes).index(s) for s in chosen]
        hits = np.array([_rank(np.tensordot(weights, s[rows], 1), r) for s, r in zip(scores, right, strict=True)])
        reciprocal = float(np.mean(np.where(hits >= 0, 1.0 / (hits + 1), 0.0)))
        points.append(GridPoint(chosen, weights, recall_at(hits, 1), recall_at(hits, 5), reciprocal))
    return sorted(points, key=lambda p: (-p.recall_1, -p.mean_reciprocal_rank, len(p.sizes), p.sizes))


def settings(sizes: Sequence[int]) -> list[tuple[tuple[int, ...], tuple[float, ...]]]:
    """Every set of up to three sizes with every convex combination on the grid; weights of 0 are smaller sets."""
    found: list[tuple[tuple[int, ...], tuple[float, ...]]] = []
    for count in range(1, min(_LARGEST_SET, len(sizes)) + 1):
        for chosen in combinations(sorted(sizes), count):
            for cuts in combinations(range(1, _STEPS), count - 1):
                edges = (0, *cuts, _STEPS)
                found.append((chosen, tuple((b - a) / _STEPS for a, b in pairwise(edges))))
    return found


def _rank(scores: NDArray[np.float64], right: NDArray[np.bool_]) -> int:
    """Rank of the first right candidate by score, -1 if there is none."""
    found = np.flatnonzero(right[np.argsort(-scores, kind="stable")])
    return int(found[0]) if len(found) else -1
