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


def test_a_closure_that_a_keyframe_near_its_match_outdoes_by_far_is_left_to_that():
    alone = seen(100, 10, 0.95, inliers=40, rival=0)
    sequence = SequenceMemory()
    sequence.remember("front", [alone], window_of(CONFIG.consistency + DOUBT))
    assert alone.evidence is not None
    for near, accepted in ((110, True), (130, False)):
        beside = replace(alone, evidence=replace(alone.evidence, near_inliers=near))
        assert decided(beside, CONFIG, sequence).accepted is accepted
        assert accepted or decided(beside, CONFIG, sequence).reason is Reason.UNCONFIRMED


def test_support_that_chance_gives_elsewhere_raises_no_doubt():
    assert verdicts(3, 0.7, inliers=10, rival=8)[-1] is None


def test_frames_that_agree_lift_the_score_of_an_accepted_closure_and_make_no_weak_one_pass():
    """Look-alike corridors agree in order for as long as one likes, each frame of them weakly."""
    for score, accepted in ((0.45, False), (0.6, True)):
        sequence = SequenceMemory()
        for i in range(6):
            closure = seen(100 + i, 10 + i, score, 12, 0)
            sequence.remember("front", [closure], window_of(CONFIG.consistency + DOUBT))
        final = decided(closure, CONFIG, sequence)
        assert final.accepted == accepted
        assert final.score > 0.6 if accepted else final.reason is Reason.LOW_SCORE
        assert decided(closure, replace(CONFIG, accept_score=0.9), sequence).reason is Reason.LOW_SCORE


def test_a_candidate_that_local_features_did_not_examine_is_not_verified():
    closure = seen(100, 10, 0.95, inliers=-1, rival=0)
    sequence = SequenceMemory()
    sequence.remember("front", [closure], window_of(CONFIG.consistency + DOUBT))
    assert decided(closure, CONFIG, sequence).reason is Reason.NOT_VERIFIED
    assert decided(closure, replace(CONFIG, verify=0), sequence).accepted


def test_without_consistency_a_score_stands_for_itself():
    assert verdicts(1, 0.7, inliers=30, rival=25, config=replace(CONFIG, consistency=0, sure_score=1.1)) == [None]
