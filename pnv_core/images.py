"""Encoded images to RGB arrays: the only decoder, for files and for compressed messages. Refusals are one line.

What a picture is does not depend on the way it came: depth (`to_8_bit`), rotation (EXIF's is applied), transparency
(dropped) and size (`MAX_PIXELS`) follow one rule.
"""

import io
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from pnv_core.errors import ImageError

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".ppm", ".pgm", ".tif", ".tiff", ".webp")
MAX_PIXELS = 1 << 26  # 192 MiB as RGB; larger ones are refused from their header, before they are unpacked

_FULL_SCALES = (255, 1023, 4095, 16383, 65535)  # of 8, 10, 12, 14 and 16 bits
_HOT = 1e-3  # share of the pixels that may lie beyond the full scale: hot pixels and glints
_ORIENTATION = 0x0112  # EXIF 2.3, section 4.6.4
_BOMB_SIZE = re.compile(r".*?(\d+ pixels).*")
_UPRIGHT: dict[int, Callable[[NDArray], NDArray]] = {
    2: np.fliplr,
    3: lambda pixels: np.rot90(pixels, 2),
    4: np.flipud,
    5: lambda pixels: np.swapaxes(pixels, 0, 1),
    6: lambda pixels: np.rot90(pixels, -1),
    7: lambda pixels: np.rot90(np.swapaxes(pixels, 0, 1), 2),
    8: np.rot90,
}


def read_image(path: Path | str) -> NDArray[np.uint8]:
    """A file -> (H, W, 3) uint8 RGB. Raises ImageError naming the file and what is wrong."""
    try:
        data = Path(path).read_bytes()
    except FileNotFoundError:
        raise ImageError(f"{path}: no such image file") from None
    except IsADirectoryError:
        raise ImageError(f"{path}: is a folder; allowed: an image file") from None
    except OSError as error:
        raise ImageError(f"{path}: cannot be read ({error.strerror})") from None
    return decode_image(data, str(path))


def decode_image(
    data: bytes, name: str, formats: tuple[str, ...] | None = None, enough: tuple[int, int] | None = None
) -> NDArray[np.uint8]:
    """The bytes of an image file -> (H, W, 3) uint8 RGB, upright.

    Grey, palette, CMYK, alpha, 16-bit and float images are taken; `formats` restricts them to some of Pillow's names.
    A JPEG is decoded at a half, quarter or eighth where that is still (width, height) `enough`, in a fraction of the
    time. Raises ImageError that begins with `name`.
    """
    limit = f"allowed: up to {MAX_PIXELS // 10**6} megapixels"
    try:
        with Image.open(io.BytesIO(data), formats=formats) as image:
            if image.width * image.height > MAX_PIXELS:
                raise ImageError(f"{image.width}x{image.height} pixels; {limit}")
            if enough is not None:
                image.draft(None, enough)  # does nothing for other formats
            pixels = _pixels(image, data)
            turn = _UPRIGHT.get(image.getexif().get(_ORIENTATION, 1))
        return np.ascontiguousarray(pixels if turn is None else turn(pixels))
    except ImageError as error:
        raise ImageError(f"{name}: {error}") from None
    except UnidentifiedImageError:
        wrong = "is no image of a known kind" if data else "is empty"
        raise ImageError(f"{name}: {wrong}; allowed: {', '.join(SUFFIXES)}") from None
    except Image.DecompressionBombError as error:  # Pillow refuses the largest before their sides can be asked
        size = _BOMB_SIZE.sub(r"\1", str(error))
        raise ImageError(f"{name}: {size}; {limit}") from None
    except (OSError, SyntaxError, ValueError, cv2.error) as error:
        raise ImageError(f"{name}: cannot be decoded ({' '.join(str(error).split())[:120]})") from None


def _pixels(image: Image.Image, data: bytes) -> NDArray[np.uint8]:
    deep_colour = image.mode in ("RGB", "RGBA", "LA") and ";16" in str(getattr(image, "tile", ""))
    image.load()  # raises for a file that stops early, which OpenCV would fill with grey
    if deep_colour:  # Pillow would keep the upper bytes: black, for a 12-bit camera
        bgr: Any = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        if bgr is None:
            raise ImageError("cannot be decoded")
        return to_8_bit(bgr[:, :, 2::-1])  # what follows is alpha
    if image.mode.startswith(("I", "F")):
        return np.repeat(to_8_bit(np.asarray(image))[:, :, None], 3, axis=2)
    return np.asarray(image if image.mode == "RGB" else image.convert("RGB"))


def to_8_bit(values: NDArray[Any]) -> NDArray[np.uint8]:
    """Pixels of any depth -> 8 bits, by the smallest full scale that holds all but a thousandth of them.

    The full scales are those of 8, 10, 12, 14 and 16 bits, because 10 to 14 bit cameras leave the upper bits empty, and
    before them 1 for floats. Raises ImageError for values that are negative, not finite or mostly beyond 16 bits.
    """
    if values.dtype == np.uint8:
        return values
    if not np.isfinite(values).all() or values.min(initial=0) < 0:
        raise ImageError("holds values that are negative or not finite; allowed: 0 to 1 or 0 to 65535")
    scales = (1, *_FULL_SCALES) if values.dtype.kind == "f" else _FULL_SCALES
    hot = _HOT * values.size
    scale = next((s for s in scales if np.count_nonzero(values > s) <= hot), None)
    if scale is None:
        raise ImageError(f"holds values up to {values.max():g}; allowed: 0 to 1 or 0 to 65535")
    return cv2.convertScaleAbs(np.minimum(values, scale).astype(np.float32), alpha=255.0 / scale)


def list_images(folder: Path | str) -> list[Path]:
    """The image files of a folder in name order. Raises ImageError if there is no folder or no image in it."""
    place = Path(folder)
    if not place.is_dir():
        raise ImageError(f"{folder}: no such folder of images")
    found = sorted(p for p in place.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith("."))
    if not found:
        inner = "; its folder images may be meant" if (place / "images").is_dir() else ""
        raise ImageError(f"{folder}: holds no image{inner}; allowed: {', '.join(SUFFIXES)}")
    return found
