"""Rotations as (3, 3) matrices, quaternions (x, y, z, w) and rotation vectors, and rigid poses (4, 4)."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

OPTICAL_IN_BODY = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # looks ahead from its origin


def matrix_of(quaternion: Sequence[float] | Array) -> Array:
    """(..., 4) as x, y, z, w, of any length -> (..., 3, 3); NaN where the length is 0 or not finite."""
    q = np.asarray(quaternion, np.float64)
    length = np.linalg.norm(q, axis=-1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y, z, w = np.moveaxis(np.where(length > 1e-6, q / length, np.nan), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_of(matrix: Array) -> Array:
    """(..., 3, 3) -> (..., 4) as x, y, z, w, of length 1, w >= 0.

    The eigenvector of Bar-Itzhack 2000 (version 2): stable at every angle.
    """
    m = np.asarray(matrix, np.float64)
    k = np.empty((*m.shape[:-2], 4, 4))
    k[..., :3, :3] = m + np.swapaxes(m, -1, -2)
    trace = np.trace(m, axis1=-2, axis2=-1)
    k[..., range(3), range(3)] -= trace[..., None]
    k[..., 3, 0] = k[..., 0, 3] = m[..., 2, 1] - m[..., 1, 2]
    k[..., 3, 1] = k[..., 1, 3] = m[..., 0, 2] - m[..., 2, 0]
    k[..., 3, 2] = k[..., 2, 3] = m[..., 1, 0] - m[..., 0, 1]
    k[..., 3, 3] = trace
    q = np.linalg.eigh(k)[1][..., -1]
    return np.where(q[..., 3:] < 0, -q, q)


def exponential(vector: Array) -> Array:
    """A rotation vector (3,) in radians -> (3, 3)."""
    return cv2.Rodrigues(np.asarray(vector, np.float64))[0]


def logarithm(matrix: Array) -> Array:
    """(3, 3) -> the rotation vector (3,) in radians; small ones too, which cv2.Rodrigues takes for none."""
    *axis, w = quaternion_of(matrix)
    length = np.linalg.norm(axis)
    return np.array(axis) * (2 * np.arctan2(length, w) / length if length > 0 else 2.0)


def angle_of(matrix: Array) -> Array:
    """(..., 3, 3) -> how far they turn (...), radians."""
    return np.arccos(np.clip((np.trace(matrix, axis1=-2, axis2=-1) - 1) / 2, -1.0, 1.0))


def from_euler(roll: float, pitch: float, yaw: float) -> Array:
    """(3, 3): about x, then about the old y, then about the old z, radians, as ROS writes mounts."""
    about_x, about_y, about_z = (exponential(axis * a) for axis, a in zip(np.eye(3), (roll, pitch, yaw), strict=True))
    return about_z @ about_y @ about_x


def rigid(rotation: Array, translation: Sequence[float] | Array) -> Array:
    """(3, 3) and (3,) -> (4, 4)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation
    return pose


def mount_of(numbers: Sequence[float]) -> Array:
    """x, y, z, roll, pitch, yaw of a camera's housing, which looks along x -> its optical frame on the body, (4, 4)."""
    return rigid(from_euler(*numbers[3:]), numbers[:3]) @ OPTICAL_IN_BODY


def inverse(pose: Array) -> Array:
    """Of rigid poses (..., 4, 4)."""
    out = np.zeros_like(pose)
    turned = np.swapaxes(pose[..., :3, :3], -1, -2)
    out[..., :3, :3], out[..., 3, 3] = turned, 1.0
    out[..., :3, 3] = -(turned @ pose[..., :3, 3:])[..., 0]
    return out


def cross_matrix(vector: Array) -> Array:
    """(3,) -> the (3, 3) that takes x to the cross product vector * x."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def transported(covariance: Array, pose: Array, before: Array, after: Array) -> Array:
    """The covariance (6, 6) of before @ pose @ after where that of `pose` is known and the others are exact.

    As ROS has it: position, then rotation about the fixed axes of the frame a pose is in.
    """
    turned, arm = before[:3, :3], pose[:3, :3] @ after[:3, 3]
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = jacobian[3:, 3:] = turned
    jacobian[:3, 3:] = -turned @ cross_matrix(arm)
    return jacobian @ covariance @ jacobian.T


def local_covariance(covariance: Array, pose: Array) -> Array:
    """ROS's covariance (6, 6) of a pose about the axes of its own frame, as pose graphs (GTSAM, g2o) have it."""
    turn = np.kron(np.eye(2), pose[:3, :3].T)
    return turn @ covariance @ turn.T


def inverted(covariance: Array, pose: Array) -> Array:
    """The covariance (6, 6) of the inverse of `pose` (4, 4), in the same convention."""
    turned = pose[:3, :3].T
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = jacobian[3:, 3:] = -turned
    jacobian[:3, 3:] = -turned @ cross_matrix(pose[:3, 3])
    return jacobian @ covariance @ jacobian.T
