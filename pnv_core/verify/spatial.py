"""Spatial scores of matched patches, in [0, 1], larger is better (Patch-NetVLAD section 3.4)."""

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from pnv_core.types import PatchGrid, PatchMatches
from pnv_core.verify.homography import homography_inliers

RANSAC_TOLERANCE_CELLS = 1.5  # the authors' code: 1.5 strides, 24 px (the paper prints one stride)
MIN_MATCHES = 4  # a homography needs four points
_SCALE_INLIERS = 8  # with fewer the slope is mostly noise
_SCALE_TOLERANCE = 0.1  # of |log scale|; ten per cent nearer or farther is another place in a row of keyframes
_SMALLEST_SLOPE = 0.05


def ransac_score(
    query: PatchGrid,
    reference: PatchGrid,
    matches: tuple[NDArray[np.int64], NDArray[np.int64]],
    search: Callable[[NDArray[np.float32], NDArray[np.float32], float], NDArray[np.bool_]] = homography_inliers,
) -> tuple[float, NDArray[np.bool_]]:
    """Share of the query's patches that a homography reference -> query explains, and which matches (M,) do.

    `search` finds the inliers: `homography_inliers` those of the authors' code, `usac_inliers` nearly those, sooner.
    Fewer than four matches, or no homography (all on one line), give 0.
    """
    q, r = matches
    if len(q) < MIN_MATCHES:
        return 0.0, np.zeros(len(q), bool)
    tolerance = query.cell * query.stride * RANSAC_TOLERANCE_CELLS
    source = reference.keypoints()[r].astype(np.float32)
    target = query.keypoints()[q].astype(np.float32)
    inlier = search(source, target, tolerance)
    return float(inlier.sum()) / (query.rows * query.cols), inlier


def rapid_spatial_score(
    query: PatchGrid, reference: PatchGrid, matches: tuple[NDArray[np.int64], NDArray[np.int64]]
) -> float:
    """Coherence of the matched displacements; 1 for identical images, 0 without matches.

    Patch-NetVLAD section 3.4, anchored at the grid extent (as the authors' code does) and divided by its maximum.
    """
    q, r = matches
    patches = query.rows * query.cols
    if not len(q):
        return 0.0
    extent = np.array([query.cols - 1, query.rows - 1], np.float64)
    largest = float((extent**2).sum())
    if largest == 0.0:
        return len(q) / patches  # a grid of one patch knows no displacement
    displacement = (reference.indices()[r] - query.indices()[q]).astype(np.float64)
    deviation = np.abs(displacement - displacement.mean(0))
    return float(((extent - deviation) ** 2).sum()) / (patches * largest)


def scale_change(matches: Sequence[PatchMatches]) -> float:
    """How surely the inliers of a pair show the scene at two scales, in [0, 1): 0 = at one.

    Going forward magnifies an image, going sideways does not: of two places in a row that match a query about equally,
    the one seen at the query's scale is the nearer. The scale is the slope of the inliers' rows in one image over those
    in the other, which the parallax of a sideways step leaves alone; the mean |log slope| over the patch sizes is
    weighed by a Gaussian. A size with too few inliers counts as seen at another scale.
    """
    changes = [_log_scale(m.query_xy[m.inlier, 1], m.reference_xy[m.inlier, 1]) for m in matches]
    return 1.0 - math.exp(-((sum(changes) / len(changes) / _SCALE_TOLERANCE) ** 2))


def _log_scale(query: NDArray[np.floating], reference: NDArray[np.floating]) -> float:
    if len(query) < _SCALE_INLIERS:
        return 1.0
    centred = query - query.mean()
    spread = float(centred @ centred)
    slope = float(centred @ (reference - reference.mean())) / spread if spread else 0.0
    return abs(math.log(max(slope, _SMALLEST_SLOPE)))


def fused_score(scores: Sequence[float], weights: Sequence[float]) -> float:
    """Convex combination over the patch sizes (Patch-NetVLAD equation 13)."""
    return float(np.dot(scores, weights))
