"""The SLAM example: the graph against worlds whose true path is known."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("gtsam", reason="the SLAM example needs GTSAM")
pytest.importorskip("evo", reason="the SLAM example needs evo")

from examples.pose_graph.__main__ import live
from examples.pose_graph.back_end import Recording, between_nodes
from examples.pose_graph.drift import Drift, drifted
from examples.pose_graph.report import false_closures, trajectory_error, trial
from examples.pose_graph.sequences import world
from examples.publisher import odometry_message
from msg_adapters.poses import matrix_of_pose, path_message
from pnv_core.pose.graph import Loop, PoseGraph
from pnv_core.types import ImageRef, LoopClosure
from pnv_lab.worlds import Pose
from test.ros.processes import own_domain


def _circle(nodes: int, turns: float) -> np.ndarray:
    angles = np.linspace(0, 2 * np.pi * turns, nodes)
    return np.array([Pose(10 * np.cos(a), 10 * np.sin(a), 1.0, a + np.pi / 2).matrix() for a in angles])


def _closure(query_ns: int, match_ns: int, score: float = 0.9) -> LoopClosure:
    return LoopClosure(ImageRef(1, query_ns, ""), ImageRef(0, match_ns, ""), score, 0.8, 0.4, 40, True)


@pytest.fixture(scope="module")
def walk():
    return world("corridor", 1, 1.4, 1.0, 1.0)


@pytest.fixture(scope="module")
def true_closures(walk) -> Recording:
    """What a good recogniser says: now and then, a frame within 1.5 m of the query, seldom the nearest."""
    rng = np.random.default_rng(3)
    positions, stamps = walk.truth[:, :3, 3], walk.stamps_ns
    closures = []
    for query in range(100, len(stamps), 3):
        near = np.flatnonzero(np.linalg.norm(positions[: query - 60] - positions[query], axis=1) < 1.5)
        if len(near):
            closures.append(_closure(stamps[query], stamps[int(rng.choice(near))]))
    return Recording(closures)


def test_exact_odometry_stays_exact_without_closures() -> None:
    graph, truth = PoseGraph(), _circle(30, 1.0)
    for pose in truth:
        graph.add_node(pose)
    graph.update(settle=True)
    np.testing.assert_allclose(graph.poses, truth, atol=1e-6)


@pytest.mark.parametrize(("kernel", "left"), [("none", 1e-3), ("huber", 1e-3), ("cauchy", 0.03)])
def test_a_measured_relative_pose_pins_the_end_of_a_drifting_loop(kernel: str, left: float) -> None:
    """Cauchy's pull has a bound, so that odometry of so much drift holds against it a little."""
    truth = _circle(80, 1.2)
    graph = PoseGraph(kernel=kernel, support=0)
    for pose in drifted(truth, Drift(), 2):
        graph.add_node(pose)
    relative = np.linalg.inv(truth[3]) @ truth[70]
    graph.add_loop(Loop(70, 3, 1.0, relative, np.diag([1e-6] * 6)))
    graph.update(settle=True)
    found = np.linalg.inv(graph.poses[3]) @ graph.poses[70]
    np.testing.assert_allclose(found, relative, atol=left)


@pytest.mark.parametrize("seed", range(4))
def test_true_closures_halve_the_error_of_a_drifting_odometry(walk, true_closures, seed: int) -> None:
    odometry = drifted(walk.truth, walk.drift, seed)
    corrected = trial(walk, odometry, true_closures, robust=True)
    assert trajectory_error(walk.truth, corrected) < 0.5 * trajectory_error(walk.truth, odometry)


def test_the_robust_solution_survives_false_closures_that_ruin_least_squares(walk, true_closures) -> None:
    errors = []
    for seed in range(6):
        odometry = drifted(walk.truth, walk.drift, seed)
        false = false_closures(walk, len(true_closures.closures) // 2, seed)
        injected = Recording(true_closures.closures + false)
        tried = ((true_closures, True), (injected, True), (injected, False))
        errors.append([trajectory_error(walk.truth, trial(walk, odometry, c, robust)) for c, robust in tried])
    clean, robust, plain = np.array(errors).T
    assert (robust < clean + 0.15).all()
    assert np.median(robust) < 0.5 * np.median(plain)


def test_a_loop_to_a_node_that_does_not_exist_is_refused() -> None:
    graph = PoseGraph()
    graph.add_node(np.eye(4))
    with pytest.raises(ValueError, match="node 7 is not one of 0 to 0"):
        graph.add_loop(Loop(0, 7, 1.0, np.eye(4)))


def test_poses_survive_the_messages() -> None:
    pose = Pose(1.0, -2.0, 0.5, 2.5).matrix()
    stamped = path_message([1_500_000_000], pose[None], "map").poses[0]
    quaternion, position = stamped.pose.orientation, stamped.pose.position
    values = [position.x, position.y, position.z, quaternion.x, quaternion.y, quaternion.z, quaternion.w]
    np.testing.assert_allclose(matrix_of_pose(odometry_message(1_500_000_000, values).pose.pose), pose, atol=1e-12)
    assert (stamped.header.stamp.sec, stamped.header.stamp.nanosec) == (1, 500_000_000)


def test_poses_between_nodes_follow_their_node_by_odometry() -> None:
    truth = _circle(30, 1.0)
    stamps, nodes = list(range(0, 3000, 100)), [3, 9, 20]
    moved = Pose(5.0, -3.0, 0.0, 0.7).matrix()
    odometry = moved @ truth  # in another frame, which the nodes are not in
    found = between_nodes(stamps, odometry, [stamps[node] for node in nodes], truth[nodes])
    np.testing.assert_allclose(found, truth, atol=1e-9)


@pytest.mark.process
def test_a_short_walk_is_corrected_by_tf_bridge_as_a_process(monkeypatch) -> None:
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    with own_domain():
        short = replace(world("corridor", 1, 1.5, 2.0, 0.5), parameters={"exclude_recent_s": 15.0})
        odometry = drifted(short.truth, short.drift, 0)
        recording, corrected = live(short, odometry)
    assert len(recording.closures) > 5
    assert trajectory_error(short.truth, corrected) < 0.5 * trajectory_error(short.truth, odometry)
