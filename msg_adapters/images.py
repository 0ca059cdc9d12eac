"""sensor_msgs/Image and CompressedImage to Frame. H x W image, C channels as sent.

Only attributes are read, so live messages, messages from a bag and test doubles serve alike. What cannot be used is
refused with an ImageError before anything of its claimed size is allocated.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pnv_core.errors import ImageError
from pnv_core.images import MAX_PIXELS, decode_image, to_8_bit
from pnv_core.types import Frame

MIN_SIDE = 16  # one cell of the feature map
MAX_SIDE = 16384
MAX_JPEG_SCANS = 100  # a progressive file has about 10; each one costs a pass over the whole image


class Encoding(NamedTuple):
    """How the pixels of an encoding lie in memory, and how they become RGB."""

    channels: int
    dtype: str
    to_rgb: Callable[[NDArray[Any]], NDArray[np.uint8]]
    even_width: bool = False


def _cvt(code: int) -> Callable[[NDArray[Any]], NDArray[np.uint8]]:
    return lambda pixels: cv2.cvtColor(pixels, code)


def _deep_gray_to_rgb(pixels: NDArray[np.uint16]) -> NDArray[np.uint8]:
    return cv2.cvtColor(to_8_bit(pixels), cv2.COLOR_GRAY2RGB)


_MAGIC = {b"\xff\xd8\xff": "jpeg", b"\x89PNG\r\n\x1a\n": "png"}

# OpenCV names a Bayer pattern by its second row and column, ROS by its first: bayer_rggb8 is BayerBG.
ENCODINGS: dict[str, Encoding] = {
    "rgb8": Encoding(3, "u1", np.copy),
    "bgr8": Encoding(3, "u1", _cvt(cv2.COLOR_BGR2RGB)),
    "8UC3": Encoding(3, "u1", _cvt(cv2.COLOR_BGR2RGB)),  # OpenCV's own order, as cv_bridge takes it
    "rgba8": Encoding(4, "u1", _cvt(cv2.COLOR_RGBA2RGB)),
    "bgra8": Encoding(4, "u1", _cvt(cv2.COLOR_BGRA2RGB)),
    "mono8": Encoding(1, "u1", _cvt(cv2.COLOR_GRAY2RGB)),
    "8UC1": Encoding(1, "u1", _cvt(cv2.COLOR_GRAY2RGB)),
    "mono16": Encoding(1, "u2", _deep_gray_to_rgb),
    "16UC1": Encoding(1, "u2", _deep_gray_to_rgb),
    "bayer_rggb8": Encoding(1, "u1", _cvt(cv2.COLOR_BayerBG2RGB)),
    "bayer_bggr8": Encoding(1, "u1", _cvt(cv2.COLOR_BayerRG2RGB)),
    "bayer_gbrg8": Encoding(1, "u1", _cvt(cv2.COLOR_BayerGR2RGB)),
    "bayer_grbg8": Encoding(1, "u1", _cvt(cv2.COLOR_BayerGB2RGB)),
    "yuv422": Encoding(2, "u1", _cvt(cv2.COLOR_YUV2RGB_UYVY), even_width=True),
    "uyvy": Encoding(2, "u1", _cvt(cv2.COLOR_YUV2RGB_UYVY), even_width=True),
    "yuv422_yuy2": Encoding(2, "u1", _cvt(cv2.COLOR_YUV2RGB_YUY2), even_width=True),
    "yuyv": Encoding(2, "u1", _cvt(cv2.COLOR_YUV2RGB_YUY2), even_width=True),
}


def stamp_of(message: Any) -> int:
    """The header stamp in nanoseconds."""
    return int(message.header.stamp.sec) * 1_000_000_000 + int(message.header.stamp.nanosec)


def message_to_frame(message: Any, camera: str, enough: tuple[int, int] | None = None) -> Frame:
    """Image or CompressedImage -> Frame. Raises ImageError in one line for anything unusable.

    A JPEG is decoded to a fraction of its size where that is still `enough` (width, height).
    """
    rgb = compressed_to_rgb(message, enough) if hasattr(message, "format") else image_to_rgb(message)
    return Frame(stamp_ns=stamp_of(message), camera=camera, rgb=rgb)


def image_to_rgb(message: Any) -> NDArray[np.uint8]:
    """sensor_msgs/Image -> (H, W, 3) uint8. Row padding and byte order are honoured.

    16-bit grey is scaled as `pnv_core.images.to_8_bit` says. Raises ImageError for an unknown encoding, a size out
    of limits, a step smaller than a row, and data shorter than step * height.
    """
    encoding = ENCODINGS.get(message.encoding)
    if encoding is None:
        raise ImageError(f"image encoding {message.encoding!r} is unknown; allowed: {', '.join(sorted(ENCODINGS))}")
    height, width, step = int(message.height), int(message.width), int(message.step)
    check_size(width, height)
    if encoding.even_width and width % 2:
        raise ImageError(f"image of encoding {message.encoding} is {width} wide; allowed: an even width")
    row = width * encoding.channels * np.dtype(encoding.dtype).itemsize
    if step < row:
        raise ImageError(
            f"image step {step} is smaller than a row; allowed: at least {row} for {width} pixels of {message.encoding}"
        )
    data = _bytes_of(message.data)
    if data.size < step * height:
        raise ImageError(f"image data has {data.size} bytes; allowed: at least step * height = {step * height}")
    rows = np.ascontiguousarray(data[: step * height].reshape(height, step)[:, :row])
    dtype = np.dtype(encoding.dtype).newbyteorder(">" if message.is_bigendian else "<")
    shape = (height, width) if encoding.channels == 1 else (height, width, encoding.channels)
    return encoding.to_rgb(rows.view(dtype).astype(encoding.dtype, copy=False).reshape(shape))


def compressed_to_rgb(message: Any, enough: tuple[int, int] | None = None) -> NDArray[np.uint8]:
    """sensor_msgs/CompressedImage of jpeg or png (8 or 16 bit) -> (H, W, 3) uint8, as `decode_image` gives it.

    The size is read from the file's header and checked before anything is unpacked; a file that stops early is
    refused rather than filled with grey. Raises ImageError.
    """
    if "compressedDepth" in message.format:
        raise ImageError(f"compressed image format {message.format!r} is a depth image; allowed: jpeg, png")
    data = _bytes_of(message.data).tobytes()
    kind = next((name for magic, name in _MAGIC.items() if data.startswith(magic)), None)
    if kind is None:
        raise ImageError(
            f"compressed image of format {message.format!r} starts with {data[:8].hex(' ') or 'nothing'}; "
            "allowed: jpeg, png"
        )
    name = f"{kind} image of {len(data)} bytes"
    if kind == "jpeg" and (scans := data.count(b"\xff\xda")) > MAX_JPEG_SCANS:
        raise ImageError(f"{name} has {scans} scans; allowed: at most {MAX_JPEG_SCANS}")
    rgb = decode_image(data, name, (kind,), enough)
    check_size(rgb.shape[1], rgb.shape[0])
    return rgb


def _bytes_of(data: Any) -> NDArray[np.uint8]:
    if isinstance(data, np.ndarray):
        return data.view(np.uint8).ravel()
    return np.frombuffer(data if isinstance(data, bytes | bytearray | memoryview) else memoryview(data), np.uint8)


def check_size(width: int, height: int) -> None:
    """Raises ImageError for a size that is not taken."""
    if not (MIN_SIDE <= width <= MAX_SIDE and MIN_SIDE <= height <= MAX_SIDE and width * height <= MAX_PIXELS):
        raise ImageError(
            f"image is {width}x{height} pixels; allowed: sides of {MIN_SIDE} to {MAX_SIDE}, at most {MAX_PIXELS} pixels"
        )
