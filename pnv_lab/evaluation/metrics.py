"""Recall@N, precision and recall of decisions, and their confidence intervals. Q queries, N the length of a ranking."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


def first_hits(rankings: Sequence[NDArray[np.int64]], truth: Sequence[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Per query with a true reference the rank (from 0) of the first true one in its ranking; -1 if there is none.

    Queries without a true reference are left out, as the standard protocols do.
    """
    hits = []
    for ranking, true in zip(rankings, truth, strict=True):
        if len(true):
            found = np.flatnonzero(np.isin(ranking, true))
            hits.append(int(found[0]) if len(found) else -1)
    return np.array(hits, np.int64)


def recall_at(hits: NDArray[np.int64], n: int) -> float:
    """Share of the queries whose first true reference is among the first n. NaN without queries."""
    return float(np.mean((hits >= 0) & (hits < n))) if len(hits) else float("nan")


def unique_groups(ranking: NDArray[np.int64], groups: NDArray[np.int64]) -> NDArray[np.int64]:
    """The ranking with only the first reference of every group (the cut-outs of one panorama count once)."""
    _, first = np.unique(groups[ranking], return_index=True)
    return ranking[np.sort(first)]


@dataclass(frozen=True, eq=False)
class Decisions:
    """The best candidate of every query: its score (Q,), whether it is right (Q,), whether a right one exists (Q,).

    A query without candidate has score -inf.
    """

    scores: Floats
    right: Bools
    possible: Bools

    def take(self, rows: NDArray[np.int64]) -> "Decisions":
        return Decisions(self.scores[rows], self.right[rows], self.possible[rows])


def precision_recall(decisions: Decisions) -> tuple[Floats, Floats, Floats]:
    """(thresholds, precision, recall), thresholds falling; equal scores share one point.

    Accepted are the candidates at or above a threshold. precision = right / accepted; recall = right accepted / queries
    that have a true reference. An accepted candidate of a query without one is wrong.
    """
    answered = np.isfinite(decisions.scores)
    order = np.argsort(-decisions.scores[answered], kind="stable")
    scores, right = decisions.scores[answered][order], decisions.right[answered][order]
    last = np.flatnonzero(np.diff(scores, append=-np.inf))  # the last of each run of equal scores
    if not len(scores):
        return np.empty(0), np.empty(0), np.empty(0)
    correct = np.cumsum(right)[last]
    possible = int(decisions.possible.sum())
    recall = correct / possible if possible else np.full(len(last), np.nan)
    return scores[last], correct / (last + 1), recall


def average_precision(decisions: Decisions) -> float:
    """Area under the precision-recall steps: sum of precision times gain in recall. NaN without a possible query."""
    _, precision, recall = precision_recall(decisions)
    if not decisions.possible.any():
        return float("nan")
    return float(np.sum(precision * np.diff(recall, prepend=0.0)))


def recall_at_full_precision(decisions: Decisions) -> float:
    """The largest recall before the first wrong acceptance. NaN without a possible query."""
    _, precision, recall = precision_recall(decisions)
    if not decisions.possible.any():
        return float("nan")
    perfect = np.flatnonzero(precision == 1.0)
    return float(recall[perfect].max()) if len(perfect) else 0.0


@dataclass(frozen=True)
class Interval:
    """A figure with the bounds of its 95 % confidence interval."""

    value: float
    low: float
    high: float


def bootstrap(
    statistic: Callable[[NDArray[np.int64]], float], count: int, samples: int = 1000, seed: int = 0
) -> Interval:
    """Percentile bootstrap over queries: `statistic` is given row numbers, drawn with replacement.

    Efron and Tibshirani 1993, chapter 13. Resamples on which the figure is undefined are left out.
    """
    rng = np.random.default_rng(seed)
    value = statistic(np.arange(count))
    if count == 0:
        return Interval(value, float("nan"), float("nan"))
    drawn = np.array([statistic(rng.integers(0, count, count)) for _ in range(samples)])
    drawn = drawn[np.isfinite(drawn)]
    if not len(drawn):
        return Interval(value, float("nan"), float("nan"))
    low, high = np.percentile(drawn, [2.5, 97.5])
    return Interval(value, float(low), float(high))
