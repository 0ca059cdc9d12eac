"""LoopClosure lists as pnv_msgs/LoopClosureArray, the typed twin of `/loop_closures`.

pnv_msgs is a package of its own that not every machine has: it is imported when a message is made.
"""

from array import array
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovariance
from numpy.typing import NDArray

from msg_adapters.loop_closures import to_time
from pnv_core.pose.geometry import RelativePose
from pnv_core.types import ImageRef, LoopClosure, Reason


def typed_type() -> Any:
    """The class LoopClosureArray, or None where pnv_msgs is not on this machine."""
    try:
        from pnv_msgs.msg import LoopClosureArray
    except ImportError:
        return None
    return LoopClosureArray


def closures_to_typed(
    closures: Sequence[LoopClosure], poses: Mapping[int, RelativePose] | None = None, robot: str = ""
) -> Any:
    """N closures of one query -> pnv_msgs/LoopClosureArray in the given order.

    `poses` by position in `closures`; `robot` is the name of images that carry none.

    Raises ImportError where pnv_msgs is not on the machine.
    """
    from pnv_msgs.msg import LoopClosure as Typed
    from pnv_msgs.msg import LoopClosureArray

    message, poses = LoopClosureArray(), poses or {}
    for number, closure in enumerate(closures):
        typed = Typed(
            query=_ref_to_message(closure.query, robot),
            match=_ref_to_message(closure.match, robot),
            score=float(closure.score),
            similarity=float(closure.similarity),
            spatial=float(closure.spatial),
            inliers=int(closure.inliers),
            accepted=bool(closure.accepted),
            reason=str(closure.reason),
        )
        typed.header.stamp, typed.header.frame_id = to_time(closure.query.stamp_ns), closure.query.camera
        if number in poses:
            typed.pose, typed.pose_kind = _pose_to_message(poses[number]), _kind(poses[number])
        message.closures.append(typed)
    if closures:
        message.header = message.closures[0].header
    return message


def keyframe_to_typed(ref: ImageRef, vector: NDArray[np.float32], thumbnail: bytes, robot: str = "") -> Any:
    """A keyframe, its global vector (D,) and small picture -> pnv_msgs/Keyframe.

    Raises ImportError where pnv_msgs is not on the machine.
    """
    from pnv_msgs.msg import Keyframe

    message = Keyframe(image=_ref_to_message(ref, robot), descriptor=vector.tolist())
    message.thumbnail = array("B", thumbnail)
    return message


def closures_from_typed(message: Any) -> list[LoopClosure]:
    """The closures of a LoopClosureArray, in order; what they say of the relative pose is in the message itself."""
    return [
        LoopClosure(
            query=_ref_from_message(typed.query),
            match=_ref_from_message(typed.match),
            score=typed.score,
            similarity=typed.similarity,
            spatial=typed.spatial,
            inliers=typed.inliers,
            accepted=typed.accepted,
            reason=Reason(typed.reason),
        )
        for typed in message.closures
    ]


def _ref_to_message(ref: ImageRef, robot: str) -> Any:
    from pnv_msgs.msg import ImageRef as Message

    return Message(stamp=to_time(ref.stamp_ns), camera=ref.camera, session=ref.session,
                   robot=ref.robot or robot, id=ref.id)  # fmt: skip


def _ref_from_message(message: Any) -> ImageRef:
    stamp_ns = message.stamp.sec * 1_000_000_000 + message.stamp.nanosec
    return ImageRef(message.id, stamp_ns, message.camera, message.session, message.robot)


def _kind(pose: RelativePose) -> int:
    from pnv_msgs.msg import LoopClosure as Typed

    return Typed.METRIC if pose.metric else Typed.DIRECTION


def _pose_to_message(pose: RelativePose) -> PoseWithCovariance:
    message = PoseWithCovariance()
    position, orientation = message.pose.position, message.pose.orientation
    position.x, position.y, position.z = (float(v) for v in pose.translation)
    orientation.x, orientation.y, orientation.z, orientation.w = (float(v) for v in pose.quaternion)
    message.covariance = [float(v) for v in pose.covariance.ravel()]
    return message
