"""The last word on candidates made by hand: doubt where a look occurs at several places."""

from dataclasses import replace

import pytest

from pnv_core.config import Config
from pnv_core.decide.consistency import DOUBT, SequenceMemory, window_of
from pnv_core.decide.gates import decided
from pnv_core.types import Evidence, ImageRef, LoopClosure, Reason

CONFIG = Config.make()


def seen(query: int, match: int, score: float, inliers: int, rival: int) -> LoopClosure:
    evidence = Evidence(0.6, 0.3, 50, local_inliers=inliers, rival_inliers=rival)
    here, there = ImageRef(query, query * 10**9, "front"), ImageRef(match, match * 10**9, "front")
    return LoopClosure(here, there, score, 0.6, 0.3, 50, False, evidence=evidence)


def verdicts(frames: int, score: float, inliers: int, rival: int, config: Config = CONFIG) -> list[Reason | None]:
    """Of a way taken again, one keyframe after another; None where the closure was accepted."""
    sequence, said = SequenceMemory(), []
    for i in range(frames):
        closure = seen(100 + i, 10 + i, score, inliers, rival)
        sequence.remember("front", [closure], window_of(config.consistency + DOUBT))
        final = decided(closure, config, sequence)
        said.append(None if final.accepted else final.reason)
    return said


@pytest.mark.parametrize("score", [0.7, 0.99])
def test_a_look_that_occurs_elsewhere_is_ambiguous_until_the_way_has_agreed_for_longer(score):
    doubted = verdicts(8, score, inliers=30, rival=25)
    assert Reason.AMBIGUOUS in doubted[:6]
    assert None not in doubted[:6]
    assert doubted[6:] == [None, None]
    assert verdicts(8, score, inliers=30, rival=8)[2:] == [None] * 6


def test_support_that_chance_gives_elsewhere_raises_no_doubt():
    assert verdicts(3, 0.7, inliers=10, rival=8)[-1] is None


def test_weak_frames_that_agree_are_accepted_with_their_common_belief_as_the_score():
    sequence = SequenceMemory()
    for i in range(5):
        closure = seen(100 + i, 10 + i, 0.4, 12, 0)
        sequence.remember("front", [closure], window_of(CONFIG.consistency + DOUBT))
    final = decided(closure, CONFIG, sequence)
    assert final.accepted
    assert final.score > 0.5
    assert decided(closure, replace(CONFIG, accept_score=0.9), sequence).reason is Reason.LOW_SCORE


def test_a_frame_that_speaks_against_a_place_is_not_outvoted():
    sequence = SequenceMemory()
    for i, score in enumerate([0.8, 0.8, 0.8, 0.8, 0.08]):
        closure = seen(100 + i, 10 + i, score, 12, 0)
        sequence.remember("front", [closure], window_of(CONFIG.consistency + DOUBT))
    assert decided(closure, CONFIG, sequence).reason is Reason.LOW_SCORE


@pytest.mark.parametrize(("matches", "accepted"), [(40, True), (60, False)])
def test_where_most_matched_features_disagree_a_closure_is_not_verified(matches, accepted):
    closure = seen(100, 10, 0.95, inliers=30, rival=0)
    closure = replace(closure, evidence=replace(closure.evidence, local_matches=matches))
    sequence = SequenceMemory()
    sequence.remember("front", [closure], window_of(CONFIG.consistency + DOUBT))
    final = decided(closure, CONFIG, sequence)
    assert (final.accepted, final.reason) == (accepted, Reason.ACCEPTED if accepted else Reason.NOT_VERIFIED)


def test_without_consistency_a_score_stands_for_itself():
    assert verdicts(1, 0.7, inliers=30, rival=25, config=replace(CONFIG, consistency=0, sure_score=1.1)) == [None]
