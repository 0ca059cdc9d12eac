"""The last word on a candidate: the gates of docs/closures.md, in order."""

from dataclasses import replace

from pnv_core.config import Config
from pnv_core.decide.consistency import SequenceMemory, confirmed, window_of
from pnv_core.types import Evidence, LoopClosure, Reason


def decided(closure: LoopClosure, config: Config, sequence: SequenceMemory, impossible: bool = False) -> LoopClosure:
    """The judged closure, accepted or refused with a reason.

    `sequence` remembers this query last; `impossible` is odometry's word, where there is any between both images.
    """
    if closure.reason is Reason.NOT_RERANKED:
        return closure
    evidence = closure.evidence or Evidence(closure.similarity, closure.spatial, closure.inliers)
    if evidence.texture < config.min_texture:
        return replace(closure, reason=Reason.LOW_TEXTURE)
    if closure.score < config.accept_score:
        return replace(closure, reason=Reason.LOW_SCORE)
    if config.verify and evidence.local_inliers < 0:
        return replace(closure, reason=Reason.NOT_VERIFIED)
    if impossible:
        return replace(closure, reason=Reason.ODOMETRY)
    path = sequence.path(closure, window_of(config.consistency))
    if closure.score < config.sure_score and not confirmed(path, config.consistency):
        return replace(closure, reason=Reason.UNCONFIRMED)
    return replace(closure, accepted=True)
