"""IntegralVLAD: patch descriptors of several sizes from one residual map (Patch-NetVLAD section 3.2 and 3.5).

K clusters, C channels, h x w feature map (N = h * w), D dimensions, n = patches of one size.

Window sums are built by doubling (sums of size 2 from size 1, 4 from 2, ...) instead of differences of an integral
map: as few additions, shared between the sizes, and no cancellation where a cluster hardly touches a window.
The projection is linear, so each cluster's residual map is projected once and the windows are summed afterwards;
only the norms of the intra-normalisation need the unprojected sums. The plain formulation, on any device of torch.
"""

from collections.abc import Sequence

import torch.nn.functional as F
from torch import Tensor

EPSILON = 1e-12  # as F.normalize


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
    exceeds the map.
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
