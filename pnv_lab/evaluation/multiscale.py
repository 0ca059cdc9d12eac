"""The paper's alternatives to fusing spatial scores: one joint score over all patch sizes (supplement)."""

import cv2
import numpy as np
from numpy.typing import NDArray

from pnv_core.types import PlaceDescriptor
from pnv_core.verify.matching import mutual_nearest
from pnv_core.verify.spatial import MIN_MATCHES, RANSAC_TOLERANCE_CELLS

_Points = NDArray[np.float32]


def early_fusion_score(query: PlaceDescriptor, reference: PlaceDescriptor) -> float:
    """Mutual nearest neighbours within each size, one RANSAC over all of them; share of the query's patches."""
    points = []
    for q, r in zip(query.patches, reference.patches, strict=True):
        matched_q, matched_r = mutual_nearest(q.descriptors, r.descriptors)
        points.append((q.keypoints()[matched_q], r.keypoints()[matched_r]))
    return _joint(query, np.concatenate([p[0] for p in points]), np.concatenate([p[1] for p in points]))


def cross_size_score(query: PlaceDescriptor, reference: PlaceDescriptor) -> float:
    """Mutual nearest neighbours among the patches of all sizes together, one RANSAC; share of the query's patches."""
    q, r = (np.concatenate([g.descriptors for g in d.patches]) for d in (query, reference))
    q_points, r_points = (np.concatenate([g.keypoints() for g in d.patches]) for d in (query, reference))
    matched_q, matched_r = mutual_nearest(q, r)
    return _joint(query, q_points[matched_q], r_points[matched_r])


def _joint(query: PlaceDescriptor, target: NDArray, source: NDArray) -> float:
    patches = sum(g.rows * g.cols for g in query.patches)
    tolerance = max(g.cell * g.stride for g in query.patches) * RANSAC_TOLERANCE_CELLS
    return count_homography_inliers(source.astype(np.float32), target.astype(np.float32), tolerance) / patches


def count_homography_inliers(source: _Points, target: _Points, tolerance: float) -> int:
    """How many of the (M, 2) point pairs one homography explains within `tolerance` pixels; 0 below four pairs."""
    if len(source) < MIN_MATCHES:
        return 0
    _, mask = cv2.findHomography(source, target, cv2.RANSAC, tolerance)
    return 0 if mask is None else int(mask.sum())
