"""Input that is out to fool: no closure may be confirmed that is not one."""

import cv2
import numpy as np
import pytest

from pnv_core.config import Config
from pnv_core.describe.describer import Describer, describer_from
from pnv_core.recognizer import PlaceRecognizer
from pnv_core.types import Frame, Reason
from test.verify.test_local_features import scene

S = 1_000_000_000
EAGER = {"exclude_recent_s": 10.0, "min_interval_s": 0.0, "min_change": 0.0}  # every frame is a keyframe


@pytest.fixture(scope="module")
def describer():
    return describer_from(Config.make(threads=1))


def processed(describer, images, step_s=2.0, **settings):
    recognizer = PlaceRecognizer(Describer(describer.model, Config.make(threads=1, **(EAGER | settings))))
    found = []
    for i, image in enumerate(images):
        found.append(recognizer.process(Frame(round(i * step_s * S), "front", image)))
    return found


def accepted(found):
    return [(c.query.id, c.match.id) for closures in found for c in closures if c.accepted]


def test_blank_and_noisy_frames_close_no_loop_and_say_why(describer):
    rng = np.random.default_rng(0)
    blank = [np.full((240, 320, 3), level, np.uint8) for level in (0, 90, 255)] * 3
    found = processed(describer, blank)
    assert accepted(found) == []
    assert {c.reason for closures in found for c in closures} == {Reason.LOW_TEXTURE}
    assert all(c.score == 0.0 for closures in found for c in closures)
    noise = [rng.integers(0, 256, (240, 320, 3), dtype=np.uint8) for _ in range(9)]
    assert accepted(processed(describer, noise)) == []


def test_pictures_of_different_things_close_no_loop(describer):
    assert accepted(processed(describer, [scene(seed, (240, 320)) for seed in range(25)])) == []


def test_a_wall_of_one_repeated_pattern_closes_no_loop(describer):
    """A robot along a wall of tiles, lit a little differently everywhere: 40 cm further on looks the same."""
    tile = scene(3, (40, 40))
    wall = np.tile(tile, (6, 60, 1)).astype(np.float32)
    light = cv2.resize(np.random.default_rng(1).uniform(0.5, 1.0, (3, 30)).astype(np.float32), wall.shape[1::-1])
    wall = np.clip(wall * light[:, :, None], 0, 255).astype(np.uint8)
    views = [np.ascontiguousarray(wall[:, 70 * i : 70 * i + 320]) for i in range(14)]
    assert accepted(processed(describer, views)) == []


def test_the_same_image_for_an_hour_adds_no_keyframe_and_closes_no_loop(describer):
    image = scene(0, (240, 320))
    rng = np.random.default_rng(0)
    images = [np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8) for _ in range(30)]
    found = processed(describer, images, step_s=120.0, min_interval_s=0.5, min_change=0.05)
    assert not any(found)


def test_a_way_taken_again_is_found_among_all_that(describer):
    """The other side: six views of one way, ten other pictures, the way again."""
    way = [np.ascontiguousarray(scene(50, (240, 800))[:, 80 * i : 80 * i + 320]) for i in range(6)]
    found = processed(describer, [*way, *(scene(seed, (240, 320)) for seed in range(8)), *way])
    pairs = accepted(found)
    assert len({q for q, _ in pairs}) >= 4
    assert all(abs((q - 14) - m) <= 2 for q, m in pairs)
