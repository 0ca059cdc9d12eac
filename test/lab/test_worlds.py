"""The rendered worlds: pinhole geometry, determinism, truth of revisits."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from pnv_core.errors import ConfigError
from pnv_lab.worlds import KINDS, Camera, Light, Pose, World, loop_sequence
from pnv_lab.worlds.rendering import Surface, pyramid, rasterise


def _pinhole(point: np.ndarray, pose: Pose, camera: Camera) -> np.ndarray:
    """The textbook pinhole for a level camera: depth along the heading, x to the right, y down."""
    ahead = np.array([np.cos(pose.yaw), np.sin(pose.yaw)])
    right = np.array([np.sin(pose.yaw), -np.cos(pose.yaw)])
    offset = point[:2] - (pose.x, pose.y)
    focal = camera.width / 2 / np.tan(np.deg2rad(camera.horizontal_view_deg) / 2)
    centre = np.array([camera.width - 1, camera.height - 1]) / 2
    return centre + focal * np.array([offset @ right, pose.z - point[2]]) / (offset @ ahead)


@pytest.mark.parametrize("yaw", [0.0, 0.35, -0.4])
@pytest.mark.parametrize("eye", [(0.0, 0.0, 1.2), (1.5, -0.8, 0.7), (4.2, 0.3, 1.6)])
def test_a_mark_on_a_wall_appears_where_the_pinhole_says(yaw: float, eye: tuple[float, float, float]) -> None:
    texture = np.zeros((300, 600, 3), np.uint8)
    cv2.circle(texture, (360, 120), 9, (255, 255, 255), -1)
    wall = Surface(np.array([6.0, 3.0, 3.0]), np.array([0.0, -6, 0]), np.array([0.0, 0, -3]), texture)
    mark = np.array([6.0, 3.0 - 6 * 360.5 / 600, 3.0 - 3 * 120.5 / 300])
    camera, pose = Camera(320, 240), Pose(*eye, yaw=yaw)
    x, y = _pinhole(mark, pose, camera)
    image = rasterise([wall], [pyramid(texture)], camera, pose)
    weight = image[..., 0].astype(float)
    if 15 < x < 305 and 15 < y < 225:
        rows, cols = np.mgrid[0:240, 0:320]
        seen = np.array([(weight * cols).sum(), (weight * rows).sum()]) / weight.sum()
        np.testing.assert_allclose(seen, (x, y), atol=0.35)
    np.testing.assert_allclose(camera.project(mark[None], pose)[0][0], (x, y), atol=1e-9)


def test_the_nearer_surface_hides_the_farther_one_in_any_order() -> None:
    def wall(x: float, grey: int) -> Surface:
        texture = np.full((8, 8, 3), grey, np.uint8)
        return Surface(np.array([x, 2.0, 3.0]), np.array([0.0, -4, 0]), np.array([0.0, 0, -3]), texture)

    for surfaces in ([wall(2, 50), wall(4, 200)], [wall(4, 200), wall(2, 50)]):
        image = rasterise(surfaces, [pyramid(s.texture) for s in surfaces], Camera(64, 48), Pose(0, 0, 1.5))
        assert (image == 50).all()


def test_a_surface_is_seen_from_its_front_only() -> None:
    texture = np.full((8, 8, 3), 90, np.uint8)
    wall = Surface(np.array([2.0, 2.0, 3.0]), np.array([0.0, -4, 0]), np.array([0.0, 0, -3]), texture)
    behind = rasterise([wall], [[texture]], Camera(64, 48), Pose(4, 0, 1.5, yaw=np.pi))
    assert not behind.any()


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_seed_gives_the_same_bytes_and_another_seed_another_place(kind: str) -> None:
    pose = World(5, kind).pose_on_route(7.0)
    first, again = (World(5, kind).render(pose, size=(160, 120), noise_seed=3) for _ in range(2))
    assert first.tobytes() == again.tobytes()
    assert first.shape == (120, 160, 3)
    assert first.dtype == np.uint8
    assert 25 < first.mean() < 235
    assert first.std() > 15
    assert np.abs(World(6, kind).render(pose, size=(160, 120)).astype(int) - first).mean() > 10


def test_a_frame_does_not_depend_on_what_was_rendered_before() -> None:
    sequence = loop_sequence(2, "office", size=(160, 120))
    last = len(sequence) - 1
    straight = sequence[last].rgb
    sequence[0], sequence[5]
    assert sequence[last].rgb.tobytes() == straight.tobytes()


def test_an_unknown_kind_is_refused_by_name() -> None:
    with pytest.raises(ConfigError, match="'jungle' is not one of corridor, office, hall, street"):
        World(1, "jungle")


def test_revisits_are_the_older_frames_near_in_place_and_heading() -> None:
    sequence = loop_sequence(4, "corridor", laps=1.4)
    revisits = sequence.revisits(gap_s=20.0, radius_m=1.0, heading_deg=30.0)
    for b in range(0, len(sequence), 7):
        pose = sequence.poses[b]
        expected = []
        for a, other in enumerate(sequence.poses):
            old = sequence.stamps_ns[b] - sequence.stamps_ns[a] >= 20_000_000_000
            near = np.hypot(np.hypot(other.x - pose.x, other.y - pose.y), other.z - pose.z) <= 1.0
            agree = np.cos(other.yaw - pose.yaw) >= np.cos(np.deg2rad(30))
            if old and near and agree:
                expected.append(a)
        assert revisits[b].tolist() == expected
    assert not any(len(row) for row in revisits[:80])
    assert all(len(row) for row in revisits[-20:])


@pytest.mark.parametrize("kind", KINDS)
def test_a_second_visit_shares_features_with_the_first_and_not_with_another_place(kind: str) -> None:
    sequence = loop_sequence(8, kind, size=(320, 240))
    half = len(sequence) // 2
    sift = cv2.SIFT_create(600)

    def shared(a: int, b: int) -> int:
        (ka, da), (kb, db) = (sift.detectAndCompute(sequence[i].rgb, None) for i in (a, b))
        pairs = cv2.BFMatcher().knnMatch(da, db, k=2)
        good = [m for m, n in pairs if m.distance < 0.8 * n.distance]
        if len(good) < 8:
            return 0
        points = [
            np.float32([k[j].pt for j in index])
            for k, index in ((ka, [m.queryIdx for m in good]), (kb, [m.trainIdx for m in good]))
        ]
        _, inliers = cv2.findFundamentalMat(*points, cv2.FM_RANSAC, 2.0, 0.99)
        return 0 if inliers is None else int(inliers.sum())

    visits = [
        (
            k,
            int(np.argmin(np.linalg.norm(sequence.matrices[half:, :3, 3] - sequence.matrices[k, :3, 3], axis=1)))
            + half,
        )
        for k in (10, half // 3, half // 2)
    ]
    same = [shared(a, b) for a, b in visits]
    other = [shared(a, (b - half + half // 2) % half) for a, b in visits]
    assert np.median(same) > 2 * np.median(other)


def test_the_light_of_the_first_visit_differs_from_the_second() -> None:
    sequence = loop_sequence(3, "hall")
    assert sequence.lights[0] == Light(seed=3)
    assert sequence.lights[-1] != sequence.lights[0]


@pytest.mark.parametrize("kind", ["corridor", "hall", "office", "street"])
def test_frames_share_all_of_one_view_half_of_it_after_a_turn_and_nothing_back_to_back(kind: str) -> None:
    """Of a turn on the spot the field of view (75 degrees) tells what stays in sight; the rows lose a little more."""
    walk = loop_sequence(3, kind, laps=1.0, fps=0.5)
    here = walk.poses[4]
    for degrees in (0.0, 30.0, -37.5, 60.0, 180.0):
        turned = replace(walk, poses=(here, replace(here, yaw=here.yaw + np.deg2rad(degrees))))
        angle = 37.5 - abs(degrees)
        in_sight = (1 + np.tan(np.deg2rad(angle)) / np.tan(np.deg2rad(37.5))) / 2 if abs(degrees) < 75 else 0.0
        assert in_sight - 0.2 <= turned.shared_view(0, 1) <= in_sight + 0.05, degrees


def test_frames_on_both_sides_of_a_wall_share_nothing_though_they_stand_close() -> None:
    walk = loop_sequence(3, "corridor", laps=1.0, fps=0.5)
    here = walk.poses[4]
    beside = replace(here, y=here.y + 60.0)  # outside of the building
    assert replace(walk, poses=(here, beside)).shared_view(0, 1) < 0.05
