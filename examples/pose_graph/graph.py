"""A pose graph on GTSAM: odometry between consecutive nodes, loop closures between far ones. Poses are (4, 4), metres.

A closure from one camera says "these two images show one place": it has no scale, so it does not say where exactly one
camera stood relative to the other. Without a measured relative pose a closure therefore only pulls the two nodes
towards each other, as loosely as the recogniser tolerates a change of viewpoint.
"""

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


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


@dataclass(frozen=True)
class Loop:
    """Two nodes of one place. `score` is P(same place), `relative` (4, 4) the query's pose as seen from the match."""

    query: int
    match: int
    score: float
    relative: Array | None = None
    covariance: Array | None = None  # (6, 6) of `relative`, order x, y, z, rotations about x, y, z


class PoseGraph:
    """Nodes along the odometry, loops between them. `robust` refuses loops that the rest of the graph contradicts.

    The robust solution is graduated non-convexity with truncated least squares (Yang et al., RA-L 2020), which starts
    from the convex problem and lets go of the loops that keep a large error; odometry is always believed.
    """

    def __init__(self, noise: Noise | None = None, robust: bool = True) -> None:
        self.noise, self.robust = noise or Noise(), robust
        self.loops: list[Loop] = []
        self.accepted: NDArray[np.bool_] = np.zeros(0, bool)  # by loop, after `optimise`
        self._odometry: list[Array] = []
        self._way: list[float] = []  # metres travelled at each node
        self._estimate: list[gtsam.Pose3] = []

    def __len__(self) -> int:
        return len(self._odometry)

    def add_odometry(self, pose: Array) -> int:
        """The next node, at an odometry pose (4, 4); its number."""
        if self._odometry:
            step = np.linalg.inv(self._odometry[-1]) @ pose
            self._way.append(self._way[-1] + float(np.linalg.norm(step[:3, 3])))
            self._estimate.append(self._estimate[-1].compose(_pose3(step)))
        else:
            self._way.append(0.0)
            self._estimate.append(_pose3(pose))
        self._odometry.append(pose)
        return len(self._odometry) - 1

    def add_loop(self, loop: Loop) -> None:
        """A closure between two nodes that exist. Raises ValueError for others."""
        for node in (loop.query, loop.match):
            if not 0 <= node < len(self):
                raise ValueError(f"node {node} is not one of 0 to {len(self) - 1}")
        self.loops.append(loop)

    def optimise(self) -> None:
        """Find the poses that agree best with all factors."""
        graph = gtsam.NonlinearFactorGraph()
        first = gtsam.noiseModel.Diagonal.Sigmas(np.full(6, 1e-6))
        graph.add(gtsam.PriorFactorPose3(0, _pose3(self._odometry[0]), first))
        for node in range(1, len(self)):
            step = np.linalg.inv(self._odometry[node - 1]) @ self._odometry[node]
            graph.add(gtsam.BetweenFactorPose3(node - 1, node, _pose3(step), self._odometry_noise(step)))
        believed = graph.size()
        for loop, model in zip(self.loops, self._loop_noises(), strict=True):
            relative = _pose3(np.eye(4) if loop.relative is None else loop.relative)
            graph.add(gtsam.BetweenFactorPose3(loop.match, loop.query, relative, model))
        initial = gtsam.Values()
        for node, pose in enumerate(self._estimate):
            initial.insert(node, pose)
        if self.robust and self.loops:
            parameters = gtsam.GncLMParams()
            parameters.setLossType(gtsam.GncLossType.TLS)
            parameters.setKnownInliers(list(range(believed)))
            optimiser = gtsam.GncLMOptimizer(graph, initial, parameters)
            optimiser.setInlierCostThresholdsAtProbability(0.99)
            result = optimiser.optimize()
            self.accepted = np.asarray(optimiser.getWeights())[believed:] > 0.5
        else:
            result = gtsam.LevenbergMarquardtOptimizer(graph, initial).optimize()
            self.accepted = np.ones(len(self.loops), bool)
        self._estimate = [result.atPose3(node) for node in range(len(self))]

    @property
    def poses(self) -> Array:
        """(n, 4, 4) corrected poses."""
        return np.array([pose.matrix() for pose in self._estimate]).reshape(-1, 4, 4)

    def _odometry_noise(self, step: Array) -> gtsam.noiseModel.Base:
        noise = self.noise
        metres = float(np.linalg.norm(step[:3, 3]))
        turned = np.degrees(np.arccos(np.clip((np.trace(step[:3, :3]) - 1) / 2, -1, 1)))
        yaw = np.deg2rad(0.02 + noise.odometry_deg_per_root_m * metres**0.5 + noise.odometry_deg_per_deg * turned)
        way = 0.002 + noise.odometry_per_m * metres
        tilt = 0.1 * yaw  # gravity is known to any robot with an accelerometer
        return gtsam.noiseModel.Diagonal.Sigmas(np.array([tilt, tilt, yaw, way, way, 0.3 * way]))

    def _loop_noises(self) -> list[gtsam.noiseModel.Base]:
        """Per loop; loops whose queries lie within the tolerance of each other share their error and their weight."""
        noise = self.noise
        way = np.array([self._way[loop.query] for loop in self.loops])
        crowd = (np.abs(way[:, None] - way[None]) <= noise.tolerance_m).sum(1) if len(way) else way
        models = []
        for loop, neighbours in zip(self.loops, crowd, strict=True):
            if loop.covariance is not None:
                order = [3, 4, 5, 0, 1, 2]  # GTSAM puts rotation first
                covariance = loop.covariance[np.ix_(order, order)] * neighbours
                models.append(gtsam.noiseModel.Gaussian.Covariance(covariance))
                continue
            scale = float(np.sqrt(neighbours / max(loop.score, 0.05)))
            angle, metres = np.deg2rad(noise.tolerance_deg) * scale, noise.tolerance_m * scale
            models.append(gtsam.noiseModel.Diagonal.Sigmas(np.array([angle, angle, angle, metres, metres, metres])))
        return models


def _pose3(matrix: Array) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3(matrix[:3, :3]), matrix[:3, 3])
