"""From what is known of a candidate to P(same place)."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Evidence:
    """What is known of a candidate before the decision. All but `inliers` in [0, 1]."""

    similarity: float  # cosine of the global vectors
    spatial: float  # fused spatial score
    inliers: int  # RANSAC inliers over all patch sizes (mutual matches for the rapid scorer)


class Uncalibrated:
    """The spatial score as it is: it ranks, but is no probability."""

    def probability(self, evidence: Evidence) -> float:
        return evidence.spatial
