"""What is kept of an image to verify it: its local features as bytes, and behind them a small picture for people.

    "PNVX", N u16, height / width of the image f32, points (N, 2) u16 in 1/16384 of its width, descriptors (N, 64) int8
    in 127ths of their largest entry, then a JPEG or nothing

Little-endian; 68 bytes a feature. `test/verify/test_feature_codes.py` bounds what the codes cost. Maps saved before
there were such features hold the JPEG alone.
"""

import struct

import numpy as np
from numpy.typing import NDArray

_MAGIC = b"PNVX"
_HEAD = struct.Struct("<4sHf")
_MOST = 2000
_GRID = 16384  # steps per width of the picture; a picture is at most four times as high as wide
_DIM = 64
_EACH = 4 + _DIM
_JPEG = b"\xff\xd8"


def pack(points: NDArray[np.float32], descriptors: NDArray[np.float32], aspect: float, picture: bytes = b"") -> bytes:
    """Points (N, 2) in units of the width, unit descriptors (N, 64), height / width of the image."""
    points, descriptors = points[:_MOST], descriptors[:_MOST]
    largest = np.maximum(np.abs(descriptors).max(1, keepdims=True, initial=0), 1e-6)
    codes = np.rint(descriptors * (127 / largest)).astype(np.int8)
    places = np.rint(np.clip(points, 0, 3.999) * _GRID).astype("<u2")
    return _HEAD.pack(_MAGIC, len(points), min(aspect, 4.0)) + places.tobytes() + codes.tobytes() + picture


def packed(kept: bytes) -> bool:
    """Whether these are features, with or without a picture behind them."""
    return kept.startswith(_MAGIC)


def unpack(kept: bytes) -> tuple[NDArray[np.float32], NDArray[np.float32], float]:
    """Points, descriptors and aspect. Raises ValueError for bytes that are not whole."""
    count, aspect, end = _extent(kept)
    points = np.frombuffer(kept, "<u2", 2 * count, _HEAD.size).reshape(count, 2).astype(np.float32)
    points /= _GRID
    codes = np.frombuffer(kept[end - _DIM * count : end], np.int8).reshape(count, _DIM).astype(np.float32)
    codes /= np.maximum(np.linalg.norm(codes, axis=1, keepdims=True), 1e-6)
    return points, codes, aspect


def features_only(kept: bytes) -> bytes:
    """Without the picture. Raises ValueError for bytes that are not whole."""
    return kept[: _extent(kept)[2]]


def picture_of(kept: bytes) -> bytes:
    """The JPEG; empty where none was kept, or what was kept is damaged."""
    if kept.startswith(_JPEG):
        return kept
    try:
        return kept[_extent(kept)[2] :]
    except ValueError:
        return b""


def _extent(kept: bytes) -> tuple[int, float, int]:
    """Features, aspect, and where the features end."""
    if len(kept) < _HEAD.size or not packed(kept):
        raise ValueError(f"packed features that begin with {kept[:4]!r}; allowed: {_MAGIC!r}")
    _, count, aspect = _HEAD.unpack_from(kept)
    end = _HEAD.size + _EACH * count
    behind = kept[end : end + 2]
    if count > _MOST or not 0.0 < aspect <= 4.0 or len(kept) < end or behind not in (b"", _JPEG):
        raise ValueError(f"{len(kept)} bytes of {count} packed features of a picture {aspect:g} times as high as wide")
    return count, aspect, end
