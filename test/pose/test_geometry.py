"""Relative poses against scenes whose points and cameras are known."""

import cv2
import numpy as np
import pytest

from pnv_core.errors import ConfigError
from pnv_core.pose.geometry import (
    Intrinsics,
    metric_from_baseline,
    metric_from_depth,
    relative_direction,
)
from pnv_core.verify.verifier import EpipolarCheck

CAMERA = Intrinsics.of_pixels(500.0, 500.0, 320.0, 240.0, 640)
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
    return np.degrees(np.linalg.norm(cv2.Rodrigues(r @ s.T)[0]))


TURN = cv2.Rodrigues(np.array([0.03, 0.12, -0.02]))[0]
SHIFT = np.array([0.5, -0.1, 0.8])


@pytest.mark.parametrize("seed", range(5))
def test_rotation_and_direction_are_those_of_the_scene(seed):
    rng = np.random.default_rng(seed)
    points = scene(rng)
    pose = relative_direction(check_of(seen(points, rng=rng), seen(points, TURN, SHIFT, rng)), CAMERA, CAMERA)
    assert not pose.metric
    assert pose.covariance is None
    assert angle(pose.rotation, TURN) < 0.3
    cosine = pose.translation @ SHIFT / np.linalg.norm(SHIFT)
    assert np.linalg.norm(pose.translation) == pytest.approx(1.0)
    assert cosine > np.cos(np.radians(3))


def test_turning_on_the_spot_gives_the_rotation_and_no_direction():
    rng = np.random.default_rng(1)
    points = scene(rng)
    pose = relative_direction(check_of(seen(points, rng=rng), seen(points, TURN, rng=rng)), CAMERA, CAMERA)
    assert not pose.translation.any()
    assert angle(pose.rotation, TURN) < 0.3


def test_too_few_points_give_no_pose():
    points = scene(np.random.default_rng(0), 9)
    assert relative_direction(check_of(seen(points), seen(points, TURN, SHIFT)), CAMERA, CAMERA) is None
    empty = np.empty((0, 2), np.float32)
    assert relative_direction(check_of(empty, empty), CAMERA, CAMERA) is None


def depth_of(points, image):
    depth = np.zeros((480, 640))
    row, column = (image[:, ::-1] * 640).astype(int).T
    inside = (row >= 0) & (row < 480) & (column >= 0) & (column < 640)
    depth[row[inside], column[inside]] = points[inside, 2]
    return depth


def test_depth_makes_the_pose_metric_and_its_covariance_tells_the_error():
    errors, sigmas = [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        points = scene(rng)
        a, b = seen(points, rng=rng), seen(points, TURN, SHIFT, rng)
        pose = metric_from_depth(check_of(a, b), depth_of(points, a), CAMERA, CAMERA)
        assert pose.metric
        assert angle(pose.rotation, TURN) < 0.5
        assert np.linalg.norm(pose.translation - SHIFT) < 0.08
        assert np.allclose(pose.covariance, pose.covariance.T)
        assert (np.linalg.eigvalsh(pose.covariance) > 0).all()
        errors.append(pose.translation - SHIFT)
        sigmas.append(np.sqrt(np.diag(pose.covariance)[:3]))
    share = np.mean(np.abs(errors) < 3 * np.array(sigmas))
    assert share > 0.95


def test_without_any_depth_there_is_no_metric_pose():
    points = scene(np.random.default_rng(0))
    check = check_of(seen(points), seen(points, TURN, SHIFT))
    assert metric_from_depth(check, np.zeros((480, 640)), CAMERA, CAMERA) is None
    assert metric_from_depth(check, np.full((480, 640), np.nan), CAMERA, CAMERA) is None


@pytest.mark.parametrize("seed", range(5))
def test_a_baseline_from_odometry_sets_the_scale(seed):
    rng = np.random.default_rng(seed)
    points = scene(rng, 300)
    step = np.array([0.35, 0.02, 0.2])
    query = seen(points, rng=rng)
    check = check_of(query, seen(points, TURN, SHIFT, rng))
    neighbour = check_of(query, seen(points, cv2.Rodrigues(np.array([0, 0.02, 0]))[0], step, rng))
    pose = metric_from_baseline(check, neighbour, float(np.linalg.norm(step)), CAMERA, CAMERA)
    assert pose.metric
    assert angle(pose.rotation, TURN) < 1
    error = np.linalg.norm(pose.translation - SHIFT)
    assert error < 0.15 * np.linalg.norm(SHIFT)
    assert error < 4 * np.sqrt(np.trace(pose.covariance[:3, :3]))


def test_no_scale_is_invented_where_the_baseline_shows_no_parallax():
    rng = np.random.default_rng(0)
    points = scene(rng)
    query = seen(points, rng=rng)
    check = check_of(query, seen(points, TURN, SHIFT, rng))
    still = check_of(query, seen(points, rng=rng))
    assert metric_from_baseline(check, still, 0.3, CAMERA, CAMERA) is None
    assert metric_from_baseline(check, check, 0.0, CAMERA, CAMERA) is None


def test_an_uncalibrated_camera_is_refused():
    with pytest.raises(ConfigError, match="calibrated"):
        Intrinsics.of_pixels(0, 0, 0, 0, 640)
