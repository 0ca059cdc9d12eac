"""Features that travel without their picture: what is kept of them, and what is refused."""

import struct

import numpy as np
import pytest

from pnv_core.verify.feature_codes import pack, packed, unpack
from pnv_core.verify.local_features import RootSIFTVerifier, detect, features_of, thumbnail
from pnv_lab.worlds import loop_sequence


@pytest.fixture(scope="module")
def revisit() -> list[bytes]:
    """Thumbnails of one place a lap apart, and of another one."""
    frames = list(loop_sequence(1, "corridor", laps=1.1, fps=1.0))
    lap = round(len(frames) / 1.1)
    return [thumbnail(frames[i].rgb) for i in (2, 2 + lap, lap // 2)]


def test_packed_features_check_as_their_pictures_do(revisit):
    first, again, elsewhere = revisit
    verifier = RootSIFTVerifier()
    pictures = [verifier.check(first, "", other, "").inliers for other in (again, elsewhere)]
    codes = [verifier.check(features_of(first), "", features_of(other), "").inliers for other in (again, elsewhere)]
    assert codes[0] > 0.75 * pictures[0]
    assert codes[1] < 0.5 * codes[0]


def test_what_is_unpacked_is_within_half_a_step(revisit):
    found = detect(revisit[0])
    points, descriptors, aspect = unpack(features_of(revisit[0]))
    assert np.abs(points - found.points).max() <= 0.5 / 16384 + 1e-7
    assert (descriptors * found.descriptors).sum(1).min() > 0.98  # cosine
    assert aspect == pytest.approx(0.75)


def test_features_of_features_are_those_features(revisit):
    codes = features_of(revisit[0])
    np.testing.assert_array_equal(detect(codes).points, detect(features_of(codes)).points)


def test_a_picture_without_features_packs_to_none():
    codes = pack(np.empty((0, 2), np.float32), np.empty((0, 128), np.float32), 0.75)
    assert packed(codes)
    assert len(detect(codes).points) == 0


@pytest.mark.parametrize(
    "damage",
    [
        lambda c: c[:5],
        lambda c: c[:40],
        lambda c: c[:-7],
        lambda c: c[:4] + struct.pack("<H", 65535) + c[6:],
        lambda c: c[:4] + struct.pack("<H", 3) + c[6:],
        lambda c: c[:6] + struct.pack("<f", float("nan")) + c[10:],
        lambda c: c[:6] + struct.pack("<f", 1e9) + c[10:],
    ],
)
def test_damaged_codes_are_refused_and_show_nothing(revisit, damage):
    codes = damage(features_of(revisit[0]))
    with pytest.raises(ValueError, match="packed"):
        unpack(codes)
    assert len(detect(codes).points) == 0
    assert RootSIFTVerifier().check(codes, "", revisit[0], "").inliers == 0
