"""Ranking the references of every query: retrieval by the global vectors, then re-ranking of the first candidates."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_BLOCK = 64  # queries per matrix product


@dataclass(frozen=True, eq=False)
class Ranking:
    """References of one query, best first, with what each scored. `seconds` is the time the matching took.

    The first `reranked` of them are ordered by the spatial score, the others by cosine.
    """

    references: NDArray[np.int64]
    scores: NDArray[np.float64]
    reranked: int = 0
    seconds: float = 0.0


def retrieve(
    queries: NDArray[np.float32],
    references: NDArray[np.float32],
    k: int,
    excluded: Sequence[NDArray[np.int64]] | None = None,
) -> Iterator[Ranking]:
    """(Q, D), (R, D) -> per query the k most similar references by cosine; ties go to the lower number.

    `excluded` lists per query the references that are not to be found.
    """
    for start in range(0, len(queries), _BLOCK):
        began = time.perf_counter()
        block = queries[start : start + _BLOCK] @ references.T  # (B, R)
        for i, similarity in enumerate(block):
            barred = 0
            if excluded is not None:
                barred = len(excluded[start + i])
                similarity[excluded[start + i]] = -np.inf
            count = min(k, len(references) - barred)
            order = _largest(similarity, count)
            spent = (time.perf_counter() - began) / len(block)
            yield Ranking(order, similarity[order].astype(np.float64), 0, spent)


def _largest(values: NDArray[np.float32], k: int) -> NDArray[np.int64]:
    """Numbers of the k largest values, largest first, equal ones in order."""
    if k <= 0:
        return np.empty(0, np.int64)
    if k < len(values):
        threshold = np.partition(values, len(values) - k)[len(values) - k]
        chosen = np.flatnonzero(values > threshold)
        ties = np.flatnonzero(values == threshold)[: k - len(chosen)]
        chosen = np.sort(np.concatenate([chosen, ties]))
    else:
        chosen = np.arange(len(values))
    return chosen[np.argsort(-values[chosen], kind="stable")].astype(np.int64)


def rerank(ranking: Ranking, candidates: int, score: Callable[[int], float]) -> Ranking:
    """The ranking with its first `candidates` ordered by their score; equal scores keep the order of retrieval."""
    head = ranking.references[:candidates]
    scores = np.array([score(int(reference)) for reference in head], np.float64)
    order = np.argsort(-scores, kind="stable")
    return Ranking(
        np.concatenate([head[order], ranking.references[candidates:]]),
        np.concatenate([scores[order], ranking.scores[candidates:]]),
        len(head),
        ranking.seconds,
    )
