"""make slam-demo: loop closures of the real node correct a drifting odometry, live, in a pose graph on GTSAM.

For every walk the node, a publisher and a back end talk over the real middleware. Then the recorded closures meet
other drifts and injected false closures, with and without the robust solution. Writes slam.png, slam.csv and each
walk's trajectories. Ends with 1 where a trajectory got worse or fewer than all errors were halved.
"""

import argparse
import csv
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException

from examples.pose_graph.back_end import BackEndNode, Recording, graph_of
from examples.pose_graph.drift import drifted
from examples.pose_graph.report import Result, plot, print_table, trial, write_tables
from examples.pose_graph.sequences import Array, Walk, walks
from examples.processes import isolated_environment, node_process, publisher_process
from examples.publisher import IMAGE_TOPIC, INFO_TOPIC, ODOMETRY_TOPIC
from examples.sources import add_source_flags, named_frames
from pnv_core import load_describer
from pnv_core.errors import PnvError
from pnv_core.pose.geometry import Intrinsics
from pnv_core.pose.relative_poses import RelativePoses
from pnv_core.recognizer import PlaceRecognizer
from pnv_core.rotations import quaternion_of

_LATE_S, _LATEST_S = 4.0, 20.0  # the node may still work on the last frames
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


def live(walk: Walk, odometry: Array, assignments: list[str]) -> tuple[Recording, Array]:
    """Play a walk through node and back end: what arrived and the corrected poses (n, 4, 4)."""
    environment = isolated_environment()
    rclpy.init(args=[])
    back_end = BackEndNode(graph_of(walk.noise))
    parameters = {"image_topics": [IMAGE_TOPIC], "odometry_topic": ODOMETRY_TOPIC, **walk.parameters}
    if walk.intrinsics:
        parameters["camera_info_topics"] = [INFO_TOPIC]
    with tempfile.TemporaryDirectory() as folder:
        table = Path(folder) / "odometry.csv"
        _write_odometry(table, walk.stamps_ns, odometry)
        flags = [*walk.flags, "--playback", str(walk.playback), "--odometry", str(table)]
        if walk.intrinsics:
            flags += ["--intrinsics", ",".join(map(str, walk.intrinsics))]
        try:
            with (
                node_process(environment, parameters, assignments, None) as node,
                publisher_process(environment, flags) as publisher,
            ):
                ended, late = None, _LATEST_S
                while ended is None or time.monotonic() - ended < late:
                    rclpy.spin_once(back_end, timeout_sec=0.1)
                    late = _LATE_S if len(back_end.back_end.stamps) == len(walk.stamps_ns) else _LATEST_S
                    if node.return_code is not None:
                        raise PnvError(f"the node ended with {node.return_code}:\n" + "\n".join(node.lines[-15:]))
                    if ended is None and publisher.return_code is not None:
                        ended = time.monotonic()
                if publisher.return_code:
                    raise PnvError("\n".join(line for line in publisher.lines if not line.startswith("{")))
            back_end.correct(everything=True)
            if len(back_end.back_end.stamps) != len(walk.stamps_ns):
                count = len(back_end.back_end.stamps)
                raise PnvError(f"{walk.name}: {count} of {len(walk.stamps_ns)} odometry messages arrived")
            return back_end.back_end.recording, back_end.back_end.graph.poses
        finally:
            back_end.destroy_node()
            rclpy.try_shutdown()


def _write_odometry(path: Path, stamps_ns: list[int], poses: Array) -> None:
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["stamp_ns", "x", "y", "z", "qx", "qy", "qz", "qw"])
        quaternions = quaternion_of(poses[:, :3, :3])
        for stamp, pose, quaternion in zip(stamps_ns, poses, quaternions, strict=True):
            writer.writerow([stamp, *np.round(pose[:3, 3], 6), *np.round(quaternion, 9)])


if __name__ == "__main__":
    sys.exit(main())
