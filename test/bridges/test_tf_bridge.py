"""tf_bridge as its own process: what it broadcasts, and what it says when odometry or closures go wrong."""

import signal
import sys

import numpy as np
import pytest
from nav_msgs.msg import Odometry, Path
from std_srvs.srv import Trigger

pytest.importorskip("gtsam", reason="tf_bridge needs GTSAM")

from msg_adapters.images import stamp_of
from msg_adapters.poses import matrix_of_pose, matrix_of_transform
from pnv_ros.bridges.tf_bridge import _LATCHED
from test.bridges.running import Recogniser, closure, odometry_message, running
from test.pose.test_back_end import S, laps
from test.ros.processes import Process, ros_arguments, wait_until

pytestmark = pytest.mark.process
PACKAGES = ("tf2_msgs",)
READY = "corrects /odom"


def test_a_robot_with_odometry_is_corrected_on_tf_and_path(listener, tmp_path):
    from tf2_msgs.msg import TFMessage

    truth, odometry = laps(90)
    sent = listener.node.create_publisher(Odometry, "/odom", 500)
    transforms = listener.collect(TFMessage, "/tf", 100)
    paths = listener.collect(Path, "/tf_bridge/path", _LATCHED)
    graph = tmp_path / "graph.g2o"
    parameters = {"graph_path": graph, "tolerance_m": 0.5, "odometry_timeout_s": 2.5}
    with running("tf_bridge", READY, **parameters) as bridge:
        recogniser = Recogniser(listener, "/tf_bridge")
        wait_until(sent.get_subscription_count, 60, "the bridge")
        for i, given in enumerate(odometry):
            sent.publish(odometry_message(i * S, given))
            if i >= 64 and i % 4 == 0:
                recogniser.say(closure(i * S, (i - 60) * S), None)
        wait_until(lambda: len(transforms) >= 90, 60, "every transform")
        before = bridge.output.count("no odometry on /odom for ")  # a slow machine may have said it before the first
        wait_until(lambda: bridge.output.count("no odometry on /odom for ") > before, 60, "a word of silence")
        for i in (90, 91, 92, 93):
            sent.publish(odometry_message(i * S, odometry[-1]))
        wait_until(
            lambda: bridge.output.rfind("odometry is back") > bridge.output.rfind("no odometry on"), 60, "odometry"
        )
        wait_until(lambda: len(transforms) >= 94, 60, "the last transform")
        recogniser.say(closure(10**18, 5 * S), None)  # an image of another clock: waits for odometry for ever
        answer = listener.call(Trigger, "/tf_bridge/save", Trigger.Request())
        assert answer.success
        assert bridge.end(signal.SIGINT) == 0
        assert "Traceback" not in bridge.output
        assert "7 of 7 closures in the solution (0 unsupported), 1 waiting, refused: none" in bridge.output

    sent_at = [stamp_of(message.transforms[0]) for message in transforms]
    assert sent_at == [i * S + S // 10 for i in range(94)]  # one for each odometry, a tenth ahead
    frames = {(m.transforms[0].header.frame_id, m.transforms[0].child_frame_id) for m in transforms}
    assert frames == {("map", "odom")}
    corrected = matrix_of_transform(transforms[-1].transforms[0].transform) @ odometry[-1]
    drift, left = (np.linalg.norm((pose - truth[-1])[:3, 3]) for pose in (odometry[-1], corrected))
    assert left < 0.3 * drift
    poses = np.array([matrix_of_pose(p.pose) for p in paths[-1].poses])
    np.testing.assert_allclose(poses[-1], corrected, atol=0.05)
    assert graph.read_text().count("EDGE_SE3:QUAT") == 89 + 7


def test_jumps_bad_covariances_and_foreign_messages_are_said_and_survived(listener):
    _, odometry = laps(20)
    sent = listener.node.create_publisher(Odometry, "/odom", 500)
    with running("tf_bridge", READY) as bridge:
        recogniser = Recogniser(listener, "/tf_bridge")
        wait_until(sent.get_subscription_count, 60, "the bridge")
        for i, given in enumerate(odometry):
            sent.publish(odometry_message(i * S, given))
        far = odometry[-1].copy()
        far[0, 3] += 300
        sent.publish(odometry_message(20 * S, far))
        bridge.wait_for("odometry jumped 300")
        sent.publish(odometry_message(3 * S, odometry[3]))
        bridge.wait_for("odometry stepped back by 17.0 s")
        broken = odometry[4].copy()
        broken[1, 3] = np.nan
        sent.publish(odometry_message(4 * S, broken))
        bridge.wait_for("is not a finite pose; passed over")
        from msg_adapters.relative_pose import relative_pose_to_message
        from test.bridges.running import METRIC

        message = relative_pose_to_message(closure(5 * S, 3 * S), METRIC)
        message.pose.covariance[0] = np.nan
        recogniser.poses.publish(message)
        bridge.wait_for("has no finite, positive covariance")
        message.header.frame_id = "camera"
        recogniser.poses.publish(message)
        bridge.wait_for("allowed: keyframe_<id of the match>")
        assert bridge.end(signal.SIGTERM) == 0
        assert "Traceback" not in bridge.output


def test_either_side_may_be_restarted(listener):
    from tf2_msgs.msg import TFMessage

    _, odometry = laps(90)
    sent = listener.node.create_publisher(Odometry, "/odom", 500)
    transforms = listener.collect(TFMessage, "/tf", 500)
    recogniser = Process(sys.executable, "-c", SAYS_AGAIN)  # as place_recognizer does, it keeps what it said
    try:
        recogniser.wait_for("said")
        with running("tf_bridge", READY) as bridge:
            wait_until(sent.get_subscription_count, 60, "the bridge")
            listener.met_by("/tf_bridge")
            for i in range(40):
                sent.publish(odometry_message(i * S, odometry[i]))
            wait_until(lambda: len(transforms) >= 40, 60, "transforms")
            bridge.child.kill()
            bridge.wait()
        assert recogniser.child.poll() is None
        wait_until(lambda: not sent.get_subscription_count(), 60, "the killed bridge to be gone")
        with running("tf_bridge", READY) as bridge:
            wait_until(sent.get_subscription_count, 60, "the bridge that came back")
            listener.met_by("/tf_bridge")
            for i in range(40, 60):
                sent.publish(odometry_message(i * S, odometry[i]))
            bridge.wait_for("loop closure 30.000 - 5.000 dropped: no odometry at the query and match")
            wait_until(lambda: len(transforms) >= 60, 60, "transforms again")
            recogniser.end(signal.SIGKILL)
            restarted = Recogniser(listener, "/tf_bridge")
            restarted.say(closure(58 * S, 42 * S), None)
            for i in range(60, 64):
                sent.publish(odometry_message(i * S, odometry[i]))
            wait_until(lambda: len(transforms) >= 64, 60, "transforms after the recogniser was restarted")
            assert bridge.end(signal.SIGINT) == 0
        assert "Traceback" not in bridge.output
        assert "0 of 1 closures in the solution (1 unsupported)" in bridge.output
    finally:
        if recogniser.child.poll() is None:
            recogniser.end(signal.SIGKILL)
    stamps = [stamp_of(message.transforms[0]) for message in transforms]
    assert stamps == sorted(set(stamps))


SAYS_AGAIN = """
import time, rclpy
from std_msgs.msg import Float64MultiArray
from msg_adapters.loop_closures import closures_to_message
from pnv_ros.outputs import CLOSURES_QOS
from test.bridges.running import S, closure
rclpy.init()
node = rclpy.create_node("place_recognizer")
publisher = node.create_publisher(Float64MultiArray, "/loop_closures", CLOSURES_QOS)
publisher.publish(closures_to_message([closure(30 * S, 5 * S)], ["c"]))
print("said", flush=True)
rclpy.spin(node)
"""


@pytest.mark.parametrize(
    ("parameters", "missing", "words"),
    [
        ({"kernel": "tukey"}, "", "kernel = 'tukey' is out of range; allowed: one of none, huber, cauchy"),
        ({"graph_path": "/nowhere/graph.g2o"}, "", "allowed: a file in a folder that exists"),
        ({}, "gtsam", "no GTSAM on this machine; allowed: after pip install gtsam"),
        ({}, "tf2_msgs", "no tf2_msgs on this machine; allowed: after apt-get install ros-jazzy-tf2-msgs"),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(domain, parameters, missing, words):
    code = f"import sys; sys.modules['{missing}'] = None; from pnv_ros.bridges.tf_bridge import main; sys.exit(main())"
    process = Process(sys.executable, "-c", code, *ros_arguments(**parameters))
    assert process.wait() == 2
    assert words in process.output
    assert "Traceback" not in process.output
