"""A disk under the patches that cannot be read: the keyframes on it are given up, the rest lives on."""

import os

import numpy as np
import pytest

from pnv_core.database import KeyframeDatabase
from pnv_core.maps import MapStore
from pnv_core.recognizer import PlaceRecognizer
from pnv_core.types import Frame
from test.core.small import noise_image, small_describer
from test.database.synthetic import SECOND, place
from test.maps.worlds import MODEL, contents, driven, go_on, on_disk
from test.tally import count, tally


def _on_disk(database):
    return [kf for kf in database.snapshot().keyframes if not isinstance(kf.buffer, np.ndarray)]


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_what_cannot_be_read_is_left_out_of_the_map_and_the_rest_is_saved(tmp_path, share):
    database = driven(count(120, 2000), memory_budget_mb=0.2, patch_store="disk")
    store, before = MapStore(tmp_path / "map", MODEL), contents(database)
    end = max(kf.buffer.place + kf.buffer.nbytes for kf in _on_disk(database))
    os.ftruncate(database._patch_file._handle.fileno(), int(share * end))
    bad = {kf.ref.id for kf in _on_disk(database) if kf.buffer.place + kf.buffer.nbytes > int(share * end)}
    assert bad
    report = store.save(database.snapshot())
    assert (report.unreadable, report.keyframes) == (len(bad), len(before) - len(bad))
    assert f"{len(bad)} unreadable ones are left out" in str(report)
    assert on_disk(tmp_path / "map") == [kf for kf in before if kf[0].id not in bad]
    readable = database.readable(kf[0].id for kf in before)
    assert set(readable) == {kf[0].id for kf in before} - bad
    assert database.stats().unreadable == len(bad)
    assert len(database) == len(before) - len(bad)
    assert database.picture(min(bad)) == b""
    go_on(database, 30, 1)
    assert store.save(database.snapshot()).unreadable == 0
    assert on_disk(tmp_path / "map") == contents(database)
    tally("2 keyframes on a disk that cannot be read", len(before), len(before) - len(bad))


def test_a_read_error_does_not_end_recognition():
    describer = small_describer(min_interval_s=0.0, min_change=0.0, exclude_recent_s=0.0, memory_budget_mb=1.0)
    database = KeyframeDatabase.for_describer(describer)
    recognizer = PlaceRecognizer(describer, database)

    def see(second):
        return recognizer.process(Frame(second * SECOND, "front", noise_image(second)))

    for second in range(12):
        see(second)
    gone = database.nearest(place(np.random.default_rng(0), dim=database.dim).global_vector, 5, 10**18, 0)
    failing = {ref.id for ref, _ in gone}

    def descriptor(keyframe, genuine=database.descriptor):
        if keyframe in failing:
            raise OSError(5, "Input/output error")
        return genuine(keyframe)

    database.descriptor = descriptor  # type: ignore[method-assign]
    for second in range(20, 30):
        assert all(c.match.id not in failing for c in see(second))
    assert 0 < database.stats().unreadable <= 5
