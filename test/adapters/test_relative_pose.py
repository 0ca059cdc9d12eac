"""Relative poses as messages, and pose graphs as other programs read them."""

import cv2
import numpy as np
import pytest

from msg_adapters.relative_pose import relative_pose_to_message
from pnv_core.errors import PnvError
from pnv_core.pose.export import GraphPose, closures_to_csv, graph_to_g2o
from pnv_core.pose.geometry import RelativePose
from pnv_core.types import Evidence, ImageRef, LoopClosure

TURN = cv2.Rodrigues(np.array([0.1, -0.4, 0.2]))[0]
METRIC = RelativePose(TURN, np.array([1.0, 2.0, 3.0]), True, 40, np.diag([0.1, 0.2, 0.3, 0.01, 0.02, 0.03]))
DIRECTION = RelativePose(TURN, np.array([1.0, 0.0, 0.0]), False, 40, np.eye(6))
CLOSURE = LoopClosure(
    ImageRef(3, 100_000_000_007, "front"), ImageRef(0, 5, "front"), 0.9, 0.5, 0.25, 60, True,
    evidence=Evidence(0.5, 0.25, 60, spread=0.4, local_inliers=31),
)  # fmt: skip


def test_a_metric_pose_is_in_the_frame_of_its_keyframe_at_the_stamp_of_the_query():
    message = relative_pose_to_message(CLOSURE, METRIC)
    assert message.header.frame_id == "keyframe_0"
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (100, 7)
    q = message.pose.pose.orientation
    x, y, z, w = q.x, q.y, q.z, q.w
    turned = [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)]  # first column of the matrix
    assert turned == pytest.approx(list(TURN[:, 0]))
    assert [message.pose.pose.position.x, message.pose.pose.position.z] == [1.0, 3.0]
    assert list(message.pose.covariance[::7]) == [0.1, 0.2, 0.3, 0.01, 0.02, 0.03]


def test_a_pose_without_scale_is_no_message():
    with pytest.raises(PnvError, match="scale"):
        relative_pose_to_message(CLOSURE, DIRECTION)


def test_another_solver_reads_the_graph_and_finds_the_measured_loop(tmp_path):
    gtsam = pytest.importorskip("gtsam")
    rng = np.random.default_rng(0)
    nodes = {}
    for i in range(4):
        vector = rng.normal(0, 0.3, 3)
        half = np.linalg.norm(vector) / 2
        quaternion = np.append(vector / (2 * half) * np.sin(half), np.cos(half))
        nodes[i] = GraphPose(rng.normal(0, 2, 3), quaternion)
    path = tmp_path / "graph.g2o"
    path.write_text(graph_to_g2o(nodes, [(CLOSURE, METRIC), (CLOSURE, DIRECTION), (CLOSURE, None)]))
    graph, values = gtsam.readG2o(str(path), True)
    assert (graph.size(), values.size()) == (4, 4)
    odometry = gtsam.NonlinearFactorGraph()
    for k in range(3):
        odometry.add(graph.at(k))
    assert odometry.error(values) == pytest.approx(0.0, abs=1e-6)
    loop = graph.at(3)
    assert list(loop.keys()) == [0, 3]
    assert np.allclose(loop.measured().matrix()[:3, :3], TURN, atol=1e-6)
    assert np.allclose(loop.measured().translation(), [1, 2, 3])
    assert path.read_text().count("# closure 0 3") == 2


def test_the_table_of_closures_keeps_whole_nanoseconds():
    header, row = closures_to_csv([CLOSURE]).splitlines()
    table = dict(zip(header.split(","), row.split(","), strict=True))
    assert table["query_stamp_ns"] == "100000000007"
    assert (table["local_inliers"], table["accepted"], table["reason"]) == ("31", "1", "")
