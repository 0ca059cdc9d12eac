"""Mutual nearest neighbours between patch descriptors. n_q, n_r patches of query and reference, D dimensions."""

import threading

import cv2
import numpy as np
from numpy.typing import NDArray

Indices = NDArray[np.int64]
_memory = threading.local()


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
    return mutual_maxima(similarities(reference, query))


def mutual_maxima(similarity: NDArray[np.float32]) -> tuple[Indices, Indices]:
    """(R, Q) -> columns and rows of what is the largest of its row and of its column, by row; the first of equal ones.

    Rows and columns of nothing but zeros have none.
    """
    forward = similarity.argmax(1)
    highest = similarity[np.arange(len(forward)), forward]
    of_column = similarity.max(0)
    matched = np.flatnonzero(highest == of_column[forward])
    columns = forward[matched]
    # numpy finds the place of a column's maximum at three times the cost of its value, which decides alone
    # unless two are equal, or all is zero
    if np.count_nonzero(similarity == of_column) > len(of_column) or not (highest.all() and of_column.all()):
        backward = similarity.argmax(0)
        kept = (backward[columns] == matched) & similarity[matched].any(1) & similarity[:, columns].any(0)
        return columns[kept], matched[kept]
    return columns, matched


def similarities(rows: NDArray[np.float32], columns: NDArray[np.float32]) -> NDArray[np.float32]:
    """(R, D), (Q, D) -> their products (R, Q), in memory of this thread that the next call overwrites.

    Memory allocated anew each time costs as much again in page faults.
    """
    size = len(rows) * len(columns)
    held: NDArray[np.float32] | None = getattr(_memory, "held", None)
    if held is None or held.size < size:
        held = _memory.held = np.empty(size, np.float32)
    return np.matmul(rows, columns.T, out=held[:size].reshape(len(rows), len(columns)))
