"""Relative poses against scenes whose points and cameras are known."""

import numpy as np
import pytest

from pnv_core.errors import ConfigError
from pnv_core.pose.geometry import Intrinsics, depth_at, pose_by_way, relative_pose, triangulated
from pnv_core.rotations import exponential, logarithm, rigid
from pnv_core.verify.verifier import EpipolarCheck

CAMERA = Intrinsics.of_pixels(500.0, 500.0, 319.5, 239.5, 640)
NOISE = 0.2 / 320  # a fifth of a thumbnail pixel, in image widths


def scene(rng, n=150):
    """Points of a room, metres, in the query's camera frame."""
    return np.column_stack([rng.uniform(-3, 3, n), rng.uniform(-2, 2, n), rng.uniform(4, 9, n)])


def seen(points, rotation=None, translation=(0, 0, 0), rng=None):
    """(N, 2) image points, in image widths, of points given in the query's frame."""
    moved = points @ (np.eye(3) if rotation is None else rotation).T + translation
    image = moved[:, :2] / moved[:, 2:] * (500 / 640) + (0.5, 240 / 640)
    return (image + (0 if rng is None else rng.normal(0, NOISE, image.shape))).astype(np.float32)


def check_of(a, b):
    return EpipolarCheck(a, b, np.ones(len(a), bool), 0.5)


def angle(r, s):
    return np.degrees(np.linalg.norm(logarithm(r @ s.T)))


def noisy(seed, n=150, outliers=0.0, turn=None, shift=None):
    """A check of a scene, and the true depths of its points in query and match."""
    rng = np.random.default_rng(seed)
    points = scene(rng, n)
    turn, shift = TURN if turn is None else turn, SHIFT if shift is None else shift
    a, b = seen(points, rng=rng), seen(points, turn, shift, rng)
    wrong = int(outliers * n)
    b[:wrong] = rng.uniform(0, 0.75, (wrong, 2))
    return check_of(a, b), points[:, 2], (points @ turn.T + shift)[:, 2]


TURN = exponential(np.array([0.03, 0.12, -0.02]))
SHIFT = np.array([0.5, -0.1, 0.8])


@pytest.mark.parametrize("seed", range(5))
def test_rotation_and_direction_are_those_of_the_scene(seed):
    pose = relative_pose(noisy(seed, outliers=0.2)[0], CAMERA, CAMERA)
    assert not pose.metric
    assert angle(pose.rotation, TURN) < 0.3
    assert np.linalg.norm(pose.translation) == pytest.approx(1.0)
    assert pose.translation @ SHIFT / np.linalg.norm(SHIFT) > np.cos(np.radians(3))
    assert pose.translation @ pose.covariance[:3, :3] @ pose.translation == pytest.approx(0, abs=1e-12)


def test_turning_on_the_spot_gives_the_rotation_and_no_direction():
    pose = relative_pose(noisy(1, shift=np.zeros(3))[0], CAMERA, CAMERA)
    assert not pose.metric
    assert not pose.translation.any()
    assert angle(pose.rotation, TURN) < 0.3


def test_a_turn_about_any_axis_is_told():
    turn = exponential(np.array([0.0, 0.0, 2.9]))  # the camera nearly upside down
    check, depth, _ = noisy(2, turn=turn)
    for pose in (relative_pose(check, CAMERA, CAMERA), relative_pose(check, CAMERA, CAMERA, depth)):
        assert angle(pose.rotation, turn) < 0.3


def test_too_few_points_give_no_pose():
    points = scene(np.random.default_rng(0), 9)
    assert relative_pose(check_of(seen(points), seen(points, TURN, SHIFT)), CAMERA, CAMERA) is None
    empty = np.empty((0, 2), np.float32)
    assert relative_pose(check_of(empty, empty), CAMERA, CAMERA) is None


@pytest.mark.parametrize("known", ["query", "match", "both", "a third"])
def test_depth_makes_the_pose_metric_wherever_it_is_known(known):
    check, here, there = noisy(3, outliers=0.2)
    few = np.where(np.arange(len(here)) % 3 == 0, here, np.nan)
    given = {"query": (here, None), "match": (None, there), "both": (here, there), "a third": (few, None)}[known]
    pose = relative_pose(check, CAMERA, CAMERA, *given)
    assert pose.metric
    assert angle(pose.rotation, TURN) < 0.3
    assert np.linalg.norm(pose.translation - SHIFT) < 0.05


@pytest.mark.parametrize("metric", [False, True])
def test_the_covariance_tells_the_error(metric):
    squared = []
    for seed in range(40):
        check, depth, _ = noisy(seed, 60 + 2 * seed)
        pose = relative_pose(check, CAMERA, CAMERA, depth if metric else None)
        true = SHIFT if metric else SHIFT / np.linalg.norm(SHIFT)
        away = np.append(true - pose.translation, logarithm(TURN @ pose.rotation.T))
        freedom = 6 if metric else 5
        squared.append(away @ np.linalg.pinv(pose.covariance, rcond=1e-7, hermitian=True) @ away / freedom)
    assert 0.3 < np.median(squared) < 1.3  # of chi squared over its freedom the median is 0.89
    assert (
        np.mean(np.array(squared) < 2.5) > 0.85
    )  # its 95th percentile is 2.1 or 2.2, of Hotelling's for 24 halves 2.5


def test_depth_is_read_where_the_point_is_and_nowhere_else():
    depth = np.zeros((480, 640), np.float32)
    depth[100, 200], depth[100, 201], depth[0, 0] = 3.0, np.nan, 1e6
    points = np.array([[200.5, 100.5], [201.5, 100.5], [0.5, 0.5], [300.5, 100.5]]) / 640
    assert depth_at(depth, points)[0] == 3.0
    assert np.isnan(depth_at(depth, points)[1:]).all()


def test_without_any_depth_there_is_no_metric_pose():
    check, depth, _ = noisy(0)
    for nothing in (np.zeros_like(depth), np.full_like(depth, np.nan), np.full_like(depth, -1)):
        assert not relative_pose(check, CAMERA, CAMERA, nothing).metric


@pytest.mark.parametrize("seed", range(5))
def test_a_known_motion_to_a_view_beside_sets_the_scale(seed):
    rng = np.random.default_rng(seed)
    points = scene(rng, 300)
    step = rigid(exponential(np.array([0, 0.02, 0])), [0.35, 0.02, 0.2])
    query = seen(points, rng=rng)
    check = check_of(query, seen(points, TURN, SHIFT, rng))
    beside = check_of(query, seen(points, step[:3, :3], step[:3, 3], rng))
    depth = triangulated(beside, CAMERA, CAMERA, step)
    known = np.isfinite(depth)
    assert known.sum() > 100
    assert np.median(np.abs(depth[known] / points[known, 2] - 1)) < 0.1
    pose = relative_pose(check, CAMERA, CAMERA, depth)
    assert pose.metric
    assert angle(pose.rotation, TURN) < 0.5
    error = np.linalg.norm(pose.translation - SHIFT)
    assert error < 0.15 * np.linalg.norm(SHIFT)
    assert error < 4 * np.sqrt(np.trace(pose.covariance[:3, :3]))


def test_no_scale_is_invented_where_the_view_beside_shows_no_parallax():
    rng = np.random.default_rng(0)
    points = scene(rng)
    query = seen(points, rng=rng)
    still = check_of(query, seen(points, rng=rng))
    assert not np.isfinite(triangulated(still, CAMERA, CAMERA, rigid(np.eye(3), [0.3, 0, 0]))).any()
    assert not np.isfinite(triangulated(still, CAMERA, CAMERA, np.eye(4))).any()


def test_the_cameras_may_differ():
    rng = np.random.default_rng(4)
    points = scene(rng)
    wide = Intrinsics.of_pixels(300.0, 320.0, 310.0, 250.0, 640)
    moved = points @ TURN.T + SHIFT
    b = moved[:, :2] / moved[:, 2:] * (wide.fx, wide.fy) + (wide.cx, wide.cy)
    pose = relative_pose(check_of(seen(points), b.astype(np.float32)), CAMERA, wide, points[:, 2])
    assert angle(pose.rotation, TURN) < 0.05
    assert np.allclose(pose.translation, SHIFT, atol=0.01)


def test_an_uncalibrated_camera_is_refused():
    with pytest.raises(ConfigError, match="calibrated"):
        Intrinsics.of_pixels(0, 0, 0, 0, 640)


@pytest.mark.parametrize("wide", [False, True])
def test_the_length_of_the_way_to_a_view_beside_sets_the_scale(wide):
    rng, squared = np.random.default_rng(0), []
    other = Intrinsics.of_pixels(300.0, 320.0, 310.0, 250.0, 640) if wide else CAMERA
    for _ in range(12):
        points = scene(rng, 200)
        query = seen(points, rng=rng)
        moved = points @ TURN.T + SHIFT
        match = moved[:, :2] / moved[:, 2:] * (other.fx, other.fy) + (other.cx, other.cy)
        match += rng.normal(0, NOISE, match.shape)
        step = np.array([0.35, 0.02, 0.2])
        beside = check_of(query, seen(points, exponential(np.array([0, 0.02, 0])), step, rng))
        check = check_of(query, match.astype(np.float32))
        pose = pose_by_way(check, beside, CAMERA, other, CAMERA, float(np.linalg.norm(step)), 0.1)
        assert pose.metric
        assert angle(pose.rotation, TURN) < 0.5
        assert np.linalg.norm(pose.translation - SHIFT) < 0.2 * np.linalg.norm(SHIFT)
        away = np.append(SHIFT - pose.translation, logarithm(TURN @ pose.rotation.T))
        squared.append(away @ np.linalg.solve(pose.covariance, away) / 6)
    assert np.median(squared) < 1.5


def test_no_scale_comes_from_no_way_and_from_views_that_share_no_points():
    rng = np.random.default_rng(0)
    points, others = scene(rng), scene(rng)
    step = np.array([0.35, 0.02, 0.2])
    check = check_of(seen(points, rng=rng), seen(points, TURN, SHIFT, rng))
    beside = check_of(check.query, seen(points, np.eye(3), step, rng))
    elsewhere = check_of(seen(others, rng=rng), seen(others, np.eye(3), step, rng))
    still = check_of(check.query, seen(points, rng=rng))
    for view, metres in ((beside, 0.0), (beside, np.nan), (elsewhere, 0.4), (still, 0.4)):
        assert pose_by_way(check, view, CAMERA, CAMERA, CAMERA, metres, 0.1) is None


def test_two_cameras_of_other_intrinsics_give_a_direction_with_an_honest_covariance():
    rng, squared = np.random.default_rng(1), []
    wide = Intrinsics.of_pixels(300.0, 320.0, 310.0, 250.0, 640)
    true = SHIFT / np.linalg.norm(SHIFT)
    for _ in range(12):
        points = scene(rng)
        moved = points @ TURN.T + SHIFT
        b = moved[:, :2] / moved[:, 2:] * (wide.fx, wide.fy) + (wide.cx, wide.cy) + rng.normal(0, NOISE, (150, 2))
        pose = relative_pose(check_of(seen(points, rng=rng), b.astype(np.float32)), CAMERA, wide)
        assert angle(pose.rotation, TURN) < 0.6
        assert pose.translation @ true > np.cos(np.radians(5))
        away = np.append(true - pose.translation, logarithm(TURN @ pose.rotation.T))
        squared.append(away @ np.linalg.pinv(pose.covariance, rcond=1e-7, hermitian=True) @ away / 5)
    assert np.median(squared) < 1.5


def test_a_direction_that_halves_of_the_matches_do_not_agree_on_is_not_given():
    check = noisy(3, shift=np.array([0.01, 0.0, 0.0]))[0]  # a centimetre at 4 to 9 m: a sixth of the noise
    pose = relative_pose(check, CAMERA, CAMERA)
    assert not pose.translation.any()
    assert np.allclose(pose.covariance[:3, :3], np.eye(3))
    error = logarithm(TURN @ pose.rotation.T)
    assert error @ np.linalg.solve(pose.covariance[3:, 3:], error) / 3 < 2.6


def test_a_pose_turned_around_is_that_of_the_views_exchanged():
    check, depth, _ = noisy(5)
    pose = relative_pose(check, CAMERA, CAMERA, depth)
    back = relative_pose(check.swapped(), CAMERA, CAMERA, None, depth).inverse()
    assert np.allclose(back.matrix, pose.matrix, atol=1e-4)
    assert np.allclose(back.covariance, pose.covariance, rtol=0.05, atol=1e-7)
