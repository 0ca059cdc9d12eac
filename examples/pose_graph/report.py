"""Trajectory errors by evo, before and after; trials with other drifts and with false closures; table and plot."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from evo.core import metrics
from evo.core.trajectory import PosePath3D
from numpy.typing import NDArray

from examples.pose_graph.back_end import Recording, RecordingBackEnd, graph_of
from examples.pose_graph.drift import drifted
from examples.pose_graph.sequences import Walk
from pnv_core.rotations import quaternion_of
from pnv_core.types import ImageRef, LoopClosure

Array = NDArray[np.float64]


def trajectory_error(truth: Array, estimate: Array) -> float:
    """Absolute trajectory error of (n, 4, 4) poses in metres: rmse of the positions after rigid alignment."""
    true, estimated = PosePath3D(poses_se3=list(truth)), PosePath3D(poses_se3=list(estimate))
    estimated.align(true)
    error = metrics.APE(metrics.PoseRelation.translation_part)
    error.process_data((true, estimated))
    return float(error.get_statistic(metrics.StatisticsType.rmse))


@dataclass(frozen=True)
class Trials:
    """Ratios error after / error before over several drifts, for one share of false closures."""

    false: int
    robust: list[float]
    plain: list[float]


@dataclass(frozen=True, eq=False)
class Result:
    """One walk, live, and the trials with its closures."""

    walk: Walk
    odometry: Array
    corrected: Array
    recording: Recording
    before_m: float
    after_m: float
    trials: list[Trials]

    @classmethod
    def of(cls, walk: Walk, odometry: Array, corrected: Array, recording: Recording, trials: int) -> "Result":
        before, after = trajectory_error(walk.truth, odometry), trajectory_error(walk.truth, corrected)
        shares = (0.0, 0.1, 0.3) if recording.closures else ()
        tried = [_trials(walk, recording, share, trials) for share in shares]
        return cls(walk, odometry, corrected, recording, before, after, tried)

    @property
    def halved(self) -> bool:
        return self.after_m <= 0.5 * self.before_m

    def sentence(self) -> str:
        return (
            f"{self.walk.name}: {len(self.recording.closures)} closures, {len(self.recording.measured)} measured, "
            f"trajectory error {self.before_m:.2f} m before, {self.after_m:.2f} m after"
        )


def _trials(walk: Walk, recording: Recording, share: float, count: int) -> Trials:
    robust, plain, false = [], [], round(share * len(recording.closures))
    for seed in range(1, count + 1):
        odometry = drifted(walk.truth, walk.drift, seed)
        before = trajectory_error(walk.truth, odometry)
        injected = Recording([*recording.closures, *false_closures(walk, false, seed)], recording.measured)
        robust.append(trajectory_error(walk.truth, trial(walk, odometry, injected, True)) / before)
        plain.append(trajectory_error(walk.truth, trial(walk, odometry, injected, False)) / before)
    return Trials(false, robust, plain)


def trial(walk: Walk, odometry: Array, recording: Recording, robust: bool) -> Array:
    """The corrected poses (n, 4, 4) that the back end gives for an odometry and a recording."""
    back_end = RecordingBackEnd(graph_of(walk.noise, robust))
    for stamp, pose in zip(walk.stamps_ns, odometry, strict=True):
        back_end.add_odometry(stamp, pose)
    back_end.play(recording)
    back_end.update(everything=True)
    return back_end.graph.poses


def false_closures(walk: Walk, count: int, seed: int) -> list[LoopClosure]:
    """Closures between places at least a tenth of the walk's extent apart, as confident as true ones."""
    rng = np.random.default_rng((seed, 13))
    positions = walk.truth[:, :3, 3]
    apart = 0.1 * float(np.linalg.norm(np.ptp(positions, axis=0)))
    closures: list[LoopClosure] = []
    while len(closures) < count:
        match, query = sorted(int(node) for node in rng.integers(0, len(positions), 2))
        if np.linalg.norm(positions[query] - positions[match]) > apart:
            ends = (ImageRef(node, walk.stamps_ns[node], "") for node in (query, match))
            closures.append(LoopClosure(*ends, 0.95, 0.9, 0.5, 50, True))
    return closures


def print_table(results: Sequence[Result]) -> None:
    heading = f"{'walk':<16}{'way':>7}{'closures':>10}{'before':>9}{'after':>9}{'ratio':>8}"
    print(f"\n{heading}   over other drifts: median (worst)")
    for result in results:
        way = np.linalg.norm(np.diff(result.walk.truth[:, :3, 3], axis=0), axis=1).sum()
        ratio = result.after_m / result.before_m
        print(
            f"{result.walk.name:<16}{way:>5.0f} m{len(result.recording.closures):>10}{result.before_m:>7.2f} m"
            f"{result.after_m:>7.2f} m{ratio:>8.2f}",
            end="",
        )
        if result.trials:
            print(f"   {_summary(result.trials[0].robust)}")
        else:
            print("   no closures, nothing to try")
    print(f"\n{'false closures added':<34}{'robust: median (worst)':<26}least squares: median (worst)")
    for result in results:
        for tried in result.trials[1:]:
            name = f"{result.walk.name}, {tried.false} to {len(result.recording.closures)}"
            print(f"{name:<34}{_summary(tried.robust):<26}{_summary(tried.plain)}")
    print()


def _summary(ratios: Sequence[float]) -> str:
    return f"{np.median(ratios):.2f} ({max(ratios):.2f})"


def write_tables(results: Sequence[Result], folder: Path) -> None:
    """slam.csv with every ratio; per walk the closures, and odometry, corrected and true trajectories in TUM format."""
    with (folder / "slam.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["walk", "closures", "false", "solution", "before_m", "after_m", "ratio"])
        for r in results:
            row = [r.walk.name, len(r.recording.closures), 0, "live", f"{r.before_m:.4f}", f"{r.after_m:.4f}"]
            writer.writerow([*row, f"{r.after_m / r.before_m:.4f}"])
            for tried in r.trials:
                for solution, ratios in (("robust", tried.robust), ("least squares", tried.plain)):
                    for ratio in ratios:
                        writer.writerow(
                            [r.walk.name, len(r.recording.closures), tried.false, solution, "", "", f"{ratio:.4f}"]
                        )
    for r in results:
        _write_closures(r, folder / f"slam_{r.walk.name.replace(' ', '_')}_closures.csv")
        for kind, poses in (("truth", r.walk.truth), ("odometry", r.odometry), ("corrected", r.corrected)):
            quaternions = quaternion_of(poses[:, :3, :3])
            seconds = np.array(r.walk.stamps_ns)[:, None] / 1e9
            table = np.hstack([seconds, poses[:, :3, 3], quaternions])
            np.savetxt(folder / f"slam_{r.walk.name.replace(' ', '_')}_{kind}.tum", table, fmt="%.9f")


def _write_closures(result: Result, path: Path) -> None:
    """How far apart the two images of each closure were truly taken."""
    nodes = {stamp: node for node, stamp in enumerate(result.walk.stamps_ns)}
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["query_ns", "match_ns", "score", "measured", "apart_m", "turned_deg"])
        for closure in result.recording.closures:
            query, match = closure.query, closure.match
            if query.stamp_ns in nodes and match.stamp_ns in nodes:
                poses = (result.walk.truth[nodes[ref.stamp_ns]] for ref in (match, query))
                truly = np.linalg.inv(next(poses)) @ next(poses)
                turned = np.degrees(np.arccos(np.clip((np.trace(truly[:3, :3]) - 1) / 2, -1, 1)))
                measured = int((query.stamp_ns, match.id) in result.recording.measured)
                apart = f"{np.linalg.norm(truly[:3, 3]):.2f}"
                row = [query.stamp_ns, match.stamp_ns, f"{closure.score:.4f}", measured, apart, f"{turned:.0f}"]
                writer.writerow(row)


def plot(results: Sequence[Result], path: Path) -> None:
    """Each walk from above: truth, odometry, corrected, and the closures."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    columns = min(3, len(results))
    rows = -(-len(results) // columns)
    figure, grid = plt.subplots(rows, columns, figsize=(5 * columns, 4.6 * rows), squeeze=False, layout="constrained")
    for axes in grid.flat[len(results) :]:
        axes.set_visible(False)
    for result, axes in zip(results, grid.flat, strict=False):
        stamps = {stamp: node for node, stamp in enumerate(result.walk.stamps_ns)}
        drawn = (
            ("odometry", _aligned(result, result.odometry), "#d55e00"),
            ("corrected", _aligned(result, result.corrected), "#0072b2"),
        )
        axes.plot(*result.walk.truth[:, :2, 3].T, color="0.55", linewidth=3, alpha=0.6, label="truth")
        for label, poses, colour in drawn:
            axes.plot(*poses[:, :2, 3].T, color=colour, linewidth=1.2, label=label)
        label = f"{len(result.recording.closures)} closures"
        for closure in result.recording.closures:
            ends = [stamps.get(ref.stamp_ns) for ref in (closure.query, closure.match)]
            if None not in ends:
                axes.plot(*drawn[1][1][ends, :2, 3].T, color="#009e73", linewidth=0.6, alpha=0.6, label=label)
                label = "_nolegend_"
        axes.set_title(f"{result.walk.name}: {result.before_m:.2f} m to {result.after_m:.2f} m", fontsize=11)
        axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
        axes.legend(fontsize=8)
    figure.savefig(path, dpi=110, bbox_inches="tight")  # equal axes may stand out of the layout
    plt.close(figure)


def _aligned(result: Result, poses: Array) -> Array:
    true, estimated = PosePath3D(poses_se3=list(result.walk.truth)), PosePath3D(poses_se3=list(poses))
    estimated.align(true)
    return np.array(estimated.poses_se3)
