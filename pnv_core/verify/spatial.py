"""Spatial scores of matched patches, in [0, 1], larger is better (Patch-NetVLAD section 3.4)."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from pnv_core.types import PatchGrid
from pnv_core.verify.homography import homography_inliers

RANSAC_TOLERANCE_CELLS = 1.5  # the authors' code: 1.5 strides, 24 px (the paper prints one stride)
MIN_MATCHES = 4  # a homography needs four points


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


def fused_score(scores: Sequence[float], weights: Sequence[float]) -> float:
    """Convex combination over the patch sizes (Patch-NetVLAD equation 13)."""
    return float(np.dot(scores, weights))
