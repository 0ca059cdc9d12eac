"""Keyframes with right checksums that no describer gave: refused when loaded, or harmless when a query meets them."""

import tracemalloc
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from pnv_core.database import KeyframeDatabase
from pnv_core.decide.calibration import Logistic
from pnv_core.errors import PnvError
from pnv_core.maps import MapStore
from pnv_core.types import PatchGrid, PlaceDescriptor
from pnv_core.verify.feature_codes import pack
from pnv_core.verify.local_features import XFeatVerifier, decoded
from test.maps.test_closures import small_frames, small_recognizer
from test.maps.worlds import contents
from test.tally import count, tally

VALUES = st.sampled_from([np.nan, np.inf, -np.inf, 60000.0, -3.0, 1e30])
SIZES = st.tuples(*[st.integers(1, 9)] * 4, st.sampled_from([1, 8, 64, 300]))


def bomb() -> bytes:
    """A JPEG of 600 kB that unpacks to 49 megapixels."""
    return cv2.imencode(".jpg", np.zeros((7000, 7000), np.uint8))[1].tobytes()


BOMB = bomb()
PICTURES = [b"", b"\xff\xd8\xff", b"PNVX", b"PNVX\xff\xff" + bytes(4000), BOMB, BOMB[:2000]]
_RNG = np.random.default_rng(0)
PICTURES += [pack(_RNG.random((n, 2), np.float32), _RNG.random((n, 64), np.float32), 0.75) for n in (1, 600, 1900)]
PICTURES += [cv2.imencode(".png", np.zeros((9, 9)))[1].tobytes()]


@pytest.fixture(scope="module")
def mapped():
    """A recogniser that has seen its places, and what it keeps of them."""
    recognizer = small_recognizer(read_only=False, patch_precision="float16")
    for frame in small_frames(0, 0):
        recognizer.process(frame)
    ids = [ref.id for ref in recognizer.database.refs()]
    return recognizer, [recognizer.database.descriptor(i) for i in ids]


def grid(shape) -> PatchGrid:
    size, rows, cols, stride, dim = shape
    return PatchGrid(size, rows, cols, np.ones((rows * cols, dim), np.float32) / np.sqrt(dim), stride)


def spoilt(kept: PlaceDescriptor, how: str, data: st.DataObject) -> PlaceDescriptor:
    if how == "other grids":
        return replace(kept, patches=tuple(map(grid, data.draw(st.lists(SIZES, max_size=4)))))
    if how == "values":
        at = data.draw(st.integers(0, len(kept.patches) - 1))
        codes = np.array(kept.patches[at].descriptors, np.float32)
        codes.flat[data.draw(st.integers(0, codes.size - 1))] = data.draw(VALUES)
        return replace(kept, patches=tuple(replace(g, descriptors=codes) if i == at else g
                                           for i, g in enumerate(kept.patches)))  # fmt: skip
    return replace(kept, thumbnail=data.draw(st.sampled_from(PICTURES) | st.binary(max_size=300)))


@pytest.mark.parametrize("precision", ["float32", "float16", "int8"])
def test_keyframes_that_no_describer_gave_are_refused_or_harmless(tmp_path_factory, mapped, precision):
    maker, kept = mapped
    finder = small_recognizer(read_only=True, verify=3, patch_precision=precision)
    decides = replace(finder.judge.calibration, verified=Logistic(-1.0, {}), matched=Logistic(5.0, {"concord": 1.0}))
    finder.judge.calibration = decides  # who is in doubt about everything
    outcome = {"refused": 0, "met": 0}

    @settings(
        max_examples=count(20, 700), phases=[Phase.generate], deadline=None, database=None,
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(how=st.sampled_from(["other grids", "values", "picture"]), which=st.integers(0, 7), data=st.data())
    def load(how, which, data):
        folder = tmp_path_factory.mktemp("hostile") / "map"
        database = KeyframeDatabase(maker.database.dim, patch_precision=precision)
        with np.errstate(all="ignore"):
            for i, descriptor in enumerate(kept):
                database.add(i * 10**9, "front", spoilt(descriptor, how, data) if i == which else descriptor)
        MapStore(folder, maker.describer.fingerprint).save(database.snapshot())
        before = contents(finder.database)
        try:
            MapStore(folder, maker.describer.fingerprint).load(finder.database)
        except PnvError as error:
            assert "\n" not in str(error)
            assert len(str(error)) < 1000
            assert contents(finder.database) == before
            outcome["refused"] += 1
            return
        assert how == "picture" or precision == "int8"
        for frame in small_frames(1000, 16):
            assert all(0 <= c.score <= 1 for c in finder.process(frame))
        outcome["met"] += 1

    load()
    tried = sum(outcome.values())
    tally(f"1e keyframes of other patch sizes, values and pictures, {precision}", tried, tried)
    assert outcome["refused"] > 0


def test_a_picture_that_unpacks_to_more_than_a_thumbnail_is_not_unpacked():
    verifier = XFeatVerifier()
    tracemalloc.start()
    try:
        assert decoded(BOMB).shape == (320, 320)
        assert len(verifier.features(BOMB)[0].points) == 0
        assert tracemalloc.get_traced_memory()[1] < 20_000_000
    finally:
        tracemalloc.stop()
