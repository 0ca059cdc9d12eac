"""The typed twin of /loop_closures: what goes through pnv_msgs and its serialisation, and what needs none of it."""

import subprocess
import sys

import numpy as np
import pytest

from msg_adapters.typed_closures import closures_from_typed, closures_to_typed, typed_type
from pnv_core.pose.geometry import RelativePose
from pnv_core.types import ImageRef, LoopClosure, Reason

QUERY = ImageRef(7, 1_700_000_100_123_456_789, "/front/image_raw", 2)
MATCH = ImageRef(3, 1_700_000_000_999_999_999, "/rear/image_raw", 1, "ant")


def closures():
    return [
        LoopClosure(QUERY, MATCH, 0.75, 0.5, 0.25, 40, True),
        LoopClosure(QUERY, MATCH, 0.125, 0.5, 0.0, 3, False, Reason.LOW_SCORE),
    ]


@pytest.fixture
def sent():
    """A function that sends a message through the middleware's serialisation."""
    from rclpy.serialization import deserialize_message, serialize_message

    kind = typed_type()
    if kind is None:
        pytest.skip("pnv_msgs is not built")
    return lambda message: deserialize_message(serialize_message(message), kind)


def test_closures_survive_the_wire(sent):
    received = sent(closures_to_typed(closures(), robot="bee"))
    (first, second), images = closures_from_typed(received), [c.query.robot for c in received.closures]
    assert images == ["bee", "bee"]
    assert (first.match, first.score, first.inliers, first.accepted) == (MATCH, 0.75, 40, True)
    assert (first.query.stamp_ns, first.query.id, first.query.camera) == (QUERY.stamp_ns, QUERY.id, QUERY.camera)
    assert second.reason is Reason.LOW_SCORE
    assert (received.header.stamp.sec, received.header.stamp.nanosec) == (1_700_000_100, 123_456_789)


def test_a_relative_pose_says_whether_it_is_metric(sent):
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    covariance = np.arange(36.0).reshape(6, 6)
    metric = RelativePose(turn, np.array([1.0, 2.0, 3.0]), True, 20, covariance)
    direction = RelativePose(turn, np.array([0.0, 0.0, 1.0]), False, 20, 2 * covariance)
    one, other, none = sent(closures_to_typed([*closures(), closures()[0]], {0: metric, 1: direction})).closures
    assert (one.pose_kind, other.pose_kind, none.pose_kind) == (one.METRIC, one.DIRECTION, one.NO_POSE)
    assert one.pose.covariance.tolist() == covariance.ravel().tolist()
    assert (one.pose.pose.position.x, one.pose.pose.position.y, one.pose.pose.position.z) == (1.0, 2.0, 3.0)
    quaternion = one.pose.pose.orientation
    assert (quaternion.z, quaternion.w) == pytest.approx((0.5**0.5, 0.5**0.5))
    assert other.pose.covariance.tolist() == (2 * covariance).ravel().tolist()


def test_the_node_and_its_adapters_import_without_pnv_msgs():
    code = (
        "import sys; sys.modules['pnv_msgs'] = None\n"  # what an import finds where the package is missing
        "import pnv_ros.node, msg_adapters.typed_closures as t\n"
        "assert t.typed_type() is None"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
