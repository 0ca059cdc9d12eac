"""CachedExtraction the images of a data set once: cached, resumable, in one process or many.

What is stored of an image depends on the bytes of the image and on the Extraction alone, so that an interrupted run,
several workers or several machines give the same files.
"""

import hashlib
import json
import multiprocessing
import signal
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pnv_core.config import Config
from pnv_core.errors import ConfigError, PnvError
from pnv_core.images import read_image
from pnv_core.settings import settings_of
from pnv_core.types import PatchGrid, PlaceDescriptor
from pnv_lab.evaluation.store import DescriptorStore, Record, code_version, content_key

# Settings that no description depends on. An extractor sees their defaults, so that none of them can change a record;
# every other setting, a new one too, is part of the key that a record is found by.
_WITHOUT_EFFECT = (
    "preset", "min_interval_s", "min_change", "exclude_recent_s", "candidates", "time_budget_ms", "index", "scorer",
    "patch_weights", "verifier", "verify", "accept_score", "min_texture", "consistency", "sure_score",
    "odometry_drift", "odometry_slack_m", "min_travelled_m", "memory_budget_mb", "eviction", "patch_store",
    "patch_folder", "disk_budget_gb",
)  # fmt: skip
Progress = Callable[[Iterable[Any], int, str], Iterable[Any]]  # (items, how many, what) -> the same items


class Extractor(Protocol):
    """Computes the record of an image. `fingerprint` tells apart the models and settings that change a record."""

    fingerprint: str

    def record(self, rgb: NDArray[np.uint8]) -> Record: ...


@dataclass(frozen=True)
class Extraction:
    """What to compute of every image: a kind of features under a Config. Small and picklable, for workers.

    Of the Config only what a description may depend on is kept; the rest has its defaults.
    """

    kind: str
    config: Config

    def __post_init__(self) -> None:
        unused = {name: s.default for name, s in settings_of(Config).items() if name in _WITHOUT_EFFECT}
        object.__setattr__(self, "config", self.config.replace(**unused))

    def open(self) -> Extractor:
        """The extractor itself. Raises ModelError or ConfigError."""
        from pnv_lab.evaluation.extractors import make_extractor

        return make_extractor(self.kind, self.config)


def descriptor_record(descriptor: PlaceDescriptor, precision: str) -> Record:
    """A PlaceDescriptor as named arrays: patches in float32 or float16."""
    kind = np.float32 if precision == "float32" else np.float16
    record: dict[str, NDArray] = {
        "global": descriptor.global_vector,
        "texture": np.array([descriptor.texture], np.float32),
    }
    for grid in descriptor.patches:
        record[f"patches_{grid.size}"] = grid.descriptors.astype(kind)
        record[f"grid_{grid.size}"] = np.array([grid.rows, grid.cols, grid.stride, grid.cell])
    return record


def descriptor_of(record: Record, sizes: Sequence[int] | None = None, dim: int | None = None) -> PlaceDescriptor:
    """The PlaceDescriptor of a record, of some patch sizes or of all.

    `dim` keeps the leading dimensions of every patch: with PCA the projection of that smaller size.
    """
    if sizes is None:
        sizes = sorted(int(name.removeprefix("grid_")) for name in record if name.startswith("grid_"))
    patches = []
    for size in sizes:
        rows, cols, stride, cell = (int(v) for v in record[f"grid_{size}"])
        patches.append(PatchGrid(size, rows, cols, leading(record[f"patches_{size}"], dim), stride, cell))
    return PlaceDescriptor(leading(record["global"], None), tuple(patches), float(record["texture"][0]))


def leading(vectors: NDArray, dim: int | None) -> NDArray[np.float32]:
    """(..., D) -> the first `dim` values as unit float32 vectors; all of them where `dim` is None."""
    values = vectors[..., :dim].astype(np.float32)
    if dim is None:
        return values
    norm = np.linalg.norm(values, axis=-1, keepdims=True)
    return values / np.maximum(norm, 1e-12)


class CachedExtraction:
    """An Extraction made ready: its extractor and its place in the cache."""

    def __init__(self, extraction: Extraction, cache: Path, memory_mb: float = 256.0) -> None:
        self.extraction = extraction
        self.extractor = extraction.open()
        identity = json.dumps([code_version(), extraction.kind, self.extractor.fingerprint])
        name = hashlib.sha256(identity.encode()).hexdigest()[:24]
        self.store = DescriptorStore(cache / f"{extraction.kind}-{name}", memory_mb)

    def describe_one(self, path: Path, key: str) -> None:
        """Compute and store the record of an image. Raises ImageError."""
        self.store.put(key, timed_record(self.extractor, path))

    def describe_all(
        self,
        paths: Sequence[Path],
        progress: Progress,
        workers: int = 1,
        dask: str | None = None,
        what: str = "describing",
    ) -> list[str]:
        """The content key of every image, each with its record in the store. Raises ImageError for an unusable image.

        `dask` is a scheduler's address, or "local" for a cluster of this machine with `workers` processes.
        """
        keys = [content_key(path) for path in progress(paths, len(paths), f"{what}: reading")]
        missing = {key: path for key, path in zip(keys, paths, strict=True) if key not in self.store}
        jobs = list(missing.items())
        if jobs:
            self.store.folder.mkdir(parents=True, exist_ok=True)
            if dask is not None:
                done = _dask_records(self.extraction, jobs, workers, dask)
            elif workers > 1:
                done = _pool_records(self.extraction, jobs, workers)
            else:
                done = ((key, timed_record(self.extractor, path)) for key, path in jobs)
            for key, record in progress(done, len(jobs), what):
                self.store.put(key, record)
        return keys

    def record(self, key: str, path: Path) -> dict[str, NDArray]:
        """The record of an image, computed anew if the stored one was lost or damaged."""
        record = self.store.get(key)
        if record is None:
            self.describe_one(path, key)
            record = self.store.get(key)
        if record is None:
            raise PnvError(f"{self.store.path(key)}: cannot be read back; name another folder with --cache")
        return record

    def vectors(self, keys: Sequence[str], paths: Sequence[Path]) -> NDArray[np.float32]:
        """(N, D) global vectors."""
        rows = []
        for key, path in zip(keys, paths, strict=True):
            vector = self.store.vector(key)
            rows.append(self.record(key, path)["global"] if vector is None else vector)
        return np.stack(rows).astype(np.float32, copy=False)


def timed_record(extractor: Extractor, path: Path) -> Record:
    """The record of an image file with the seconds its description took (reading the file excluded)."""
    rgb = read_image(path)
    start = time.perf_counter()
    record = extractor.record(rgb)
    return {**record, "seconds": np.array([time.perf_counter() - start])}


_worker_extractor: Extractor | None = None  # of a worker process, made once


def _start_worker(extraction: Extraction) -> None:
    global _worker_extractor
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches every process of the terminal; the parent ends these
    _worker_extractor = extraction.open()


def _work(job: tuple[str, Path]) -> tuple[str, Record]:
    assert _worker_extractor is not None
    key, path = job
    return key, timed_record(_worker_extractor, path)


def one_thread(extraction: Extraction) -> Extraction:
    """The same extraction for one of several processes: each takes one thread."""
    return Extraction(extraction.kind, extraction.config.replace(threads=1))


def _pool_records(extraction: Extraction, jobs: list[tuple[str, Path]], workers: int) -> Iterator[tuple[str, Record]]:
    """Records from spawned processes, at most four per worker waiting."""
    context = multiprocessing.get_context("spawn")  # torch's threads do not survive a fork
    with ProcessPoolExecutor(workers, context, _start_worker, (one_thread(extraction),)) as pool:
        waiting: list[Any] = []
        remaining = iter(jobs)
        try:
            while True:
                while len(waiting) < 4 * workers and (job := next(remaining, None)) is not None:
                    waiting.append(pool.submit(_work, job))
                if not waiting:
                    return
                yield waiting.pop(0).result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


_dask_extractors: dict[Extraction, Extractor] = {}  # of a Dask worker process


def _dask_work(extraction: Extraction, key: str, path: Path) -> tuple[str, Record]:
    if extraction not in _dask_extractors:
        _dask_extractors[extraction] = extraction.open()
    return key, timed_record(_dask_extractors[extraction], path)


def _dask_records(
    extraction: Extraction, jobs: list[tuple[str, Path]], workers: int, address: str
) -> Iterator[tuple[str, Record]]:
    """Records from a Dask cluster, at most four per worker waiting. Workers see the images under the same paths."""
    try:
        from distributed import Client, LocalCluster, as_completed
    except ImportError:
        raise ConfigError("Dask is not installed; allowed: pip install 'pnv_ros[dask]', or no --dask") from None
    cluster = None
    if address == "local":
        cluster = LocalCluster(n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=None)
    try:
        with Client(cluster or address, timeout="30s") as client:
            waiting = as_completed()
            remaining = iter(jobs)
            ahead = 4 * max(workers, len(client.scheduler_info()["workers"]))
            small = one_thread(extraction)
            for _, (key, path) in zip(range(ahead), remaining, strict=False):
                waiting.add(client.submit(_dask_work, small, key, path.resolve(), pure=False))
            for future in waiting:
                yield future.result()
                if (job := next(remaining, None)) is not None:
                    waiting.add(client.submit(_dask_work, small, job[0], job[1].resolve(), pure=False))
    except OSError as error:
        raise ConfigError(
            f"--dask {address}: no scheduler answers ({error}); allowed: local or tcp://HOST:PORT"
        ) from None
    finally:
        if cluster is not None:
            cluster.close()
