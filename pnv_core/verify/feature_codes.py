"""Local features as bytes, for keyframes that travel without their picture. N features, at most 2000.

    "PNVF", N u16, height / width of the picture f32, points (N, 2) u16 in 1/16384 of its width, then zlib of the
    RootSIFT descriptors (N, 128): four bits each of their square roots, which spreads the many small values.

Little-endian. `test/verify/test_feature_codes.py` bounds what the codes cost in inliers.
"""

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

_MAGIC = b"PNVF"
_HEAD = struct.Struct("<4sHf")
_MOST = 2000
_GRID = 16384  # steps per width of the picture; a picture is at most four times as high as wide
_LARGEST = 0.71  # square root of the largest value that is told apart; a SIFT histogram is clipped near it


def pack(points: NDArray[np.float32], descriptors: NDArray[np.float32], aspect: float) -> bytes:
    """Points (N, 2) in units of the width, unit descriptors (N, 128), height / width of the picture."""
    points, descriptors = points[:_MOST], descriptors[:_MOST]
    codes = np.rint(np.minimum(np.sqrt(descriptors) / _LARGEST, 1.0) * 15).astype(np.uint8)
    pairs = (codes[:, ::2] << 4) | codes[:, 1::2]
    places = np.rint(np.clip(points, 0, 3.999) * _GRID).astype("<u2")
    return _HEAD.pack(_MAGIC, len(points), aspect) + places.tobytes() + zlib.compress(pairs.tobytes(), 6)


def packed(picture: bytes) -> bool:
    """Whether these are features rather than a picture."""
    return picture.startswith(_MAGIC)


def unpack(codes: bytes) -> tuple[NDArray[np.float32], NDArray[np.float32], float]:
    """Points, descriptors and aspect. Raises ValueError for bytes that are not whole."""
    if len(codes) < _HEAD.size or not packed(codes):
        raise ValueError("no packed features")
    _, count, aspect = _HEAD.unpack_from(codes)
    start = _HEAD.size + 4 * count
    if count > _MOST or not 0.01 < aspect <= 4.0 or len(codes) < start:
        raise ValueError(f"{count} packed features of a picture {aspect:g} times as high as wide")
    inflate = zlib.decompressobj()
    try:
        pairs = inflate.decompress(codes[start:], 64 * count + 1)
    except zlib.error as error:
        raise ValueError(f"packed features: {error}") from error
    if len(pairs) != 64 * count:
        raise ValueError(f"{len(pairs)} bytes of packed descriptors; allowed: {64 * count}")
    points = np.frombuffer(codes, "<u2", 2 * count, _HEAD.size).reshape(count, 2).astype(np.float32)
    points /= _GRID
    both = np.frombuffer(pairs, np.uint8).reshape(count, 64)
    values = np.empty((count, 128), np.float32)
    values[:, ::2], values[:, 1::2] = both >> 4, both & 15
    values *= _LARGEST / 15
    values *= values
    values /= np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-6)
    return points.astype(np.float32), values.astype(np.float32), aspect
