"""What of an image is looked at: mask, crop, rectification."""

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from msg_adapters.camera_info import Rectifier
from msg_adapters.images import MIN_SIDE
from pnv_core.errors import ConfigError, ImageError
from pnv_core.images import read_image
from pnv_core.pose.geometry import Intrinsics
from pnv_core.types import Frame


class View:
    """Mask, rectification and crop of one camera, in this order."""

    def __init__(self, mask: NDArray[np.uint8] | None = None, crop: Sequence[int] = ()) -> None:
        self._mask, self._crop = mask, tuple(crop) or (0, 0, 0, 0)
        self.rectifier: Rectifier | None = None
        self.needs_info = False  # no frame is used before its CameraInfo is known

    def __call__(self, frame: Frame) -> Frame:
        """Raises ImageError where nothing is left of the image."""
        height, width = frame.rgb.shape[:2]
        rgb, valid, depth = frame.rgb, self._valid(width, height), frame.depth
        rectifier = self.rectifier  # may be replaced by another thread
        if rectifier is not None:
            seen = np.full((height, width), 255, np.uint8) if valid is None else valid
            rgb, valid = rectifier(rgb), rectifier(seen)
            if depth is not None:
                depth = rectifier(depth)
        left, top, right, bottom = self._crop
        if width - left - right < MIN_SIDE or height - top - bottom < MIN_SIDE:
            raise ImageError(f"crop = {list(self._crop)} leaves {width - left - right}x{height - top - bottom} of a "
                             f"{width}x{height} image; allowed: at least {MIN_SIDE}x{MIN_SIDE}")  # fmt: skip
        window = slice(top, height - bottom), slice(left, width - right)
        return dataclasses.replace(frame, rgb=np.ascontiguousarray(rgb[window]),
                                   valid=None if valid is None else valid[window] > 127,
                                   depth=None if depth is None else depth[window])  # fmt: skip

    @property
    def scalable(self) -> bool:
        """Whether a smaller picture of the same scene may be given: nothing here counts the camera's pixels."""
        return not any(self._crop) and not self.needs_info

    def intrinsics(self, rectifier: Rectifier) -> Intrinsics:
        """Of the images this view gives with a rectifier. Raises ConfigError."""
        (fx, fy, cx, cy), (left, top, right, _) = rectifier.focal_and_centre, self._crop
        return Intrinsics.of_pixels(fx, fy, cx - left, cy - top, rectifier.size[0] - left - right)

    def _valid(self, width: int, height: int) -> NDArray[np.uint8] | None:
        if self._mask is None or self._mask.shape == (height, width):
            return self._mask
        return cv2.resize(self._mask, (width, height), interpolation=cv2.INTER_NEAREST)


def read_mask(path: str) -> NDArray[np.uint8]:
    """(H, W) uint8, 0 where pixels are ignored and 255 elsewhere. Raises ConfigError for a file that is no mask."""
    file = Path(os.path.expanduser(path))
    if not file.is_file():
        raise ConfigError(f"mask {path!r} is no file; allowed: an image, black where pixels are ignored")
    try:
        pixels = cv2.cvtColor(read_image(file), cv2.COLOR_RGB2GRAY)
    except ImageError as error:
        raise ConfigError(f"mask {error}; allowed: an image, black where pixels are ignored") from None
    if not pixels.any():
        raise ConfigError(f"mask {path!r} is black; allowed: an image with something left to look at")
    return np.where(pixels > 0, 255, 0).astype(np.uint8)
