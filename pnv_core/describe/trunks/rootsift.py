"""Dense RootSIFT: the features of DenseVLAD, the paper's baseline; no trained weights.

h x w = H // 16 x W // 16 cells.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from pnv_core.describe.trunks.trunk import Trunk

_ORIENTATIONS = 8
_BINS = 4  # spatial bins per side
_CELL = 16  # pixels
_BIN = _CELL // 2
_CLIP = 0.2  # Lowe 2004, section 6.1: against a few large gradients
_LUMA = np.array((0.299, 0.587, 0.114), np.float32)  # ITU-R BT.601
_LEAST = 1e-4  # length below which a descriptor is not made longer


def rootsift_trunk() -> Trunk:
    return Trunk((), dense=dense_rootsift, dense_channels=_ORIENTATIONS * _BINS * _BINS)


def dense_rootsift(image: NDArray) -> NDArray[np.float32]:
    """(H, W, 3) RGB, uint8 or float in [0, 1] -> (128, H // 16, W // 16) upright RootSIFT, one descriptor per cell.

    SIFT (Lowe, IJCV 2004) on a regular grid, 4 x 4 bins of 8 pixels around each cell's centre, then L1
    normalisation and square root (Arandjelovic and Zisserman, CVPR 2012), as in DenseVLAD (Torii et al., CVPR 2015).
    A cell without gradient gives zeros.
    """
    h, w = image.shape[0] // _CELL, image.shape[1] // _CELL
    rgb = image[: h * _CELL, : w * _CELL]
    rgb = rgb.astype(np.float32) / np.float32(255) if rgb.dtype == np.uint8 else rgb.astype(np.float32)
    maps = _orientation_maps(rgb)  # (H, W, 8)
    ramp = (np.arange(2 * _BIN) + 0.5) / _BIN
    triangle = np.minimum(ramp, 2 - ramp)  # bilinear sharing between neighbouring bins
    pad = _BIN // 2
    padded = cv2.copyMakeBorder(maps, pad, pad, pad, pad, cv2.BORDER_CONSTANT)
    spread = cv2.sepFilter2D(padded, cv2.CV_32F, triangle, triangle, anchor=(0, 0), borderType=cv2.BORDER_CONSTANT)
    bins = spread[: 2 * h * _BIN : _BIN, : 2 * w * _BIN : _BIN]  # (2 h, 2 w, 8)
    around = np.pad(bins, ((1, 1), (1, 1), (0, 0)))
    cells = np.lib.stride_tricks.sliding_window_view(around, (_BINS, _BINS), axis=(0, 1))[::2, ::2]  # (h, w, 8, 4, 4)
    sift = cells.reshape(h, w, -1)
    sift = np.minimum(sift / np.maximum(np.linalg.norm(sift, axis=2, keepdims=True), _LEAST), _CLIP)
    sift = sift / np.maximum(sift.sum(2, keepdims=True), _LEAST)
    return np.ascontiguousarray(np.sqrt(sift).transpose(2, 0, 1), np.float32)


def _orientation_maps(rgb: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W, 3) -> (H, W, 8): gradient magnitude, shared between the two nearest orientations."""
    blur = np.exp(-0.5 * np.arange(-2, 3) ** 2 / 0.8**2)
    grey = cv2.sepFilter2D(
        rgb @ _LUMA, cv2.CV_32F, blur / blur.sum(), blur / blur.sum(), borderType=cv2.BORDER_REPLICATE
    )
    padded = cv2.copyMakeBorder(grey, 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    dx = (padded[1:-1, 2:] - padded[1:-1, :-2]) / 2
    dy = (padded[2:, 1:-1] - padded[:-2, 1:-1]) / 2
    step = np.float32(2 * np.pi / _ORIENTATIONS)
    angles = np.arange(_ORIENTATIONS, dtype=np.float32) * step
    turn = np.arctan2(dy, dx)[:, :, None] - angles
    turn = np.mod(turn + np.float32(np.pi), np.float32(2 * np.pi)) - np.float32(np.pi)  # (H, W, 8)
    return np.maximum(1 - np.abs(turn) / step, 0) * np.hypot(dx, dy)[:, :, None]
