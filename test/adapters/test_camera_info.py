"""Camera infos that cannot be used are refused in one line; none of them reaches OpenCV."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from msg_adapters.camera_info import Rectifier
from pnv_core.errors import ImageError
from test.tally import count, tally

K = [300.0, 0.0, 160.0, 0.0, 300.0, 120.0, 0.0, 0.0, 1.0]


def info(d=(), model="plumb_bob", width=320, height=240, k=K, p=(0.0,) * 12):
    return SimpleNamespace(width=width, height=height, k=k, d=list(d), distortion_model=model, p=list(p))


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
        info(k=[*K[:4], 0.0, *K[5:]]),
        info(k=[*K[:8], 0.0]),
        info(k=[1e-300, *K[1:]]),
        info(k=[1e300, *K[1:]]),
        info([1e300] * 5),
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


def test_rectified_images_are_not_rectified_again_and_their_projection_counts():
    picture = np.random.default_rng(0).integers(0, 256, (240, 320), dtype=np.uint8)
    p = [250.0, 0.0, 150.0, 0.0, 0.0, 260.0, 110.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    given = info([-0.3, 0.1, 0.0, 0.0, 0.0], p=p)
    rectified, raw = Rectifier(given, rectified=True), Rectifier(given)
    assert rectified(picture) is picture
    assert rectified.focal_and_centre == (250.0, 260.0, 150.0, 110.0)
    assert (raw(picture) != picture).mean() > 0.3
    assert raw.focal_and_centre == (300.0, 300.0, 160.0, 120.0)


NUMBERS = st.floats() | st.sampled_from([0.0, 1.0, 300.0, 1e-300, 1e300, -1.0, 1e9]) | st.floats(-2, 2)


@given(
    st.lists(NUMBERS, min_size=9, max_size=9), st.lists(NUMBERS, max_size=14), st.booleans(),
    st.sampled_from(["plumb_bob", "rational_polynomial", "equidistant", "fisheye", "", "wide"]), st.integers(0, 9),
)  # fmt: skip
@settings(max_examples=count(150, 10_000), deadline=None, database=None)
def test_no_camera_info_turns_an_image_black(numbers, d, rectified, model, kept):
    """What is accepted shows at least a tenth of the image."""
    tally("4 camera infos of any numbers", 1, 1)
    k = [own if i < kept else other for i, (own, other) in enumerate(zip(K, numbers, strict=True))]
    try:
        rectifier = Rectifier(info(d, model, k=k), rectified=rectified)
    except ImageError as error:
        assert "\n" not in str(error)
        assert len(str(error)) <= 1000
        return
    white = np.full((240, 320), 255, np.uint8)
    assert rectifier(white).mean() > 25
