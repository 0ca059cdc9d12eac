"""Ground truth from positions and poses. N images; a pose is (4, 4), camera (or body) to world."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pnv_core.rotations import matrix_of, quaternion_of, rigid
from pnv_lab.evaluation.datasets.dataset import NONE, Indices

Floats = NDArray[np.float64]


def within_radius(queries: Floats, references: Floats, radius: float) -> tuple[Indices, ...]:
    """(Q, d), (R, d) positions -> per query the references at most `radius` away, in order."""
    found = cKDTree(references).query_ball_point(queries, radius, return_sorted=True)
    return tuple(np.array(f, np.int64) if len(f) else NONE for f in found)


def turned(a: Floats, b: Floats) -> Floats:
    """(..., 3, 3), (..., 3, 3) rotations -> the angle between them in degrees."""
    trace = np.einsum("...ij,...ij->...", a, b)
    return np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))


def within_pose(queries: Floats, references: Floats, radius: float, angle: float) -> tuple[Indices, ...]:
    """(Q, 4, 4), (R, 4, 4) -> per query the references at most `radius` away and turned by at most `angle` degrees.

    A query pose of NaN (unknown) has no true reference.
    """
    known = np.isfinite(queries.sum((1, 2)))
    near = iter(within_radius(queries[known, :3, 3], references[:, :3, 3], radius))
    truth = []
    for pose, is_known in zip(queries, known, strict=True):
        candidates = next(near) if is_known else NONE
        angles = turned(pose[None, :3, :3], references[candidates, :3, :3])
        truth.append(candidates[angles <= angle])
    return tuple(truth)


def pose_errors(estimated: Floats, true: Floats) -> tuple[Floats, Floats]:
    """(N, 4, 4) each -> distances in metres and angles in degrees."""
    return np.linalg.norm(estimated[:, :3, 3] - true[:, :3, 3], axis=1), turned(estimated[:, :3, :3], true[:, :3, :3])


def rotation(w: float, x: float, y: float, z: float) -> Floats:
    """(3, 3) of a quaternion. Raises ValueError for a zero one."""
    if not np.linalg.norm((w, x, y, z)) > 0:
        raise ValueError("quaternion of length 0")
    return matrix_of((x, y, z, w))


def quaternion(matrix: Floats) -> tuple[float, float, float, float]:
    """(w, x, y, z), w >= 0, of a (3, 3) rotation."""
    x, y, z, w = quaternion_of(matrix)
    return float(w), float(x), float(y), float(z)


def pose(rotation_matrix: Floats, position: Sequence[float] | Floats) -> Floats:
    """(4, 4) from (3, 3) and (3,)."""
    return rigid(rotation_matrix, position)


def pose_from_world_rotation(quaternion_wxyz: Sequence[float], centre: Sequence[float]) -> Floats:
    """Camera to world from a world-to-camera quaternion and the camera's centre (NVM and the CMU lists)."""
    return pose(rotation(*quaternion_wxyz).T, centre)


def heading(yaw: float, position: Sequence[float]) -> Floats:
    """(4, 4) turned by `yaw` radians about the vertical."""
    c, s = np.cos(yaw), np.sin(yaw)
    return pose(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]), position)
