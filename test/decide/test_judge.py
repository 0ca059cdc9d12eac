"""What the judge knows of a candidate beside the pair itself."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from pnv_core.decide.calibration import Logistic
from pnv_core.decide.judge import spread_and_distortion
from pnv_core.decide.order import standing
from pnv_core.recognizer import PlaceRecognizer
from pnv_core.types import Frame, PatchGrid, PatchMatches, PlaceDescriptor
from pnv_core.verify.verifier import CloserLook
from test.core.small import noise_image, small_describer

S = 1_000_000_000


@pytest.mark.parametrize("places", [8, 40])
def test_the_background_is_the_fifth_most_similar_keyframe_elsewhere(places):
    describer = small_describer(min_interval_s=0.0, min_change=0.0, exclude_recent_s=5.0, verify=0, candidates=4)
    recognizer = PlaceRecognizer(describer)
    images = [noise_image(seed) for seed in range(places)]
    for i, image in enumerate(images):
        recognizer.process(Frame(i * S, "front", image))
    found = recognizer.process(Frame(1000 * S, "front", noise_image(3)))
    vectors = np.array([describer.describe(image).global_vector for image in images])
    similarity = vectors @ describer.describe(noise_image(3)).global_vector
    assert len(found) == 4
    for closure in found:
        elsewhere = sorted((s for i, s in enumerate(similarity) if abs(i - closure.match.id) > 10), reverse=True)
        middle = sorted(similarity, reverse=True)[places // 2]  # what counts where all of eight are neighbours
        expected = max(elsewhere[4], middle) if elsewhere else middle
        assert closure.evidence.background == pytest.approx(expected, abs=1e-5)


class Told:
    """A verifier that finds as many inliers as a picture says, and as many matches of its own as it is given rivals."""

    side = 64

    def keep(self, rgb, camera, valid=None):
        return bytes([int(rgb.astype(int).sum()) % 251 + 1])

    def prepare(self, kept, workers):
        pass

    def look_closer(self, query, reference):
        raise AssertionError("nobody asked for a closer look")

    def check(self, query, query_camera, reference, reference_camera):
        return SimpleNamespace(
            inliers=reference[0], spread=0.5, inlier=np.ones(9, bool), likeness=0.0, matches_beside=len
        )


def test_support_near_the_match_and_elsewhere_is_that_of_the_candidates_examined():
    describer = small_describer(min_interval_s=0.0, min_change=0.0, exclude_recent_s=5.0, verify=8, candidates=12)
    recognizer = PlaceRecognizer(describer)
    recognizer.judge.verifier = Told()
    for i in range(40):
        recognizer.process(Frame(i * S, "front", noise_image(i)))
    found = recognizer.process(Frame(1000 * S, "front", noise_image(3)))
    examined = {c.match.id: c.evidence.local_inliers for c in found if c.evidence.local_inliers >= 0}
    assert len(examined) == 8
    assert all(n == Told().keep(noise_image(i), "")[0] for i, n in examined.items())
    for c in found:
        near = [n for i, n in examined.items() if abs(i - c.match.id) <= 10]
        elsewhere = [n for i, n in examined.items() if abs(i - c.match.id) > 10]
        assert c.evidence.near_inliers == max(near, default=0)
        assert c.evidence.rival_inliers == max(elsewhere, default=0)
        if c.match.id in examined:
            assert c.evidence.own_matches == len(elsewhere)


class Closer(Told):
    """And is as sure as the picture of the match says."""

    def __init__(self):
        self.looks = []

    def look_closer(self, query, reference):
        self.looks.append(reference[0])
        return CloserLook(reference[0] / 3, 1.25)


def doubted(evidence, before, surest):
    """Whether the score leaves doubt that the surest matches would settle."""
    at_best = replace(evidence, match_confidence=60.0, magnification=1.0)
    score, most = (part.probability(at_best) for part in (before, surest))
    return 0.03 <= score < 0.6 and max(score, most) >= 0.5


def test_only_candidates_in_doubt_are_looked_at_closer_and_two_at_most():
    every = {"min_interval_s": 0.0, "min_change": 0.0, "exclude_recent_s": 5.0, "consistency": 0}
    describer = small_describer(verify=8, candidates=12, **every)
    recognizer = PlaceRecognizer(describer)
    judge, before = recognizer.judge, Logistic(3.0, {"accord": 1.5})
    judge.calibration = replace(judge.calibration, verified=before, matched=Logistic(-3.0, {"concord": 3.0}))
    judge.verifier, surest = Closer(), judge.calibration.matched
    seen, both = {"looked": 0, "sure": 0, "hopeless": 0}, 0
    for i in range(80):
        judge.verifier.looks.clear()
        found = recognizer.process(Frame(i * S, "front", noise_image(i % 23)))
        closer = [c.evidence for c in found if c.evidence.match_confidence >= 0]
        assert len(judge.verifier.looks) == len(closer) <= 2
        for e in closer:
            assert 0.03 <= before.probability(e) < 0.6
            assert e.match_confidence == pytest.approx(e.local_inliers / 3)
            assert e.magnification == 1.25
        best = sorted(
            (c for c in found if c.evidence.local_inliers >= 0),
            key=lambda c: (-standing(c.evidence), -c.similarity, c.match.id),
        )[:2]
        wanted = {c.match.id for c in best if doubted(c.evidence, before, surest)}
        assert {c.match.id for c in found if c.evidence.match_confidence >= 0} == wanted
        both += len(wanted) == 2
        for c in found:
            e = c.evidence
            if e.match_confidence < 0 <= e.local_inliers:
                most = surest.probability(replace(e, match_confidence=60.0))
                seen["sure"] += before.probability(e) >= 0.6
                seen["hopeless"] += before.probability(e) < 0.5 and most < 0.5
                assert c.score == pytest.approx(before.probability(e))
            elif e.match_confidence >= 0:
                seen["looked"] += 1
                assert c.score == pytest.approx(surest.probability(e))
    assert min(seen.values()) > 5, seen
    assert both


@pytest.mark.parametrize("seed", range(8))
def test_spread_and_distortion_are_those_of_least_squares_and_of_a_polygon(seed):
    """Against numpy's least squares and the shoelace formula of a convex polygon of inliers."""
    rng = np.random.default_rng(seed)
    grid = PatchGrid(2, 10, 12, np.zeros((120, 4), np.float32))
    inside = rng.uniform(-1, 1, (6, 2)) * 20 + 100
    corners = np.array([[40, 50], [170, 40], [180, 130], [50, 140]]) + rng.integers(-9, 9, (4, 2))
    there = np.concatenate([corners, inside.astype(int)])
    here = np.rint(there @ (np.eye(2) + rng.normal(size=(2, 2)) / 20) + [5, -3]).astype(int)
    wrong = rng.integers(0, 190, (3, 2))
    inlier = np.arange(13) < 10
    number = np.arange(13)
    found = PatchMatches(2, number, number, inlier, np.concatenate([here, wrong]), np.concatenate([there, wrong]))
    spread, distortion = spread_and_distortion(PlaceDescriptor(np.zeros(4, np.float32), (grid,)), [found])
    solved = np.linalg.lstsq(np.column_stack([there, np.ones(10)]), here, rcond=None)[0][:2]
    assert distortion == pytest.approx(np.linalg.norm(solved - np.eye(2)), rel=1e-9)
    areas = [
        abs(sum(a[0] * b[1] - a[1] * b[0] for a, b in zip(p, np.roll(p, -1, 0), strict=True))) / 2
        for p in (here[:4].astype(float), there[:4].astype(float))
    ]
    assert spread == pytest.approx(min(areas) / (11 * 16 * 9 * 16), rel=1e-6)


def test_matches_on_a_line_tell_no_distortion():
    grid = PatchGrid(2, 10, 12, np.zeros((120, 4), np.float32))
    number = np.arange(5)
    line = np.stack([16 * number, 32 * number], 1)
    found = PatchMatches(2, number, number, np.ones(5, bool), line, line)
    spread, distortion = spread_and_distortion(PlaceDescriptor(np.zeros(4, np.float32), (grid,)), [found])
    assert spread == 0.0
    assert distortion == np.inf
