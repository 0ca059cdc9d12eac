"""Image files to RGB arrays, with every refusal in one line."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps, UnidentifiedImageError

from pnv_core.errors import ImageError

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".ppm", ".pgm", ".tif", ".tiff", ".webp")
MAX_PIXELS = 80_000_000  # larger ones are refused from their header, before they are unpacked


def read_image(path: Path | str) -> NDArray[np.uint8]:
    """A file -> (H, W, 3) uint8 RGB. Grey, palette, alpha and 16-bit images are converted, EXIF rotation is applied.

    Raises ImageError naming the file and what is wrong.
    """
    try:
        with Image.open(path) as image:
            if image.width * image.height > MAX_PIXELS:
                raise ImageError(
                    f"{path}: {image.width}x{image.height} pixels; allowed: up to {MAX_PIXELS // 10**6} megapixels"
                )
            if image.mode in ("I;16", "I;16B", "I;16L", "I;16N", "I"):
                return np.repeat((np.asarray(image).clip(0, 65535) >> 8).astype(np.uint8)[:, :, None], 3, axis=2)
            return np.array(ImageOps.exif_transpose(image).convert("RGB"))
    except ImageError:
        raise
    except FileNotFoundError:
        raise ImageError(f"{path}: no such image file") from None
    except IsADirectoryError:
        raise ImageError(f"{path}: is a folder; allowed: an image file") from None
    except UnidentifiedImageError:
        empty = Path(path).stat().st_size == 0
        raise ImageError(f"{path}: {'is empty' if empty else 'is no image'}; allowed: {', '.join(SUFFIXES)}") from None
    except Image.DecompressionBombError:  # Pillow refuses the largest before their size can be asked
        raise ImageError(f"{path}: too many pixels; allowed: up to {MAX_PIXELS // 10**6} megapixels") from None
    except (OSError, SyntaxError, ValueError) as error:
        raise ImageError(f"{path}: cannot be decoded ({str(error)[:120]})") from None


def list_images(folder: Path | str) -> list[Path]:
    """The image files of a folder in name order. Raises ImageError if there is no folder or no image in it."""
    place = Path(folder)
    if not place.is_dir():
        raise ImageError(f"{folder}: no such folder of images")
    found = sorted(p for p in place.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith("."))
    if not found:
        raise ImageError(f"{folder}: holds no image; allowed: {', '.join(SUFFIXES)}")
    return found
