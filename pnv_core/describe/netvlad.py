"""NetVLAD. K clusters, C channels, h x w feature map (N = h * w cells), D output dimensions, B images."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class NetVLAD(nn.Module):
    """Soft assignment to K clusters and residual aggregation (Arandjelovic et al., CVPR 2016; VLADv1, no bias).

    `centroids` (K, C) and `assignment` (K, C) are independent parameters; at initialisation
    assignment = alpha * c_k / |c_k| (`alpha_rule`).
    """

    def __init__(self, clusters: int, channels: int) -> None:
        super().__init__()
        self.centroids = nn.Parameter(torch.zeros(clusters, channels))
        self.assignment = nn.Parameter(torch.zeros(clusters, channels))

    @property
    def clusters(self) -> int:
        return self.centroids.shape[0]

    def soft_assign(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """(B, C, h, w) -> unit local descriptors (B, C, N) and their assignment weights (B, K, N)."""
        x = F.normalize(features.flatten(2), dim=1)
        return x, torch.softmax(self.assignment @ x, dim=1)

    def vlad(self, x: Tensor, weights: Tensor) -> Tensor:
        """(B, C, N), (B, K, N) -> the whole-image VLAD (B, K * C): intra-normalised, cluster-major, unit length."""
        sums = weights @ x.transpose(1, 2) - weights.sum(2, keepdim=True) * self.centroids  # (B, K, C)
        return F.normalize(F.normalize(sums, dim=2).flatten(1), dim=1)

    def forward(self, features: Tensor) -> Tensor:
        """(B, C, h, w) -> (B, K * C)."""
        return self.vlad(*self.soft_assign(features))


def alpha_rule(centroids: Tensor, samples: Tensor) -> Tensor:
    """Assignment weights (K, C) for centroids (K, C): alpha * c/|c| with alpha chosen so that over the unit
    samples (M, C) the second-best cluster gets on average a hundredth of the best one's weight (NetVLAD appendix)."""
    directions = F.normalize(centroids, dim=1)
    top = (samples @ directions.T).topk(2, dim=1).values  # (M, 2)
    alpha = -torch.log(torch.tensor(0.01)) / (top[:, 0] - top[:, 1]).mean()
    return alpha.to(centroids) * directions


def gem(maps: Tensor, weights: Tensor | None = None, power: float = 3.0) -> Tensor:
    """Generalised mean over cells (Radenovic et al., TPAMI 2018): (B, W, h, w) -> (B, W), unit length.

    `weights` (B, N) say how much each cell counts.
    """
    cells = maps.clamp(min=1e-6).pow(power).flatten(2)  # (B, W, N)
    if weights is None:
        mean = cells.mean(2)
    else:
        mean = (cells * weights[:, None]).sum(2) / weights.sum(1, keepdim=True).clamp(min=1e-6)
    return F.normalize(mean.clamp(min=1e-18).pow(1 / power), dim=1)


class Projection(nn.Module):
    """PCA whitening as a linear map: (..., K * C) -> (..., D), then L2 (Patch-NetVLAD section 3.2)."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(outputs, inputs))
        self.bias = nn.Parameter(torch.zeros(outputs))

    def forward(self, vlad: Tensor) -> Tensor:
        return F.normalize(F.linear(vlad, self.weight, self.bias), dim=-1)
