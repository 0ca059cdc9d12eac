"""XFeat (Potje et al., CVPR 2024): learned local features that hold where light and viewpoint change.

The network is plain convolutions on the inference backend; its weights are Apache-2.0 (models/XFEAT.md). N features of
an image, H x W its grey picture with sides that are multiples of 32, h x w = H / 8 x W / 8.
"""

import math
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import openvino as ov
from numpy.typing import NDArray
from openvino import opset15 as ops
from safetensors.numpy import load_file

from pnv_core.networks.layers import (
    Add,
    AvgPool,
    Concat,
    Conv,
    InstanceNorm,
    Network,
    Relu,
    Resize,
    SpaceToDepth,
    same_pads,
)
from pnv_core.networks.openvino_backend import Compiled, build, integers
from pnv_core.verify.local_features import LocalFeatures, no_features

WEIGHTS = Path(__file__).parents[1] / "models" / "xfeat.safetensors"
_SIDE = 32  # what both sides of a picture are multiples of
_CELL = 8
_LEAST_SCORE = 0.05  # of a corner, the authors' detection threshold
_NEIGHBOURHOOD = 5  # pixels, in which a corner is the surest
_TEXTURE = 1e-3  # standard deviation of a picture in [0, 1] that shows nothing
_EPSILON = 1e-12
_GRAPH = "1"  # to be counted up where the graph or its weights change: what older programs compiled is no longer read
_SHAPES = 8  # graphs kept compiled, one per picture shape


def _chain(name: str, *layers: tuple[int, ...]) -> Network:
    """Convolutions (outputs, kernel 3, stride 1), each with a ReLU."""

    def conv(number: int, outputs: int, kernel: int = 3, stride: int = 1) -> Conv:
        return Conv(f"{name}.{number}", outputs, kernel, stride, same_pads(kernel))

    return tuple(part for number, given in enumerate(layers) for part in (conv(number, *given), Relu()))


_COARSE = (  # maps of 1 / 16 and 1 / 32, brought back to 1 / 8
    *_chain("block4", (64, 3, 2), (64,), (64,)),
    Add(((Resize(2),), (*_chain("block5", (128, 3, 2), (128,), (128,), (64, 1)), Resize(4)))),
)
_DESCRIPTORS = (
    Add((_chain("block1", (4,), (8, 3, 2), (8,), (24, 3, 2)), (AvgPool(4, 4), Conv("skip1", 24)))),
    *_chain("block2", (24,), (24,)),
    *_chain("block3", (64, 3, 2), (64,), (64, 1)),
    Add(((), _COARSE)),
    *_chain("block_fusion", (64,), (64,)),
    Conv("block_fusion.2", 64),
)
_RELIABILITY = (*_chain("heatmap_head", (64, 1), (64, 1)), Conv("heatmap_head.2", 1))
_CORNERS = (SpaceToDepth(_CELL), *_chain("keypoint_head", (64, 1), (64, 1), (64, 1)), Conv("keypoint_head.3", 65))
_NORM = InstanceNorm()
NETWORK: Network = (_NORM, Concat(((*_DESCRIPTORS, Concat(((), _RELIABILITY))), _CORNERS)))
"""(1, H, W) -> (64 + 1 + 65, h, w): descriptors, log odds of their reliability, logits of the corner in each cell."""


@lru_cache(maxsize=1)
def _weights() -> dict[str, NDArray[np.float32]]:
    return {name: values.astype(np.float32) for name, values in load_file(str(WEIGHTS)).items()}


class XFeat:
    """The network with its detection, compiled for the shapes of the pictures it meets."""

    def __init__(
        self, width: int, most: int, threads: int = 0, precision: str = "float32", cache: Path | None = None
    ) -> None:
        """`width` pixels of a picture's longer side, at most `most` features; threads and precision as in Config.

        `cache` is a folder for what is compiled.
        """
        self.width, self.most = width, most
        self._settings, self._cache = (threads, precision), cache
        self._compiled = lru_cache(maxsize=_SHAPES)(self._compile)

    def features(self, grey: NDArray[np.uint8], valid: NDArray[np.bool_] | None = None) -> LocalFeatures:
        """(h, w), optionally bool of the pixels to use -> the features, the surest first."""
        picture = self._sized(grey)
        normal = _normalised(picture)
        if normal is None:
            return no_features(64)
        rows, cols = picture.shape
        heat, reliable, descriptors = self._compiled(rows, cols)(normal[None, None])
        score = heat.reshape(rows, cols)
        highest = cv2.dilate(score, np.ones((_NEIGHBOURHOOD, _NEIGHBOURHOOD), np.uint8))
        peak = (score == highest) & (score > _LEAST_SCORE)
        if valid is not None:
            mask = cv2.resize(valid.astype(np.uint8), (cols, rows), interpolation=cv2.INTER_NEAREST)
            peak &= cv2.erode(mask, np.ones((9, 9), np.uint8)) > 0  # the border of the mask is no feature
        y, x = np.divmod(np.flatnonzero(peak), cols)  # five times as fast as np.nonzero
        at = np.stack([x / (cols - 1) * (cols // _CELL), y / (rows - 1) * (rows // _CELL)], 1) - 0.5
        sure = score[y, x] * _sampled(reliable[0, 0, :, :, None], at)[:, 0]
        best = np.argsort(-sure, kind="stable")[: self.most]
        found = _sampled(descriptors[0], at[best])
        found /= np.maximum(np.linalg.norm(found, axis=1, keepdims=True), _EPSILON)
        aspect = grey.shape[0] / grey.shape[1]
        points = np.stack([(x[best] + 0.5) / cols, (y[best] + 0.5) / rows * aspect], 1)
        return LocalFeatures(points.astype(np.float32), found)

    def _compile(self, rows: int, cols: int) -> Compiled:
        kept = None if self._cache is None else self._cache / f"xfeat_{_GRAPH}_{rows}x{cols}"
        return Compiled(lambda: _graph(rows, cols), *self._settings, kept)

    def _sized(self, grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The longer side `width`, the shorter within 16 pixels of what keeps the aspect."""
        height, width = grey.shape
        long, short = max(height, width), min(height, width)
        other = max(_SIDE, round(self.width * short / long / _SIDE) * _SIDE)
        size = (self.width, other) if width >= height else (other, self.width)
        way = cv2.INTER_AREA if long > self.width else cv2.INTER_LINEAR
        return cv2.resize(grey, size, interpolation=way)


def _normalised(picture: NDArray[np.uint8]) -> NDArray[np.float32] | None:
    """Mean 0 and variance 1, as _NORM does it to a picture in [0, 1]; None for one that shows nothing."""
    mean, deviation = (float(of[0, 0]) / 255 for of in cv2.meanStdDev(picture))
    if deviation < _TEXTURE:
        return None
    gain = 1 / math.hypot(deviation, math.sqrt(_NORM.epsilon))
    return picture * np.float32(gain / 255) - np.float32(mean * gain)


def _graph(rows: int, cols: int) -> ov.Model:
    """(1, 1, H, W) of mean 0 and variance 1 -> how sure each pixel is a corner (1, 1, H, W); reliability (1, 1, h, w);
    unit descriptors (1, h, w, 64).
    """
    picture = ops.parameter([1, 1, rows, cols], np.float32)
    maps = build(_DESCRIPTORS, _weights(), picture)
    cells = ops.softmax(build(_CORNERS, _weights(), picture), 1)  # the last: no corner in this cell
    corners = ops.slice(cells, integers(0), integers(_CELL**2), integers(1), integers(1))
    heat = ops.depth_to_space(corners, "depth_first", _CELL)
    reliability = ops.sigmoid(build(_RELIABILITY, _weights(), maps))
    descriptors = ops.transpose(ops.normalize_l2(maps, integers(1), _EPSILON**2, "max"), integers(0, 2, 3, 1))
    return ov.Model([heat, reliability, descriptors], [picture], "xfeat")


def _sampled(values: NDArray[np.float32], at: NDArray[np.float64]) -> NDArray[np.float32]:
    """Bilinear: (h, w, C) at (N, 2) cells (x, y) -> (N, C); beyond the border as at it."""
    h, w = values.shape[:2]
    low = np.floor(at)
    x, y = low.astype(np.int64).T
    right, down = ((at - low).astype(np.float32).T)[..., None]
    x0, x1, y0, y1 = x.clip(0, w - 1), (x + 1).clip(0, w - 1), y.clip(0, h - 1), (y + 1).clip(0, h - 1)
    upper = values[y0, x0] * (1 - right) + values[y0, x1] * right
    return upper * (1 - down) + (values[y1, x0] * (1 - right) + values[y1, x1] * right) * down
