"""make slam-demo: loop closures of the real node correct a drifting odometry, live, by the real tf_bridge.

For every walk place_recognizer, tf_bridge and a publisher of images and odometry are processes that talk over the real
middleware; the corrected trajectory is tf_bridge's path. Then the recorded closures meet other drifts and injected
false closures, with and without the robust solution. Writes slam.png, slam.csv and each walk's trajectories. Ends with
1 where a trajectory got worse or fewer than all errors were halved.
"""

import argparse
import csv
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException

from examples.pose_graph.back_end import Follower, Recording, between_nodes
from examples.pose_graph.drift import drifted
from examples.pose_graph.report import Result, plot, print_table, trial, write_tables
from examples.pose_graph.sequences import Array, Walk, walks
from examples.processes import Process, isolated_environment, node_process, publisher_process
from examples.publisher import IMAGE_TOPIC, INFO_TOPIC, ODOMETRY_TOPIC
from examples.sources import add_source_flags, named_frames
from pnv_core import load_describer
from pnv_core.errors import PnvError
from pnv_core.pose.geometry import Intrinsics
from pnv_core.pose.relative_poses import RelativePoses
from pnv_core.recognizer import PlaceRecognizer
from pnv_core.rotations import quaternion_of

_LATE_S = 4.0  # the node may still work on the last frames
_SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"


def main() -> int:
    parser = argparse.ArgumentParser(prog="make slam-demo", description=__doc__.splitlines()[0])
    parser.add_argument("--only", action="append", metavar="NAME", help="walks to run, by the start of their names")
    parser.add_argument("--data", type=Path, default=_SHARED, help="folder of recorded walks; default ../shared/data")
    parser.add_argument("--seed", type=int, default=0, help="of the odometry's drift")
    parser.add_argument("--trials", type=int, default=10, help="further drifts each walk's closures are tried with")
    parser.add_argument("--offline", action="store_true", help="no processes: the recogniser itself, every frame")
    parser.add_argument("--depth", action="store_true", help="offline, rendered walks: every image with its depth")
    parser.add_argument("--parameter", action="append", default=[], metavar="NAME:=VALUE", help="of the node")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder of what is written; default out")
    args = parser.parse_args()
    chosen = [w for w in walks(args.data) if not args.only or any(w.name.startswith(name) for name in args.only)]
    if args.depth:
        if not args.offline:
            parser.error("--depth is for --offline")
        chosen = [w for w in chosen if w.depth is not None]
    try:
        args.out.mkdir(parents=True, exist_ok=True)
        results = []
        for walk in chosen:
            odometry = drifted(walk.truth, walk.drift, args.seed)
            if args.offline:
                recording = recorded(walk, odometry, args.depth)
                corrected = trial(walk, odometry, recording, robust=True)
            else:
                recording, corrected = live(walk, odometry, args.parameter)
            results.append(Result.of(walk, odometry, corrected, recording, args.trials))
            print(results[-1].sentence(), flush=True)
    except PnvError as error:
        print(f"slam-demo: {error}", file=sys.stderr)
        return 2
    except (KeyboardInterrupt, ExternalShutdownException):
        print("slam-demo: interrupted", file=sys.stderr)
        return 130
    print_table(results)
    plot(results, args.out / "slam.png")
    write_tables(results, args.out)
    print(f"written: {args.out / 'slam.png'}, {args.out / 'slam.csv'} and trajectories in TUM format")
    return 0 if results and all(result.halved for result in results) else 1


def recorded(walk: Walk, odometry: Array, with_depth: bool = False) -> Recording:
    """What the recogniser says when it is given every frame, whatever time that takes: the same on any machine."""
    parser = argparse.ArgumentParser()
    add_source_flags(parser)
    describer = load_describer("default", **walk.parameters)
    recognizer = PlaceRecognizer(describer)
    relative, recording = RelativePoses(recognizer), Recording()
    positions = dict(zip(walk.stamps_ns, odometry[:, :3, 3], strict=True))
    for number, (_, frame) in enumerate(named_frames(parser.parse_args(walk.flags))):
        if with_depth and walk.depth is not None:
            frame = replace(frame, depth=walk.depth(number))
        recognizer.odometry.add(frame.stamp_ns, *positions[frame.stamp_ns])
        if walk.intrinsics:
            relative.cameras[frame.camera] = Intrinsics.of_pixels(*walk.intrinsics, frame.rgb.shape[1])
        for closure in recognizer.process(frame):
            if closure.accepted:
                recording.closures.append(replace(closure, matches=()))
                pose = relative.estimate(closure)
                if pose is not None and pose.metric:
                    recording.measured[closure.query.stamp_ns, closure.match.id] = pose.matrix, pose.covariance
    return recording


def live(walk: Walk, odometry: Array, assignments: Sequence[str] = ()) -> tuple[Recording, Array]:
    """Play a walk through place_recognizer and tf_bridge: what was said, and tf_bridge's poses (n, 4, 4)."""
    environment = isolated_environment()
    rclpy.init(args=[])
    follower = Follower()
    parameters = {"image_topics": [IMAGE_TOPIC], "odometry_topic": ODOMETRY_TOPIC, **walk.parameters}
    if walk.intrinsics:
        parameters["camera_info_topics"] = [INFO_TOPIC]
    with tempfile.TemporaryDirectory() as folder:
        table = Path(folder) / "odometry.csv"
        _write_odometry(table, walk.stamps_ns, odometry)
        flags = [*walk.flags, "--playback", str(walk.playback), "--odometry", str(table)]
        if walk.intrinsics:
            flags += ["--intrinsics", ",".join(map(str, walk.intrinsics))]
        bridge_parameters = {
            "odometry_topic": ODOMETRY_TOPIC, "graph_path": str(Path(folder) / "graph.g2o"), "node_m": 0.1,
            "tolerance_m": walk.noise.tolerance_m, "tolerance_deg": walk.noise.tolerance_deg,
            "publish_tf": find_spec("tf2_msgs") is not None,
        }  # fmt: skip
        try:
            with (
                node_process(environment, bridge_parameters, (), None, executable="tf_bridge") as bridge,
                node_process(environment, parameters, assignments, None) as node,
            ):
                _spin(follower, [bridge, node], lambda: any("corrects" in line for line in bridge.lines))
                with publisher_process(environment, flags) as publisher:
                    _spin(follower, [bridge, node], lambda: publisher.return_code is not None)
                    if publisher.return_code:
                        raise PnvError("\n".join(line for line in publisher.lines if not line.startswith("{")))
                end = time.monotonic() + _LATE_S
                _spin(follower, [bridge, node], lambda: time.monotonic() > end)
                print(f"{walk.name}: tf_bridge has {follower.settle()}", flush=True)
            poses = between_nodes(walk.stamps_ns, odometry, follower.stamps_ns, follower.path)
            return follower.recording, poses
        finally:
            follower.destroy_node()
            rclpy.try_shutdown()


def _spin(follower: Follower, processes: Sequence[Process], done: Callable[[], bool]) -> None:
    """Listen until `done`. Raises PnvError where a process ends."""
    while not done():
        rclpy.spin_once(follower, timeout_sec=0.1)
        for process in processes:
            if process.return_code is not None:
                last = "\n".join(process.lines[-15:])
                raise PnvError(f"the {process.name} ended with {process.return_code}:\n{last}")


def _write_odometry(path: Path, stamps_ns: list[int], poses: Array) -> None:
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["stamp_ns", "x", "y", "z", "qx", "qy", "qz", "qw"])
        quaternions = quaternion_of(poses[:, :3, :3])
        for stamp, pose, quaternion in zip(stamps_ns, poses, quaternions, strict=True):
            writer.writerow([stamp, *np.round(pose[:3, 3], 6), *np.round(quaternion, 9)])


if __name__ == "__main__":
    sys.exit(main())
