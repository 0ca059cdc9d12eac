"""A recogniser on a saved map says what the one that saved it says."""

import json
import subprocess
import sys

import cv2
import numpy as np
import pytest

from pnv_core.database import KeyframeDatabase
from pnv_core.maps import MapStore
from pnv_core.recognizer import PlaceRecognizer
from pnv_core.types import NO_PICTURE, Frame
from test.core.small import small_describer
from test.database.synthetic import SECOND
from test.tally import tally

SETTINGS = {"min_interval_s": 0.0, "min_change": 0.0, "accept_score": 0.0, "sure_score": 0.0, "patch_precision": "int8"}


def small_recognizer(read_only: bool, **more) -> PlaceRecognizer:
    describer = small_describer(**SETTINGS | more)
    database = KeyframeDatabase.for_describer(describer, read_only=read_only)
    return PlaceRecognizer(describer, database)


def small_frames(laps_start_s: int, shift: int) -> list[Frame]:
    """Eight places in a row, seen `shift` pixels further to the side."""
    rng = np.random.default_rng(0)
    walls = [cv2.resize(rng.integers(0, 255, (24, 36, 3), np.uint8), (288, 160)) for _ in range(8)]
    return [
        Frame((laps_start_s + i) * SECOND, "front", np.ascontiguousarray(wall[:, shift : shift + 192]))
        for i, wall in enumerate(walls)
    ]


def _closures(recognizer: PlaceRecognizer) -> list[list]:
    """Every candidate of a later visit, in plain values."""
    return [
        [c.match.id, c.match.stamp_ns, c.match.session, c.accepted, c.score, c.similarity, c.spatial, c.inliers]
        for frame in small_frames(1000, 16)
        for c in recognizer.process(frame)
    ]


def visit(path: str) -> None:
    """In a process of its own: load, look again, print."""
    recognizer = small_recognizer(read_only=True)
    MapStore(path, recognizer.describer.fingerprint).load(recognizer.database)
    print(json.dumps(_closures(recognizer)))


def test_a_map_without_pictures_is_judged_by_what_it_has_and_it_is_said(tmp_path):
    maker, finder = small_recognizer(read_only=False, verify=0), small_recognizer(read_only=True, verify=3)
    for frame in small_frames(0, 0):
        maker.process(frame)
    MapStore(tmp_path / "map", maker.describer.fingerprint).save(maker.database.snapshot())
    MapStore(tmp_path / "map", finder.describer.fingerprint).load(finder.database)
    assert finder.database.stats().without_picture == 8
    maker.new_session()
    maker.database.read_only = True
    without, found = _closures(maker), _closures(finder)
    assert [c[0] for c in found if c[3]] == [c[0] for c in without if c[3]] != []
    assert {c.evidence.local_inliers for f in small_frames(2000, 16) for c in finder.process(f)} == {NO_PICTURE}
    tally("1h frames before a map without pictures", 8, 8)


@pytest.mark.process
def test_a_saved_map_gives_the_same_closures_in_a_new_process(tmp_path):
    recognizer = small_recognizer(read_only=False)
    for frame in small_frames(0, 0):
        recognizer.process(frame)
    MapStore(tmp_path / "map", recognizer.describer.fingerprint).save(recognizer.database.snapshot())
    recognizer.new_session()
    recognizer.database.read_only = True
    here = _closures(recognizer)
    code = f"from test.maps.test_closures import visit; visit({str(tmp_path / 'map')!r})"
    there = json.loads(subprocess.run([sys.executable, "-c", code], check=True, capture_output=True).stdout)
    assert len(here) == len(there) >= 8
    for ours, theirs in zip(here, there, strict=True):
        assert ours[:4] == theirs[:4]
        np.testing.assert_allclose(ours[4:], theirs[4:], atol=1e-6)
    assert [c[0] for c in here if c[3]]  # some are closures
    assert {c[2] for c in here} == {0}
