"""How the product's times grow: patches with image size, patch sizes, K and D; retrieval with keyframes; re-ranking.

    python -m benchmarks.growth [--keyframes 1000 10000 100000 1000000] [--plot FILE]

One database of global vectors, those of a robot that drives a course in laps (benchmarks/database.py), that grows to
each size under `index auto`: what a query and a new keyframe take there, and memory. Patches are left out: describing
and re-ranking a fixed number of candidates do not depend on the keyframes, and what patches take is bounded by
memory_budget_mb (`benchmarks/database.py footprint`).
"""

import argparse
import time
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from benchmarks.database import LAPS, SECOND, Course
from pnv_core.config import Config
from pnv_core.database import KeyframeDatabase
from pnv_core.describe.model_files import ModelInfo, build_model
from pnv_core.describe.openvino_describing import head
from pnv_core.describe.trunks.vgg16 import vgg16_trunk
from pnv_core.networks.openvino_backend import Compiled
from pnv_core.types import PatchGrid, PlaceDescriptor
from pnv_core.verify.reranker import Reranker

_ROUNDS = 3
_QUERIES = 200
_BLOCK = 1000  # vectors made at once
_DIM = 512  # of the default model
_CHANNELS = 512


def _ms(function: Callable[[], Any]) -> float:
    function()
    taken = []
    for _ in range(_ROUNDS):
        start = time.perf_counter()
        function()
        taken.append((time.perf_counter() - start) * 1e3)
    return round(float(np.median(taken)), 3)


def _patches_ms(cells: tuple[int, int], sizes: tuple[int, ...], clusters: int, dim: int, threads: int) -> float:
    rng = np.random.default_rng(0)
    centroids = F.normalize(torch.from_numpy(rng.standard_normal((clusters, _CHANNELS), np.float32))).numpy() * 0.3
    tensors = {f"trunk.{name}": np.zeros(shape) for name, shape in vgg16_trunk().tensor_shapes().items()} | {
        "netvlad.centroids": centroids,
        "netvlad.assignment": 20 * centroids,
        "global_projection.weight": rng.standard_normal((dim, clusters * _CHANNELS), np.float32),
        "global_projection.bias": np.zeros(dim),
    }
    model = build_model(ModelInfo("vgg16"), tensors, "benchmark")
    graph = Compiled(lambda: head(model, cells, [(size, 1) for size in sizes]), threads)
    maps = rng.standard_normal((1, _CHANNELS, *cells), np.float32)
    return _ms(lambda: graph(maps, maps, np.ones((1, 1, *cells), np.float32)))


def _retrieval_ms(keyframes: int, dim: int = 512) -> float:
    rng = np.random.default_rng(0)
    vectors = rng.standard_normal((keyframes, dim), np.float32)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    database = KeyframeDatabase(dim, memory_budget_mb=4096.0)
    for number, vector in enumerate(vectors):
        database.add(number, "camera", PlaceDescriptor(vector, ()))
    return _ms(lambda: database.nearest(vectors[0], 10, 10**9, 0))


def _reranking_ms(candidates: int, threads: int, dim: int = 64, side: tuple[int, int] = (15, 20)) -> float:
    rng = np.random.default_rng(0)

    def place() -> PlaceDescriptor:
        grids = []
        for size in (2, 3, 5):
            shape = side[0] - size + 1, side[1] - size + 1
            rows = rng.standard_normal((shape[0] * shape[1], dim)).astype(np.float32)
            rows /= np.linalg.norm(rows, axis=1, keepdims=True)
            grids.append(PatchGrid(size, *shape, rows))
        return PlaceDescriptor(np.zeros(dim, np.float32), tuple(grids))

    settings = Config.make(patch_sizes=(2, 3, 5), patch_weights=(0.34, 0.33, 0.33), threads=threads)
    reranker, query, references = Reranker(settings), place(), [place() for _ in range(candidates)]
    return _ms(lambda: reranker.scores(query, references))


def measured_growth(threads: int) -> dict[str, dict[str, list[float]]]:
    """Per quantity its values and the milliseconds of each."""

    def series(values: list[Any], measure: Callable[[Any], float], shown: Callable[[Any], Any] = lambda v: v) -> dict:
        return {"values": [shown(v) for v in values], "ms": [measure(v) for v in values]}

    three = (2, 5, 8)
    found = {
        "image width [px], 4:3": series(
            [320, 480, 640, 960],
            lambda w: _patches_ms((w * 3 // 4 // 16, w // 16), three, 16, 512, threads),
        ),
        "number of patch sizes": series(
            [(5,), (2, 5), three, (2, 3, 5, 8), (2, 3, 4, 5, 6, 8)],
            lambda sizes: _patches_ms((30, 40), sizes, 16, 512, threads),
            len,
        ),
        "clusters K": series([8, 16, 32, 64], lambda k: _patches_ms((30, 40), three, k, 512, threads)),
        "dimensions D": series([64, 128, 512, 1024, 2048], lambda d: _patches_ms((30, 40), three, 16, d, threads)),
        "keyframes (retrieval)": series([100, 1000, 10000, 50000], _retrieval_ms),
        "candidates (default model's patches, RANSAC)": series(
            [1, 3, 10, 30, 100], lambda n: _reranking_ms(n, threads)
        ),
    }
    for name, line in found.items():
        print(f"{name}: " + ", ".join(f"{v}: {ms:.2f} ms" for v, ms in zip(line["values"], line["ms"], strict=True)))
    return found


def plotted(growth: dict[str, dict[str, list[float]]], path: Path) -> None:
    """One small plot per quantity, in one picture."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(2, 3, figsize=(12, 6.5))
    for axis, (name, line) in zip(axes.ravel(), growth.items(), strict=True):
        axis.plot(line["values"], line["ms"], "o-")
        axis.set_xlabel(name)
        axis.set_ylabel("ms")
        axis.set_xlim(left=0)
        axis.set_ylim(bottom=0)
        axis.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(path, dpi=80)


def resident_mb() -> float:
    """Of this process."""
    return int(Path("/proc/self/status").read_text().split("VmRSS:")[1].split()[0]) / 1e3


def _driven(course: Course) -> Iterator[NDArray[np.float32]]:
    """The global vectors of a drive, lap after lap."""
    for lap in count():
        for start in range(0, course.places, _BLOCK):
            yield from course.frames(np.arange(start, min(start + _BLOCK, course.places)), lap)


def keyframe_growth(sizes: list[int]) -> list[dict[str, float]]:
    """Per number of keyframes: milliseconds of a query and of a new keyframe, and megabytes."""
    course = Course(max(sizes[-1] // LAPS, 1), _DIM)
    database = KeyframeDatabase(_DIM, sizes[-1] * (_DIM * 8 + 4000) / 1e6)
    queries = course.frames(np.random.default_rng(7).uniform(0, course.places, _QUERIES), lap=LAPS)
    vectors = _driven(course)
    before, rows = resident_mb(), []
    print("| keyframes | query p50 | query p95 | new keyframe | database | resident |\n|---:|---:|---:|---:|---:|---:|")
    for size in sizes:
        more, adding = size - len(database), 0.0
        for _ in range(more):
            vector, begun = next(vectors), time.perf_counter()
            database.add(len(database) * SECOND, "front", PlaceDescriptor(vector, ()))
            adding += 1e3 * (time.perf_counter() - begun) / more
        taken = []
        for query in queries:
            start = time.perf_counter()
            database.nearest(query, 10, (size + 3600) * SECOND, 30 * SECOND)
            taken.append(1e3 * (time.perf_counter() - start))
        median, late = (float(np.percentile(taken, p)) for p in (50, 95))
        used, resident = database.bytes_used / 1e6, resident_mb() - before
        rows.append({"keyframes": size, "p50": median, "p95": late, "add": adding, "MB": used, "resident": resident})
        print(
            f"| {size:,} | {median:.2f} ms | {late:.2f} ms | {adding:.2f} ms | {used:.0f} MB | {resident:.0f} MB |",
            flush=True,
        )
    return rows


def plotted_keyframes(rows: list[dict[str, float]], path: Path) -> None:
    """Latency and memory over the number of keyframes."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (times, memory) = pyplot.subplots(1, 2, figsize=(9, 3.6))
    sizes = [row["keyframes"] for row in rows]
    for axis, lines, unit in (
        (times, {"p50": "query, median", "p95": "query, 95th percentile", "add": "new keyframe"}, "ms"),
        (memory, {"MB": "database", "resident": "resident"}, "MB"),
    ):
        for key, label in lines.items():
            axis.loglog(sizes, [row[key] for row in rows], "o-", label=label)
        axis.set_xlabel("keyframes")
        axis.set_ylabel(unit)
        axis.grid(alpha=0.3)
        axis.legend()
    figure.tight_layout()
    figure.savefig(path, dpi=80)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keyframes", type=int, nargs="+", default=[1000, 10_000, 100_000, 1_000_000])
    parser.add_argument("--plot", type=Path, default=Path("out/performance_keyframes.png"))
    args = parser.parse_args()
    rows = keyframe_growth(sorted(args.keyframes))
    args.plot.parent.mkdir(parents=True, exist_ok=True)
    plotted_keyframes(rows, args.plot)
    print(f"drawn to {args.plot}")


if __name__ == "__main__":
    main()
