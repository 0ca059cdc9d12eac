"""sensor_msgs/CameraInfo to a rectification of images."""

from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from msg_adapters.images import check_size
from pnv_core.errors import ImageError

T = TypeVar("T", np.uint8, np.float32)

PINHOLE = ("plumb_bob", "rational_polynomial")
FISHEYE = ("equidistant", "fisheye")
PINHOLE_COEFFICIENTS = 4, 5, 8, 12, 14
FISHEYE_COEFFICIENTS = 4


FOCAL_LENGTHS = 0.05, 100.0  # in image widths: a fisheye lens has 0.2, a telescope 50
LEAST_SEEN = 0.1  # share of a rectified image that shows something


def calibration_of(info: Any) -> tuple[Any, ...]:
    """What a CameraInfo says of the camera, comparable."""
    numbers = (np.asarray(v, np.float64).tobytes() for v in (info.k, info.d, info.p))
    return int(info.width), int(info.height), info.distortion_model, *numbers


def baseline_of(info: Any) -> float:
    """How far right of the left camera of a stereo pair this one is, metres: -P[3] / P[0]; 0 for other cameras."""
    p = [float(v) for v in info.p]
    return -p[3] / p[0] if p[0] > 0 and np.isfinite(p[3]) else 0.0


class Rectifier:
    """Removes lens distortion as a CameraInfo describes it; the maps are computed once.

    `rectified` images are left as they are, whatever the distortion of their camera. Raises ImageError for an
    uncalibrated camera, numbers that no camera has, a size that no image may have, and a distortion model or a number
    of coefficients other than the ones above.
    """

    def __init__(self, info: Any, *, rectified: bool = False) -> None:
        self.size = int(info.width), int(info.height)
        k, d = np.array(info.k, np.float64).reshape(3, 3), np.array(info.d, np.float64)
        if rectified and np.asarray(info.p, np.float64).any():
            k, d = np.array(info.p, np.float64).reshape(3, 4)[:, :3], np.zeros(0)
        if not (k[0, 0] > 0 and k[1, 1] > 0) or 0 in self.size:
            raise ImageError(f"camera info of {self.size[0]}x{self.size[1]} has focal lengths {k[0, 0]:g}, {k[1, 1]:g}"
                             "; allowed: a calibrated camera")  # fmt: skip
        if not (np.isfinite(k).all() and np.isfinite(d).all()):
            raise ImageError(f"camera info has k = {k.ravel().tolist()} and d = {d.tolist()}; allowed: finite numbers")
        check_size(*self.size)
        width, height = self.size
        low, high = (share * width for share in FOCAL_LENGTHS)
        if not (low <= k[0, 0] <= high and low <= k[1, 1] <= high):
            raise ImageError(f"camera info has focal lengths {k[0, 0]:g}, {k[1, 1]:g} px; "
                             f"allowed: {low:g} to {high:g} for a width of {width}")  # fmt: skip
        if not (-width <= k[0, 2] <= 2 * width and -height <= k[1, 2] <= 2 * height):
            raise ImageError(f"camera info has its centre at {k[0, 2]:g}, {k[1, 2]:g}; allowed: near the image")
        if k[1, 0] != 0 or k[2].tolist() != [0.0, 0.0, 1.0]:
            raise ImageError(f"camera info has k = {k.ravel().tolist()}; allowed: 0 at [3], and 0, 0, 1 at the end")
        model = info.distortion_model
        if d.size and model not in PINHOLE + FISHEYE:
            raise ImageError(f"distortion model {model!r} is unknown; allowed: {', '.join(PINHOLE + FISHEYE)}")
        allowed = (FISHEYE_COEFFICIENTS,) if model in FISHEYE else PINHOLE_COEFFICIENTS
        if d.any() and d.size not in allowed:
            raise ImageError(f"distortion model {model!r} comes with {d.size} coefficients; "
                             f"allowed: 0, {', '.join(map(str, allowed))}")  # fmt: skip
        self.focal_and_centre = k[0, 0], k[1, 1], k[0, 2], k[1, 2]  # pixels, before and after
        self._maps: tuple[Any, Any] | None = None
        if d.any():
            undistort = cv2.fisheye.initUndistortRectifyMap if model in FISHEYE else cv2.initUndistortRectifyMap
            try:
                self._maps = undistort(k, d, np.eye(3), k, self.size, cv2.CV_16SC2)
            except cv2.error as error:
                raise ImageError(f"camera info cannot be used ({error.err}); allowed: a calibrated camera") from error
            seen = self(np.full((height, width), 255, np.uint8)).mean() / 255
            if not seen >= LEAST_SEEN:
                raise ImageError(f"camera info with d = {d.tolist()} leaves {seen:.0%} of the image; "
                                 f"allowed: a distortion that leaves {LEAST_SEEN:.0%}")  # fmt: skip

    def __call__(self, pixels: NDArray[T]) -> NDArray[T]:
        """(H, W) or (H, W, 3) -> the same shape, 0 where nothing was seen. Raises ImageError for another size.

        Depth (float32) is that of the nearest pixel, uninterpolated.
        """
        if (pixels.shape[1], pixels.shape[0]) != self.size:
            raise ImageError(f"image is {pixels.shape[1]}x{pixels.shape[0]}; allowed by its camera info: "
                             f"{self.size[0]}x{self.size[1]}")  # fmt: skip
        if self._maps is None:
            return pixels
        how = cv2.INTER_LINEAR if pixels.dtype == np.uint8 else cv2.INTER_NEAREST  # no depth lies between two surfaces
        return cv2.remap(pixels, *self._maps, how)
