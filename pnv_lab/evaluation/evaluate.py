"""Evaluation: methods over a data set, with everything a table or a report shows. Q queries, R references."""

import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnv_core.config import Config
from pnv_core.describe.describer import describer_from
from pnv_lab.evaluation.datasets.dataset import Dataset
from pnv_lab.evaluation.datasets.pose_truth import pose_errors
from pnv_lab.evaluation.dense_vlad import fitted_dense_vlad
from pnv_lab.evaluation.extraction import CachedExtraction, Extraction, Progress, leading
from pnv_lab.evaluation.methods import Method
from pnv_lab.evaluation.metrics import Decisions, first_hits, unique_groups
from pnv_lab.evaluation.ranking import Ranking, rerank, retrieve

_STORES = 8  # kinds of features that may be held at once share the memory budget
MATRIX_SIDE = 160  # rows and columns kept of the similarity matrix


@dataclass(frozen=True, eq=False)
class MethodResult:
    """What one method did on one data set.

    hits: rank of the first true reference per answerable query, -1 if none. Seconds are medians per query. `*_bytes`
    is what is stored of one reference.
    """

    method: Method
    dataset: Dataset
    rankings: tuple[Ranking, ...]
    hits: NDArray[np.int64]
    decisions: Decisions
    extraction_s: float
    matching_s: float
    reference_bytes: float


class Evaluation:
    """Runs methods over data sets, keeping descriptors under `cache`.

    depth: how many references a ranking holds; `config.candidates` of them are re-ranked.
    """

    def __init__(
        self,
        config: Config,
        cache: Path,
        progress: Progress,
        workers: int = 1,
        dask: str | None = None,
        depth: int = 25,
    ) -> None:
        self.config = config
        self.cache = cache
        self.progress = progress
        self.workers = workers
        self.dask = dask
        self.depth = max(depth, config.candidates)
        self._ready: dict[Extraction, CachedExtraction] = {}
        self._completed: dict[Config, Config] = {}
        self._sizes: dict[Config, set[int]] = {}  # patch sizes described together, for methods that share features

    def run(self, dataset: Dataset, methods: Sequence[Method]) -> list[MethodResult]:
        """Every method over the data set, in order. Raises PnvError for an unusable image, model or method."""
        for method in methods:
            config = method.config(self.config)
            if "densevlad" not in (method.features, method.retrieval):
                done = self.completed(config)
                self._sizes.setdefault(config, set()).update(done.patch_sizes, method.wanted_sizes(done))
        return [self._run_one(dataset, method) for method in methods]

    def _run_one(self, dataset: Dataset, method: Method) -> MethodResult:
        retrieval = self.describing(dataset, method, method.retrieval)
        features = self.describing(dataset, method, method.features)
        used = [retrieval] if features is retrieval else [retrieval, features]
        keys = {
            id(d): (self._described(d, dataset, "references"), self._described(d, dataset, "queries")) for d in used
        }
        reference_keys, query_keys = keys[id(retrieval)]
        dim = method.dim if self._shared_projection(retrieval) or not method.scorer else None
        references = leading(retrieval.vectors(reference_keys, dataset.references), dim)
        queries = leading(retrieval.vectors(query_keys, dataset.queries), dim)
        rankings = list(retrieve(queries, references, self._depth(dataset), dataset.excluded))
        if method.scorer:
            rankings = list(self._reranked(dataset, method, features, keys[id(features)], rankings))
        if dataset.groups is not None:
            rankings = [_one_per_group(r, dataset.groups) for r in rankings]
        return MethodResult(
            method,
            dataset,
            tuple(rankings),
            first_hits([r.references for r in rankings], dataset.truth),
            decisions(rankings, dataset),
            sum(self._seconds(d, keys[id(d)][1], dataset.queries) for d in used),
            float(np.median([r.seconds for r in rankings])),
            self._reference_bytes(method, features, keys[id(features)][0], dataset.references, references),
        )

    def describing(self, dataset: Dataset, method: Method, kind: str) -> CachedExtraction:
        """The ready extraction of a kind of features for a method."""
        config = method.config(self.config)
        if kind == "densevlad":
            if method.weights is None:
                path = fitted_dense_vlad(dataset.references, self.completed(config), self.cache, self.progress)
                config = self.config.replace(weights=str(path), patch_sizes=(), patch_strides=(), patch_weights=())
        else:
            done = self.completed(config)
            wanted = tuple(sorted(self._sizes.get(config, done.patch_sizes)))
            if wanted != tuple(sorted(done.patch_sizes)):
                strides = dict(zip(done.patch_sizes, done.patch_strides, strict=True))
                own = tuple(strides.get(size, 1) for size in wanted)
                config = config.replace(patch_sizes=wanted, patch_strides=own, patch_weights=())
        extraction = Extraction(kind, config)
        if extraction not in self._ready:
            self._ready[extraction] = CachedExtraction(extraction, self.cache, self.config.memory_budget_mb / _STORES)
        return self._ready[extraction]

    def completed(self, config: Config) -> Config:
        """The Config with every size filled in from its model."""
        if config not in self._completed:
            self._completed[config] = describer_from(config).config
        return self._completed[config]

    def similarity_matrix(self, dataset: Dataset, method: Method) -> NDArray[np.float32]:
        """Cosines of the global vectors, evenly thinned to at most MATRIX_SIDE queries (rows) and references."""
        retrieval = self.describing(dataset, method, method.retrieval)
        vectors = []
        for paths in (dataset.queries, dataset.references):
            chosen = [paths[i] for i in np.unique(np.linspace(0, len(paths) - 1, MATRIX_SIDE).round().astype(int))]
            vectors.append(retrieval.vectors(retrieval.describe_all(chosen, self.progress), chosen))
        return vectors[0] @ vectors[1].T

    def _described(self, describing: CachedExtraction, dataset: Dataset, part: str) -> list[str]:
        """The keys of the references or queries, all of them described."""
        paths = dataset.references if part == "references" else dataset.queries
        what = f"{dataset.name}, {describing.extraction.kind}, {part}"
        return describing.describe_all(paths, self.progress, self.workers, self.dask, what)

    def _shared_projection(self, describing: CachedExtraction) -> bool:
        describer = getattr(describing.extractor, "describer", None)
        return describer is None or not describer.model.has("patch_projection")

    def _depth(self, dataset: Dataset) -> int:
        if dataset.groups is None:
            return min(self.depth, len(dataset.references))
        largest = int(np.bincount(np.unique(dataset.groups, return_inverse=True)[1]).max())
        return min(self.depth * largest, len(dataset.references))

    def _reranked(
        self,
        dataset: Dataset,
        method: Method,
        features: CachedExtraction,
        keys: tuple[list[str], list[str]],
        rankings: Sequence[Ranking],
    ) -> Iterator[Ranking]:
        """The rankings with their candidates re-ranked, in order."""
        reference_keys, query_keys = keys
        score = method.pair_score(self.completed(method.config(self.config)))
        assert score is not None

        def one(q: int) -> Ranking:
            head = rankings[q].references[: self.config.candidates]
            record = features.record(query_keys[q], dataset.queries[q])
            seconds = rankings[q].seconds

            def scored(r: int) -> float:  # one reference at a time: a hundred of the largest preset fill 5 GB
                nonlocal seconds
                reference = features.record(reference_keys[r], dataset.references[r])
                began = time.perf_counter()
                value = score(record, reference)
                seconds += time.perf_counter() - began
                return value

            return replace(rerank(rankings[q], len(head), scored), seconds=seconds)

        with ThreadPoolExecutor(self.workers) as pool:
            done = _in_order(pool, one, len(rankings), 2 * self.workers)
            yield from self.progress(done, len(rankings), f"{dataset.name}, {method.name}")

    def _seconds(self, describing: CachedExtraction, keys: Sequence[str], paths: Sequence[Path]) -> float:
        """Median seconds of describing an image, as measured when it was described."""
        sample = range(0, len(keys), max(1, len(keys) // 50))
        return float(np.median([describing.record(keys[i], paths[i])["seconds"][0] for i in sample]))

    def _reference_bytes(
        self,
        method: Method,
        features: CachedExtraction,
        keys: Sequence[str],
        paths: Sequence[Path],
        vectors: NDArray[np.float32],
    ) -> float:
        """Bytes of one reference: global vector and what re-ranking needs of it."""
        size = float(vectors.itemsize * vectors.shape[1])
        if not method.scorer:
            return size
        record = features.record(keys[0], paths[0])
        if "points" in record or "keypoints" in record:
            return size + sum(a.nbytes for n, a in record.items() if n != "seconds")
        for patch_size in method.wanted_sizes(self.completed(method.config(self.config))):
            patches = record[f"patches_{patch_size}"]
            size += patches.itemsize * len(patches) * min(patches.shape[1], method.dim or patches.shape[1])
        return size


def _in_order(pool: ThreadPoolExecutor, work: Callable[[int], Any], count: int, ahead: int) -> Iterator[Any]:
    """Results of work(0) ... work(count - 1) in order, at most `ahead` of them waiting."""
    waiting = [pool.submit(work, i) for i in range(min(ahead, count))]
    started = len(waiting)
    try:
        while waiting:
            yield waiting.pop(0).result()
            if started < count:
                waiting.append(pool.submit(work, started))
                started += 1
    finally:
        for future in waiting:
            future.cancel()


def _one_per_group(ranking: Ranking, groups: NDArray[np.int64]) -> Ranking:
    kept = unique_groups(ranking.references, groups)
    position = {int(r): i for i, r in enumerate(ranking.references)}
    rows = np.array([position[int(r)] for r in kept], np.int64)
    return Ranking(kept, ranking.scores[rows], int((rows < ranking.reranked).sum()), ranking.seconds)


def localised(result: MethodResult, tolerances: Sequence[tuple[float, float]]) -> list[float]:
    """Share of the queries with a known pose whose best reference's pose is within each (metres, degrees)."""
    dataset = result.dataset
    if dataset.query_poses is None or dataset.reference_poses is None:
        return []
    rows = [q for q in range(len(dataset.queries)) if np.isfinite(dataset.query_poses[q]).all()]
    if not rows:
        return [float("nan")] * len(tolerances)
    answered = [q for q in rows if len(result.rankings[q].references)]
    best = np.array([result.rankings[q].references[0] for q in answered], np.int64)
    metres, degrees = pose_errors(dataset.reference_poses[best], dataset.query_poses[answered])
    return [float(((metres <= m) & (degrees <= d)).sum()) / len(rows) for m, d in tolerances]


def decisions(rankings: Sequence[Ranking], dataset: Dataset) -> Decisions:
    """The best candidate of every query: its score, whether it is right, whether a right one exists."""
    scores = [float(r.scores[0]) if len(r.scores) else -np.inf for r in rankings]
    right = [bool(len(r.references)) and r.references[0] in t for r, t in zip(rankings, dataset.truth, strict=True)]
    return Decisions(np.array(scores), np.array(right), np.array([len(t) > 0 for t in dataset.truth]))
