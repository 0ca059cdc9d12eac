"""Dense RootSIFT: the features of DenseVLAD, the paper's baseline; no trained weights.

h x w = H // 16 x W // 16 cells.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from pnv_core.describe.trunks.trunk import Trunk

_ORIENTATIONS = 8
_BINS = 4  # spatial bins per side
_CLIP = 0.2  # Lowe 2004, section 6.1: against a few large gradients
_LUMA = (0.299, 0.587, 0.114)  # ITU-R BT.601


class RootSIFTTrunk(Trunk):
    """(B, 3, H, W) RGB in [0, 1] -> (B, 128, H // 16, W // 16) upright RootSIFT, one descriptor per cell.

    SIFT (Lowe, IJCV 2004) on a regular grid, 4 x 4 bins of 8 pixels around each cell's centre, then L1
    normalisation and square root (Arandjelovic and Zisserman, CVPR 2012), as in DenseVLAD (Torii et al., CVPR 2015).
    A cell without gradient gives zeros.
    """

    channels = _ORIENTATIONS * _BINS * _BINS
    luma: Tensor
    triangle: Tensor
    blur: Tensor
    angles: Tensor
    _BIN = Trunk.stride // 2  # pixels

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("luma", torch.tensor(_LUMA).view(1, 3, 1, 1), persistent=False)
        ramp = (torch.arange(2 * self._BIN) + 0.5) / self._BIN
        triangle = torch.minimum(ramp, 2 - ramp)  # bilinear sharing between neighbouring bins
        self.register_buffer("triangle", torch.outer(triangle, triangle)[None, None], persistent=False)
        blur = torch.exp(-0.5 * torch.arange(-2, 3) ** 2 / 0.8**2)
        self.register_buffer("blur", (torch.outer(blur, blur) / blur.sum() ** 2)[None, None], persistent=False)
        angles = torch.arange(_ORIENTATIONS) * (2 * math.pi / _ORIENTATIONS)
        self.register_buffer("angles", angles.view(1, _ORIENTATIONS, 1, 1), persistent=False)

    def _orientation_maps(self, images: Tensor) -> Tensor:
        """(B, 3, H, W) -> (B, 8, H, W): gradient magnitude, shared between the two nearest orientations."""
        grey = F.conv2d(F.pad((images * self.luma).sum(1, keepdim=True), (2, 2, 2, 2), mode="replicate"), self.blur)
        padded = F.pad(grey, (1, 1, 1, 1), mode="replicate")
        dx = (padded[:, :, 1:-1, 2:] - padded[:, :, 1:-1, :-2]) / 2
        dy = (padded[:, :, 2:, 1:-1] - padded[:, :, :-2, 1:-1]) / 2
        turn = torch.remainder(torch.atan2(dy, dx) - self.angles + math.pi, 2 * math.pi) - math.pi  # (B, 8, H, W)
        share = (1 - turn.abs() * (_ORIENTATIONS / (2 * math.pi))).clamp(min=0)
        return share * torch.hypot(dx, dy)

    def forward(self, images: Tensor) -> Tensor:
        height, width = (side // self.stride * self.stride for side in images.shape[2:])
        maps = self._orientation_maps(images[:, :, :height, :width])
        batch = maps.shape[0]
        bins = F.conv2d(maps.flatten(0, 1)[:, None], self.triangle, stride=self._BIN, padding=self._BIN // 2)
        bins = bins.view(batch, _ORIENTATIONS, height // self._BIN, width // self._BIN)
        sift = F.unfold(bins, _BINS, stride=2, padding=1)  # (B, 128, h * w)
        sift = F.normalize(F.normalize(sift, dim=1, eps=1e-4).clamp(max=_CLIP), p=1, dim=1, eps=1e-4)
        return sift.sqrt().view(batch, self.channels, height // self.stride, width // self.stride)
