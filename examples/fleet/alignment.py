"""Two robots' odometries in one frame, by the closures between them: a pose graph in the plane, on GTSAM."""

import gtsam
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_STEP = (0.03, 0.03, 0.02)  # metres, metres, radians: deviation of a step of odometry
_CLOSURE = (1.0, 1.0, 0.2)  # how far apart two images of one place are taken


def planar(poses: Array) -> Array:
    """(n, 4, 4) -> (n, 3) of x, y, yaw."""
    return np.column_stack([poses[:, 0, 3], poses[:, 1, 3], np.arctan2(poses[:, 1, 0], poses[:, 0, 0])])


def merged(odometries: dict[str, Array], closures: list[tuple[str, int, str, int]]) -> dict[str, Array]:
    """(n, 3) odometry of each robot in a frame of its own, closures (robot, node, robot, node) -> (n, 3) in one frame.

    The first robot's start is the frame. Closures are weighted by Geman and McClure's robust loss, first guesses come
    from the median closure. Raises ValueError where a robot has no closure.
    """
    names = list(odometries)
    keys = {name: [gtsam.symbol(chr(ord("a") + i), n) for n in range(len(odometries[name]))]
            for i, name in enumerate(names)}  # fmt: skip
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    step, place = (gtsam.noiseModel.Diagonal.Sigmas(np.array(s)) for s in (_STEP, _CLOSURE))
    robust = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.GemanMcClure.Create(1.0), place)
    first = names[0]
    graph.add(gtsam.PriorFactorPose2(keys[first][0], gtsam.Pose2(*odometries[first][0]), step))
    for name in names:
        poses = [gtsam.Pose2(*row) for row in odometries[name]]
        move = gtsam.Pose2() if name == first else _guess(odometries, closures, first, name)
        for n, pose in enumerate(poses):
            values.insert(keys[name][n], move.compose(pose))
            if n:
                graph.add(gtsam.BetweenFactorPose2(keys[name][n - 1], keys[name][n], poses[n - 1].between(pose), step))
    for a, i, b, j in closures:
        graph.add(gtsam.BetweenFactorPose2(keys[a][i], keys[b][j], gtsam.Pose2(), robust))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    read = {name: [found.atPose2(key) for key in keys[name]] for name in names}
    return {name: np.array([[p.x(), p.y(), p.theta()] for p in poses]) for name, poses in read.items()}


def _guess(
    odometries: dict[str, Array], closures: list[tuple[str, int, str, int]], first: str, name: str
) -> gtsam.Pose2:
    """Of the moves that single closures give, the one that most others agree with."""
    pairs = [(i, j) if a == first else (j, i) for a, i, b, j in closures if {a, b} == {first, name}]
    if not pairs:
        raise ValueError(f"no closure between {first} and {name}")
    moves = [gtsam.Pose2(*odometries[first][i]).compose(gtsam.Pose2(*odometries[name][j]).inverse()) for i, j in pairs]
    ours = np.array([odometries[first][i][:2] for i, _ in pairs])
    theirs = np.array([odometries[name][j][:2] for _, j in pairs])

    def agreeing(move: gtsam.Pose2) -> int:
        moved = np.array([move.transformFrom(point) for point in theirs])
        return int((np.linalg.norm(moved - ours, axis=1) < 3.0).sum())

    return max(moves, key=agreeing)
