"""The fleet's memory, measured: python -m benchmarks.fleet robots | latency | scale | kills | cut

robots    two robots that share places against one that drives both their laps: precision and recall
latency   the node with a fleet and without, in turn
scale     insert rate, query latency, recall@10 against exact search, at so many keyframes (--sizes)
kills     robot and store killed at random moments (--kills): nothing acknowledged is lost, nothing is stored twice
cut       the store is away for a while (--seconds) in a walk: local closures and time of a frame as without a fleet,
          the outbox drained after
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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnv_core.config import Config
from pnv_core.types import ImageRef, PatchGrid, PlaceDescriptor, Query

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
        environment = os.environ | {"OMP_NUM_THREADS": "1"}  # a search is one short piece of work, not one to share out
        self.process = subprocess.Popen(command, stdout=self._out, stderr=self._out, env=environment)

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

    def cpu_s(self) -> float:
        """Processor time so far."""
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

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


def revisits(seen: Array, seed: int = 1) -> Array:
    """(n, D) of stored places seen again: cosine about 0.75 to where they were."""
    noise = np.random.default_rng(seed).standard_normal(seen.shape).astype(np.float32)
    seen = 0.75 * seen + 0.66 * noise / np.linalg.norm(noise, axis=1, keepdims=True)
    return seen / np.linalg.norm(seen, axis=1, keepdims=True)


def scale(sizes: list[int], queries: int, indexes: list[str]) -> None:
    """Inserts go on under the first of the indexes; the others are built over the same rows."""
    import faiss

    from pnv_core.decide.judge import AROUND
    from pnv_fleet.places import Place
    from pnv_fleet.store import Access, PlaceStore

    print("keyframes  index      inserts/s  index and first search  search p50     p95  server busy  recall@10  server"
          "  on disk/keyframe  load")  # fmt: skip
    model = "5" * 64
    with served() as server:
        store = PlaceStore(server.uri, model, Access(), _DIM, 1, timeout_s=3600.0)
        exact = faiss.IndexFlatIP(_DIM)
        keys: list[str] = []
        for size in sorted(sizes):
            _set_index(store, indexes[0])
            start, before = time.perf_counter(), len(keys)
            for number, run in enumerate(trajectories(size - len(keys), seed=len(keys))):
                robot = f"robot_{number % 10}"
                first = len(keys)
                places = [
                    Place(robot, 0, "camera", first + i, (first + i) * 10**9, 1.0, vector)
                    for i, vector in enumerate(run)
                ]
                store.put(places)
                exact.add(run)
                keys += [place.key for place in places]
            inserted = (size - before) / (time.perf_counter() - start)
            print(f"{len(keys)} inserted, {inserted:.0f} a second", file=sys.stderr)
            store._client.flush(store.collection, timeout=3600.0)
            chosen = np.random.default_rng(1).integers(0, len(keys), queries)
            asked = revisits(np.stack([exact.reconstruct(int(i)) for i in chosen]))
            truth = exact.search(asked, 10)[1]
            for index in indexes:
                _set_index(store, index)
                store.close()
                server.kill()  # what is measured has come from the disk
                begin = time.perf_counter()
                server.start()
                server.wait()
                store = PlaceStore(server.uri, model, Access(), timeout_s=3600.0)
                store.search(asked[0], 10)
                built = time.perf_counter() - begin
                where = 'robot != "another" or stamp_ns < 0'  # as a node asks; here it leaves out none
                times, right, busy = [], 0, server.cpu_s()
                for vector, best in zip(asked, truth, strict=True):
                    begin = time.perf_counter()
                    hits, _ = store.search(vector, AROUND, where)  # as many as a node asks for
                    times.append(time.perf_counter() - begin)
                    right += len({hit.place.key for hit in hits[:10]} & {keys[i] for i in best})
                ms, busy = 1e3 * np.array(times), 1e3 * (server.cpu_s() - busy) / queries
                disk = sum(f.stat().st_size for f in server.folder.rglob("*") if f.is_file())
                print(
                    f"{len(keys):>9}  {index:<9}  {inserted:>9.0f}  {built:>20.0f} s  {np.median(ms):>7.1f} ms"
                    f"  {np.percentile(ms, 95):>6.1f}  {busy:>8.1f} ms  {right / 10 / queries:>9.3f}"
                    f"  {server.rss_mb():>4.0f} MB  {disk / len(keys):>14.0f} B  {os.getloadavg()[0]:>4.1f}",
                    flush=True,
                )


def _set_index(store: Any, kind: str) -> None:
    client, name = store._client, store.collection
    if client.describe_index(name, "vector")["index_type"] == kind:
        return
    client.release_collection(name)
    client.drop_index(name, "vector")
    index = client.prepare_index_params()
    index.add_index("vector", index_type=kind, metric_type="COSINE")
    client.create_index(name, index)  # not loaded: built by the server's next start


def _like() -> PlaceDescriptor:
    return _seen(0)


def _seen(number: int) -> PlaceDescriptor:
    rng = np.random.default_rng(number)
    rows = rng.standard_normal((13, 32)).astype(np.float32)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    return PlaceDescriptor(rows[0], (PatchGrid(2, 3, 4, rows[1:]),), 0.5)


def robot(uri: str, folder: Path) -> None:
    """Keeps a keyframe every tenth of a second and prints its number once it is in the outbox; until it is killed."""
    fleet = _robot(uri, folder)
    number = int((folder / "next").read_text()) if (folder / "next").exists() else 0
    while True:
        query = Query(ImageRef(number, (number + 1) * 10**9, "camera"), _seen(number), 1.0)
        fleet._take(query, 0, None, time.monotonic())
        print(number, flush=True)
        number += 1
        time.sleep(0.1)


def _robot(uri: str, folder: Path) -> Any:
    from pnv_fleet.fleet import Fleet, Options

    config = Config.make(patch_sizes=(2,), patch_strides=(1,), patch_weights=(1.0,), verify=0, scorer="rapid")
    options = Options(uri, "robot", 200.0, folder / "outbox", 100.0, 0.0, 1.0, False)
    return Fleet(options, config, "7" * 64, _like(), None, lambda closures: None, lambda line: None)


def kills(count: int, longest_s: float) -> int:
    """0 where nothing was lost or doubled, and everything that waited was stored in the end."""
    from pnv_fleet.store import Access, PlaceStore

    rng = np.random.default_rng(0)
    kept: set[int] = set()
    killed = {"robot": 0, "store": 0}
    with served() as server:
        folder = server.folder.parent
        out = folder / "printed"
        child: subprocess.Popen | None = None
        for _ in range(count):
            if child is None:
                kept |= _printed(out)
                (folder / "next").write_text(str(max(kept, default=-1) + 2))  # the last line may have been cut
                command = [sys.executable, "-m", "benchmarks.fleet", "robot", server.uri, str(folder)]
                child = subprocess.Popen(command, stdout=open(out, "w"))  # noqa: SIM115
                end = time.monotonic() + _START_S
                while not _printed(out) and time.monotonic() < end:
                    time.sleep(0.02)
            time.sleep(float(rng.uniform(0.05, longest_s)))
            if rng.random() < 0.5:
                killed["store"] += 1
                server.kill()
                server.start()
            else:
                killed["robot"] += 1
                child.kill()
                child.wait()
                child = None
        if child is not None:
            child.kill()
            child.wait()
        kept |= _printed(out)
        server.wait()
        store = PlaceStore(server.uri, "7" * 64, Access(), timeout_s=60.0)
        last = _robot(server.uri, folder)
        waiting, before = len(last._outbox), store.count()
        end = time.monotonic() + 10 * _START_S
        while len(last._outbox) and time.monotonic() < end:
            time.sleep(0.1)
        left = {w.place.keyframe for w in last._outbox.oldest(10**6, 10**9)}
        last.close()
        stored = [place.keyframe for place in store.scan() if not isinstance(place, str)]
        lost, doubled = kept - left - set(stored), len(stored) - len(set(stored))
        print(f"{killed['robot']} kills of the robot, {killed['store']} of the store: {len(kept)} keyframes "
              f"acknowledged by the outbox; at the last kill {before} were in the store and {waiting} waited; drained: "
              f"{len(stored)} in the store, {len(left)} wait, lost {len(lost)}, doubled {doubled}")  # fmt: skip
        return int(bool(lost or left) or doubled > 0)


def _printed(out: Path) -> set[int]:
    lines = out.read_text().split("\n")[:-1] if out.exists() else []
    return {int(line) for line in lines if line.isdigit()}


def cut(seconds: float) -> int:
    """0 where the local closures with a store that comes late, and with none, are the same byte for byte."""
    from msg_adapters.loop_closures import closures_to_message
    from pnv_core import PlaceRecognizer, load_describer
    from pnv_fleet.fleet import Fleet, Options
    from pnv_lab.worlds import loop_sequence

    describer = load_describer("default")
    frames = list(loop_sequence(1, "corridor", laps=2.0, fps=2.0))
    with served() as server:
        like = describer.describe(frames[0].rgb)
        server.kill()
        options = Options(server.uri, "robot", 500.0, server.folder.parent / "outbox", 1000.0, 0.0, 1.0, False)
        model, calibration = describer.map_fingerprint, describer.model.info.calibration
        fleet = Fleet(options, describer.config, model, like, calibration, lambda c: None, print)
        start = time.monotonic()
        both = PlaceRecognizer(describer), PlaceRecognizer(describer)
        sent: tuple[list[bytes], list[bytes]] = ([], [])
        times: tuple[list[float], list[float]] = ([], [])
        for number, frame in enumerate(frames):
            for i in (0, 1) if number % 2 else (1, 0):  # interleaved: with a fleet, without
                begin = time.perf_counter()
                found = [c for c in both[i].process(frame) if c.accepted]
                if i == 0 and (query := both[0].latest) is not None:
                    fleet.offer(query, both[0].database.first().stamp_ns)  # type: ignore[union-attr]
                times[i].append(time.perf_counter() - begin)
                sent[i].append(np.array(closures_to_message(found, ("camera",)).data).tobytes())
            if number < len(frames) - 20:  # as many frames as there are, spread over the whole of the cut
                due = start + seconds * (number + 1) / (len(frames) - 20)
                time.sleep(max(0.0, due - time.monotonic()))
            elif server.process.poll() is not None:
                waiting = fleet.status().waiting
                print(f"the store is back after {time.monotonic() - start:.0f} s; {waiting} keyframes wait")
                server.start()
        begin, end = time.monotonic(), time.monotonic() + 300
        while fleet.status().waiting and time.monotonic() < end:
            time.sleep(0.1)
        status = fleet.status()
        fleet.close()
    same = sent[0] == sent[1]
    late = [1e3 * np.percentile(t[5:], 95) for t in times]
    print(f"local closures {'identical' if same else 'DIFFER'} ({sum(map(bool, sent[0]))} messages); outbox drained "
          f"{time.monotonic() - begin:.0f} s after the last frame, {status.waiting} wait, {status.sent} sent, "
          f"{status.dropped} dropped; p95 of a frame {late[0]:.1f} ms with, {late[1]:.1f} ms without")  # fmt: skip
    return int(not same or status.waiting > 0)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    actions = parser.add_subparsers(required=True, dest="action")
    sized = actions.add_parser("scale")
    sized.add_argument("--sizes", type=int, nargs="+", default=[10_000, 100_000])
    sized.add_argument("--queries", type=int, default=200)
    sized.add_argument(
        "--index", nargs="+", default=["AUTOINDEX"], help="as the server names them, one after the other"
    )
    killing = actions.add_parser("kills")
    killing.add_argument("--kills", type=int, default=100)
    killing.add_argument("--longest", type=float, default=6.0, help="seconds between two of them, at most")
    actions.add_parser("cut").add_argument("--seconds", type=float, default=600.0)
    pair = actions.add_parser("robots")
    pair.add_argument("names", nargs="*")
    pair.add_argument("--shared", type=Path, default=Path("../shared"))
    taking = actions.add_parser("latency")
    taking.add_argument("--blocks", type=int, default=6, help="of 20 images, for each of both")
    taking.add_argument("--rate", type=float, default=2.0, help="images per second")
    taking.add_argument("--images", type=Path)
    child = actions.add_parser("robot")
    child.add_argument("uri")
    child.add_argument("folder", type=Path)
    args = parser.parse_args()
    os.nice(5)
    if args.action == "kills":
        return kills(args.kills, args.longest)
    if args.action == "cut":
        return cut(args.seconds)
    if args.action == "latency":
        from benchmarks.fleet_latency import latency

        return latency(args.blocks, args.rate, args.images)
    if args.action == "robots":
        from benchmarks.fleet_robots import SETS, robots

        return robots(args.names or list(SETS), args.shared)
    if args.action == "robot":
        robot(args.uri, args.folder)
    elif args.action == "scale":
        scale(args.sizes, args.queries, args.index)
    return 0


if __name__ == "__main__":
    sys.exit(main())
