"""Poses (4, 4) to and from messages. Only attributes are read."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, Transform, TransformStamped
from nav_msgs.msg import Path
from numpy.typing import NDArray

from msg_adapters.loop_closures import to_time
from pnv_core.rotations import matrix_of, quaternion_of, rigid

Array = NDArray[np.float64]


def matrix_of_pose(pose: Any) -> Array:
    """geometry_msgs/Pose -> (4, 4); NaN where the quaternion has no length."""
    q, p = pose.orientation, pose.position
    return rigid(matrix_of((q.x, q.y, q.z, q.w)), (p.x, p.y, p.z))


def matrix_of_transform(transform: Any) -> Array:
    """geometry_msgs/Transform -> (4, 4); NaN where the quaternion has no length."""
    q, t = transform.rotation, transform.translation
    return rigid(matrix_of((q.x, q.y, q.z, q.w)), (t.x, t.y, t.z))


def set_pose(pose: Any, matrix: Array) -> None:
    """Fill a geometry_msgs/Pose."""
    pose.position.x, pose.position.y, pose.position.z = (float(v) for v in matrix[:3, 3])
    q = pose.orientation
    q.x, q.y, q.z, q.w = (float(v) for v in quaternion_of(matrix[:3, :3]))


def transform_of(matrix: Array) -> Transform:
    """(4, 4) -> geometry_msgs/Transform."""
    transform = Transform()
    t, q = transform.translation, transform.rotation
    t.x, t.y, t.z = (float(v) for v in matrix[:3, 3])
    q.x, q.y, q.z, q.w = (float(v) for v in quaternion_of(matrix[:3, :3]))
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
