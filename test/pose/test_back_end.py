"""The pose graph by stamps against paths whose truth is known, with odometry and closures that go wrong."""

import numpy as np
import pytest

pytest.importorskip("gtsam", reason="the back end needs GTSAM")

from pnv_core.errors import PnvError
from pnv_core.pose.back_end import BackEnd
from pnv_core.pose.export import pose_graph_to_g2o
from pnv_core.pose.graph import Noise, PoseGraph
from pnv_core.rotations import OPTICAL_IN_BODY
from pnv_core.types import ImageRef, LoopClosure

S = 1_000_000_000


def pose(x, y, heading=0.0):
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, 0], [0, 0, 0, 1.0]])


def laps(count, laps_m=60, side=15.0):
    """A square walked at 1 m/s, one pose a second; its odometry turns too far by half a degree per metre."""
    truth, drifted = [], []
    for i in range(count):
        edge, along = divmod(i % laps_m, side)
        corner = [(0, 0), (side, 0), (side, side), (0, side)][int(edge)]
        heading = edge * np.pi / 2
        truth.append(pose(corner[0] + along * np.cos(heading), corner[1] + along * np.sin(heading), heading))
    for i, true in enumerate(truth):
        drifted.append(
            true if i == 0 else drifted[-1] @ np.linalg.inv(truth[i - 1]) @ true @ pose(0.0, 0.0, np.deg2rad(0.5))
        )
    return np.array(truth), np.array(drifted)


def closure(query_ns, match_ns, match_id=0, score=0.9):
    return LoopClosure(ImageRef(1, query_ns, ""), ImageRef(match_id, match_ns, ""), score, 0.8, 0.4, 40, True)


def walked(count, start_s=0):
    truth, odometry = laps(count)
    back_end = BackEnd(PoseGraph(Noise(tolerance_m=0.5)))
    for i, given in enumerate(odometry):
        back_end.add_odometry((start_s + i) * S, given)
    return back_end, truth, odometry


def error(back_end, truth, odometry):
    """Distance of the corrected last pose from the true one."""
    return np.linalg.norm((back_end.map_from_odom @ odometry[-1] - truth[-1])[:3, 3])


def test_closures_bring_a_drifting_robot_back():
    back_end, truth, odometry = walked(90)
    back_end.update()
    before = error(back_end, truth, odometry)
    back_end.add_closures([closure(i * S, (i - 60) * S) for i in range(64, 90, 4)])
    assert back_end.update(everything=True)
    assert before > 3
    assert error(back_end, truth, odometry) < 0.3 * before


def test_a_measured_pose_between_nodes_is_carried_to_them_by_odometry():
    back_end, truth, _ = walked(80)
    for query, match in ((70.4, 10.2), (72.0, 12.6)):
        at = [truth[int(t)] @ pose(t % 1, 0) for t in (query, match)]
        camera = np.linalg.inv(OPTICAL_IN_BODY) @ np.linalg.inv(at[1]) @ at[0] @ OPTICAL_IN_BODY
        back_end.add_relative_pose(round(query * S), 7, camera, np.diag([1e-4] * 6))
        back_end.add_closures([closure(round(query * S), round(match * S), 7)])
    assert back_end.update(everything=True)
    poses = back_end.graph.poses
    found, true = (np.linalg.inv(p[10]) @ p[70] for p in (poses, truth))
    np.testing.assert_allclose(found, true, atol=0.05)


def test_a_closure_that_no_other_supports_changes_nothing():
    back_end, _, _ = walked(90)
    back_end.add_closures([closure(75 * S, 40 * S), closure(88 * S, 3 * S)])
    assert not back_end.update(everything=True)
    np.testing.assert_allclose(back_end.map_from_odom, np.eye(4), atol=1e-6)
    assert (back_end.taken, sum(back_end.graph.entered)) == (2, 0)


@pytest.mark.parametrize("share", [0.05, 0.15, 0.3])
def test_wrong_closures_do_not_spoil_the_correction(share):
    back_end, truth, _ = walked(180)
    rng = np.random.default_rng(5)
    right = [closure(i * S, (i - 60) * S) for i in range(62, 180, 2)]
    wrong = []
    while len(wrong) < share / (1 - share) * len(right):
        query, match = sorted(rng.integers(0, 180, 2), reverse=True)
        if np.linalg.norm((truth[query] - truth[match])[:3, 3]) > 5:
            wrong.append(closure(int(query) * S, int(match) * S))
    every = sorted(right + wrong, key=lambda c: c.query.stamp_ns)
    back_end.add_closures(every)
    back_end.update(everything=True)
    assert np.linalg.norm((back_end.graph.poses - truth)[:, :3, 3], axis=1).mean() < 1.0


def test_odometry_that_jumps_begins_anew_where_the_robot_was_and_a_closure_tells_where_it_is():
    back_end, _, odometry = walked(40)
    shift = pose(500, -200, 2.0)
    for i in range(40, 80):
        back_end.add_odometry(i * S, shift @ laps(80)[1][i])
        back_end.update()
        if i == 40:
            here = back_end.map_from_odom @ shift @ laps(80)[1][40]
            assert np.linalg.norm((here - odometry[39])[:3, 3]) < 0.01
    assert back_end.refused["jumps"] == 1
    assert "odometry jumped" in back_end.complaints[0]
    back_end.add_closures([closure(i * S, (i - 60) * S) for i in range(64, 80, 4)])
    back_end.update(everything=True)
    here = back_end.map_from_odom @ shift @ laps(80)[1][79]
    assert np.linalg.norm((here - laps(80)[0][79])[:3, 3]) < 1.5


def test_odometry_that_goes_back_in_time_keeps_the_poses_and_drops_what_waited():
    back_end, _, odometry = walked(30, start_s=1000)
    back_end.add_closures([closure(2000 * S, 1003 * S)])
    back_end.add_odometry(5 * S, odometry[0])
    back_end.add_odometry(6 * S, odometry[1])
    back_end.update()
    assert len(back_end.graph) == 32
    assert back_end.waiting == 0
    assert "stepped back by 1024.0 s" in back_end.complaints[0]
    back_end.add_closures([closure(6 * S, 1003 * S)])
    back_end.update(everything=True)
    assert "no odometry at the match" in back_end.complaints[-1]


def test_late_and_broken_odometry_is_passed_over():
    back_end, _, odometry = walked(5)
    back_end.add_odometry(round(3.5 * S), odometry[3])
    broken = odometry[4].copy()
    broken[0, 3] = np.nan
    back_end.add_odometry(6 * S, broken)
    back_end.add_odometry(7 * S, np.zeros((4, 4)))
    assert back_end.refused == {"late odometry": 1, "odometry without a pose": 2}
    assert len(back_end.stamps) == 5


@pytest.mark.parametrize("covariance", [np.full((6, 6), np.nan), np.zeros((6, 6)), -np.eye(6)])
def test_a_pose_without_a_usable_covariance_is_refused_and_its_closure_kept(covariance):
    back_end, _, _ = walked(80)
    back_end.add_relative_pose(70 * S, 0, np.eye(4), covariance)
    back_end.add_closures([closure(70 * S, 10 * S)])
    back_end.update(everything=True)
    assert "no finite, positive covariance" in back_end.complaints[0]
    assert back_end.taken == 1
    assert back_end.graph.loops[0].covariance is None


def test_closures_wait_for_their_odometry():
    back_end, _, _ = walked(70)
    back_end.add_closures([closure(90 * S, 10 * S)])
    back_end.update(everything=True)
    assert (back_end.waiting, back_end.taken) == (1, 0)
    for i, given in enumerate(laps(100)[1][70:], 70):
        back_end.add_odometry(i * S, given)
    back_end.update()
    assert (back_end.waiting, back_end.taken) == (0, 1)


def test_the_graph_read_by_gtsam_is_the_graph_that_was_written(tmp_path):
    import gtsam

    back_end, _, _ = walked(90)
    back_end.add_closures([closure(i * S, (i - 60) * S) for i in range(64, 90, 4)])
    back_end.update(everything=True)
    graph = back_end.graph
    (tmp_path / "graph.g2o").write_text(pose_graph_to_g2o(graph.poses, graph.edges()))
    factors, values = gtsam.readG2o(str(tmp_path / "graph.g2o"), True)
    assert factors.size() == 89 + sum(graph.entered)
    for node in (0, 45, 89):
        np.testing.assert_allclose(values.atPose3(node).matrix(), graph.poses[node], atol=1e-5)


def test_an_unknown_kernel_is_refused():
    with pytest.raises(PnvError, match="kernel 'tukey' given; allowed: none, huber"):
        PoseGraph(kernel="tukey")
