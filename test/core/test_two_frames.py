"""The two halves of the recogniser in two threads, against frame after frame in one."""

import threading
from dataclasses import replace
from queue import Queue

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pnv_core.decide.calibration import Logistic
from pnv_core.recognizer import PlaceRecognizer
from pnv_core.types import Frame
from test.core.small import noise_image, small_describer

_SETTINGS = {"exclude_recent_s": 0.0, "min_interval_s": 0.4, "accept_score": 0.0, "consistency": 2, "sure_score": 1.1}


def recogniser(threads: int) -> PlaceRecognizer:
    """One that takes a closer look at everything it examines."""
    found = PlaceRecognizer(small_describer(threads=threads, verify=2, **_SETTINGS))
    doubtful, closer = Logistic(-1.0, {}), Logistic(5.0, {"concord": 1.0})
    found.judge.calibration = replace(found.judge.calibration, verified=doubtful, matched=closer)
    return found


def one_after_another(recognizer, walk):
    found = []
    for frame, changes in walk:
        recognizer.change(**changes)
        found.append(recognizer.process(frame))
    return found


def looking_ahead(recognizer, walk):
    """Frames are looked at in a thread of their own, as far ahead as they come."""
    waiting, found = Queue(), []

    def look():
        for frame, changes in walk:
            recognizer.change(**changes)
            waiting.put(recognizer.look(frame))

    thread = threading.Thread(target=look)
    thread.start()
    for _ in walk:
        seen = waiting.get()
        found.append([] if seen is None else recognizer.recognise(seen))
    thread.join()
    return found


CHANGES = st.one_of(
    st.just({}),
    st.fixed_dictionaries({"candidates": st.sampled_from([2, 10]), "accept_score": st.sampled_from([0.0, 0.3])}),
    st.sampled_from([{"min_interval_s": 0.0}, {"consistency": 0}, {"exclude_recent_s": 2.0}]),
)
STEPS = st.lists(st.tuples(st.integers(0, 5), st.sampled_from(["left", "right"]), CHANGES), min_size=1, max_size=14)


@settings(deadline=None, max_examples=12)
@example(steps=[(place, "left", {}) for place in (0, 1, 2, 0, 1, 2)], interval_ms=700)
@given(steps=STEPS, interval_ms=st.sampled_from([100, 300, 700]))
def test_looking_ahead_changes_nothing(steps, interval_ms):
    """Places seen again, standing still, frames that are no keyframes, two cameras, live settings."""
    walk = [
        (Frame(number * interval_ms * 1_000_000, camera, noise_image(place)), changes)
        for number, (place, camera, changes) in enumerate(steps)
    ]
    straight, ahead = recogniser(1), recogniser(2)
    expected, found = one_after_another(straight, walk), looking_ahead(ahead, walk)
    assert found == expected
    assert [[c.evidence for c in one] for one in found] == [[c.evidence for c in one] for one in expected]
    if [place for place, *_ in steps] == [0, 1, 2, 0, 1, 2]:  # the example
        assert any(c.evidence.match_confidence > 20 for one in found for c in one)
    assert ahead.database.refs() == straight.database.refs()
    for ref in straight.database.refs():
        assert np.array_equal(ahead.database.vector(ref.id), straight.database.vector(ref.id))
        assert ahead.database.picture(ref.id) == straight.database.picture(ref.id)


def test_features_of_a_frame_that_shows_nothing_new_are_not_computed(monkeypatch):
    """But for the first one, which could not be known."""
    recognizer, kept = recogniser(2), []
    keep = recognizer.judge.verifier.keep
    monkeypatch.setattr(recognizer.judge.verifier, "keep", lambda *given: kept.append(given) or keep(*given))
    for second, place in enumerate([0, 0, 0, 0, 1]):
        recognizer.process(Frame(second * 10**9, "left", noise_image(place)))
    assert len(recognizer.database) == 2
    assert len(kept) == 3
