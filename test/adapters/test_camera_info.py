"""Camera infos that cannot be used are refused in one line; none of them reaches OpenCV."""

from types import SimpleNamespace

import numpy as np
import pytest

from msg_adapters.camera_info import Rectifier
from pnv_core.errors import ImageError

K = [300.0, 0.0, 160.0, 0.0, 300.0, 120.0, 0.0, 0.0, 1.0]


def info(d=(), model="plumb_bob", width=320, height=240, k=K):
    return SimpleNamespace(width=width, height=height, k=k, d=list(d), distortion_model=model)


@pytest.mark.parametrize(
    "unusable",
    [
        *(info([0.1] * n) for n in (1, 2, 3, 6, 7, 9, 13, 15, 100)),
        *(info([0.1] * n, "equidistant") for n in (1, 2, 3, 5)),
        info([0.1] * 5, width=2**32 - 1),
        info([0.1] * 5, width=40_000, height=2),
        info([0.1] * 5, height=0),
        info([float("nan")] * 5),
        info([0.1] * 5, k=[float("inf"), *K[1:]]),
        info([0.1] * 5, k=[0.0] * 9),
        info([0.1] * 5, "wide"),
    ],
)
def test_an_unusable_camera_info_is_an_image_error_in_one_line(unusable):
    with pytest.raises(ImageError, match="allowed: ") as raised:
        Rectifier(unusable)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("d", "model"), [([-0.2] * n, "rational_polynomial") for n in (4, 5, 8, 12, 14)] + [([-0.2] * 4, "equidistant")]
)
def test_every_number_of_coefficients_that_opencv_knows_moves_pixels(d, model):
    picture = np.random.default_rng(0).integers(0, 256, (240, 320), dtype=np.uint8)
    moved = Rectifier(info(d, model))(picture)
    assert moved.shape == picture.shape
    assert (moved != picture).mean() > 0.3


def test_a_camera_without_distortion_gives_its_images_as_they_are():
    picture = np.random.default_rng(0).integers(0, 256, (240, 320), dtype=np.uint8)
    assert Rectifier(info([0.0] * 3))(picture) is picture
