"""Answers: a candidate of the fleet is judged as it would be in the robot's own map."""

from dataclasses import asdict, replace

import pytest

from pnv_core.recognizer import PlaceRecognizer
from pnv_core.types import Frame
from pnv_fleet.answers import Answers, of_robot
from pnv_fleet.places import Place, encode_view, without_picture
from pnv_fleet.store import Hit
from test.core.small import small_describer
from test.ros.camera import scene

SECOND = 10**9


class Shelf:
    """A store that compares with everything it holds."""

    uri = "shelf"

    def __init__(self, places: list[Place]) -> None:
        self._places = {place.key: place for place in places}

    def search(self, vector, k, where=""):
        ranked = sorted(self._places.values(), key=lambda place: -float(place.vector @ vector))[:k]
        return [Hit(replace(place, view=b""), float(place.vector @ vector)) for place in ranked], []

    def fetch(self, keys):
        return {key: self._places[key] for key in keys}, []


def test_a_candidate_has_the_evidence_that_it_has_in_the_own_map():
    describer = small_describer(min_interval_s=0.0, min_change=0.0, consistency=0, exclude_recent_s=5.0)
    recognizer = PlaceRecognizer(describer)
    places = []
    for number in range(60):  # more than are asked for, as the background of a candidate is
        recognizer.process(Frame((number + 1) * SECOND, "front", scene(number)))
        ref, seen = recognizer.latest.ref, without_picture(recognizer.latest.descriptor)
        places.append(
            Place("alpha", SECOND, "front", ref.id, ref.stamp_ns, seen.texture, seen.global_vector, encode_view(seen))
        )
    local = recognizer.process(Frame(100 * SECOND, "front", scene(7)))
    answers = Answers(describer.config, None, recognizer.latest.descriptor)
    asked = replace(recognizer.latest, descriptor=without_picture(recognizer.latest.descriptor))
    found = answers.to(of_robot(asked, "beta", 0), Shelf(places))
    assert [c.match.id for c in found] == [c.match.id for c in local]
    assert local[0].match.id == 7
    for there, here in zip(found, local, strict=True):
        assert asdict(there.evidence) == pytest.approx(asdict(here.evidence), abs=1e-5)
        assert there.score == pytest.approx(here.score, abs=1e-5)
