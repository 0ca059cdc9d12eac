"""Which rows of the vector table are most similar to a query. N = rows, D = dimension.

Exact search reads 4 * D bytes a row, the quantised scan D / 4. Measured on 2 cores of an AMD EPYC with AVX-512, one
thread, D = 512, processor time (benchmarks/database.py): 100,000 rows 14 ms exact, 2.4 ms quantised; 1,000,000 rows
159 ms exact, 12 ms quantised; recall@10 of the quantised scan at least 0.998 on random and on trajectory-like vectors.
HNSW and IVF-PQ were slower than the scan at equal recall and slower to build; they went.
"""

from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from pnv_core.database.vectors import Allowed, VectorTable
from pnv_core.errors import ConfigError
from pnv_core.registry import Registry

EXACT_BYTES = 64_000_000  # above this much to read per query, `auto` scans codes: 5 ms here
CATCH_UP = 32  # rows encoded per add while `auto` prepares to leave exact search: 0.3 ms


class Index(Protocol):
    """Finds rows by similarity. `search` may give more rows than asked for, in any order; the caller ranks them."""

    def nbytes(self, more: int = 0) -> int:
        """Bytes beside the vectors, now or after `more` further rows."""
        ...

    def add(self, slot: int) -> None:
        """Take in a row of the table; a row used before is replaced."""
        ...

    def remove(self, slot: int) -> None: ...

    def search(self, query: NDArray[np.float32], k: int, allowed: Allowed) -> NDArray[np.int64]:
        """At least k rows, or all allowed ones if those are fewer; only allowed ones."""
        ...


class ExactIndex:
    """Every similarity, one matrix-vector product."""

    def __init__(self, table: VectorTable) -> None:
        self._table = table

    def nbytes(self, more: int = 0) -> int:
        return 0

    def add(self, slot: int) -> None:
        pass

    def remove(self, slot: int) -> None:
        pass

    def search(self, query: NDArray[np.float32], k: int, allowed: Allowed) -> NDArray[np.int64]:
        similarity = _similarities(self._table.vectors[: self._table.high], query)
        return _largest(np.where(allowed.all(), similarity, -np.inf), k)


class PqIndex:
    """Every similarity, approximately, from 2 bits per dimension; the exact ones of the best 1000 decide.

    Product quantisation with 4-bit codes of pairs (FAISS fast scan). Vectors are turned by random signs and a Fourier
    transform, after which every pair of a unit vector is nearly a 2-D Gaussian of variance 1 / D; so one codebook, that
    of the Gaussian, serves every model and map: nothing is trained and nothing drifts. The code of row i lies at place
    i and is overwritten in place when the row is reused.
    """

    def __init__(self, table: VectorTable) -> None:
        faiss = _faiss()
        dim = table.dim
        if dim % 2:
            raise ConfigError(
                f"index = 'pq' with vectors of {dim} dimensions; allowed: an even number, or index = 'exact'"
            )
        self._table = table
        self._signs = np.random.default_rng(2).choice(np.array([-1, 1], np.float32), dim)
        self._codes = faiss.IndexPQFastScan(dim, dim // 2, 4, faiss.METRIC_INNER_PRODUCT)
        codebook = np.tile(_gaussian_codebook() / np.float32(np.sqrt(dim)), (dim // 2, 1))  # (D/2 * 16, 2)
        faiss.copy_array_to_vector(codebook.ravel(), self._codes.pq.centroids)
        self._codes.is_trained = True
        self._packer = self._codes.get_CodePacker()

    @property
    def rows(self) -> int:
        """Rows encoded: the first ones of the table."""
        return self._codes.ntotal

    def nbytes(self, more: int = 0) -> int:
        rows = self.rows + more
        needed = -(-rows // self._packer.nvec) * self._packer.block_size
        allocated = 1 << max(needed - 1, 1).bit_length()  # FAISS grows the code table by doubling
        return self._signs.nbytes + allocated

    def add(self, slot: int) -> None:
        if slot >= self.rows:
            self.encode_up_to(slot + 1)
        else:
            self._overwrite(slot)

    def encode_up_to(self, rows: int) -> None:
        """Encode the rows of the table that are not yet, up to this many."""
        for start in range(self.rows, rows, 8192):
            self._codes.add(self._turned(self._table.vectors[start : min(rows, start + 8192)]))

    def _turned(self, vectors: NDArray[np.float32]) -> NDArray[np.float32]:
        """(n, D) by an orthogonal map without a matrix: signs, then the real Fourier transform as D / 2 pairs."""
        dim = vectors.shape[1]
        bins = np.fft.rfft(vectors * self._signs, norm="ortho")  # (n, D / 2 + 1) complex
        turned = np.empty((len(vectors), dim), np.float32)
        turned[:, 0], turned[:, 1] = bins[:, 0].real, bins[:, -1].real  # the two bins that are real
        turned[:, 2::2] = np.sqrt(2) * bins[:, 1:-1].real
        turned[:, 3::2] = np.sqrt(2) * bins[:, 1:-1].imag
        return turned

    def _overwrite(self, slot: int) -> None:
        faiss = _faiss()
        code = self._codes.pq.compute_codes(self._turned(self._table.vectors[slot : slot + 1]))[0]
        packed = faiss.rev_swig_ptr(self._codes.codes.get(), self._codes.codes.size())
        block, place = divmod(slot, self._packer.nvec)
        self._packer.pack_1(code, place, packed.reshape(-1, self._packer.block_size)[block : block + 1])

    def remove(self, slot: int) -> None:
        pass  # `allowed` leaves it out until the row is reused

    def search(self, query: NDArray[np.float32], k: int, allowed: Allowed) -> NDArray[np.int64]:
        examined = max(1000, 20 * k)
        turned = self._turned(query[None])
        while 4 * examined < self._table.high:
            found = self._codes.search(turned, examined)[1][0]
            found = found[found >= 0]
            found = found[allowed.of(found)]
            if len(found) >= max(k, examined // 4):
                return _best(self._table, np.sort(found), query, k)
            examined *= 4
        return _best(self._table, np.flatnonzero(allowed.all()), query, k)


class AutoIndex:
    """Exact search while a query reads at most EXACT_BYTES, the quantised scan beyond.

    The codes are made a few rows per add before they are needed, so that no frame waits for the change.
    """

    def __init__(self, table: VectorTable) -> None:
        self._table = table
        self._exact = ExactIndex(table)
        self._scan: PqIndex | None = None

    def _exact_rows(self) -> int:
        return EXACT_BYTES // (4 * self._table.dim)

    def nbytes(self, more: int = 0) -> int:
        return self._scan.nbytes(more * (CATCH_UP + 1)) if self._scan is not None else 0

    def add(self, slot: int) -> None:
        if self._scan is None and 2 * self._table.high > self._exact_rows() and self._table.dim % 2 == 0:
            self._scan = PqIndex(self._table)
        if self._scan is None:
            return
        if slot < self._scan.rows:
            self._scan.add(slot)
        self._scan.encode_up_to(min(self._table.high, self._scan.rows + CATCH_UP))

    def remove(self, slot: int) -> None:
        pass

    def search(self, query: NDArray[np.float32], k: int, allowed: Allowed) -> NDArray[np.int64]:
        if self._scan is None or self._scan.rows < self._table.high or self._table.high <= self._exact_rows():
            return self._exact.search(query, k, allowed)
        return self._scan.search(query, k, allowed)


INDICES: Registry[Index] = Registry(
    "index",
    {name: f"pnv_core.database.index:{name.capitalize()}Index" for name in ("auto", "exact", "pq")},
    ConfigError,
)


def _similarities(rows: NDArray[np.float32], query: NDArray[np.float32]) -> NDArray[np.float32]:
    """(N, D), (D,) -> (N,) inner products by FAISS, twice to eight times as fast as the BLAS of numpy here."""
    faiss = _faiss()
    products = np.empty(len(rows), np.float32)
    arrays = [products, np.ascontiguousarray(query), np.ascontiguousarray(rows)]  # held while FAISS has their addresses
    faiss.fvec_inner_products_ny(*(faiss.swig_ptr(array) for array in arrays), rows.shape[1], len(rows))
    return products


def _faiss() -> Any:
    import faiss  # not at the top: 0.1 s that reading a map need not pay; and its type stubs are incomplete

    return faiss


def _gaussian_codebook() -> NDArray[np.float32]:
    """(16, 2) k-means of the standard 2-D Gaussian: the grid of least error for 4-bit codes of pairs."""
    faiss = _faiss()
    kmeans = faiss.Kmeans(2, 16, niter=25, seed=1, max_points_per_centroid=10_000)
    kmeans.train(np.random.default_rng(1).standard_normal((20_000, 2), dtype=np.float32))
    return cast(np.ndarray, kmeans.centroids)


def _best(table: VectorTable, slots: NDArray[np.int64], query: NDArray[np.float32], k: int) -> NDArray[np.int64]:
    return slots[_largest(_similarities(table.vectors[slots], query), k)]


def _largest(values: NDArray[np.float32], k: int) -> NDArray[np.int64]:
    """Positions of the k largest finite values and of all that tie with the last of them, in any order."""
    if len(values) > k:
        tie = np.partition(values, len(values) - k)[-k] - 1e-6  # the product's rounding depends on a row's position
        return np.flatnonzero((values >= tie) & np.isfinite(values))
    return np.flatnonzero(np.isfinite(values))
