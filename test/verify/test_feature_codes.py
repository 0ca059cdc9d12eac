"""What is kept of an image to verify it: what the codes cost, and what is refused."""

import struct

import numpy as np
import pytest

from pnv_core.verify.feature_codes import features_only, pack, packed, picture_of, unpack
from pnv_core.verify.local_features import XFeatVerifier, epipolar_check, features_of, thumbnail
from pnv_lab.worlds import loop_sequence


@pytest.fixture(scope="module")
def verifier() -> XFeatVerifier:
    return XFeatVerifier()


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    """One place a lap apart, and another one."""
    frames = list(loop_sequence(1, "corridor", laps=1.1, fps=1.0))
    lap = round(len(frames) / 1.1)
    return [frames[i].rgb for i in (2, 2 + lap, lap // 2)]


@pytest.fixture(scope="module")
def kept(verifier, images) -> list[bytes]:
    return [verifier.keep(rgb, "") for rgb in images]


def test_codes_agree_as_the_features_themselves_do(verifier, images, kept):
    exact = [verifier.found(rgb) for rgb in images]
    coded = [verifier.features(bytes_)[0] for bytes_ in kept]
    again, elsewhere = (epipolar_check(exact[0], exact[i], 0.75).inliers for i in (1, 2))
    assert epipolar_check(coded[0], coded[1], 0.75).inliers == pytest.approx(again, rel=0.1)
    assert epipolar_check(coded[0], coded[2], 0.75).inliers < 0.5 * again
    assert elsewhere < 0.5 * again


def test_what_is_unpacked_is_within_half_a_step(verifier, images, kept):
    exact = verifier.found(images[0])
    points, descriptors, aspect = unpack(kept[0])
    assert np.abs(points - exact.points).max() <= 0.5 / 16384 + 1e-7
    assert (descriptors * exact.descriptors).sum(1).min() > 0.9995  # cosine
    assert aspect == pytest.approx(0.75)


def test_the_picture_lies_behind_the_features_and_goes_without_them(images, kept):
    assert picture_of(kept[0]) == thumbnail(images[0])
    codes = features_of(kept[0])
    assert codes == features_only(kept[0])
    assert packed(codes)
    assert picture_of(codes) == b""
    assert features_of(codes) == codes
    assert len(codes) <= 10 + 500 * 68


def test_a_picture_kept_alone_as_in_older_maps_is_examined_by_its_own_features(verifier, images, kept):
    old = [thumbnail(rgb) for rgb in images]
    assert picture_of(old[0]) == old[0]
    assert verifier.check(kept[1], "", old[0], "").inliers > 2 * verifier.check(kept[2], "", old[0], "").inliers
    assert len(unpack(features_of(old[0]))[0]) > 50


def test_a_picture_without_features_packs_to_none(verifier):
    codes = pack(np.empty((0, 2), np.float32), np.empty((0, 64), np.float32), 0.75)
    assert packed(codes)
    assert len(verifier.features(codes)[0].points) == 0


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
def test_damaged_codes_are_refused_and_show_nothing(verifier, kept, damage):
    codes = damage(features_only(kept[0]))
    with pytest.raises(ValueError, match="packed"):
        unpack(codes)
    assert len(verifier.features(codes)[0].points) == 0
    assert verifier.check(codes, "", kept[0], "").inliers == 0
    assert picture_of(codes) == b""


def test_bytes_of_nobody_show_nothing(verifier, kept):
    assert verifier.check(b"PNVF of an older fleet", "", kept[0], "").inliers == 0
    assert verifier.check(b"", "", kept[0], "").inliers == 0
