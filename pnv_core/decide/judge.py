"""What speaks for each candidate, weighed: patches first, then local features of the best ones, then P(same place)."""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice

import numpy as np

from pnv_core.config import Config
from pnv_core.decide.calibration import Calibration, calibration_for
from pnv_core.decide.consistency import Steps, by_id
from pnv_core.decide.order import Order
from pnv_core.threads import workers
from pnv_core.types import NO_PICTURE, Evidence, ImageRef, LoopClosure, PatchMatches, PlaceDescriptor, Reason
from pnv_core.verify.reranker import Reranker, SpatialResult
from pnv_core.verify.verifier import VERIFIERS, hull_area

_NEIGHBOURS = 10  # keyframes of a sequence this close to each other show one place
AROUND = 50  # most similar keyframes to be known for the background
_CLOSER = 2  # of the best candidates
_UNSURE = (0.03, 0.6)  # P(same place) that a closer look may change; beyond, it costs time alone
_SUREST = 60.0  # confidence of matches that would settle it: one in seven true pairs of viewpoint_places has more
_EVEN = 0.5
_ON_A_LINE = 1e8  # ratio of the largest to the least scatter
_BACKGROUND = 5  # the first few elsewhere may be the place itself on another lap

Candidate = tuple[ImageRef, float]  # keyframe, similarity


class Judge:
    """Scores the candidates of a query with the re-ranker and calibration of a completed Config."""

    def __init__(self, config: Config, stored_calibration: dict | None, steps: Steps | None = None) -> None:
        self._steps = steps or by_id
        self.reranker = Reranker(config)
        self.verifier = VERIFIERS.make(config.verifier, config)
        self.calibration: Calibration = calibration_for(stored_calibration, config)
        self.order = Order(config)

    def judge(
        self,
        query: ImageRef,
        descriptor: PlaceDescriptor,
        predecessor: float,
        candidates: Sequence[Candidate],
        references: Sequence[PlaceDescriptor],
        config: Config,
        around: Sequence[Candidate] = (),
    ) -> list[LoopClosure]:
        """A LoopClosure per candidate, best first, none accepted yet.

        `references` is what is stored of the first candidates; the others are refused as not re-ranked. `around` are
        the AROUND most similar keyframes, best first; where not given, the candidates themselves.
        `predecessor` is the cosine of the query and the keyframe before it (1 if there is none); the
        `config.verify` best are examined by local features where both images have a thumbnail; where one has none, the
        evidence is missing and the calibration of patches alone decides. An image with less
        texture than `config.min_texture` scores 0.
        """
        scored = self.reranker.scores(descriptor, references)
        found = []
        for number, (result, reference) in enumerate(zip(scored, references, strict=True)):
            ref, similarity = candidates[number]
            spread, distortion = spread_and_distortion(descriptor, result.matches)
            elsewhere = [i for i, (other, _) in enumerate(candidates) if self._apart(other, ref)]
            evidence = Evidence(
                similarity=similarity,
                spatial=result.score,
                inliers=result.inliers,
                spread=spread,
                distortion=distortion,
                lead=min((similarity - candidates[i][1] for i in elsewhere), default=0.0),
                recent_lead=similarity - predecessor,
                spatial_lead=min((result.score - scored[i].score for i in elsewhere if i < len(scored)), default=0.0),
                texture=min(descriptor.texture, reference.texture),
                local_inliers=-1 if reference.thumbnail else NO_PICTURE,
                background=self._background(ref, around or candidates),
            )
            found.append((self._closure(query, ref, evidence, result, config.min_texture), evidence, number))
        found.sort(key=lambda pair: self.order(pair[0]))
        kept = [references[number].thumbnail for _, _, number in found[: config.verify]]
        if descriptor.thumbnail and any(kept):
            cameras = [closure.match.camera for closure, _, _ in found]
            shown = [(picture, camera) for picture, camera in zip(kept, cameras, strict=False) if picture]
            self.verifier.prepare([(descriptor.thumbnail, query.camera), *shown], self.reranker.workers)
            checks = workers(1).map(lambda pair: self.verifier.check(descriptor.thumbnail, query.camera, *pair), shown)
            places = [place for place, picture in enumerate(kept) if picture]
            examined = [(found[place][0].match, check) for place, check in zip(places, checks, strict=True)]
            for place, check in zip(places, checks, strict=True):
                closure, evidence, number = found[place]
                rivals = [other for ref, other in examined if self._apart(ref, closure.match)]
                seen = replace(
                    evidence,
                    local_inliers=check.inliers,
                    local_spread=check.spread,
                    local_matches=len(check.inlier),
                    own_matches=check.matches_beside(rivals),
                    likeness=check.likeness,
                )
                verified = self._closure(query, closure.match, seen, scored[number], config.min_texture)
                found[place] = verified, seen, number
            for place in sorted(places, key=lambda place: self.order(found[place][0]))[:_CLOSER]:
                closure, evidence, number = found[place]
                if self._in_doubt(closure.score, evidence):
                    look = self.verifier.look_closer(descriptor.thumbnail, kept[place])
                    seen = replace(evidence, match_confidence=look.confidence, magnification=look.magnification)
                    matched = self._closure(query, closure.match, seen, scored[number], config.min_texture)
                    found[place] = matched, seen, number
        # what ranked lower and was not examined is not believed more than what was; what has no picture stands by
        # what its patches say
        most = max((c.score for c, e, _ in found if e.local_inliers >= 0), default=1.0)
        closures = [replace(c, score=min(c.score, most)) if e.local_inliers == -1 else c for c, e, _ in found]
        closures = [self._beside_rivals(c, closures) for c in closures]
        rest = [_not_reranked(query, *candidate, descriptor.texture) for candidate in candidates[len(references) :]]
        return sorted(closures + rest, key=self.order)

    def _in_doubt(self, score: float, evidence: Evidence) -> bool:
        """Whether a closer look may turn a candidate into a closure, or take it from those that nearly are."""
        least, most = _UNSURE
        surest = replace(evidence, match_confidence=_SUREST)
        return (
            self.calibration.matched is not None
            and least <= score < most
            and max(score, self.calibration.probability(surest)) >= _EVEN
        )

    def _apart(self, a: ImageRef, b: ImageRef) -> bool:
        return (a.robot, a.session) != (b.robot, b.session) or abs(self._steps(a, b)) > _NEIGHBOURS

    def _background(self, match: ImageRef, around: Sequence[Candidate]) -> float:
        """How similar other places are to the query: the fifth keyframe elsewhere.

        Of a young map, where `around` is all there is, at least the middle one: the fifth of five is no measure.
        """
        elsewhere = list(islice((s for ref, s in around if self._apart(ref, match)), _BACKGROUND))
        fifth = elsewhere[_BACKGROUND - 1] if len(elsewhere) >= _BACKGROUND else -1.0
        return fifth if len(around) >= AROUND else max(fifth, around[len(around) // 2][1])

    def _beside_rivals(self, closure: LoopClosure, all_of_query: Sequence[LoopClosure]) -> LoopClosure:
        """With the most support that any other place of the match's own sequence has, and that its own place has."""
        there, evidence = closure.match, closure.evidence
        assert evidence is not None
        rival = near = 0
        for c in all_of_query:
            if c.evidence is not None and (c.match.robot, c.match.session) == (there.robot, there.session):
                if self._apart(c.match, there):
                    rival = max(rival, c.evidence.local_inliers)
                else:
                    near = max(near, c.evidence.local_inliers)
        return replace(closure, evidence=replace(evidence, rival_inliers=rival, near_inliers=near))

    def _closure(
        self, query: ImageRef, match: ImageRef, evidence: Evidence, result: SpatialResult, min_texture: float
    ) -> LoopClosure:
        score = self.calibration.probability(evidence) if evidence.texture >= min_texture else 0.0
        return LoopClosure(
            query, match, score, evidence.similarity, result.score, result.inliers, False,
            matches=result.matches, evidence=evidence,
        )  # fmt: skip


def _not_reranked(query: ImageRef, match: ImageRef, similarity: float, texture: float) -> LoopClosure:
    evidence = Evidence(similarity=similarity, spatial=0.0, inliers=0, texture=texture)
    return LoopClosure(query, match, 0.0, similarity, 0.0, 0, False, Reason.NOT_RERANKED, evidence=evidence)


def _inlier_points(matches: Sequence[PatchMatches]) -> tuple[np.ndarray, np.ndarray]:
    """(N, 2), (N, 2) pixels of the inliers of every patch size, pooled; all matches where none was tested."""
    pairs = []
    for m in matches:
        use = m.inlier if m.inlier.any() else slice(None)
        pairs.append((m.query_xy[use], m.reference_xy[use]))
    return np.concatenate([p for p, _ in pairs]), np.concatenate([p for _, p in pairs])


def spread_and_distortion(query: PlaceDescriptor, matches: Sequence[PatchMatches]) -> tuple[float, float]:
    """Of the patch inliers: how far they reach, and how far the affine map from reference to query is from a shift.

    Spread is their convex hull as a share of what the patch centres span, the smaller of both images; distortion the
    Frobenius norm of the map's linear part less I. A robot back at a place sees it little rotated and scaled; chance
    matches shrink to a point, mirror or shear. Infinite for fewer than three inliers or inliers on a line.
    """
    q, r = _inlier_points(matches)
    span = _span(query)
    return min(hull_area(q), hull_area(r)) / span if span else 0.0, _distortion(q, r)


def _span(descriptor: PlaceDescriptor) -> float:
    """Square pixels between the outermost centres of the size with most patches."""
    grid = max(descriptor.patches, key=lambda grid: len(grid.descriptors))
    return float((grid.rows - 1) * (grid.cols - 1) * (grid.cell * grid.stride) ** 2)


def _distortion(q: np.ndarray, r: np.ndarray) -> float:
    """Of (N, 2) inliers each; the normal equations of the affine map solved by hand."""
    if len(q) < 3:
        return float("inf")
    centred = r - r.sum(0) / len(r)
    (a, b), (_, d) = centred.T @ centred
    determinant = a * d - b * b
    largest = (a + d + math.hypot(a - d, 2.0 * b)) / 2  # eigenvalue; their product is the determinant
    if not largest * largest < _ON_A_LINE * determinant:
        return float("inf")
    (e, f), (g, h) = centred.T @ q  # as of q centred: the columns of `centred` sum to zero
    residual = d * e - b * g - determinant, d * f - b * h, a * g - b * e, a * h - b * f - determinant
    return math.hypot(*residual) / float(determinant)
