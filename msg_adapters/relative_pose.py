"""A metric relative pose as a message."""

from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from numpy.typing import NDArray

from msg_adapters.loop_closures import to_time
from msg_adapters.poses import matrix_of_pose
from pnv_core.errors import PnvError
from pnv_core.pose.geometry import RelativePose
from pnv_core.types import LoopClosure


def relative_pose_to_message(closure: LoopClosure, pose: RelativePose) -> PoseWithCovarianceStamped:
    """The query's camera (optical frame) in the frame `keyframe_<id of the match>`, stamped as the query's image.

    Raises PnvError for a pose without scale: a message has no way to say so.
    """
    if not pose.metric:
        raise PnvError("relative pose without scale; allowed: a metric one, from depth or odometry")
    message = PoseWithCovarianceStamped()
    message.header.stamp = to_time(closure.query.stamp_ns)
    message.header.frame_id = f"keyframe_{closure.match.id}"
    position, orientation = message.pose.pose.position, message.pose.pose.orientation
    position.x, position.y, position.z = (float(v) for v in pose.translation)
    orientation.x, orientation.y, orientation.z, orientation.w = (float(v) for v in pose.quaternion)
    message.pose.covariance = [float(v) for v in pose.covariance.ravel()]
    return message


def relative_pose_from_message(message: Any) -> tuple[int, NDArray[np.float64], NDArray[np.float64]]:
    """Id of the match, the query's camera (4, 4) in the match's, covariance (6, 6) with position first.

    Raises PnvError for a frame that names no keyframe.
    """
    name, _, number = message.header.frame_id.rpartition("_")
    if name != "keyframe" or not number.isdigit():
        raise PnvError(f"relative pose in the frame {message.header.frame_id!r}; allowed: keyframe_<id of the match>")
    return int(number), matrix_of_pose(message.pose.pose), np.reshape(message.pose.covariance, (6, 6)).copy()
