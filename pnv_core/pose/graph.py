"""An incremental pose graph on GTSAM: odometry between consecutive nodes, loop closures between far ones.

Poses are (4, 4), metres. A closure from one camera says "these two images show one place": it has no scale, so it does
not say where exactly one camera stood relative to the other. Without a measured relative pose a closure therefore only
pulls the two nodes towards each other, as loosely as the recogniser tolerates a change of viewpoint.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnv_core.errors import PnvError
from pnv_core.rotations import angle_of, local_covariance

Array = NDArray[np.float64]

KERNELS = ("none", "huber", "cauchy", "geman_mcclure", "dcs")
# Where odometry begins anew, next to nothing is known but the vertical; looser, the solution would lose its digits.
_AFTER_BREAK = (0.05, 0.05, 1.0, 20.0, 20.0, 20.0)
_SUPPORT_TOLERANCES = 20.0  # closures support each other within so many tolerances of way
# Metres and radians a node moves before it is linearised anew; less for a tolerance below a metre. As good as 0.1
# over an hour with wrong closures, at half the work: worst update 21 for 46 ms (benchmarks/pose_graph.py).
_RELINEARIZE = 0.5
_ITERATIONS = 5  # of iSAM2 after a closure, one an update; each relinearises what moved


@dataclass(frozen=True)
class Noise:
    """Standard deviations of the factors.

    The odometry's grow with the way and the turn between two nodes. `tolerance_m` and `tolerance_deg` are how far apart
    two images of one place are typically taken: the deviation of a closure without a measured pose and of score 1.
    """

    odometry_per_m: float = 0.03
    odometry_deg_per_root_m: float = 1.0
    odometry_deg_per_deg: float = 0.03
    tolerance_m: float = 1.0
    tolerance_deg: float = 12.0


@dataclass(frozen=True, eq=False)
class Loop:
    """Two nodes of one place. `score` is P(same place), `relative` (4, 4) the query's pose as seen from the match.

    `covariance` (6, 6) is of `relative` where it was measured, in the order x, y, z, rotations about x, y, z, in the
    match's frame, as ROS has it.
    """

    query: int
    match: int
    score: float
    relative: Array
    covariance: Array | None = None


class PoseGraph:
    """Nodes along the odometry, loops between them, kept solved by iSAM2 (Kaess et al., IJRR 2012).

    A loop enters the solution once `support` others agree with it: pairs of loops whose queries and whose matches lie
    near each other must close a cycle with the odometry between them, which is the pairwise test of PCM (Mangelson et
    al., ICRA 2018) within a window. Loops that no other supports wait. `kernel` is the robust kernel of the loops that
    entered; odometry is always believed. Raises PnvError where GTSAM is not on the machine.
    """

    def __init__(self, noise: Noise | None = None, kernel: str = "cauchy", support: int = 1) -> None:
        self._gtsam = gtsam = imported_gtsam()
        self.noise, self._support = noise or Noise(), support
        self._kernel = _kernel(gtsam, kernel)
        self._after_break = gtsam.noiseModel.Diagonal.Sigmas(np.array(_AFTER_BREAK))
        parameters = gtsam.ISAM2Params()
        parameters.setRelinearizeThreshold(min(_RELINEARIZE, _RELINEARIZE * self.noise.tolerance_m))
        parameters.relinearizeSkip = 1
        self._isam = gtsam.ISAM2(parameters)
        self._factors, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._odometry: list[Array] = []
        self._way: list[float] = []  # metres travelled at each node
        self._run: list[int] = []  # which unbroken piece of odometry each node belongs to
        self._newest: Any = None  # gtsam.Pose3 of the last node
        self.loops: list[Loop] = []  # all, entered or not
        self.entered: list[bool] = []  # by loop
        self._ends = np.zeros((0, 2), int)  # by loop: query, match
        self._partners: list[int] = []  # by loop: how many others agree
        self._unsettled = 0  # iterations that are due

    def __len__(self) -> int:
        return len(self._odometry)

    def add_node(self, pose: Array, continues: bool = True) -> int:
        """The next node, at an odometry pose (4, 4); its number. `continues` is false where odometry began anew.

        After a break the node is placed where the last one was, and held there so loosely that one closure moves it.
        """
        gtsam, number = self._gtsam, len(self)
        if not self._odometry:
            self._newest = self._pose3(pose)
            tight = gtsam.noiseModel.Diagonal.Sigmas(np.full(6, 1e-4))
            self._factors.add(gtsam.PriorFactorPose3(0, self._newest, tight))
            way, run = 0.0, 0
        else:
            step = np.linalg.inv(self._odometry[-1]) @ pose if continues else np.eye(4)
            way, run = self._way[-1] + float(np.linalg.norm(step[:3, 3])), self._run[-1] + (not continues)
            noise = self._odometry_noise(step) if continues else self._after_break
            self._factors.add(gtsam.BetweenFactorPose3(number - 1, number, self._pose3(step), noise))
            self._newest = self._newest.compose(self._pose3(step))
        self._values.insert(number, self._newest)
        self._odometry.append(pose)
        self._way.append(way)
        self._run.append(run)
        return number

    def add_loop(self, loop: Loop) -> None:
        """A closure between two nodes that exist, which enters now or when others support it.

        Raises ValueError for other nodes.
        """
        for node in (loop.query, loop.match):
            if not 0 <= node < len(self):
                raise ValueError(f"node {node} is not one of 0 to {len(self) - 1}")
        agreeing = self._agreeing(loop)
        self.loops.append(loop)
        self.entered.append(False)
        self._partners.append(len(agreeing))
        self._ends = np.vstack([self._ends, (loop.query, loop.match)])
        for other in agreeing:
            self._partners[other] += 1
        for number in (*agreeing, len(self.loops) - 1):
            if not self.entered[number] and self._partners[number] >= self._support:
                self._enter(number)

    def update(self, settle: bool = False) -> bool:
        """Solve with what was added; whether old poses moved.

        After a loop entered, this and the next updates each go one iteration further, `settle` all that are due.
        """
        moved = self._unsettled > 0
        if moved or self._values.size():
            self._isam.update(self._factors, self._values)
            self._factors, self._values = self._gtsam.NonlinearFactorGraph(), self._gtsam.Values()
            self._unsettled = max(0, self._unsettled - 1)
            while settle and self._unsettled:
                self._isam.update()
                self._unsettled -= 1
            self._newest = self._isam.calculateEstimatePose3(len(self) - 1)
        return moved

    @property
    def newest(self) -> Array:
        """(4, 4) corrected pose of the last node."""
        return self._newest.matrix()

    @property
    def poses(self) -> Array:
        """(n, 4, 4) corrected poses as of the last update."""
        table = self._gtsam.utilities.extractPose3(self._isam.calculateEstimate())  # (n, 12): rotation rows, position
        poses = np.tile(np.eye(4), (len(table), 1, 1))
        poses[:, :3, :3], poses[:, :3, 3] = table[:, :9].reshape(-1, 3, 3), table[:, 9:]
        return poses

    def edges(self) -> list[tuple[int, int, Array, Array]]:
        """(from, to, relative (4, 4), information (6, 6), position first): odometry, then the loops that entered."""
        edges = []
        for node in range(1, len(self)):
            if self._run[node] == self._run[node - 1]:
                step = np.linalg.inv(self._odometry[node - 1]) @ self._odometry[node]
                edges.append((node - 1, node, step, self._information(self._odometry_noise(step))))
        for loop, entered in zip(self.loops, self.entered, strict=True):
            if entered:
                edges.append((loop.match, loop.query, loop.relative, self._information(self._loop_noise(loop))))
        return edges

    def _information(self, noise: Any) -> Array:
        order = [3, 4, 5, 0, 1, 2]
        return np.linalg.inv(noise.covariance())[np.ix_(order, order)]

    def odometry(self, node: int) -> Array:
        """The odometry pose (4, 4) a node was made at."""
        return self._odometry[node]

    def run(self, node: int) -> int:
        """Which unbroken piece of odometry a node belongs to, counted from 0."""
        return self._run[node]

    def _enter(self, number: int) -> None:
        loop, self.entered[number] = self.loops[number], True
        noise = self._loop_noise(loop)
        if self._kernel is not None:
            noise = self._gtsam.noiseModel.Robust.Create(self._kernel, noise)
        relative = self._pose3(loop.relative)
        self._factors.add(self._gtsam.BetweenFactorPose3(loop.match, loop.query, relative, noise))
        self._unsettled = _ITERATIONS

    def _agreeing(self, loop: Loop) -> list[int]:
        """The loops of other queries near by that close a cycle with this one; loops across breaks support none."""
        if not self.loops:
            return []
        way, run = np.array(self._way), np.array(self._run)
        window = _SUPPORT_TOLERANCES * self.noise.tolerance_m
        ends = np.array([loop.query, loop.match])
        gone = np.abs(way[self._ends] - way[ends])  # (L, 2)
        near = (gone <= window).all(1) & (run[self._ends] == run[ends]).all(1) & (self._ends[:, 0] != loop.query)
        return [int(i) for i in np.flatnonzero(near) if self._closes(loop, self.loops[i], float(gone[i].sum()))]

    def _closes(self, one: Loop, other: Loop, gone_m: float) -> bool:
        """Whether going around both loops and the odometry between them ends where it began, within three deviations.

        A deviation of a loop's angle moves the end by the way between the loops.
        """
        between_matches = np.linalg.inv(self._odometry[one.match]) @ self._odometry[other.match]
        between_queries = np.linalg.inv(self._odometry[other.query]) @ self._odometry[one.query]
        cycle = between_matches @ other.relative @ between_queries @ np.linalg.inv(one.relative)
        (m_one, rad_one), (m_other, rad_other) = self._deviations(one), self._deviations(other)
        noise = self.noise
        turned = math.radians(noise.odometry_deg_per_root_m) * math.sqrt(gone_m) + math.hypot(rad_one, rad_other)
        arm = max(np.linalg.norm(between_matches[:3, 3]), np.linalg.norm(between_queries[:3, 3]))
        metres = math.hypot(m_one, m_other) + noise.odometry_per_m * gone_m + turned * arm
        angle = float(angle_of(cycle[:3, :3]))
        return bool(np.linalg.norm(cycle[:3, 3]) <= 3 * metres and angle <= 3 * turned)

    def _deviations(self, loop: Loop) -> tuple[float, float]:
        if loop.covariance is None:
            return self.noise.tolerance_m, math.radians(self.noise.tolerance_deg)
        variances = np.diag(loop.covariance)
        return math.sqrt(variances[:3].max()), math.sqrt(variances[3:].max())

    def _odometry_noise(self, step: Array) -> Any:
        noise = self.noise
        metres = float(np.linalg.norm(step[:3, 3]))
        turned = np.degrees(angle_of(step[:3, :3]))
        yaw = np.deg2rad(0.1 + noise.odometry_deg_per_root_m * metres**0.5 + noise.odometry_deg_per_deg * turned)
        way = 0.002 + noise.odometry_per_m * metres
        tilt = 0.1 * yaw  # gravity is known to any robot with an accelerometer
        return self._gtsam.noiseModel.Diagonal.Sigmas(np.array([tilt, tilt, yaw, way, way, 0.3 * way]))

    def _loop_noise(self, loop: Loop) -> Any:
        """Loops whose queries lie within the tolerance of each other share their error: each counts for less."""
        way = np.array(self._way)
        crowd = 1 + sum(
            entered and abs(way[other.query] - way[loop.query]) <= self.noise.tolerance_m and other is not loop
            for other, entered in zip(self.loops, self.entered, strict=True)
        )
        if loop.covariance is not None:
            order = [3, 4, 5, 0, 1, 2]  # GTSAM puts rotation first
            covariance = local_covariance(loop.covariance, loop.relative)
            return self._gtsam.noiseModel.Gaussian.Covariance(covariance[np.ix_(order, order)] * crowd)
        scale = math.sqrt(crowd / max(loop.score, 0.05))
        return _sigmas(self._gtsam, math.radians(self.noise.tolerance_deg) * scale, self.noise.tolerance_m * scale)

    def _pose3(self, matrix: Array) -> Any:
        return self._gtsam.Pose3(self._gtsam.Rot3(matrix[:3, :3]), matrix[:3, 3])


def imported_gtsam() -> Any:
    """The module gtsam. Raises PnvError where it is not on the machine."""
    try:
        import gtsam
    except ImportError:
        raise PnvError("no GTSAM on this machine; allowed: after pip install gtsam, or pnv_ros[slam]") from None
    return gtsam


def _sigmas(gtsam: Any, radians: float, metres: float) -> Any:
    return gtsam.noiseModel.Diagonal.Sigmas(np.array([radians] * 3 + [metres] * 3))


def _kernel(gtsam: Any, name: str) -> Any:
    """The robust kernel, with the constants of 95 % efficiency (Zhang 1997); None for least squares."""
    if name not in KERNELS:
        raise PnvError(f"kernel {name!r} given; allowed: {', '.join(KERNELS)}")
    estimators = gtsam.noiseModel.mEstimator
    return {
        "none": lambda: None,
        "huber": lambda: estimators.Huber.Create(1.345),
        "cauchy": lambda: estimators.Cauchy.Create(2.385),
        "geman_mcclure": lambda: estimators.GemanMcClure.Create(2.0),
        "dcs": lambda: estimators.DCS.Create(5.0),
    }[name]()
