"""Mutual nearest neighbours between patch descriptors. n_q, n_r patches of query and reference, D dimensions."""

import cv2
import numpy as np
from numpy.typing import NDArray

Indices = NDArray[np.int64]


def patch_rows(descriptors: NDArray[np.floating]) -> NDArray[np.float32]:
    """(n, D) float32 or float16, as they are stored -> float32, contiguous."""
    if descriptors.dtype != np.float16 or not descriptors.size:
        return np.ascontiguousarray(descriptors, np.float32)
    return np.asarray(cv2.multiply(descriptors, 1.0, dtype=cv2.CV_32F))  # numpy converts ten times slower


def mutual_nearest(query: NDArray[np.floating], reference: NDArray[np.floating]) -> tuple[Indices, Indices]:
    """(n_q, D), (n_r, D) unit rows -> matched patch numbers (query, reference), ordered by reference patch.

    Patch i of the query and j of the reference match if each is the other's most similar (Patch-NetVLAD section 3.3);
    the lowest number wins ties. Rows of zeros (masked patches) match nothing.
    """
    return mutual_nearest_rows(patch_rows(query), patch_rows(reference))


def mutual_nearest_rows(query: NDArray[np.float32], reference: NDArray[np.float32]) -> tuple[Indices, Indices]:
    """As mutual_nearest, of prepared rows."""
    if not len(query) or not len(reference):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    similarity = reference @ query.T
    forward = np.where(reference.any(1), similarity.argmax(1), -1)
    backward = np.where(query.any(1), similarity.argmax(0), -1)
    matched = np.flatnonzero((forward >= 0) & (backward[forward] == np.arange(len(forward))))
    return forward[matched], matched
