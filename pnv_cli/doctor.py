"""pnv doctor [--json]: checks what the recogniser and the node need, and says what to do where something is amiss."""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from pnv_core.config import Config
from pnv_core.errors import PnvError

OK, NOTE, FAULT = "ok", "note", "FAULT"
_ROS_WHEELS = "pip install 'pnv_ros[ros]'"
_LEAST_SHM_MB = 64.0  # what Docker gives by default; a few 1280x960 images fill it
_LEAST_UDP_BYTES = 2_000_000  # one 1280x720 colour image is 2.8 MB; below, fragments of large images are lost
_TIMEOUT_S = 60
_PRECISIONS = {"FP32": "float32", "BF16": "bfloat16", "INT8": "int8"}  # by the library's names

# Runs in a process of its own: a broken middleware may hang or crash, and the command line stays free of ROS.
_MIDDLEWARE_PROBE = """
import json, time
import rclpy
from rclpy.qos import QoSProfile
from rclpy.utilities import get_rmw_implementation_identifier
from sensor_msgs.msg import Image
rclpy.init()
node = rclpy.create_node("pnv_doctor")
got = []
topic = f"pnv_doctor_{time.time_ns()}"
node.create_subscription(Image, topic, got.append, QoSProfile(depth=5))
publisher = node.create_publisher(Image, topic, QoSProfile(depth=5))
image = Image(height=480, width=640, encoding="rgb8", step=1920, data=bytes(480 * 1920))
start = time.monotonic()
while not got and time.monotonic() - start < 15:
    publisher.publish(image)
    rclpy.spin_once(node, timeout_sec=0.2)
print(json.dumps({"rclpy": rclpy.__file__, "rmw": get_rmw_implementation_identifier(), "got": len(got)}))
node.destroy_node()
rclpy.shutdown()
"""


@dataclass(frozen=True)
class Finding:
    """The outcome of a check. `advice` says what to do; empty where nothing is to be done."""

    check: str
    state: str  # OK, NOTE or FAULT
    words: str
    advice: str = ""


def add_parser(subparsers: Any) -> None:
    parser = subparsers.add_parser("doctor", help="check this machine and say what to do", allow_abbrev=False)
    parser.add_argument("--json", action="store_true", help="one JSON object per line instead of text")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """0 if nothing is at fault, 1 otherwise."""
    findings = []
    for check in CHECKS:
        finding = _guarded(check)
        findings.append(finding)
        if args.json:
            print(json.dumps(asdict(finding)), flush=True)
            continue
        print(f"{finding.state:<6}{finding.check:<15}{finding.words}", flush=True)
        if finding.advice:
            print(f"{'':21}-> {finding.advice}", flush=True)
    faults = sum(f.state == FAULT for f in findings)
    if not args.json:
        print(f"\n{faults} faults" if faults else "\neverything needed is there")
    return 1 if faults else 0


def _guarded(check: Callable[[], Finding]) -> Finding:
    try:
        return check()
    except Exception as error:
        return Finding(check.__name__.lstrip("_"), FAULT, f"the check itself failed: {type(error).__name__}: {error}")


def _python() -> Finding:
    version = ".".join(map(str, sys.version_info[:3]))
    if sys.version_info < (3, 11):
        return Finding("python", FAULT, version, "install Python 3.11 or newer")
    words = f"{version} in {sys.prefix}"
    return Finding("python", OK, words)


def _torch() -> Finding:
    try:
        import torch
    except (ImportError, OSError) as error:
        return Finding("torch", FAULT, str(error), "pip install torch, or make install in the checkout")
    result = torch.nn.functional.conv2d(torch.ones(1, 1, 8, 8), torch.ones(1, 1, 3, 3))
    if float(result[0, 0, 0, 0]) != 9.0:
        return Finding("torch", FAULT, f"{torch.__version__} computes a convolution wrongly", "reinstall torch")
    gpu = torch.cuda.get_device_name(0) if torch.cuda.is_available() else "no CUDA device, the CPU is used"
    return Finding("torch", OK, f"{torch.__version__}, {torch.get_num_threads()} threads, {gpu}")


def _openvino() -> Finding:
    try:
        from pnv_core.describe.describer import precision_of, read_model
        from pnv_core.describe.download import resolve_weights
        from pnv_core.networks.openvino_backend import fast_precisions, release
    except (ImportError, OSError) as error:
        advice = "pip install openvino, or set backend: torch"
        return Finding("openvino", FAULT, str(error), advice)
    fast = [_PRECISIONS[name] for name in fast_precisions() if name in _PRECISIONS]
    used = precision_of(Config(), read_model(resolve_weights("default")))
    return Finding("openvino", OK, f"{release()}; fast here: {', '.join(fast)}; the network computes in {used}")


def _opencv() -> Finding:
    try:
        import cv2
    except (ImportError, OSError) as error:
        return Finding("opencv", FAULT, str(error), "pip install opencv-python-headless (needs no libGL)")
    square = np.array([[0, 0], [9, 0], [9, 9], [0, 9], [4, 4]], np.float32)
    _, mask = cv2.findHomography(square, square + 2, cv2.RANSAC, 1.0)
    if mask is None or int(mask.sum()) != len(square):
        return Finding("opencv", FAULT, f"{cv2.__version__} finds no homography", "reinstall opencv-python-headless")
    both = {"opencv-python", "opencv-python-headless", "opencv-contrib-python"} & _installed()
    if len(both) > 1:
        advice = f"keep one of them: pip uninstall {' '.join(sorted(both))}, then install opencv-python-headless"
        return Finding("opencv", NOTE, f"{cv2.__version__}, but {' and '.join(sorted(both))} share its files", advice)
    return Finding("opencv", OK, cv2.__version__)


def _faiss() -> Finding:
    try:
        import faiss
    except (ImportError, OSError) as error:
        return Finding("faiss", FAULT, str(error), "pip install faiss-cpu")
    index = faiss.IndexFlatIP(8)
    index.add(np.eye(8, dtype=np.float32))
    _, found = index.search(np.eye(8, dtype=np.float32)[3:4], 1)
    state = OK if found[0, 0] == 3 else FAULT
    return Finding("faiss", state, faiss.__version__, "" if state == OK else "reinstall faiss-cpu")


def _model() -> Finding:
    from pnv_core.describe.describer import load_describer
    from pnv_core.describe.download import PUBLISHED

    try:
        describer = load_describer()
        noise = np.random.default_rng(0).integers(0, 255, (240, 320, 3), dtype=np.uint8)
        vector = describer.describe(noise).global_vector
    except PnvError as error:
        return Finding("model", FAULT, str(error), "reinstall the package: its model file is missing or damaged")
    if abs(float(vector @ vector) - 1.0) > 1e-3:
        return Finding("model", FAULT, "the shipped model gives no unit vector", "reinstall the package")
    present = [name for name, published in PUBLISHED.items() if published.path.is_file()]
    others = f"; published ones here: {', '.join(present)}" if present else "; no published one here (optional)"
    done = describer.config
    return Finding("model", OK, f"shipped model, {done.image_width}x{done.image_height}, D={len(vector)}{others}")


def _ros() -> Finding:
    packages = {name: version for name, version in _versions().items() if name.startswith("ros-jazzy-")}
    command = [sys.executable, "-c", "import rclpy, sensor_msgs.msg, std_msgs.msg; print(rclpy.__file__)"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return Finding("ros", FAULT, f"import rclpy did not return within {_TIMEOUT_S} s", f"reinstall: {_ROS_WHEELS}")
    distribution = os.environ.get("ROS_DISTRO", "")
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["rclpy cannot be imported"])[-1]
        advice = f"{_ROS_WHEELS}, or source /opt/ros/jazzy/setup.bash (the node needs it; the command line does not)"
        return Finding("ros", FAULT, last, advice)
    place = done.stdout.strip()
    if distribution not in ("", "jazzy"):
        return Finding("ros", NOTE, f"ROS_DISTRO is {distribution}", "this package is tested with jazzy")
    if packages and "/opt/ros" in os.environ.get("AMENT_PREFIX_PATH", ""):
        advice = "use either the wheels or the sourced installation: pip uninstall ros-jazzy-rclpy"
        return Finding("ros", NOTE, "wheels and a sourced /opt/ros at once", advice)
    kind = ", ".join(f"{n} {v}" for n, v in sorted(packages.items())) or "system installation"
    return Finding("ros", OK, f"{kind} ({place})")


def _middleware() -> Finding:
    try:
        done = subprocess.run(
            [sys.executable, "-c", _MIDDLEWARE_PROBE], capture_output=True, text=True, timeout=_TIMEOUT_S
        )
    except subprocess.TimeoutExpired:
        return Finding("middleware", FAULT, "publishing an image hangs", "try RMW_IMPLEMENTATION=rmw_fastrtps_cpp")
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["failed"])[-1]
        chosen = os.environ.get("RMW_IMPLEMENTATION")
        advice = f"RMW_IMPLEMENTATION={chosen} may not be installed" if chosen else "see the line above about ros"
        return Finding("middleware", FAULT, last, advice)
    report = json.loads(done.stdout.strip().splitlines()[-1])
    domain = os.environ.get("ROS_DOMAIN_ID", "0")
    if not report["got"]:
        advice = "check the firewall and ROS_LOCALHOST_ONLY / ROS_AUTOMATIC_DISCOVERY_RANGE; free /dev/shm"
        return Finding("middleware", FAULT, f"{report['rmw']}: an image published here never arrives here", advice)
    return Finding("middleware", OK, f"{report['rmw']}, domain {domain}: a 640x480 image went through")


def _shared_memory() -> Finding:
    """Fast DDS hands images between processes in /dev/shm."""
    folder = Path("/dev/shm")
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        return Finding("shared memory", NOTE, "/dev/shm is absent or not writable", "images go over UDP; mount a tmpfs")
    usage = shutil.disk_usage(folder)
    words = f"{usage.free / 1e6:.0f} of {usage.total / 1e6:.0f} MB free in /dev/shm"
    if usage.free / 1e6 < _LEAST_SHM_MB:
        return Finding(
            "shared memory", FAULT, words, "in Docker: --shm-size=512m; else remove stale /dev/shm/fastrtps_*"
        )
    if usage.total / 1e6 <= _LEAST_SHM_MB:
        return Finding("shared memory", NOTE, words, "large images need more; in Docker: --shm-size=512m")
    return Finding("shared memory", OK, words)


def _udp_buffers() -> Finding:
    path = Path("/proc/sys/net/core/rmem_max")
    if not path.is_file():
        return Finding("udp buffers", OK, "not a Linux host, not checked")
    size = int(path.read_text())
    if size < _LEAST_UDP_BYTES:
        advice = "images from other machines may be lost: sudo sysctl -w net.core.rmem_max=8388608"
        return Finding("udp buffers", NOTE, f"receive buffers up to {size} bytes", advice)
    return Finding("udp buffers", OK, f"receive buffers up to {size} bytes")


def _memory() -> Finding:
    from pnv_core.config import Config

    budget = Config().memory_budget_mb
    cores = len(os.sched_getaffinity(0))
    try:
        lines = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text().splitlines())
        free = int(lines["MemAvailable"].split()[0]) / 1e3
    except (OSError, KeyError, ValueError):
        return Finding("memory", OK, f"{cores} cores; memory not checked")
    words = f"{cores} cores, {free:.0f} MB available; default budget of the keyframes {budget:g} MB"
    if free < 2 * budget:
        return Finding("memory", NOTE, words, f"set memory_budget_mb to {max(64, int(free / 4))} or less")
    return Finding("memory", OK, words)


def _cache() -> Finding:
    from pnv_core.describe.download import cache_folder

    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        return Finding("cache", NOTE, f"{folder}: {error.strerror}", "set XDG_CACHE_HOME to a writable folder")
    return Finding("cache", OK, f"{folder}, {shutil.disk_usage(folder).free / 1e9:.1f} GB free")


def _versions() -> dict[str, str]:
    return {d.metadata["Name"].lower(): d.version for d in metadata.distributions() if d.metadata["Name"]}


def _installed() -> set[str]:
    return set(_versions())


CHECKS = (
    _python, _openvino, _torch, _opencv, _faiss, _model, _ros, _middleware, _shared_memory, _udp_buffers, _memory,
    _cache,
)  # fmt: skip
