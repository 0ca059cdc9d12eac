"""make fleet-demo: two robots drive one place from different sides under different light; a third starts later.

Every robot is a node of its own with an empty map; Milvus Lite's server keeps what they share. Prints who recognised
whom, right and wrong, and bytes sent; writes fleet.png. Ends with 1 where a robot recognised nobody or is mostly wrong.
"""

import argparse
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import Image
from std_msgs.msg import Float64MultiArray

from benchmarks.fleet import served
from examples.fleet.alignment import Array, merged, planar
from examples.listener import CLOSURES_QOS
from examples.pose_graph.drift import Drift, drifted
from examples.processes import Process, isolated_environment, node_process
from msg_adapters.loop_closures import closures_from_message
from msg_adapters.pictures import rgb_to_message
from pnv_core.types import ImageRef, LoopClosure
from pnv_lab.worlds import Sequence, loop_sequence

_RIGHT_M = 4.0  # two images taken within this show one place
_STEP_NS = 10**9  # between two frames
_START_S, _SETTLE_S = 120.0, 60.0


@dataclass
class Robot:
    """One robot: which frames of the walk it sees, when it starts [ns], its node, what it said."""

    name: str
    frames: list[int]
    start_ns: int
    closures: list[LoopClosure] = field(default_factory=list)
    counts: dict[str, str] = field(default_factory=dict)
    process: Process | None = None
    images: Any = None

    def count(self, name: str) -> int:
        return int(self.counts.get(name, 0))

    def stamp_ns(self, step: int) -> int:
        """Its own clock goes on whatever part of the walk it sees: a node takes no stamps that go back."""
        return self.start_ns + step * _STEP_NS

    def frame_at(self, stamp_ns: int) -> int:
        return self.frames[(stamp_ns - self.start_ns) // _STEP_NS]

    @property
    def done(self) -> int:
        return self.count("frames processed") + sum(int(v) for k, v in self.counts.items() if k.startswith("dropped"))


def main() -> int:
    parser = argparse.ArgumentParser(prog="make fleet-demo", description=__doc__.splitlines()[0])
    parser.add_argument("--world", default="corridor", choices=("corridor", "hall", "street", "office"))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("out"))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    walk = loop_sequence(args.seed, args.world, laps=3.0, fps=1.0)
    lap = len(walk) // 3
    half = lap // 2
    start, later = walk.stamps_ns[0], walk.stamps_ns[0] + 2 * lap * _STEP_NS
    robots = [
        Robot("alpha", list(range(lap)), start),
        Robot("beta", [lap + (half + i) % lap for i in range(lap)], start),  # from the other side, in its own light
        Robot("gamma", list(range(2 * lap, 2 * lap + lap // 3)), later),
    ]
    environment = isolated_environment()
    rclpy.init(args=[])
    node = Node("fleet_demo")
    with served() as server, tempfile.TemporaryDirectory(prefix="pnv_fleet_") as folder:
        try:
            for robot in robots:
                listen(node, robot)
            drive(node, walk, robots[:2], environment, server.uri, folder)
            drive(node, walk, robots[2:], environment, server.uri, folder)
        finally:
            for robot in robots:
                if robot.process is not None:
                    robot.process.__exit__()
            node.destroy_node()
            rclpy.try_shutdown()
    good = report(walk, robots)
    align(walk, robots)
    plot(walk, robots, args.out / "fleet.png")
    return 0 if good else 1


def listen(node: Node, robot: Robot) -> None:
    def closures(message: Float64MultiArray) -> None:
        robot.closures += [c for c in closures_from_message(message) if c.match.robot]

    def diagnostics(message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.startswith(f"/{robot.name}/"):
                robot.counts = {pair.key: pair.value for pair in status.values} or robot.counts

    node.create_subscription(Float64MultiArray, f"/{robot.name}/loop_closures", closures, CLOSURES_QOS)
    node.create_subscription(DiagnosticArray, "/diagnostics", diagnostics, 20)
    reliable = QoSProfile(depth=10, reliability=QoSReliabilityPolicy.RELIABLE)
    robot.images = node.create_publisher(Image, f"/{robot.name}/camera/image_raw", reliable)


def drive(node: Node, walk: Sequence, robots: list[Robot], environment: dict, uri: str, folder: str) -> None:
    """Start the nodes, show each robot its frames one by one, wait until everything is sent."""
    for robot in robots:
        parameters = {"fleet_uri": uri, "fleet_robot": robot.name, "fleet_outbox": folder, "fleet_budget_ms": 5000.0}
        robot.process = node_process(environment, parameters, [], None, f"/{robot.name}")
    until(node, lambda: all(r.images.get_subscription_count() and r.counts for r in robots), _START_S, "the nodes")
    print(f"{' and '.join(r.name for r in robots)} drive", flush=True)
    for step in range(max(len(r.frames) for r in robots)):
        moving = [r for r in robots if step < len(r.frames)]
        for robot in moving:
            robot.images.publish(rgb_to_message(walk[robot.frames[step]].rgb, robot.stamp_ns(step), "camera"))
        spin(node, 0.7)
        shown = step + 1
        until(node, lambda m=moving, n=shown: all(r.done >= n - 1 for r in m), _START_S, "the nodes to follow")
    spin(node, 2.5)
    until(node, lambda: all(r.count("fleet: keyframes waiting") == 0 for r in robots), _SETTLE_S, "the outboxes")
    spin(node, 2.0)


def spin(node: Node, seconds: float) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        rclpy.spin_once(node, timeout_sec=0.05)


def until(node: Node, condition: Any, seconds: float, what: str) -> None:
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            raise SystemExit(f"fleet-demo: waited {seconds:.0f} s for {what}")
        rclpy.spin_once(node, timeout_sec=0.05)


def taken_at(walk: Sequence, robots: list[Robot], ref: ImageRef) -> Array:
    """(3,) metres: where an image was taken."""
    robot = next(r for r in robots if r.name == ref.robot)
    position: Array = walk.matrices[robot.frame_at(ref.stamp_ns)][:3, 3]
    return position


def apart(walk: Sequence, robots: list[Robot], closure: LoopClosure) -> float:
    """Metres between where both images were taken."""
    return float(np.linalg.norm(taken_at(walk, robots, closure.query) - taken_at(walk, robots, closure.match)))


def report(walk: Sequence, robots: list[Robot]) -> bool:
    print(f"\n{'robot':<8}{'recognised':<12}{'queries':>8}{'right':>7}{'wrong':>7}{'sent':>10}{'received':>10}")
    good = True
    for robot in robots:
        others = sorted({c.match.robot for c in robot.closures})
        for i, other in enumerate(others or ["nobody"]):
            with_other = [c for c in robot.closures if c.match.robot == other]
            right = sum(apart(walk, robots, c) <= _RIGHT_M for c in with_other)
            wrong, queries = len(with_other) - right, len({c.query.stamp_ns for c in with_other})
            kb = [f"{robot.count(f'fleet: {way} [kB]')} kB" if not i else "" for way in ("sent", "received")]
            print(f"{robot.name:<8}{other:<12}{queries:>8}{right:>7}{wrong:>7}{kb[0]:>10}{kb[1]:>10}")
            good = good and wrong <= right
    for closure in (c for r in robots for c in r.closures):
        if (metres := apart(walk, robots, closure)) > _RIGHT_M:
            print(f"wrong: {closure.query.robot} {closure.query.id} and {closure.match.robot} {closure.match.id}, "
                  f"{metres:.1f} m apart, score {closure.score:.2f}")  # fmt: skip
    return good and all(r.closures for r in robots)


def align(walk: Sequence, robots: list[Robot]) -> None:
    """Alpha's and beta's drifting odometries in one frame, by the closures between them."""
    pair = robots[:2]
    truth = {r.name: walk.matrices[r.frames] for r in pair}
    # each odometry begins at an origin of its own and knows nothing of the other
    odometry = {r.name: planar(drifted(np.linalg.inv(truth[r.name][0]) @ truth[r.name], Drift(), 3 + i))
                for i, r in enumerate(pair)}  # fmt: skip
    node = {(r.name, r.stamp_ns(n)): n for r in pair for n in range(len(r.frames))}
    between = [c for r in pair for c in r.closures if c.match.robot != c.query.robot]
    loops = [
        (q.robot, node[q.robot, q.stamp_ns], m.robot, node[m.robot, m.stamp_ns])
        for q, m in ((c.query, c.match) for c in between)
    ]
    try:
        found = merged(odometry, loops)
    except ValueError as error:
        print(f"not merged: {error}")
        return
    start = np.linalg.inv(truth[pair[0].name][0])
    errors = [_errors(found[r.name], planar(start @ truth[r.name])) for r in pair]
    words = ", ".join(f"{r.name} {np.sqrt((e**2).mean()):.2f} m" for r, e in zip(pair, errors, strict=True))
    print(f"\nboth maps in alpha's frame by {len(loops)} closures: rms error {words}")


def _errors(found: Array, truth: Array) -> Array:
    return np.linalg.norm(found[:, :2] - truth[:, :2], axis=1)


def plot(walk: Sequence, robots: list[Robot], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(8, 6), layout="constrained")
    # laps lie on top of each other: each robot's is drawn a little aside
    aside = {robot.name: np.array([0.8 * i, 0.8 * i]) for i, robot in enumerate(robots)}
    for robot, colour in zip(robots, ("#0072b2", "#d55e00", "#cc79a7"), strict=True):
        xy = walk.matrices[robot.frames][:, :2, 3] + aside[robot.name]
        axes.plot(*xy.T, ".-", color=colour, label=robot.name, linewidth=1.0, markersize=3)
        for closure in robot.closures:
            refs = closure.query, closure.match
            ends = np.array([taken_at(walk, robots, r)[:2] + aside[r.robot] for r in refs])
            right = apart(walk, robots, closure) <= _RIGHT_M
            axes.plot(*ends.T, color="#009e73" if right else "red", linewidth=0.5, alpha=0.6)
    axes.set(
        aspect="equal", xlabel="x [m]", ylabel="y [m]", title="paths, drawn aside, and the closures between robots"
    )
    axes.legend()
    figure.savefig(path, dpi=110)
    print(f"wrote {path}")


if __name__ == "__main__":
    sys.exit(main())
