"""The keyframe database: retrieval at any size, memory, and saving while frames arrive.

    nice python benchmarks/database.py retrieval --rows 100000 --index exact pq
    nice python benchmarks/database.py retrieval --rows 1000000 --index exact pq
    nice python benchmarks/database.py saving --keyframes 10000
    nice python benchmarks/database.py stalls --keyframes 11000
    nice python benchmarks/database.py footprint

Vectors are random, or those of a robot that drives the same closed course of places in many laps, each under its own
appearance: the neighbours of a query are then a few frames of every lap. Truth is exact search over all vectors.
"""

import argparse
import shutil
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import faiss
import numpy as np
from numpy.typing import NDArray

from pnv_core.database import KeyframeDatabase
from pnv_core.maps import MapStore
from pnv_core.types import PatchGrid, PlaceDescriptor

SECOND = 10**9
LAPS = 20
Vectors = NDArray[np.float32]


def unit(values: NDArray) -> Vectors:
    return np.asarray(values / np.linalg.norm(values, axis=-1, keepdims=True), np.float32)


def random_vectors(rows: int, dim: int) -> Iterator[Vectors]:
    """Blocks (n, D) of `rows` vectors without structure: what is hardest for an index."""
    rng = np.random.default_rng(0)
    for start in range(0, rows, 50_000):
        yield unit(rng.standard_normal((min(50_000, rows - start), dim), dtype=np.float32))


class Course:
    """A closed course of `places`, one frame each per lap. Consecutive frames have a cosine of about 0.8; half the
    energy a frame does not share with its place is the lap's (weather, light), the other half its own."""

    def __init__(self, places: int, dim: int) -> None:
        rng = np.random.default_rng(1)
        self.places = places
        self._frequencies = rng.standard_normal((3, dim // 2))
        harmonics = np.arange(1, 13)
        self._mix = rng.standard_normal((24, 3)) * places / 12 / np.sqrt(2 * (harmonics**2).sum())
        self._harmonics = harmonics

    def frames(self, where: NDArray, lap: int) -> Vectors:
        """(n,) places -> (n, D) vectors seen in this lap."""
        rng = np.random.default_rng(1000 + lap)
        angle = 2 * np.pi * np.outer(where / self.places, self._harmonics)
        position = np.concatenate([np.cos(angle), np.sin(angle)], axis=1) @ self._mix
        phase = position @ self._frequencies
        view = np.concatenate([np.cos(phase), np.sin(phase)], axis=1)
        dim = view.shape[1]
        return unit(view + 0.35 * rng.standard_normal(dim) + 0.35 * rng.standard_normal((len(where), dim)))

    def vectors(self, rows: int) -> Iterator[Vectors]:
        """Blocks (n, D) of `rows` frames, lap after lap."""
        for lap in range(-(-rows // self.places)):
            count = min(self.places, rows - lap * self.places)
            jitter = np.random.default_rng(lap).uniform(-0.5, 0.5)
            yield self.frames(np.arange(count) + jitter, lap)


def retrieval(args: argparse.Namespace) -> None:
    """Time per query, recall@10, and what an added keyframe costs, per number of rows, kind of vectors and index.

    Own time leaves out what the thread waited for a processor, CPU is processor time.
    """
    print("| rows | vectors | index | query median | own median | own p95 | CPU mean | recall@10 | add CPU mean | MB |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for rows in args.rows:
        for kind in args.kind:
            course = Course(rows // LAPS, args.dim)
            rng = np.random.default_rng(7)
            if kind == "random":
                blocks, queries = random_vectors, unit(rng.standard_normal((args.queries, args.dim)))
                vectors = np.concatenate(list(blocks(rows, args.dim)))
            else:
                queries = course.frames(rng.uniform(0, course.places, args.queries), lap=LAPS)
                vectors = np.concatenate(list(course.vectors(rows)))
            truth = faiss.knn(queries, vectors, 10, metric=faiss.METRIC_INNER_PRODUCT)[1]
            for index in args.index:
                _retrieve(kind, index, vectors, queries, truth)


def _retrieve(kind: str, index: str, vectors: Vectors, queries: Vectors, truth: NDArray) -> None:
    rows, dim = vectors.shape
    database = KeyframeDatabase(dim, rows * (dim * 8 + 4000) / 1e6, index=index)
    cpu = time.process_time()
    for i, vector in enumerate(vectors):
        database.add(i * SECOND, "front", PlaceDescriptor(vector, ()))
    adding_cpu = (time.process_time() - cpu) / rows
    hits, asking, own = 0, [], []
    cpu = time.process_time()
    for query, best in zip(queries, truth, strict=True):
        started, waited = time.perf_counter(), _waited_for_processor()
        found = database.nearest(query, 10, (rows + 3600) * SECOND, 30 * SECOND)
        asking.append(time.perf_counter() - started)
        own.append(asking[-1] - (_waited_for_processor() - waited))
        hits += len({ref.id for ref, _ in found} & set(best.tolist()))
    asking_cpu = (time.process_time() - cpu) / len(queries)
    ms = [1e3 * value for value in (np.median(asking), np.median(own), np.percentile(own, 95), asking_cpu)]
    print(
        f"| {rows} | {kind} | {index} | {ms[0]:.1f} ms | {ms[1]:.1f} | {ms[2]:.1f} | {ms[3]:.1f} "
        f"| {hits / truth.size:.4f} | {1e3 * adding_cpu:.2f} ms | {database.bytes_used / 1e6:.0f} |",
        flush=True,
    )


def place(rng: np.random.Generator, dim: int, patches: int) -> PlaceDescriptor:
    grid = PatchGrid(2, 1, patches, unit(rng.standard_normal((patches, 64), dtype=np.float32)))
    return PlaceDescriptor(unit(rng.standard_normal(dim)), (grid,))


def saving(args: argparse.Namespace) -> None:
    """How long frames wait while a whole map is saved: queries and adds at `--rate`, with and without a save."""
    rng = np.random.default_rng(0)
    places = [place(rng, args.dim, 676) for _ in range(64)]
    database = KeyframeDatabase(args.dim, args.keyframes * 0.1)
    for i in range(args.keyframes):
        database.add(i * SECOND, "front", places[i % 64])
    folder = Path(tempfile.mkdtemp(prefix="map-", dir=args.folder))
    try:
        quiet = _frames(database, places, args.rate, threading.Event(), 5.0)
        _report("no save", quiet)
        done = threading.Event()
        outcome: list[str] = []

        def save() -> None:
            started = time.perf_counter()
            report = MapStore(folder / "map", "0" * 16).save(database.snapshot())
            took = time.perf_counter() - started
            outcome.append(f"{report.keyframes} keyframes, {report.bytes_written / 1e6:.0f} MB, {took:.1f} s")
            done.set()

        saver = threading.Thread(target=save)
        saver.start()
        busy = _frames(database, places, args.rate, done, 600.0)
        saver.join()
        _report(f"while saving {outcome[0]}", busy)
        started = time.perf_counter()
        loaded = KeyframeDatabase(args.dim, args.keyframes * 0.1)
        MapStore(folder / "map", "0" * 16).load(loaded)
        print(f"verified and loaded: {len(loaded)} keyframes in {time.perf_counter() - started:.1f} s")
    finally:
        shutil.rmtree(folder)


def _frames(
    database: KeyframeDatabase, places: list[PlaceDescriptor], rate: float, until: threading.Event, most_s: float
) -> NDArray:
    """(frames, 2) seconds each frame's query and add took, and of those the seconds it waited for a processor."""
    took, started = [], time.perf_counter()
    while not until.is_set() and time.perf_counter() - started < most_s:
        begin, waited = time.perf_counter(), _waited_for_processor()
        last = database.last()
        assert last is not None
        stamp = last.stamp_ns + SECOND
        seen = places[last.id % 64]
        database.nearest(seen.global_vector, 10, stamp, 30 * SECOND)
        database.add(stamp, "front", seen)
        took.append((time.perf_counter() - begin, _waited_for_processor() - waited))
        time.sleep(max(0.0, 1 / rate - took[-1][0]))
    return np.array(took)


def _waited_for_processor(thread: int | str = "") -> float:
    """Seconds a thread, this one by default, has been ready to run while others ran (Linux schedstat).

    That is the load of the machine, not ours.
    """
    which = f"self/task/{thread}" if thread else "thread-self"
    return int(Path(f"/proc/{which}/schedstat").read_text().split()[1]) / 1e9


class Ticks:
    """A thread that wants to run every millisecond, as a callback would: the longest it had to wait, in ms.

    `longest` is by the clock; `longest_own` leaves out what it and the thread that made it waited for a processor.
    """

    def __init__(self) -> None:
        self.longest = self.longest_own = 0.0
        self._worker, self._ended = threading.get_native_id(), threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _run(self) -> None:
        at, waited = time.perf_counter(), self._waited()
        while not self._ended.is_set():
            time.sleep(0.001)
            now, now_waited = time.perf_counter(), self._waited()
            self.longest = max(self.longest, (now - at) * 1e3)
            self.longest_own = max(self.longest_own, (now - at - (now_waited - waited)) * 1e3)
            at, waited = now, now_waited

    def _waited(self) -> float:
        return _waited_for_processor() + _waited_for_processor(self._worker)

    def __enter__(self) -> "Ticks":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()


def stalled(keyframes: int, folder: Path, dim: int = 512) -> dict[str, Ticks]:
    """How long callbacks wait while a map of about 89 kB a keyframe is saved, read, put in place and let go."""
    rng = np.random.default_rng(0)
    places = [place(rng, dim, 676) for _ in range(64)]
    database = KeyframeDatabase(dim, keyframes * 0.11)
    store, found = MapStore(folder / "map", "0" * 16), {}

    def drive() -> None:
        for i in range(keyframes):
            database.add(i * SECOND, "front", places[i % 64])

    turns = []
    for _ in range(3):  # only where memory was in use before does a block lie so
        drive()
        above = [np.ones(8000) for _ in range(50)]  # as arrays of a frame, which lie above the map in memory
        with Ticks() as ticks:
            database.clear()
        turns.append(ticks)
        with Ticks() as ticks:
            above.clear()
            time.sleep(0.01)
        turns.append(ticks)
    found["forgotten below a frame"] = max(turns, key=lambda ticks: ticks.longest_own)
    drive()
    with Ticks() as found["saved"]:
        store.save(database.snapshot())
    with Ticks() as found["read"]:
        manifest, prepared = store.read(database)
    with Ticks() as found["put in place"]:
        store.put(database, manifest, prepared)
    del prepared
    with Ticks() as found["forgotten"]:
        database.clear()
    return found


def stalls(args: argparse.Namespace) -> None:
    """The longest a thread waits that wants to run every millisecond, while a map is saved and loaded."""
    folder = Path(tempfile.mkdtemp(prefix="map-", dir=args.folder))
    try:
        found = stalled(args.keyframes, folder, args.dim)
        size = sum(file.stat().st_size for file in (folder / "map").iterdir()) / 1e6
    finally:
        shutil.rmtree(folder)
    for what, ticks in found.items():
        print(f"{size:.0f} MB {what}: {ticks.longest:.1f} ms, {ticks.longest_own:.1f} without the load of the machine")


def _report(what: str, took: NDArray) -> None:
    whole = 1e3 * took[:, 0]
    own = 1e3 * (took[:, 0] - took[:, 1])
    print(
        f"{what}: {len(took)} frames, query and add median {np.median(whole):.1f} ms, most {whole.max():.1f}; "
        f"without waiting for a processor median {np.median(own):.1f} ms, most {own.max():.1f}"
    )


def footprint(args: argparse.Namespace) -> None:
    """Bytes of a keyframe of the default model by precision, and MB per hour at the default least interval."""
    from pnv_core import Config, load_describer

    describer = load_describer()
    descriptor = describer.describe(np.random.default_rng(0).integers(0, 255, (480, 640, 3), np.uint8))
    for precision in ("float32", "float16", "int8"):
        size = KeyframeDatabase(describer.model.global_dim, patch_precision=precision).bytes_per_keyframe(descriptor)
        an_hour = size * 3600 / Config().min_interval_s / 1e6
        print(f"{precision}: {size / 1e3:.1f} KB a keyframe, at most {an_hour:.0f} MB per hour of driving")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("retrieval", "saving", "stalls", "footprint"))
    parser.add_argument("--rows", type=int, nargs="+", default=[100_000])
    parser.add_argument("--kind", nargs="+", choices=("random", "trajectory"), default=["random", "trajectory"])
    parser.add_argument("--index", nargs="+", default=["exact", "pq"])
    parser.add_argument("--dim", type=int, default=512, help="of the global vector; the default model's")
    parser.add_argument("--queries", type=int, default=200)
    parser.add_argument("--keyframes", type=int, default=10_000)
    parser.add_argument("--rate", type=float, default=20.0, help="frames per second")
    parser.add_argument("--folder", default="/var/tmp", help="where the map is saved")
    args = parser.parse_args()
    {"retrieval": retrieval, "saving": saving, "stalls": stalls, "footprint": footprint}[args.what](args)


if __name__ == "__main__":
    main()
