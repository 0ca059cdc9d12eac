"""Small pictures of keyframes, for people. Bounded in bytes, oldest given up first."""

from collections import OrderedDict

import cv2
import numpy as np
from numpy.typing import NDArray

_WIDTH = 320
_QUALITY = 80


class Thumbnails:
    """JPEG pictures by keyframe id."""

    def __init__(self, budget_mb: float) -> None:
        self._budget = int(budget_mb * 1e6)
        self._pictures: OrderedDict[int, bytes] = OrderedDict()
        self._bytes = 0

    def add(self, keyframe: int, rgb: NDArray[np.uint8]) -> None:
        """Remember (H, W, 3) RGB at a width of 320 pixels."""
        if not self._budget:
            return
        height = max(1, round(rgb.shape[0] * _WIDTH / rgb.shape[1]))
        small = cv2.cvtColor(cv2.resize(rgb, (_WIDTH, height), interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2BGR)
        picture = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
        self._pictures[keyframe] = picture
        self._bytes += len(picture)
        while self._bytes > self._budget:
            self._bytes -= len(self._pictures.popitem(last=False)[1])

    def get(self, keyframe: int) -> NDArray[np.uint8] | None:
        """(h, 320, 3) RGB, or None for a keyframe whose picture is not, or no longer, kept."""
        picture = self._pictures.get(keyframe)
        if picture is None:
            return None
        return cv2.cvtColor(cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)

    def clear(self) -> None:
        self._pictures.clear()
        self._bytes = 0
