"""The node's latency with a fleet and without: python -m benchmarks.fleet latency.

Two nodes hold the same map of 1,000 keyframes. A camera of 640x480 shows images to one of them, a block at a time, so
that both meet the same load of the machine; every image is a keyframe. The fleet's store holds another robot's
keyframes, is asked for each and takes each. Latency is the time from the image's stamp to the first closure's arrival.
"""

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from sensor_msgs.msg import Image
from std_msgs.msg import Float64MultiArray

from benchmarks.fleet import served
from benchmarks.live_node import fill_map, pictures
from msg_adapters.loop_closures import closures_from_message
from msg_adapters.pictures import rgb_to_message
from pnv_cli.main import main as pnv
from pnv_ros.outputs import CLOSURES_QOS
from test.ros.camera import RELIABLE, Health
from test.ros.processes import Listener, own_domain, running_node, wait_until

_KEYFRAMES, _SHARED = 1000, 200
_BLOCK = 20  # images, before the other node has its turn
_WARM = 3  # of these, not counted


def latency(blocks: int, rate: float, images: Path | None) -> int:
    """0 where p95 with a fleet is within 10 % of p95 without."""
    shown = pictures(images, 640, 480)
    with tempfile.TemporaryDirectory(prefix="pnv_fleet_") as scratch, served() as server, own_domain():
        folder = Path(scratch)
        fill_map(folder / "map", _KEYFRAMES, shown)
        fill_map(folder / "shared", _SHARED, shown)
        pnv(["fleet", "push", str(folder / "shared"), "--robot", "another", "--uri", server.uri])
        settings = {
            "min_interval_s": 0.0, "min_change": 0.0, "accept_score": 0.0, "consistency": 0, "min_texture": 0.0,
            "map_path": folder / "map", "load_on_start": True,
            "qos_overrides./with/camera/image_raw.subscription.reliability": "reliable",
            "qos_overrides./without/camera/image_raw.subscription.reliability": "reliable",
        }  # fmt: skip
        fleet = {"fleet_uri": server.uri, "fleet_outbox": folder}
        listener = Listener()
        with (
            running_node("-r", "__ns:=/with", **settings | fleet),
            running_node("-r", "__ns:=/without", **settings),
        ):
            cameras = [_Camera(listener, name) for name in ("with", "without")]
            health = Health(listener, "/with/place_recognizer")
            for block in range(2 * blocks):
                cameras[block % 2].show(shown, rate)
                wait_until(lambda: health.count("fleet: keyframes waiting") == 0, 120, "the outbox")
            told = health.values()
        listener.close()
    p50, p95 = ([float(np.percentile(c.latencies, p)) for c in cameras] for p in (50, 95))
    print(
        f"{len(cameras[0].latencies)} images each at {rate:g} Hz: p50 {p50[0]:.0f} ms with a fleet, {p50[1]:.0f} ms "
        f"without; p95 {p95[0]:.0f} and {p95[1]:.0f} ms ({100 * (p95[0] / p95[1] - 1):+.0f} %); the fleet answered "
        f"{told['fleet: queries']} queries, {told['fleet: late answers']} of them late, and took "
        f"{told['fleet: keyframes sent']} keyframes"
    )
    return int(p95[0] > 1.1 * p95[1])


class _Camera:
    """Shows images to one node and notes when the closures of each arrive."""

    def __init__(self, listener: Listener, name: str) -> None:
        self.latencies: list[float] = []
        self._arrived: dict[int, int] = {}
        self._publisher = listener.node.create_publisher(Image, f"/{name}/camera/image_raw", RELIABLE)
        listener.node.create_subscription(Float64MultiArray, f"/{name}/loop_closures", self._note, CLOSURES_QOS)
        wait_until(self._publisher.get_subscription_count, 60, f"the node {name}")

    def _note(self, message: Any) -> None:
        now, closure = time.time_ns(), closures_from_message(message)[0]
        if not closure.match.robot:  # the fleet's answers come later, by themselves
            self._arrived.setdefault(closure.query.stamp_ns, now)

    def show(self, shown: list[Any], rate: float) -> None:
        start = time.monotonic()
        stamps = []
        for number in range(_BLOCK):
            time.sleep(max(0.0, start + number / rate - time.monotonic()))
            message = rgb_to_message(shown[number % len(shown)], time.time_ns(), "camera")
            stamps.append(time.time_ns())  # the message is made; the way begins
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamps[-1], 10**9)
            self._publisher.publish(message)
        wait_until(lambda: stamps[-1] in self._arrived, 60, "the last closure")
        self.latencies += [(self._arrived[s] - s) / 1e6 for s in stamps[_WARM:] if s in self._arrived]
