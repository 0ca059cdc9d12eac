"""The last word on a candidate: the gates of docs/closures.md, in order."""

from dataclasses import replace

from pnv_core.config import Config
from pnv_core.decide.calibration import CHANCE
from pnv_core.decide.consistency import DOUBT, SequenceMemory, confirmed, window_of
from pnv_core.types import NO_PICTURE, Evidence, LoopClosure, Reason

_ALIKE = 0.4  # of the match's own support
_FAR_BETTER = 3


def decided(closure: LoopClosure, config: Config, sequence: SequenceMemory, impossible: bool = False) -> LoopClosure:
    """The judged closure, accepted or refused with a reason.

    The score of an accepted one is P(same place) with the keyframes before it. `sequence` remembers this query last;
    `impossible` is odometry's word, where there is any between both images.
    """
    if closure.reason is Reason.NOT_RERANKED:
        return closure
    evidence = closure.evidence or Evidence(closure.similarity, closure.spatial, closure.inliers)
    if evidence.texture < config.min_texture:
        return replace(closure, reason=Reason.LOW_TEXTURE)
    if closure.score < config.accept_score:  # frames that agree lift no weak one: look-alike corridors agree in order
        return replace(closure, reason=Reason.LOW_SCORE)
    wanted = config.consistency
    path = sequence.path(closure, window_of(wanted))
    alone = wanted <= 1  # nothing beyond the closure itself is asked for
    agreed = alone or confirmed(path, wanted)
    belief = closure.score if alone or not agreed else max(closure.score, path.belief)
    if config.verify and evidence.local_inliers < 0 and evidence.local_inliers != NO_PICTURE:
        return replace(closure, reason=Reason.NOT_VERIFIED)
    if impossible:
        return replace(closure, reason=Reason.ODOMETRY)
    if outdone(evidence) or (not agreed and closure.score < config.sure_score):
        return replace(closure, reason=Reason.UNCONFIRMED)
    if not alone and ambiguous(evidence):
        longer = sequence.path(closure, window_of(wanted + DOUBT))
        if not confirmed(longer, wanted + DOUBT):
            return replace(closure, reason=Reason.AMBIGUOUS)
    return replace(closure, score=belief, accepted=True)


def outdone(evidence: Evidence) -> bool:
    """Whether a keyframe near the match is supported far better: this one shows the place from farther along."""
    return 0 <= _FAR_BETTER * evidence.local_inliers < evidence.near_inliers


def ambiguous(evidence: Evidence) -> bool:
    """Whether this look occurs elsewhere: a place far from the match in the sequence is supported about alike.

    On laps the rival may be the same place on another lap, so doubt asks for more keyframes that agree rather than
    refusing for good; look-alike rooms (Doppelgangers: Cai et al., ICCV 2023) are left before they agree that long.
    """
    return evidence.rival_inliers > CHANCE and evidence.rival_inliers >= _ALIKE * evidence.local_inliers
