"""Poses (4, 4) to and from messages. Only attributes are read."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, Transform, TransformStamped
from nav_msgs.msg import Path
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from msg_adapters.loop_closures import to_time

Array = NDArray[np.float64]


def matrix_of_pose(pose: Any) -> Array:
    """geometry_msgs/Pose -> (4, 4); NaN where the quaternion has no length."""
    q, p = pose.orientation, pose.position
    return _matrix((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))


def matrix_of_transform(transform: Any) -> Array:
    """geometry_msgs/Transform -> (4, 4); NaN where the quaternion has no length."""
    q, t = transform.rotation, transform.translation
    return _matrix((t.x, t.y, t.z), (q.x, q.y, q.z, q.w))


def set_pose(pose: Any, matrix: Array) -> None:
    """Fill a geometry_msgs/Pose."""
    pose.position.x, pose.position.y, pose.position.z = (float(v) for v in matrix[:3, 3])
    q = pose.orientation
    q.x, q.y, q.z, q.w = (float(v) for v in Rotation.from_matrix(matrix[:3, :3]).as_quat())


def transform_of(matrix: Array) -> Transform:
    """(4, 4) -> geometry_msgs/Transform."""
    transform = Transform()
    t, q = transform.translation, transform.rotation
    t.x, t.y, t.z = (float(v) for v in matrix[:3, 3])
    q.x, q.y, q.z, q.w = (float(v) for v in Rotation.from_matrix(matrix[:3, :3]).as_quat())
    return transform


def transform_stamped(matrix: Array, stamp_ns: int, parent: str, child: str) -> TransformStamped:
    """The child's frame in the parent's, as tf takes it."""
    message = TransformStamped(child_frame_id=child, transform=transform_of(matrix))
    message.header.stamp, message.header.frame_id = to_time(stamp_ns), parent
    return message


def path_message(stamps_ns: Sequence[int], poses: Array, frame: str) -> Path:
    """(n, 4, 4) poses as nav_msgs/Path, stamped as the last of them."""
    message = Path()
    message.header.frame_id = frame
    if len(stamps_ns):
        message.header.stamp = to_time(stamps_ns[-1])
    for stamp_ns, matrix in zip(stamps_ns, poses, strict=True):
        item = PoseStamped()
        item.header.frame_id, item.header.stamp = frame, to_time(stamp_ns)
        set_pose(item.pose, matrix)
        message.poses.append(item)
    return message


def _matrix(position: tuple[float, float, float], quaternion: tuple[float, float, float, float]) -> Array:
    matrix = np.eye(4)
    matrix[:3, 3] = position
    length = np.linalg.norm(quaternion)
    usable = np.isfinite(length) and length > 1e-6
    matrix[:3, :3] = Rotation.from_quat(quaternion).as_matrix() if usable else np.full((3, 3), np.nan)
    return matrix
