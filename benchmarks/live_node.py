"""The node live: a 30 Hz camera in a process of its own, a map of 1,000 keyframes, every frame a query.

python -m benchmarks.live_node [--short] [--seconds S] [--runs N] [--images DIR] [--only WORDS] [NAME=VALUE ...]

First the start: from the start of the process to the second processed frame, while a camera is already sending, without
any cache (compiled network, Python's bytecode) and with them, and the resident memory then. After that a table over
middleware (config/fastdds_shared_memory.xml, or Fast DDS as it comes), raw images and JPEG, 640x480 and 1280x720;
medians of the runs. The camera stamps each image as it publishes it; latency is the time from that stamp to the arrival
of the closure in the measuring process, which shares the processor with camera and node. Growth is the difference
between the medians of the last and the first third. --only takes the rows whose name has the words, "start" among them.
NAME=VALUE are parameters of the node. Without images the pictures are noise that drifts.
"""

import argparse
import itertools
import json
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from numpy.typing import NDArray
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Float64MultiArray

from benchmarks.run import machine
from msg_adapters.loop_closures import closures_from_message
from pnv_core import PlaceRecognizer, load_describer
from pnv_core.files import atomic_write
from pnv_core.images import list_images, read_image
from pnv_core.maps import MapStore
from pnv_ros.outputs import CLOSURES_QOS
from test.ros.processes import Listener, Process, executable, own_domain, ros_arguments, wait_until

SIZES = ((640, 480), (1280, 720))
TOPIC = "camera/image_raw"
PROFILE = str(Path("config/fastdds_shared_memory.xml").resolve())
EVERY_FRAME: dict[str, Any] = {
    "min_interval_s": 0.0, "min_change": 0.0, "min_texture": 0.0, "accept_score": 0.0, "consistency": 0
}  # fmt: skip
_PICTURES = 40  # different ones
_QUALITY = 90


@dataclass(frozen=True)
class Setup:
    """How images come."""

    width: int
    height: int
    jpeg: bool
    profile: bool

    @property
    def name(self) -> str:
        kind = "JPEG" if self.jpeg else "raw"
        return f"{self.width}x{self.height} {kind}, {'with profile' if self.profile else 'as it comes'}"

    @property
    def topic(self) -> str:
        return f"{TOPIC}/compressed" if self.jpeg else TOPIC

    @property
    def environment(self) -> dict[str, str]:
        return {"FASTRTPS_DEFAULT_PROFILES_FILE": PROFILE} if self.profile else {}


SETUPS = [Setup(*size, jpeg, profile) for size, jpeg, profile in itertools.product(SIZES, (False, True), (True, False))]


def pictures(folder: Path | None, width: int, height: int) -> list[NDArray[np.uint8]]:
    """RGB images: those of a folder, or drifting noise of several scales."""
    if folder is not None:
        paths = list_images(folder)
        paths = paths[:: max(1, len(paths) // _PICTURES)][:_PICTURES]
        return [cv2.resize(read_image(p), (width, height)) for p in paths]
    rng = np.random.default_rng(0)
    scales = [rng.integers(0, 256, (height // s, 2 * width // s, 3), np.uint8) for s in (4, 16, 60)]
    wide = np.mean([cv2.resize(s, (2 * width, height), interpolation=cv2.INTER_CUBIC) for s in scales], axis=0)
    step = width // _PICTURES
    return [np.ascontiguousarray(wide[:, i * step : i * step + width]).astype(np.uint8) for i in range(_PICTURES)]


def publish(folder: Path | None, setup: Setup, rate: float, seconds: float) -> None:
    """The camera: stamps are the wall clock's when the image is published."""
    rclpy.init()
    node = rclpy.create_node("camera_driver")
    qos = QoSProfile(depth=2, reliability=QoSReliabilityPolicy.BEST_EFFORT)
    publisher = node.create_publisher(CompressedImage if setup.jpeg else Image, setup.topic, qos)
    messages = []
    for rgb in pictures(folder, setup.width, setup.height):
        if setup.jpeg:
            message = CompressedImage(format="jpeg")
            jpeg = cv2.imencode(".jpg", rgb[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]
            message.data.frombytes(jpeg.tobytes())
        else:
            message = Image(encoding="rgb8", height=setup.height, width=setup.width, step=3 * setup.width)
            message.data.frombytes(rgb.tobytes())
        messages.append(message)
    print("ready", flush=True)
    start = time.monotonic()
    for number in range(int(rate * seconds)):
        time.sleep(max(0.0, start + number / rate - time.monotonic()))
        message = messages[number % len(messages)]
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(time.time_ns(), 10**9)
        publisher.publish(message)


def fill_map(path: Path, keyframes: int, images: list[NDArray[np.uint8]]) -> None:
    """A saved map of so many keyframes: the pictures' descriptors, their global vectors slightly turned."""
    recognizer = PlaceRecognizer(load_describer())
    keep = recognizer.judge.verifier.keep
    known = [replace(recognizer.describer.describe(rgb), thumbnail=keep(rgb, "0")) for rgb in images]
    rng = np.random.default_rng(1)
    for number in range(keyframes):
        descriptor = known[number % len(known)]
        vector = descriptor.global_vector + rng.normal(0, 0.01, len(descriptor.global_vector)).astype(np.float32)
        turned = replace(descriptor, global_vector=(vector / np.linalg.norm(vector)).astype(np.float32))
        recognizer.database.add(10**9 * number, "0", turned)
    MapStore(path, recognizer.describer.map_fingerprint).save(recognizer.database.snapshot())


@contextmanager
def camera(setup: Setup, args: argparse.Namespace, seconds: float) -> Iterator[Process]:
    """The camera's process, once its pictures are made."""
    command = [sys.executable, "-m", "benchmarks.live_node", "--publish", json.dumps(vars(setup))]
    command += ["--rate", str(args.rate), "--seconds", str(seconds)]
    driver = Process(*command, *(["--images", str(args.images)] if args.images else []), environment=setup.environment)
    try:
        driver.wait_for("ready")
        yield driver
    finally:
        driver.child.kill()
        driver.child.wait()


@contextmanager
def node(setup: Setup, environment: dict[str, str], **parameters: Any) -> Iterator[Process]:
    """The installed node, from the moment its process begins."""
    given = ros_arguments(**(EVERY_FRAME | {"image_topics": [setup.topic]} | parameters))
    process = Process(executable(), *given, environment=setup.environment | environment)
    try:
        yield process
    finally:
        process.child.kill()
        process.child.wait()


class Latencies:
    """Milliseconds from image stamps to the arrival of their closures."""

    def __init__(self, listener: Listener) -> None:
        self.ms: list[float] = []
        listener.node.create_subscription(Float64MultiArray, "loop_closures", self._arrived, CLOSURES_QOS)

    def _arrived(self, message: Float64MultiArray) -> None:
        now = time.time_ns()
        self.ms.append((now - closures_from_message(message)[0].query.stamp_ns) / 1e6)


def start(args: argparse.Namespace, caches: Path) -> tuple[float, float]:
    """Seconds from the start of the process to its second processed frame, and megabytes resident then."""
    setup = SETUPS[0]
    environment = {"XDG_CACHE_HOME": str(caches / "cache"), "PYTHONPYCACHEPREFIX": str(caches / "bytecode")}
    environment["PYTHONDONTWRITEBYTECODE"] = ""  # or there is nothing to be warm from
    listener = Listener()
    closures = Latencies(listener)
    with camera(setup, args, 120), node(setup, environment, exclude_recent_s=0.0, **args.parameters) as process:
        wait_until(lambda: closures.ms or process.child.poll() is not None, 90, "the first closure")
        seconds = time.monotonic() - process.started
        memory = process.memory_mb()
    listener.close()
    return seconds, memory


def run(setup: Setup, args: argparse.Namespace, map_path: Path) -> dict[str, Any]:
    """One run over a loaded map."""
    listener = Listener()
    closures = Latencies(listener)
    diagnostics = listener.collect(DiagnosticArray, "/diagnostics")
    known = {"map_path": str(map_path), "load_on_start": True, "localization": True}
    with node(setup, {}, **(known | args.parameters)) as process:
        process.wait_for("publishes")
        with camera(setup, args, args.seconds + 30):
            wait_until(lambda: closures.ms or process.child.poll() is not None, 60, "the first closure")
            time.sleep(1.0)
            first, begun, before = len(closures.ms), time.monotonic(), process.cpu_s()
            time.sleep(args.seconds)
            latency = np.array(closures.ms[first:] or [np.nan])
            seconds, cpu = time.monotonic() - begun, process.cpu_s() - before
            memory = process.memory_mb()
    stages = [{v.key: v.value for v in status.values} for d in diagnostics[-1:] for status in d.status]
    listener.close()
    third = max(1, len(latency) // 3)
    return {
        "frames/s": np.isfinite(latency).sum() / seconds,
        "p50 ms": float(np.percentile(latency, 50)),
        "p95 ms": float(np.percentile(latency, 95)),
        "growth ms": float(np.median(latency[-third:]) - np.median(latency[:third])),
        "node's cores": cpu / seconds,
        "cpu ms/frame": 1e3 * cpu / max(len(latency), 1),
        "MB": memory,
        "stages": stages,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--short", action="store_true", help="one run of 8 seconds per row")
    parser.add_argument("--keyframes", type=int, default=1000)
    parser.add_argument("--rate", type=float, default=30.0)
    parser.add_argument("--images", type=Path)
    parser.add_argument("--only", default="", metavar="WORDS")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--publish", help=argparse.SUPPRESS)
    parser.add_argument("parameters", nargs="*", metavar="NAME=VALUE")
    args = parser.parse_args()
    if args.publish:
        publish(args.images, Setup(**json.loads(args.publish)), args.rate, args.seconds)
        return 0
    if args.short:
        args.seconds, args.runs = min(args.seconds, 8.0), 1
    args.parameters = {name: yaml.safe_load(value) for name, value in (i.split("=", 1) for i in args.parameters)}
    report: dict[str, Any] = {"machine": machine(), "parameters": args.parameters, "rate": args.rate, "rows": {}}
    with tempfile.TemporaryDirectory() as scratch, own_domain():
        if args.only in "start":
            for number in range(args.runs):
                caches = Path(scratch) / f"caches{number}"
                for kind in ("cold", "warm"):
                    seconds, memory = start(args, caches)
                    report.setdefault(f"start {kind}", []).append({"s": seconds, "MB": memory})
            for kind in ("cold", "warm"):
                s, mb = (np.median([r[key] for r in report[f"start {kind}"]]) for key in ("s", "MB"))
                print(f"start to second processed frame, {kind}: {s:.2f} s, {mb:.0f} MB", flush=True)
        wanted = [setup for setup in SETUPS if args.only in setup.name]
        if wanted:
            fill_map(Path(scratch) / "map", args.keyframes, pictures(args.images, *SIZES[0]))
            columns = ("frames/s", "p50 ms", "p95 ms", "growth ms", "node's cores", "cpu ms/frame", "MB")
            print("| images, middleware | " + " | ".join(columns) + " |\n|---|" + "---:|" * len(columns))
        for setup in wanted:
            runs = [run(setup, args, Path(scratch) / "map") for _ in range(args.runs)]
            report["rows"][setup.name] = runs
            figures = (f"{np.median([r[column] for r in runs]):.1f}" for column in columns)
            print(f"| {setup.name} | " + " | ".join(figures) + " |", flush=True)
    if args.out:
        with atomic_write(args.out) as file:
            file.write((json.dumps(report, indent=1) + "\n").encode())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
