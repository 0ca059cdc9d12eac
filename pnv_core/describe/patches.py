"""IntegralVLAD: patch descriptors of several sizes from one residual map (Patch-NetVLAD section 3.2 and 3.5).

K clusters, C channels, h x w feature map (N = h * w), D dimensions, n = patches of one size.

Window sums are built by doubling (sums of size 2 from size 1, 4 from 2, ...) instead of differences of an integral
map: as few additions, shared between the sizes, and no cancellation where a cluster hardly touches a window.
The projection is linear, so each cluster's residual map is projected once and the windows are summed afterwards;
only the norms of the intra-normalisation need the unprojected sums.
"""

from collections.abc import Sequence
from functools import partial

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from pnv_core import kernels
from pnv_core.threads import Workers, spans

EPSILON = 1e-12  # as F.normalize
_LANES = 64  # columns a kernel works on at once: the lines of one grid row then fit the first-level cache
_COLUMNS = 256  # columns of one matrix product: its result then fits the second-level cache


def window_sums(maps: Tensor, sizes: Sequence[int]) -> dict[int, Tensor]:
    """(..., h, w) -> per size p the sums over p x p windows (..., h - p + 1, w - p + 1). Sizes must fit the map."""
    rows = _sliding_sums(maps, sizes, -2)
    return {size: _sliding_sums(rows[size], [size], -1)[size] for size in rows}


def _sliding_sums(maps: Tensor, sizes: Sequence[int], dim: int) -> dict[int, Tensor]:
    """Sums of `size` neighbours along `dim`, from sums of powers of two."""
    length = maps.shape[dim]
    powers = {1: maps}
    sums = {}
    for size in sizes:
        total, start = None, 0
        out = length - size + 1
        power = 1
        while power <= size:
            if power not in powers:
                half = powers[power // 2]
                reach = length - power + 1
                powers[power] = half.narrow(dim, 0, reach) + half.narrow(dim, power // 2, reach)
            if size & power:
                part = powers[power].narrow(dim, start, out)
                total = part if total is None else total + part
                start += power
            power *= 2
        assert total is not None
        sums[size] = total
    return sums


def patch_vlads(
    x: Tensor, weights: Tensor, centroids: Tensor, shape: tuple[int, int], size: int, stride: int = 1
) -> Tensor:
    """Unprojected patch VLADs (n, K * C): the definition, for small maps and for fitting projections.

    x (C, N) unit descriptors, weights (K, N) soft assignment, centroids (K, C).
    """
    k, c = centroids.shape
    residuals = weights[:, None] * (x[None] - centroids[:, :, None])  # (K, C, N)
    sums = window_sums(residuals.view(k, c, *shape), [size])[size][..., ::stride, ::stride]
    vlad = F.normalize(sums, dim=1, eps=EPSILON).flatten(2).flatten(0, 1).T  # (n, K * C)
    return F.normalize(vlad, dim=1, eps=EPSILON)


def patch_descriptors(
    x: Tensor,
    weights: Tensor,
    centroids: Tensor,
    projection: Tensor,
    bias: Tensor,
    shape: tuple[int, int],
    sizes: Sequence[int],
    strides: Sequence[int],
) -> list[Tensor]:
    """Projected unit patch descriptors per size: [(n, D), ...], row-major over the patch grid.

    x (C, N), weights (K, N), centroids (K, C), projection (D, K * C), bias (D,). A cluster no pixel of a window touches
    contributes nothing; a patch no cluster touches (masked) is a row of zeros. Raises ValueError for a size that
    exceeds the map. The plain formulation, on any device; `PatchAggregator` gives the same faster.
    """
    h, w = shape
    _check_sizes(sizes, shape)
    k, c = centroids.shape
    per_cluster = projection.view(-1, k, c)  # (D, K, C)
    sums: list[Tensor] = []
    squares: list[Tensor] = []
    for cluster in range(k):
        residual = (x - centroids[cluster][:, None]) * weights[cluster]  # (C, N)
        projected = (per_cluster[:, cluster] @ residual).view(-1, h, w)
        norms = window_sums(residual.view(c, h, w), sizes)
        patches = window_sums(projected, sizes)
        for i, (size, stride) in enumerate(zip(sizes, strides, strict=True)):
            norm = norms[size][:, ::stride, ::stride].square().sum(0).sqrt() / size**2  # (rows, cols)
            scale = 1.0 / (norm.clamp_min(EPSILON) * size**2)
            part = patches[size][:, ::stride, ::stride] * scale
            unit = (norm / norm.clamp_min(EPSILON)).square()
            if cluster == 0:
                sums.append(part)
                squares.append(unit)
            else:
                sums[i] += part
                squares[i] += unit
    out = []
    for total, square in zip(sums, squares, strict=True):
        vector = total / square.sqrt().clamp_min(EPSILON)
        rows = F.normalize(vector.flatten(1).T + bias, dim=1, eps=EPSILON)
        out.append(rows * (square.flatten()[:, None] > 0))
    return out


def _check_sizes(sizes: Sequence[int], shape: tuple[int, int]) -> None:
    for size in sizes:
        if size > min(shape):
            h, w = shape
            raise ValueError(f"patch size {size} exceeds the feature map of {h} x {w} cells; allowed: 1 to {min(h, w)}")


def bfloat16_is_fast() -> bool:
    """Whether the processor multiplies bfloat16; elsewhere torch converts, which gains nothing."""
    return hasattr(torch.cpu, "_is_avx512_bf16_supported") and bool(torch.cpu._is_avx512_bf16_supported())


class PatchAggregator:
    """Patch descriptors with one vocabulary (K, C) and projection (D, K * C), (D,), on the processor.

    Each worker takes columns of the projection: one matrix product per cluster, then that cluster's window sums while
    the product is still in cache. The norms come from products of neighbouring local descriptors (`kernels`).
    `fast` projects in bfloat16 where the processor multiplies it; all else stays float32.
    """

    def __init__(
        self, centroids: Tensor, projection: Tensor, bias: Tensor, workers: Workers, fast: bool = False
    ) -> None:
        k, c = centroids.shape
        self.workers = workers
        self.fast = fast and bfloat16_is_fast()
        self.centroids = centroids.detach().numpy()
        self.projection = projection.detach().view(-1, k, c).permute(1, 0, 2).contiguous()  # (K, D, C)
        self.offsets = self.projection.numpy()  # the same in float32: of a centroid every bit counts
        if self.fast:
            self.projection = self.projection.bfloat16()
        self.bias = bias.detach().numpy()

    def __call__(
        self, x: Tensor, weights: Tensor, shape: tuple[int, int], sizes: Sequence[int], strides: Sequence[int]
    ) -> list[NDArray[np.float32]]:
        """x (C, N) unit descriptors, weights (K, N) -> as patch_descriptors: [(n, D), ...]."""
        _check_sizes(sizes, shape)
        order = np.argsort(sizes, kind="stable")
        grid = _Grid(shape, [sizes[i] for i in order], [strides[i] for i in order])
        local = np.array(x.T.numpy(), order="C")
        assignment = np.ascontiguousarray(weights.numpy())
        middle = local.mean(0)  # residuals do not change, but smaller numbers cancel less
        local -= middle
        centroids = self.centroids - middle
        scales, touched = self._scales(local, assignment, centroids, grid)
        out = np.empty((grid.starts[-1], len(self.bias)), np.float32)
        columns = max(_LANES // 2, min(_COLUMNS, -(-len(self.bias) // self.workers.threads)))
        parts = [(a, min(a + columns, len(self.bias))) for a in range(0, len(self.bias), columns)]
        self.workers.map(partial(self._add_clusters, local, assignment, centroids, scales, grid, out), parts)
        rows = spans(len(out), self.workers.threads)
        self.workers.map(lambda span: _finish(out[slice(*span)], self.bias, touched[slice(*span)]), rows)
        found: list[NDArray[np.float32]] = [out] * len(sizes)
        for place, i in enumerate(order):
            found[i] = out[grid.starts[place] : grid.starts[place + 1]]
        return found

    def _scales(
        self, x: NDArray[np.float32], weights: NDArray[np.float32], centroids: NDArray[np.float32], grid: "_Grid"
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """(K, P) factors normalising each cluster's sum in each patch, (P,) whether any cluster touches it."""
        h, w = grid.shape
        gram = np.empty((h * w, h * w), np.float32)
        reach = grid.sizes[-1]

        def products(rows: tuple[int, int]) -> None:
            first, end = rows[0] * w, min(rows[1] + reach - 1, h) * w
            np.matmul(x[first : rows[1] * w], x[first:end].T, out=gram[first : rows[1] * w, first:end])

        self.workers.map(products, [(a, min(a + reach, h)) for a in range(0, h, reach)])
        arguments = (x, gram, x @ centroids.T, np.ascontiguousarray(weights.T), centroids)
        squares = np.square(centroids).sum(1)
        scales = np.empty((grid.starts[-1], len(centroids)), np.float32)
        for place, (size, stride) in enumerate(zip(grid.sizes, grid.strides, strict=True)):
            rows, cols = (h - size) // stride + 1, (w - size) // stride + 1
            norms = scales[grid.starts[place] : grid.starts[place + 1]].reshape(rows, cols, -1)

            def fill(span: tuple[int, int], norms=norms, window=(size, stride)) -> None:
                kernels.window_norms(*arguments, squares, h, w, *window, *span, norms)

            self.workers.map(fill, spans(rows, self.workers.threads))
            area = np.float32(size**2)
            norms /= area
            floor = np.maximum(norms, np.float32(EPSILON))
            units = np.sqrt(np.square(norms / floor).sum(2, keepdims=True))
            np.divide(1.0, floor * area * np.maximum(units, np.float32(EPSILON)), out=norms)
            norms *= units > 0
        return np.ascontiguousarray(scales.T), np.any(scales, axis=1)

    def _add_clusters(
        self,
        x: NDArray[np.float32],
        weights: NDArray[np.float32],
        centroids: NDArray[np.float32],
        scales: NDArray[np.float32],
        grid: "_Grid",
        out: NDArray[np.float32],
        span: tuple[int, int],
    ) -> None:
        """Columns `span` of the patch sums, before the bias."""
        first, end = span
        maps = np.empty((len(x), end - first), np.float32)
        lanes = spans(end - first, -(-(end - first) // _LANES), align=16)
        sums = [np.zeros((len(out), b - a), np.float32) for a, b in lanes]
        rounded = torch.from_numpy(x).bfloat16() if self.fast else None
        for k in range(len(weights)):
            columns = self.projection[k, first:end]
            if rounded is None:
                np.matmul(x, columns.numpy().T, out=maps)
            else:
                maps = torch.mm(rounded, columns.T).float().numpy()
            projected = self.offsets[k, first:end] @ centroids[k]
            for (a, b), total in zip(lanes, sums, strict=True):
                offsets = projected[a:b]
                windows = (*grid.shape, grid.sizes, grid.strides, grid.starts)
                kernels.add_windows(maps[:, a:b], offsets, weights[k], scales[k], *windows, total)
        for (a, b), total in zip(lanes, sums, strict=True):
            out[:, first + a : first + b] = total


class _Grid:
    """Patch sizes in ascending order on a map of h x w cells, and where each size's patches start (last: how many)."""

    def __init__(self, shape: tuple[int, int], sizes: Sequence[int], strides: Sequence[int]) -> None:
        h, w = self.shape = shape
        self.sizes = np.array(sizes, np.int64)
        self.strides = np.array(strides, np.int64)
        patches = ((h - self.sizes) // self.strides + 1) * ((w - self.sizes) // self.strides + 1)
        self.starts = np.concatenate([[0], patches.cumsum()])


def _finish(rows: NDArray[np.float32], bias: NDArray[np.float32], touched: NDArray[np.bool_]) -> None:
    """Adds the bias and makes the rows unit, in place; rows without any weight become zero."""
    rows += bias
    norm = np.sqrt(np.einsum("nd,nd->n", rows, rows))
    rows *= (touched / np.maximum(norm, np.float32(EPSILON)))[:, None].astype(np.float32)
