"""The pose graph of tf_bridge over an hour: 2,000 keyframes, 10 laps, odometry with 1 % drift, wrong closures injected.

    python -m benchmarks.pose_graph [--kernel NAME] [--support N]

Prints one JSON line per share of wrong closures: absolute trajectory error before and after (rmse after alignment, by
evo), the time of an update (by the clock, and of the processor, as the machine may have other work), and how many right
and wrong closures entered. Half of the keyframes of a lap that was walked before have a closure, to a keyframe at most
1.7 m from the right one.
"""

import argparse
import json
import sys
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from examples.pose_graph.drift import Drift, drifted
from examples.pose_graph.report import trajectory_error
from pnv_core.pose.back_end import BackEnd, Keeping
from pnv_core.pose.graph import KERNELS, Noise, PoseGraph
from pnv_core.types import ImageRef, LoopClosure
from pnv_lab.worlds import Pose

KEYFRAMES, LAPS, PERIOD_NS = 2000, 10, 1_800_000_000
SHARES = (0.0, 0.05, 0.15, 0.3)


def walk() -> NDArray[np.float64]:
    """(2000, 4, 4) true poses: ten laps of a bent loop, 333 m each."""
    a = np.linspace(0, 2 * np.pi * LAPS, KEYFRAMES, endpoint=False)
    x, y = 60 * np.cos(a) + 8 * np.cos(3 * a), 40 * np.sin(a) + 5 * np.sin(2 * a)
    heading = np.arctan2(np.gradient(y), np.gradient(x))
    return np.array([Pose(*values).matrix() for values in zip(x, y, np.zeros(KEYFRAMES), heading, strict=True)])


def closure(query: int, match: int) -> LoopClosure:
    ends = (ImageRef(i, i * PERIOD_NS, "") for i in (query, match))
    return LoopClosure(*ends, 0.9, 0.8, 0.4, 40, True)


def trial(share: float, kernel: str, support: int, seed: int = 1) -> dict[str, Any]:
    truth, rng, lap = walk(), np.random.default_rng(seed), KEYFRAMES // LAPS
    odometry = drifted(truth, Drift(scale=0.01, deg_per_m=0.02, step=0.02), seed)
    noise = Noise(odometry_deg_per_root_m=0.3)
    back_end = BackEnd(PoseGraph(noise, kernel, support), Keeping(pose_wait_s=0.0))
    times = []
    for i in range(KEYFRAMES):
        back_end.add_odometry(i * PERIOD_NS, odometry[i])
        if i >= lap and rng.random() < 0.5:
            match = i - lap * int(rng.integers(1, i // lap + 1)) + int(rng.integers(-1, 2))
            back_end.add_closures([closure(i, max(match, 0))])
        if i >= lap and rng.random() < 0.5 * share / (1 - share):
            back_end.add_closures([closure(i, int(rng.integers(0, i - 50)))])
        start, cpu = time.perf_counter(), time.thread_time()
        back_end.update()
        times.append(((time.perf_counter() - start) * 1e3, (time.thread_time() - cpu) * 1e3))
    back_end.update(everything=True)
    graph = back_end.graph
    apart = [np.linalg.norm((truth[p.query] - truth[p.match])[:3, 3]) for p in graph.loops]
    entered = np.array(graph.entered)
    return {
        "wrong_share": share,
        "way_m": round(float(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum())),
        "before_m": round(trajectory_error(truth, odometry), 2),
        "after_m": round(trajectory_error(truth, graph.poses), 2),
        "right": int(sum(a < 5 for a in apart)),
        "right_in": int((entered & (np.array(apart) < 5)).sum()),
        "wrong": int(sum(a >= 5 for a in apart)),
        "wrong_in": int((entered & (np.array(apart) >= 5)).sum()),
        **{
            f"update_{what}_ms": [round(float(value), 1) for value in values]
            for what, values in (("median", np.median(times, axis=0)), ("worst", np.max(times, axis=0)))
        },
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kernel", choices=KERNELS, default="cauchy")
    parser.add_argument("--support", type=int, default=1)
    parser.add_argument("--share", type=float, action="append", help=f"of wrong closures; default {SHARES}")
    args = parser.parse_args()
    for share in args.share or SHARES:
        print(json.dumps(trial(share, args.kernel, args.support)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
