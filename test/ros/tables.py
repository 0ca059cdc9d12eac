"""Reads a PointCloud2 as rows, by its own fields alone."""

import struct
from typing import Any

_CODES = {1: "b", 2: "B", 3: "h", 4: "H", 5: "i", 6: "I", 7: "f", 8: "d"}  # sensor_msgs/PointField


def rows_of(message: Any) -> list[dict[str, Any]]:
    data = bytes(message.data)
    return [
        {f.name: struct.unpack_from("<" + _CODES[f.datatype], data, at + f.offset)[0] for f in message.fields}
        for at in range(0, len(data), message.point_step)
    ]
