"""Depth images as messages."""

import numpy as np
import pytest
from sensor_msgs.msg import Image

from msg_adapters.depth import depth_of
from pnv_core.errors import ImageError


def message(pixels, encoding, padding=0, big=False):
    rows = pixels.astype(pixels.dtype.newbyteorder(">" if big else "<"))
    data = np.hstack([rows.view(np.uint8).reshape(len(pixels), -1), np.full((len(pixels), padding), 255, np.uint8)])
    return Image(height=pixels.shape[0], width=pixels.shape[1], encoding=encoding, step=data.shape[1],
                 is_bigendian=int(big), data=data.tobytes())  # fmt: skip


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("padding", [0, 6])
def test_millimetres_and_metres_are_metres(big, padding):
    metres = np.random.default_rng(0).uniform(0.3, 9, (20, 30)).round(3)
    millimetres = (metres * 1000).round().astype(np.uint16)
    assert np.allclose(depth_of(message(millimetres, "16UC1", padding, big)), metres, atol=1e-6)
    assert np.allclose(depth_of(message(metres.astype(np.float32), "32FC1", padding, big)), metres, atol=1e-6)


def test_what_is_unknown_stays_unknown():
    pixels = np.full((20, 30), np.nan, np.float32)
    assert np.isnan(depth_of(message(pixels, "32FC1"))).all()
    assert not depth_of(message(np.zeros((20, 30), np.uint16), "16UC1")).any()


def test_other_images_are_refused():
    with pytest.raises(ImageError, match="encoding 'rgb8'; allowed: 16UC1"):
        depth_of(message(np.zeros((20, 30), np.uint16), "rgb8"))
    short = message(np.zeros((20, 30), np.uint16), "16UC1")
    short.data = short.data[:-1]
    with pytest.raises(ImageError, match="1199 bytes"):
        depth_of(short)
