"""Mutual nearest neighbours between patch descriptors. n_q, n_r patches of query and reference, D dimensions."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from pnv_core import kernels

Indices = NDArray[np.int64]


def _products_are_fast() -> bool:
    """Whether the processor multiplies int8 four at a time, and torch offers it."""
    known = hasattr(torch, "_int_mm") and hasattr(torch.cpu, "_is_vnni_supported")
    return kernels.COMPILED and known and bool(torch.cpu._is_vnni_supported())


_QUANTISED = _products_are_fast()


@dataclass(frozen=True, eq=False)
class PatchRows:
    """Patch descriptors made ready for matching: unit rows (n, D) float32, contiguous, and where int8 products are
    fast their int8 codes (n, D), scales (n,) and the largest length `error` of a row's rounding error."""

    rows: NDArray[np.float32]
    codes: NDArray[np.int8] | None = None
    scales: NDArray[np.float32] | None = None
    error: float = 0.0


def patch_rows(descriptors: NDArray[np.floating]) -> PatchRows:
    """(n, D) float32 or float16, as they are stored."""
    rows = _as_float32(descriptors)
    if not _QUANTISED or not len(rows):
        return PatchRows(rows)
    codes, scales = np.empty(rows.shape, np.int8), np.empty(len(rows), np.float32)
    return PatchRows(rows, codes, scales, kernels.quantise_rows(rows, codes, scales))


def _as_float32(descriptors: NDArray[np.floating]) -> NDArray[np.float32]:
    if descriptors.dtype != np.float16 or not kernels.COMPILED:
        return np.ascontiguousarray(descriptors, np.float32)
    rows = np.empty(descriptors.shape, np.float32)
    kernels.unpack_halves(np.ascontiguousarray(descriptors).view(np.uint16), rows)
    return rows


def mutual_nearest(query: NDArray[np.floating], reference: NDArray[np.floating]) -> tuple[Indices, Indices]:
    """(n_q, D), (n_r, D) unit rows -> matched patch numbers (query, reference), ordered by reference patch.

    Patch i of the query and j of the reference match if each is the other's most similar (Patch-NetVLAD section 3.3);
    the lowest number wins ties. Rows of zeros (masked patches) match nothing.
    """
    return mutual_nearest_rows(patch_rows(query), patch_rows(reference))


def mutual_nearest_rows(query: PatchRows, reference: PatchRows) -> tuple[Indices, Indices]:
    """As mutual_nearest, of prepared rows.

    Where int8 products are fast, they only say which pairs can be nearest, by a bound: with x = x' + e_x and
    y = y' + e_y, |x.y - x'.y'| <= |e_x| + |e_y| + |e_x| |e_y| for unit rows. Those pairs are multiplied in float32.
    """
    if not len(query.rows) or not len(reference.rows):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    forward, backward = _nearest(query, reference)
    matched = np.flatnonzero((forward >= 0) & (backward[forward] == np.arange(len(forward))))
    return forward[matched], matched


def _nearest(query: PatchRows, reference: PatchRows) -> tuple[Indices, Indices]:
    """The nearest query patch of each reference patch (n_r,) and the reverse (n_q,); -1 for rows of zeros."""
    if query.codes is None or reference.codes is None:
        similarity = reference.rows @ query.rows.T
        forward = np.where(reference.rows.any(1), similarity.argmax(1), -1)
        return forward, np.where(query.rows.any(1), similarity.argmax(0), -1)
    forward, backward = np.empty(len(reference.rows), np.int64), np.empty(len(query.rows), np.int64)
    products = torch._int_mm(torch.from_numpy(reference.codes), torch.from_numpy(query.codes).T).numpy()
    bound = query.error + reference.error + query.error * reference.error
    margin = np.float32(1.01 * bound + 1e-5)  # and the rounding of the bound itself
    kernels.nearest_of_products(
        products, query.rows, reference.rows, query.scales, reference.scales, margin, forward, backward
    )
    return forward, backward
