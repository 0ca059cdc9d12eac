"""The fleet's memory, measured: python -m benchmarks.fleet scale | kills | cut | latency | views

scale     insert rate, query latency, recall@10 against exact search, at so many keyframes (--sizes)
kills     node and store killed at random moments (--kills): nothing acknowledged is lost, nothing is stored twice
cut       the store is away for a while (--seconds): local closures as without a fleet, the outbox drained after
latency   time of a frame with and without a fleet, interleaved
views     what the parts of a keyframe take, and what search costs beside them
"""

import argparse
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
_DIM = 512  # of the default model's global vector
_RUN = 500  # keyframes of one trajectory
_START_S = 60.0


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Server:
    """Milvus Lite's own server over a folder, in a process that can be killed and started again."""

    def __init__(self, folder: Path, port: int | None = None, quiet: bool = True) -> None:
        self.folder, self.port = folder, port or free_port()
        self._out = subprocess.DEVNULL if quiet else None
        self.start()

    @property
    def uri(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def start(self) -> None:
        # one worker: Milvus Lite's collections have one writer
        command = [sys.executable, "-m", "milvus_lite", "server", "--data-dir", str(self.folder)]
        command += ["--host", "127.0.0.1", "--port", str(self.port), "--max-workers", "1"]
        self.process = subprocess.Popen(command, stdout=self._out, stderr=self._out)

    def wait(self) -> None:
        """Until it listens."""
        end = time.monotonic() + _START_S
        while time.monotonic() < end:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", self.port)) == 0:
                    return
            if self.process.poll() is not None:
                raise RuntimeError(f"the server ended with {self.process.returncode}")
            time.sleep(0.05)
        raise RuntimeError("the server does not listen")

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    def rss_mb(self) -> float:
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return int(status.split("VmRSS:")[1].split()[0]) / 1e3


@contextmanager
def served(quiet: bool = True) -> Iterator[Server]:
    folder = Path(tempfile.mkdtemp(prefix="pnv_fleet_", dir="/var/tmp"))
    server = Server(folder / "places.db", quiet=quiet)
    try:
        server.wait()
        yield server
    finally:
        server.kill()
        shutil.rmtree(folder, ignore_errors=True)


def trajectories(count: int, seed: int = 0) -> Iterator[Array]:
    """(n, D) unit vectors of one run after the other: neighbours have cosines of about 0.9, as keyframes do."""
    rng = np.random.default_rng(seed)
    while count > 0:
        steps = rng.standard_normal((min(_RUN, count), _DIM)).astype(np.float32)
        run = np.empty_like(steps)
        at = steps[0] / np.linalg.norm(steps[0])
        for i, step in enumerate(steps):
            at = 0.9 * at + 0.43 * step / np.linalg.norm(step)
            at /= np.linalg.norm(at)
            run[i] = at
        yield run
        count -= len(run)


def revisits(vectors: Array, count: int, seed: int = 1) -> Array:
    """(count, D): stored places seen again, cosine about 0.75 to where they were."""
    rng = np.random.default_rng(seed)
    seen = vectors[rng.integers(0, len(vectors), count)]
    noise = rng.standard_normal(seen.shape).astype(np.float32)
    seen = 0.75 * seen + 0.66 * noise / np.linalg.norm(noise, axis=1, keepdims=True)
    return seen / np.linalg.norm(seen, axis=1, keepdims=True)


def scale(sizes: list[int], queries: int) -> None:
    import faiss

    from pnv_fleet.places import Place
    from pnv_fleet.store import Access, PlaceStore

    print("keyframes  insert/s  index and first query  query p50    p95  recall@10  server  on disk/keyframe")
    with served() as server:
        store = PlaceStore(server.uri, "5" * 64, Access(), _DIM, 1, timeout_s=3600.0)
        exact = faiss.IndexFlatIP(_DIM)
        keys: list[str] = []
        vectors: list[Array] = []
        for size in sorted(sizes):
            start, before = time.perf_counter(), len(keys)
            for number, run in enumerate(trajectories(size - len(keys), seed=len(keys))):
                robot = f"robot_{number % 10}"
                first = len(keys)
                places = [
                    Place(robot, 0, "camera", first + i, (first + i) * 10**9, 1.0, vector)
                    for i, vector in enumerate(run)
                ]
                for at in range(0, len(places), 100):
                    store.put(places[at : at + 100])
                exact.add(run)
                vectors.append(run)
                keys += [place.key for place in places]
            inserted = time.perf_counter() - start
            store._client.flush(store.collection, timeout=3600.0)
            store.close()
            server.kill()  # Milvus Lite builds the index of what is on disk when it loads it, not before
            begin = time.perf_counter()
            server.start()
            server.wait()
            store = PlaceStore(server.uri, "5" * 64, Access(), timeout_s=3600.0)
            store.search(vectors[0][0], 10)
            built = time.perf_counter() - begin
            asked = revisits(np.concatenate(vectors), queries)
            times, right = [], 0
            truth = exact.search(asked, 10)[1]
            for vector, best in zip(asked, truth, strict=True):
                begin = time.perf_counter()
                hits, _ = store.search(vector, 10)
                times.append(time.perf_counter() - begin)
                right += len({hit.place.key for hit in hits} & {keys[i] for i in best})
            ms = 1e3 * np.array(times)
            disk = sum(f.stat().st_size for f in server.folder.rglob("*") if f.is_file())
            print(
                f"{len(keys):>9}  {(size - before) / inserted:>8.0f}  {built:>18.0f} s  {np.median(ms):>6.1f} ms"
                f"  {np.percentile(ms, 95):>5.1f}  {right / 10 / queries:>9.3f}  {server.rss_mb():>4.0f} MB"
                f"  {disk / len(keys):>6.0f} B",
                flush=True,
            )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    actions = parser.add_subparsers(required=True, dest="action")
    sized = actions.add_parser("scale")
    sized.add_argument("--sizes", type=int, nargs="+", default=[10_000, 100_000])
    sized.add_argument("--queries", type=int, default=200)
    args = parser.parse_args()
    os.nice(5)
    if args.action == "scale":
        scale(args.sizes, args.queries)
    return 0


if __name__ == "__main__":
    sys.exit(main())
