"""The authors' formulation, written plainly: the yardstick of the benchmarks. It shares no code with pnv_core.

Integral maps by cumulative sums, window sums by a dilated depthwise convolution, PCA by a 1x1 convolution of the
unprojected patch VLADs, one candidate at a time with distances and two argmins, RANSAC per patch size.
K clusters, C channels, h x w feature map, D dimensions, n patches of one size.
"""

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor


def patch_vlads(features: Tensor, assignment: Tensor, centroids: Tensor, sizes: tuple[int, ...]) -> list[Tensor]:
    """(1, C, h, w), (K, C), (K, C) -> per size the normalised patch VLADs (1, K * C, n)."""
    k, c = centroids.shape
    _, _, h, w = features.shape
    x = F.normalize(features, dim=1)
    weights = F.softmax(F.conv2d(x, assignment[:, :, None, None]).view(1, k, -1), dim=1)  # (1, K, h * w)
    x = x.view(1, 1, c, h * w)
    residuals = (x - centroids[None, :, :, None]) * weights[:, :, None]  # (1, K, C, h * w)
    integral = F.pad(residuals.view(1, k * c, h, w).cumsum(3).cumsum(2), (1, 0, 1, 0))
    corner = integral.new_tensor([[1.0, -1.0], [-1.0, 1.0]]).expand(k * c, 1, 2, 2)
    out = []
    for size in sizes:
        sums = F.conv2d(integral, corner, dilation=size, groups=k * c) / size**2
        vlad = F.normalize(sums.view(1, k, c, -1), dim=2)
        out.append(F.normalize(vlad.view(1, k * c, -1), dim=1))
    return out


def patch_descriptors(
    features: Tensor,
    assignment: Tensor,
    centroids: Tensor,
    projection: Tensor,
    bias: Tensor,
    sizes: tuple[int, ...],
) -> list[Tensor]:
    """As patch_vlads, projected by (D, K * C) and (D,): per size (D, n) unit columns."""
    out = []
    for vlad in patch_vlads(features, assignment, centroids, sizes):
        _, inputs, n = vlad.shape
        columns = vlad.permute(2, 0, 1).reshape(n, inputs, 1, 1)
        out.append(F.normalize(F.conv2d(columns, projection[:, :, None, None], bias).flatten(1), dim=1).T.contiguous())
    return out


def mutual_matches(query: Tensor, reference: Tensor) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(D, n_q), (D, n_r) unit columns -> matched patch numbers (query, reference)."""
    distance = torch.sqrt(2 - 2 * (query.T @ reference) + 1e-9)
    forward = distance.argmin(0).numpy()
    backward = distance.argmin(1).numpy()
    matched = np.flatnonzero(backward[forward] == np.arange(len(forward)))
    return forward[matched], matched


def rapid_score(query_grid: NDArray[np.int64], reference_grid: NDArray[np.int64], rows: int, cols: int) -> float:
    """(M, 2) grid coordinates (column, row) of the matches -> the authors' score, lower is better."""
    if not len(query_grid):
        return 0.0
    shift = reference_grid - query_grid
    residual = np.abs(shift - shift.mean(0))
    return -float(((np.array([cols - 1, rows - 1]) - residual) ** 2).sum()) / (rows * cols)


def ransac_score(query_xy: NDArray[np.int64], reference_xy: NDArray[np.int64], patches: int) -> float:
    """(M, 2) pixel centres of the matches -> minus the share of patches that are inliers."""
    if len(query_xy) < 4:
        return 0.0
    _, mask = cv2.findHomography(reference_xy.astype(float), query_xy.astype(float), cv2.RANSAC, 24.0)
    return 0.0 if mask is None else -float(mask.sum()) / patches
