"""Which rows of the vector table are most similar to a query. N = rows, D = dimension."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pnv_core.database.vectors import VectorTable


class VectorIndex(Protocol):
    """Finds rows by similarity. `search` may give more rows than asked for, in any order; the caller ranks them."""

    row_bytes: int  # bytes per vector beside the vector itself

    def add(self, slot: int) -> None: ...

    def remove(self, slot: int) -> None: ...

    def search(self, query: NDArray[np.float32], k: int, allowed: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Rows (>= min(k, allowed.sum()),) among those allowed (high,)."""
        ...


class ExactIndex:
    """Every similarity, one matrix-vector product."""

    row_bytes = 0

    def __init__(self, table: VectorTable) -> None:
        self._table = table

    def add(self, slot: int) -> None:
        pass

    def remove(self, slot: int) -> None:
        pass

    def search(self, query: NDArray[np.float32], k: int, allowed: NDArray[np.bool_]) -> NDArray[np.int64]:
        similarity = self._table.vectors[: len(allowed)] @ query
        return largest(np.where(allowed, similarity, -np.inf), k)


def largest(values: NDArray[np.float32], k: int) -> NDArray[np.int64]:
    """Positions of the k largest finite values and of all that tie with the last of them, in any order."""
    if len(values) > k:
        tie = np.partition(values, len(values) - k)[-k] - 1e-6  # the product's rounding depends on a row's position
        return np.flatnonzero((values >= tie) & np.isfinite(values))
    return np.flatnonzero(np.isfinite(values))
