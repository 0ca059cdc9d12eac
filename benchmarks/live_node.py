"""The node live: a 30 Hz camera in a process of its own, a database of 1,000 keyframes, every frame a keyframe.

python -m benchmarks.live_node [--seconds S] [--keyframes N] [--rate HZ] [--images DIR] [--out FILE] [NAME=VALUE ...]

The camera stamps each image as it publishes it; latency is the time from that stamp to the arrival of the closure in
the measuring process, which shares the processor with camera and node. NAME=VALUE are parameters of the node. Without
images the pictures are rendered noise that drifts. Camera and node use the shared memory profile in config/ (Fast DDS's
default segment is smaller than an image of 640x480), unless told otherwise. Growth of latency is the difference between
the medians of the last and the first third.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from numpy.typing import NDArray
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import Image
from std_msgs.msg import Float64MultiArray

from benchmarks.run import machine
from msg_adapters.loop_closures import closures_from_message
from pnv_core import load_describer
from pnv_core.database import KeyframeDatabase
from pnv_core.files import atomic_write
from pnv_core.images import read_image
from pnv_core.maps import MapStore
from pnv_core.verify.local_features import thumbnail
from pnv_ros.outputs import CLOSURES_QOS
from test.ros.processes import Listener, own_domain, running_node, wait_until

WIDTH, HEIGHT = 640, 480
TOPIC = "camera/image_raw"
_PICTURES = 40  # different ones


def pictures(folder: Path | None) -> list[NDArray[np.uint8]]:
    """RGB images of 640x480: those of a folder, or drifting noise of several scales."""
    if folder is not None:
        paths = sorted(p for p in folder.iterdir() if p.suffix.lower() in (".jpg", ".jpeg", ".png"))
        paths = paths[:: max(1, len(paths) // _PICTURES)][:_PICTURES]
        return [cv2.resize(read_image(p), (WIDTH, HEIGHT)) for p in paths]
    rng = np.random.default_rng(0)
    scales = [rng.integers(0, 256, (HEIGHT // s, 2 * WIDTH // s, 3), np.uint8) for s in (4, 16, 60)]
    wide = np.mean([cv2.resize(s, (2 * WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC) for s in scales], axis=0)
    step = WIDTH // _PICTURES
    return [np.ascontiguousarray(wide[:, i * step : i * step + WIDTH]).astype(np.uint8) for i in range(_PICTURES)]


def publish(folder: Path | None, rate: float, seconds: float) -> None:
    """The camera: stamps are the wall clock's when the image is published."""
    rclpy.init()
    node = rclpy.create_node("camera_driver")
    publisher = node.create_publisher(Image, TOPIC, QoSProfile(depth=2, reliability=QoSReliabilityPolicy.BEST_EFFORT))
    messages = []
    for rgb in pictures(folder):
        message = Image(encoding="rgb8", height=HEIGHT, width=WIDTH, step=3 * WIDTH)
        message.data.frombytes(rgb.tobytes())
        messages.append(message)
    while not publisher.get_subscription_count():
        time.sleep(0.02)
    start = time.monotonic()
    for number in range(int(rate * seconds)):
        time.sleep(max(0.0, start + number / rate - time.monotonic()))
        message = messages[number % len(messages)]
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(time.time_ns(), 10**9)
        publisher.publish(message)
    time.sleep(1.0)


def fill_map(path: Path, keyframes: int, images: list[NDArray[np.uint8]]) -> None:
    """A saved map of so many keyframes: the pictures' descriptors, their global vectors slightly turned."""
    describer = load_describer()
    database = KeyframeDatabase.for_describer(describer)
    known = [replace(describer.describe(rgb), thumbnail=thumbnail(rgb)) for rgb in images]
    rng = np.random.default_rng(1)
    for number in range(keyframes):
        descriptor = known[number % len(known)]
        vector = descriptor.global_vector + rng.normal(0, 0.01, len(descriptor.global_vector)).astype(np.float32)
        turned = replace(descriptor, global_vector=(vector / np.linalg.norm(vector)).astype(np.float32))
        database.add(10**9 * number, "0", turned)
    MapStore(path, describer.map_fingerprint).save(database.snapshot())


def summary(latency_ms: NDArray[np.float64], processed: int, seconds: float) -> dict[str, Any]:
    third = max(1, len(latency_ms) // 3)
    return {
        "processed_per_s": round(processed / seconds, 2),
        "latency_ms": {f"p{p}": round(float(np.percentile(latency_ms, p)), 1) for p in (50, 95, 99)},
        "growth_ms": round(float(np.median(latency_ms[-third:]) - np.median(latency_ms[:third])), 1),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--keyframes", type=int, default=1000)
    parser.add_argument("--rate", type=float, default=30.0)
    parser.add_argument("--images", type=Path)
    parser.add_argument("--out", type=Path)
    parser.add_argument(
        "--default-transport",
        action="store_true",
        help="Fast DDS as it comes, without config/fastdds_shared_memory.xml",
    )
    parser.add_argument("--publish", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("parameters", nargs="*", metavar="NAME=VALUE")
    args = parser.parse_args()
    if args.publish:
        publish(args.images, args.rate, args.seconds)
        return 0
    parameters = {name: yaml.safe_load(value) for name, value in (item.split("=", 1) for item in args.parameters)}
    if not args.default_transport:
        os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(Path("config/fastdds_shared_memory.xml").resolve())
    folder = ["--images", str(args.images)] if args.images else []
    camera = [sys.executable, "-m", "benchmarks.live_node", "--publish", *folder]
    camera += ["--rate", str(args.rate), "--seconds", str(args.seconds)]
    with tempfile.TemporaryDirectory() as scratch, own_domain():
        fill_map(Path(scratch) / "map", args.keyframes, pictures(args.images))
        listener = Listener()
        taken: list[float] = []

        def arrived(message: Float64MultiArray) -> None:
            now = time.time_ns()
            taken.append((now - closures_from_message(message)[0].query.stamp_ns) / 1e6)

        listener.node.create_subscription(Float64MultiArray, "loop_closures", arrived, CLOSURES_QOS)
        diagnostics = listener.collect(DiagnosticArray, "/diagnostics")
        every_frame = {"min_interval_s": 0.0, "min_change": 0.0, "accept_score": 0.0, "consistency": 0}
        known = {"map_path": str(Path(scratch) / "map"), "load_on_start": True, "read_only": True, "min_texture": 0.0}
        with running_node(**(every_frame | known | parameters)) as node:
            driver = subprocess.Popen(camera)
            wait_until(lambda: taken or node.child.poll() is not None, 60, "the first closure")
            start, first, cpu = time.monotonic(), len(taken), node.cpu_s()
            driver.wait(args.seconds + 60)
            seconds = time.monotonic() - start - 1.0  # the camera lingers for a second
            cpu = node.cpu_s() - cpu
        stages = [{v.key: v.value for v in status.values} for d in diagnostics[-1:] for status in d.status]
        listener.close()
    report = summary(np.array(taken[first:]), len(taken) - first, seconds)
    report |= {"offered_per_s": args.rate, "keyframes": args.keyframes, "node_cores": round(cpu / seconds, 2)}
    report |= {
        "default_transport": args.default_transport,
        "parameters": parameters,
        "machine": machine(),
        "diagnostics": stages,
    }
    print(json.dumps(report, indent=1))
    if args.out:
        with atomic_write(args.out) as file:
            file.write((json.dumps(report, indent=1) + "\n").encode())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
