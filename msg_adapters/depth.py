"""sensor_msgs/Image with depth, as REP-118 has it, to metres."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from msg_adapters.images import check_size
from pnv_core.errors import ImageError

_UNITS = {"16UC1": ("u2", 1e-3), "mono16": ("u2", 1e-3), "32FC1": ("f4", 1.0)}


def depth_of(message: Any) -> NDArray[np.float32]:
    """(H, W) metres along the optical axis; 0 or NaN where unknown. Row padding and byte order are honoured.

    Raises ImageError for another encoding, for a size no image may have, and for too few bytes.
    """
    if message.encoding not in _UNITS:
        raise ImageError(f"depth image of encoding {message.encoding!r}; allowed: {', '.join(_UNITS)}")
    code, unit = _UNITS[message.encoding]
    kind = np.dtype((">" if message.is_bigendian else "<") + code)
    check_size(message.width, message.height)
    row = message.width * kind.itemsize
    data = np.frombuffer(message.data, np.uint8)
    if message.step < row or len(data) < message.step * message.height:
        raise ImageError(f"depth image of {message.width}x{message.height} has {len(data)} bytes in rows of "
                         f"{message.step}; allowed: rows of {row} or more, all of them")  # fmt: skip
    rows = data[: message.step * message.height].reshape(message.height, message.step)[:, :row]
    return np.ascontiguousarray(rows).view(kind).astype(np.float32) * np.float32(unit)
