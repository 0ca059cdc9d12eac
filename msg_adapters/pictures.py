"""Pictures to sensor_msgs/Image."""

from array import array

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import Image


def rgb_to_message(rgb: NDArray[np.uint8], stamp_ns: int, frame_id: str) -> Image:
    """(H, W, 3) uint8 RGB -> sensor_msgs/Image of encoding rgb8."""
    height, width = rgb.shape[:2]
    message = Image(height=height, width=width, step=3 * width, encoding="rgb8")
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
    message.header.frame_id = frame_id
    message.data = array("B", np.ascontiguousarray(rgb).tobytes())  # any other type is checked byte by byte
    return message
