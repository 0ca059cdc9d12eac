"""Which candidate of a query comes first: all evidence together, so that re-ranking does not subtract.

The patches' spatial score alone puts a wrong place first where the viewpoint has changed; the global vector knows more
there. Weights are those that serve best on the places of `benchmarks/closure_sets.py` that choices are made on.
"""

import math

from pnv_core.config import Config
from pnv_core.types import Evidence, LoopClosure

_SPATIAL = 0.2  # of the logarithm of the spatial score, against the cosine
_LEAST_SPATIAL = 0.01
_OWN = 0.2  # of the logarithm of the local matches that no other candidate has as near
_LEAST_OWN = 10  # and of what no local feature examined


def standing(evidence: Evidence) -> float:
    """Grows with similarity, spatial score and what local features say; only differences within a query count."""
    spatial = math.log(max(evidence.spatial, _LEAST_SPATIAL) / _LEAST_SPATIAL)
    own = math.log(max(evidence.own_matches, _LEAST_OWN) / _LEAST_OWN)
    return evidence.similarity + _SPATIAL * spatial + _OWN * own


class Order:
    """Sorts closures of a query best first: accepted ones by their score, the others by standing.

    Published presets sort those by the paper's score.
    """

    def __init__(self, config: Config) -> None:
        self._paper = config.preset != "default"

    def __call__(self, closure: LoopClosure) -> tuple[bool, float, float, int]:
        evidence = closure.evidence or Evidence(closure.similarity, closure.spatial, closure.inliers)
        by = closure.score if closure.accepted else closure.spatial if self._paper else standing(evidence)
        return not closure.accepted, -by, -closure.similarity, closure.match.id
