"""A metric relative pose as a message."""

from geometry_msgs.msg import PoseWithCovarianceStamped

from msg_adapters.loop_closures import to_time
from pnv_core.errors import PnvError
from pnv_core.pose.geometry import RelativePose
from pnv_core.types import LoopClosure


def relative_pose_to_message(closure: LoopClosure, pose: RelativePose) -> PoseWithCovarianceStamped:
    """The query's camera (optical frame) in the frame `keyframe_<id of the match>`, stamped as the query's image.

    Raises PnvError for a pose without scale: a message has no way to say so.
    """
    if not pose.metric or pose.covariance is None:
        raise PnvError("relative pose without scale; allowed: a metric one, from depth or odometry")
    message = PoseWithCovarianceStamped()
    message.header.stamp = to_time(closure.query.stamp_ns)
    message.header.frame_id = f"keyframe_{closure.match.id}"
    position, orientation = message.pose.pose.position, message.pose.pose.orientation
    position.x, position.y, position.z = (float(v) for v in pose.translation)
    orientation.x, orientation.y, orientation.z, orientation.w = (float(v) for v in pose.quaternion)
    message.pose.covariance = [float(v) for v in pose.covariance.ravel()]
    return message
