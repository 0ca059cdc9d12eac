"""Mutual nearest neighbours between patch descriptors. n_q, n_r patches of query and reference, D dimensions."""

import numpy as np
from numpy.typing import NDArray

Indices = NDArray[np.int64]


def mutual_nearest(query: NDArray[np.floating], reference: NDArray[np.floating]) -> tuple[Indices, Indices]:
    """(n_q, D), (n_r, D) unit rows -> matched patch numbers (query, reference), ordered by reference patch.

    Patch i of the query and j of the reference match if each is the other's most similar (Patch-NetVLAD section 3.3);
    the lowest number wins ties. Rows of zeros (masked patches) match nothing.
    """
    if not len(query) or not len(reference):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    similarity = query.astype(np.float32, copy=False) @ reference.astype(np.float32, copy=False).T
    forward = similarity.argmax(0)  # (n_r,) best query patch of each reference patch
    backward = similarity.argmax(1)  # (n_q,) best reference patch of each query patch
    matched = np.flatnonzero(backward[forward] == np.arange(len(reference)))
    matched = matched[reference[matched].any(1) & query[forward[matched]].any(1)]
    return forward[matched].astype(np.int64), matched.astype(np.int64)
